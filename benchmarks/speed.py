"""Steps of the 40-freedom figure on a free base (46 freedoms), open and with two grips, and of the
high bar's, beside MuJoCo, MJX, Pinocchio and JaxSim.

`python benchmarks/speed.py [case ...] [--dtype ..] [--batch ..]` prints its rows, puts them into
results/speed.csv and draws results/speed.png (extra `viz`). Peers that are not installed (extra
`bench`) are left out. One step is symplectic Euler of 2 ms with all that it needs; microseconds per
step and lane, the median of rounds in which all that are compared take turns, and the least and
most; `times svkc`: of svkc on as many cores.
XLA is told to make one kernel of a loop (README). svkc on one core is `vmap` of `svkc.step` in one
program, on all cores each device has its own lanes. Grips are hard in svkc, soft in MuJoCo and MJX.
Compile seconds: trace, lower, XLA."""

import argparse
import csv
import os
import pathlib
import platform
import time

import peers  # first: its own processes go without the next line

# before jax makes its first program
os.environ["XLA_FLAGS"] = (
    peers.FLAGS
    + " --xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1000000000000"
)

import jax

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", os.cpu_count())

import figures
import jax.numpy as jnp
import mujoco
import numpy as np
from figures import DT
from jax.sharding import PartitionSpec
from peers import by_mujoco
from programs import Program, scanned

import svkc

RESULTS = pathlib.Path(__file__).parent / "results"
BATCHES, ROUNDS = (1, 64, 1024, 16384), 7
HEAD = [
    "case",
    "dtype",
    "batch",
    "by",
    "us per step",
    "least",
    "most",
    "times svkc",
    "trace s",
    "lower s",
    "compile s",
    "temporary MB",
]


def steps_for(batch: int) -> int:
    """Steps in one timed call: enough to be measured, not so many that it takes long."""
    return max(5, min(250, 40000 // batch))


def by_svkc(chain, state, batch: int, steps: int):
    """One core, and all of them."""
    tau = jnp.zeros(chain.nv, state.q.dtype)
    run = scanned(lambda s: svkc.step(chain, s, tau, DT), steps)
    if batch == 1:
        yield "svkc", Program(run, jax.tree.map(lambda x: x[0], figures.lanes(chain, state, 1)))
        return
    states, many = (
        figures.lanes(chain, state, batch),
        scanned(jax.vmap(lambda s: svkc.step(chain, s, tau, DT)), steps),
    )
    yield "svkc, vmap on one core", Program(many, states)
    cores = jax.device_count()
    if batch % cores == 0:
        mesh = jax.make_mesh((cores,), ("lanes",))
        spread = jax.shard_map(
            many,
            mesh=mesh,
            in_specs=PartitionSpec("lanes"),
            out_specs=PartitionSpec("lanes"),
            check_vma=False,
        )
        placed = jax.device_put(states, jax.sharding.NamedSharding(mesh, PartitionSpec("lanes")))
        yield "svkc, all cores", Program(spread, placed)


def timed(runs: dict) -> dict[str, np.ndarray]:
    """Seconds of each, in turns; a first one is left out."""
    seconds = {name: [] for name in runs}
    for _ in range(ROUNDS + 1):
        for name, run in list(runs.items()):
            begun = time.perf_counter()
            try:
                run()
            except TimeoutError as late:
                print(f"left out: {late}", flush=True)
                del runs[name]
                continue
            seconds[name].append(time.perf_counter() - begun)
    return {name: np.array(seconds[name][1:]) for name in runs}


def compared(name: str, dtype: str, batch: int, said: set):
    """Rows of one case."""
    chain, state = figures.case(name)
    model, q, _ = figures.in_mujoco(name, chain, state)
    v, steps, runs = (
        np.asarray(figures.lanes(chain, state, batch).v[:, : chain.nv], float),
        steps_for(batch),
        {},
    )
    them = [
        lambda: by_svkc(chain, state, batch, steps),
        lambda: by_mujoco(model, q, v, batch, steps),
    ]
    if batch <= 1024:
        them += [
            lambda: peers.by_pinocchio(name, chain, state, batch, steps),
            lambda: [("MJX, one core", peers.Process("mjx", name, dtype, batch, steps))],
        ]
        them += (
            [lambda: [("JaxSim, one core", peers.Process("jaxsim", name, dtype, batch, steps))]]
            if name == "open"
            else []
        )
    for peer in them:
        try:
            runs |= dict(peer())
        except (ImportError, NotImplementedError) as missing:
            if str(missing) not in said:
                said.add(str(missing))
                print(f"left out: {missing}", flush=True)
    times = {who: seconds / steps / batch * 1e6 for who, seconds in timed(runs).items()}
    for run in runs.values():
        if isinstance(run, peers.Process):
            run.close()
    ours = {
        "all cores" in who: float(np.median(x))
        for who, x in times.items()
        if who.startswith("svkc")
    }
    for who, x in times.items():
        made = (
            [f"{value:.2f}" for value in runs[who].made]
            if isinstance(runs[who], Program | peers.Process)
            else [""] * 4
        )
        yield [
            name,
            dtype,
            batch,
            who,
            *(f"{f(x):.3g}" for f in (np.median, min, max)),
            f"{np.median(x) / ours.get('all cores' in who, np.nan):.2f}",
            *made,
        ]


def draw(table):
    """Microseconds per step and lane by lanes: a panel for each case, float32 dashed."""
    import matplotlib.pyplot as plt

    cases = list(dict.fromkeys(row[0] for row in table))
    figure, axes = plt.subplots(
        1, len(cases), figsize=(4 * len(cases), 4), layout="constrained", squeeze=False, sharey=True
    )
    kinds = {
        "svkc": "C0",
        "svkc, vmap on one core": "C0",
        "svkc, all cores": "C2",
        "MuJoCo": "C1",
        "MuJoCo rollout, all cores": "C3",
        "MJX, one core": "C4",
        "JaxSim, one core": "C5",
    }
    for ax, case in zip(axes[0], cases, strict=True):
        for who, color in kinds.items():
            for dtype, style in (("float64", "o-"), ("float32", "s--")):
                rows = [row for row in table if row[:2] == [case, dtype] and row[3] == who]
                if rows:
                    ax.loglog(
                        [row[2] for row in rows],
                        [float(row[4]) for row in rows],
                        style,
                        color=color,
                        markersize=4,
                        label=f"{who}, {dtype}",
                    )
        ax.set(title=case, xlabel="lanes")
        ax.grid(alpha=0.3)
    axes[0, 0].set_ylabel("us per step and lane")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), fontsize=7, loc="outside right center")
    figure.savefig(RESULTS / "speed.png", dpi=110)


