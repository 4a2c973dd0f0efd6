"""Runs of scenes by default options, beside those of another checkout.

`python benchmarks/scenes.py [SCENE ...] --beside FOLDER` prints and writes results/scenes.csv.
FOLDER is a checkout of an older version, which runs by default and, where it has loops, by
articulated bodies: the better of the two is its best way. Each version runs in its own process, and
the processes take turns.

Columns: milliseconds of a run (median, least); attempted steps; the root mean square distance of
the final coordinates from those of this checkout, which means nothing in chaotic scenes; the median
over rounds of this checkout's time divided by that of the row.
"""

import argparse
import csv
import json
import os
import pathlib
import subprocess
import sys
import time

HERE = pathlib.Path(__file__).resolve().parent
ROUNDS = 7
HEAD = ["scene", "version", "method", "ms", "least ms", "attempts", "distance", "ratio"]
SCENES = (
    "high_bar",
    "high_bar_ranges",
    "swing",
    "brachiation",
    "n_four_bar",
    "forty_windows",
    "andrews",
    "stewart",
    "two_feet",
)


class Scene:
    """A chain, its initial state, the end time and options of `simulate`."""

    def __init__(self, chain, state, end, exact=None, torques=(), **options):
        self.chain, self.state, self.end, self.options = chain, state, end, options


def scene(name: str) -> Scene:
    """Return a scene, built by the checkout whose folders come first in the path."""
    import accuracy
    import jax.numpy as jnp
    import models

    import svkc
    from svkc.scenes.brachiation import brachiation
    from svkc.scenes.walking import walking

    accuracy.Problem = Scene  # without a reference run
    cuts = lambda first, second: [
        svkc.at(first, cut="right_hand_grip"),
        svkc.at(second, cut="left_hand_grip"),
    ]
    if name == "high_bar":
        return Scene(*svkc.scenes.high_bar(ignore="limit"), 10.0, events=cuts(8.0, 9.0))
    if name == "high_bar_ranges":
        return Scene(*svkc.scenes.high_bar(), 1.8, events=cuts(0.9, 1.1))
    if name == "brachiation":
        return Scene(*brachiation(), 0.5)
    if name == "stewart":
        chain = models.stewart()
        return Scene(chain, chain.state(), 0.5)
    if name == "two_feet":
        chain, state = walking()
        events = [svkc.at(0.2, cut="left_foot_ground")]
        return Scene(chain, state, 0.4, events=events, control=lambda t, s, a: jnp.zeros(chain.nv))
    return accuracy.PROBLEMS[name]()


def work(name: str, method: str) -> None:
    """Run a scene once for each line of the input, and print seconds, counts and coordinates."""
    import jax

    jax.config.update("jax_enable_x64", True)
    import svkc

    own = scene(name)
    options = {"rtol": 1e-8, "atol": 1e-10, "max_steps": 100000, "throw": False} | own.options
    if method == "articulated bodies":
        options["dynamics"] = svkc.dynamics.ArticulatedBodies()
    run = jax.jit(lambda state: svkc.simulate(own.chain, state, own.end, **options))
    traj = jax.block_until_ready(run(own.state))
    for _ in sys.stdin:
        start = time.perf_counter()
        jax.block_until_ready(run(own.state))
        answer = {
            "seconds": time.perf_counter() - start,
            "attempts": int(traj.phases.accepted.sum() + traj.phases.rejected.sum()),
            "q": traj.final.q[: own.chain.nq].tolist(),
            "result": str(traj.result),
        }
        print(json.dumps(answer), flush=True)


class Worker:
    """A process that runs a scene of one checkout."""

    def __init__(self, folder: pathlib.Path, name: str, method: str):
        parts = (folder, folder / "benchmarks", folder / "tests", folder / "tests" / "references")
        path = os.pathsep.join(map(str, parts))
        self.process = subprocess.Popen(
            [sys.executable, __file__, name, "--work", method],
            env=os.environ | {"PYTHONPATH": path},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.answers: list[dict] = []

    def run(self) -> None:
        """Run the scene once more."""
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        self.answers.append(json.loads(self.process.stdout.readline()))

    def seconds(self) -> list[float]:
        """Return the seconds of all runs but the first."""
        return [answer["seconds"] for answer in self.answers[1:]]


def measure(name: str, versions: list[tuple[str, pathlib.Path, str]]):
    """Yield the rows of a scene. versions: name, folder and method of each."""
    import numpy as np

    workers = [Worker(folder, name, method) for _, folder, method in versions]
    for _ in range(ROUNDS + 1):
        for worker in workers:
            worker.run()
    first = np.array(workers[0].seconds())
    before = np.array(workers[0].answers[0]["q"])
    for worker, (version, _, method) in zip(workers, versions, strict=True):
        answer, own = worker.answers[0], np.array(worker.seconds())
        distance = np.sqrt(np.mean((np.array(answer["q"]) - before) ** 2))
        failed = "" if "successful" in answer["result"].lower() else f" ({answer['result']})"
        yield [
            name,
            version,
            method + failed,
            f"{1e3 * np.median(own):.3g}",
            f"{1e3 * np.min(own):.3g}",
            answer["attempts"],
            f"{distance:.1e}",
            f"{np.median(first / own):.2f}",
        ]
        worker.process.stdin.close()
        worker.process.wait()


def main(names, beside: pathlib.Path | None) -> None:
    """Measure, print and write all rows."""
    from programs import machine

    versions = [("this", HERE.parent, "default")]
    if beside:
        versions += [("before", beside, way) for way in ("default", "articulated bodies")]
    path = HERE / "results" / "scenes.csv"
    table = []
    if path.exists():
        with path.open() as file:
            table = [row for row in list(csv.reader(file))[1:] if row[0] not in names]
    print("| " + " | ".join(HEAD) + " |")
    for name in names:
        for row in measure(name, versions):
            table.append([*map(str, row), *map(str, machine().values())])
            print("| " + " | ".join(map(str, row)) + " |", flush=True)
        table.sort(key=lambda row: SCENES.index(row[0]))
        with path.open("w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([[*HEAD, *machine()], *table])


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("scenes", nargs="*", metavar="scene", help=f"of {', '.join(SCENES)}")
    parser.add_argument("--beside", type=pathlib.Path, help="another checkout")
    parser.add_argument("--work", metavar="METHOD", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.work:
        work(options.scenes[0], options.work)
    else:
        main(options.scenes or SCENES, options.beside and options.beside.resolve())