def machine() -> dict:
    """What it was measured with."""
    cpu = [
        line.split(":")[1].strip()
        for line in open("/proc/cpuinfo")
        if line.startswith("model name")
    ]
    versions = {
        "python": platform.python_version(),
        "jax": jax.__version__,
        "svkc": svkc.__version__,
        "mujoco": mujoco.__version__,
    }
    return versions | {
        "backend": jax.default_backend(),
        "processor": cpu[0],
        "cores": os.cpu_count(),
    }


def main(cases, dtypes, batches):
    """Measures, prints, writes: rows of a case, a dtype and a number of lanes in place of their old
    ones."""
    said = set()
    print("| " + " | ".join(HEAD) + " |")
    for name in cases:
        for dtype in dtypes:
            with jax.enable_x64(dtype == "float64"):
                for batch in batches:
                    rows = []
                    for row in compared(name, dtype, batch, said):
                        rows.append(row)
                        print("| " + " | ".join(map(str, row)) + " |", flush=True)
                    save((name, dtype, str(batch)), rows)
                    jax.clear_caches()
    print(machine())


def save(key: tuple, rows):
    """In the file of all, and in its picture."""
    path = RESULTS / "speed.csv"
    with path.open() as file:
        kept = [row for row in list(csv.reader(file))[1:] if tuple(row[:3]) != key]
    kept += [[*map(str, row), *map(str, machine().values())] for row in rows]
    kept.sort(key=lambda row: (figures.CASES.index(row[0]), row[1] != "float64", int(row[2])))
    with path.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([[*HEAD, *machine()], *kept])
    draw([[row[0], row[1], int(row[2]), *row[3:]] for row in kept])


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument(
        "cases", nargs="*", metavar="case", help=f"of {', '.join(figures.CASES)}; none: all"
    )
    parser.add_argument("--dtype", nargs="+", default=["float64", "float32"])
    parser.add_argument("--batch", nargs="+", type=int, default=BATCHES, help="lanes")
    options = parser.parse_args()
    main(options.cases or figures.CASES, options.dtype, options.batch)
