"""Steps of the 40-freedom figure on a free base (46 freedoms), open and with two grips, and of the high bar's, beside MuJoCo, MJX and Pinocchio.

`python benchmarks/speed.py [case ...] [--dtype ..] [--batch ..]` (extra `bench`) prints its rows, puts them into results/speed.csv and draws
results/speed.png. One step is symplectic Euler of 2 ms with all that it needs; microseconds per step and lane, the median of rounds in which all that are
compared take turns, and the least and most; `times svkc`: of svkc on as many cores.
XLA is told to make one kernel of a loop (README). svkc on one core is `vmap` of `svkc.step` in one program, on all cores each device has its own lanes.
Grips are hard in svkc, soft in MuJoCo and MJX. Compile seconds: trace, lower, XLA."""

import argparse
import csv
import json
import os
import pathlib
import platform
import select
import subprocess
import sys
import time

WORKER = "--mjx"
FLAGS = os.environ.get("XLA_FLAGS", "")
if WORKER in sys.argv:
    # on two cores, and now and then on one, its batches wait for one another for ever (mujoco-mjx 3.17.0, jax 0.10.1)
    os.sched_setaffinity(0, {0})
else:
    # before jax makes its first program
    os.environ["XLA_FLAGS"] = FLAGS + " --xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1000000000000"

import jax

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", os.cpu_count())

import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np
from jax.sharding import PartitionSpec

ROOT = pathlib.Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "tests"))

import figures
from figures import DT

import svkc

RESULTS = pathlib.Path(__file__).parent / "results"
BATCHES, ROUNDS, PATIENCE = (1, 64, 1024, 16384), 7, 60
HEAD = ["case", "dtype", "batch", "by", "us per step", "least", "most", "times svkc", "trace s", "lower s", "compile s", "temporary MB"]


def steps_for(batch: int) -> int:
    """Steps in one timed call: enough to be measured, not so many that it takes long."""
    return max(5, min(250, 40000 // batch))


class Program:
    """A compiled function of states, and what making it took. Called: all its steps."""

    def __init__(self, function, states):
        seconds = [time.perf_counter()]
        stages = jax.jit(function).trace(states)
        seconds.append(time.perf_counter())
        stages = stages.lower()
        seconds.append(time.perf_counter())
        self.program, self.states = stages.compile(), states
        self.made = [*np.diff([*seconds, time.perf_counter()]).tolist(), self.program.memory_analysis().temp_size_in_bytes / 1e6]

    def __call__(self):
        jax.block_until_ready(self.program(self.states))


def scanned(step, steps: int):
    """Many steps, in a loop that is compiled."""
    return lambda states: jax.lax.scan(lambda s, _: (step(s), None), states, None, length=steps)[0]


def by_svkc(chain, state, batch: int, steps: int):
    """One core, and all of them."""
    tau = jnp.zeros(chain.nv, state.q.dtype)
    run = scanned(lambda s: svkc.step(chain, s, tau, DT), steps)
    if batch == 1:
        yield "svkc", Program(run, jax.tree.map(lambda x: x[0], figures.lanes(chain, state, 1)))
        return
    states, many = figures.lanes(chain, state, batch), scanned(jax.vmap(lambda s: svkc.step(chain, s, tau, DT)), steps)
    yield "svkc, vmap on one core", Program(many, states)
    cores = jax.device_count()
    if batch % cores == 0:
        mesh = jax.make_mesh((cores,), ("lanes",))
        spread = jax.shard_map(many, mesh=mesh, in_specs=PartitionSpec("lanes"), out_specs=PartitionSpec("lanes"), check_vma=False)
        placed = jax.device_put(states, jax.sharding.NamedSharding(mesh, PartitionSpec("lanes")))
        yield "svkc, all cores", Program(spread, placed)


def by_mujoco(model, q, v, batch: int, steps: int):
    """`mj_step` on one core; `rollout` on all. Both leave their end where the next call begins anew."""
    data = mujoco.MjData(model)
    if batch == 1:

        def run():
            mujoco.mj_resetData(model, data)
            data.qpos[:], data.qvel[:] = q, v[0]
            mujoco.mj_step(model, data, steps)

        yield "MuJoCo", run
        return
    kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
    start = np.zeros((batch, mujoco.mj_stateSize(model, kind)))
    for lane in range(batch):
        data.qpos[:], data.qvel[:] = q, v[lane]
        mujoco.mj_getState(model, data, start[lane], kind)
    threads = os.cpu_count()
    pool, workers = mujoco.rollout.Rollout(nthread=threads), [mujoco.MjData(model) for _ in range(threads)]
    yield "MuJoCo rollout, all cores", lambda: pool.rollout([model] * batch, workers, start, nstep=steps)


class Mjx:
    """MJX in a process and on a core of its own, compiled as XLA does by itself."""

    def __init__(self, *case):
        env = os.environ | {"XLA_FLAGS": FLAGS}
        self.process = subprocess.Popen([sys.executable, __file__, WORKER, *map(str, case)], env=env, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        answer = json.loads(self.process.stdout.readline())
        if "missing" in answer:
            raise ImportError(answer["missing"])
        self.made = answer["made"]

    def __call__(self):
        """All its steps. TimeoutError: it does not answer."""
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        if not select.select([self.process.stdout], [], [], PATIENCE)[0]:
            self.process.kill()
            raise TimeoutError(f"MJX did not answer within {PATIENCE} s")
        self.process.stdout.readline()

    def close(self):
        """Ends the process."""
        self.process.stdin.close()
        self.process.wait()


def mjx_worker(name: str, dtype: str, batch: int, steps: int):
    """The other end of it: compiles, says what that took, and runs once for every line it reads."""
    said = os.dup(1)
    os.dup2(2, 1)
    answer = lambda x: os.write(said, (json.dumps(x) + "\n").encode())
    with jax.enable_x64(dtype == "float64"):
        try:
            from mujoco import mjx
        except ImportError as missing:
            answer({"missing": str(missing)})
            return
        chain, state = figures.case(name)
        model, q, _ = figures.in_mujoco(name, chain, state)
        v = jnp.asarray(figures.lanes(chain, state, batch).v[:, : chain.nv])
        put = mjx.put_model(model)
        data, step = mjx.make_data(put), lambda d: mjx.step(put, d)
        place = lambda v: data.replace(qpos=jnp.asarray(q, v.dtype), qvel=v)
        program = Program(scanned(step, steps), place(v[0])) if batch == 1 else Program(scanned(jax.vmap(step), steps), jax.vmap(place)(v))
        answer({"made": program.made})
        for _ in sys.stdin:
            program()
            answer("done")


def by_pinocchio(model, q, v, batch: int, steps: int):
    """The open chain's articulated bodies, the same number of calls one after another on one core: accelerations alone, called from Python."""
    import tempfile

    import pinocchio

    if model.neq or batch > 1:
        return
    with tempfile.NamedTemporaryFile("w", suffix=".xml") as file:
        file.write(pathlib.Path(figures.FIGURE).read_text())
        file.flush()
        made = pinocchio.buildModelFromMJCF(file.name)
    data, place, rate, force = made.createData(), pinocchio.neutral(made), np.ones(made.nv) * 0.1, np.zeros(made.nv)

    def run():
        for _ in range(steps):
            pinocchio.aba(made, data, place, rate, force)

    yield "Pinocchio, aba alone", run


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
    v, steps, runs = np.asarray(figures.lanes(chain, state, batch).v[:, : chain.nv], float), steps_for(batch), {}
    peers = [lambda *_: by_svkc(chain, state, batch, steps)]
    peers += [lambda *a: by_mujoco(*a), lambda *a: by_pinocchio(*a)] if dtype == "float64" or batch > 1 else [by_mujoco]
    peers += [lambda *_: [("MJX, one core", Mjx(name, dtype, batch, steps))]] if batch <= 1024 else []
    for peer in peers:
        try:
            runs |= dict(peer(model, q, v, batch, steps))
        except (ImportError, NotImplementedError) as missing:
            if str(missing) not in said:
                said.add(str(missing))
                print(f"left out: {missing}", flush=True)
    times = {who: seconds / steps / batch * 1e6 for who, seconds in timed(runs).items()}
    if "MJX, one core" in runs:
        runs["MJX, one core"].close()
    ours = {"all cores" in who: float(np.median(x)) for who, x in times.items() if who.startswith("svkc")}
    for who, x in times.items():
        made = [f"{value:.2f}" for value in runs[who].made] if isinstance(runs[who], Program | Mjx) else [""] * 4
        yield [name, dtype, batch, who, *(f"{f(x):.3g}" for f in (np.median, min, max)), f"{np.median(x) / ours.get('all cores' in who, np.nan):.2f}", *made]


def draw(table):
    """Microseconds per step and lane by lanes: a panel for each case, float32 dashed."""
    import matplotlib.pyplot as plt

    cases = list(dict.fromkeys(row[0] for row in table))
    figure, axes = plt.subplots(1, len(cases), figsize=(4 * len(cases), 4), layout="constrained", squeeze=False, sharey=True)
    kinds = {"svkc": "C0", "svkc, vmap on one core": "C0", "svkc, all cores": "C2", "MuJoCo": "C1", "MuJoCo rollout, all cores": "C3", "MJX, one core": "C4"}
    for ax, case in zip(axes[0], cases, strict=True):
        for who, color in kinds.items():
            for dtype, style in (("float64", "o-"), ("float32", "s--")):
                rows = [row for row in table if row[:2] == [case, dtype] and row[3] == who]
                if rows:
                    ax.loglog([row[2] for row in rows], [float(row[4]) for row in rows], style, color=color, markersize=4, label=f"{who}, {dtype}")
        ax.set(title=case, xlabel="lanes")
        ax.grid(alpha=0.3)
    axes[0, 0].set_ylabel("us per step and lane")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), fontsize=7, loc="outside right center")
    figure.savefig(RESULTS / "speed.png", dpi=110)


def machine() -> dict:
    """What it was measured with."""
    cpu = [line.split(":")[1].strip() for line in open("/proc/cpuinfo") if line.startswith("model name")]
    versions = {"python": platform.python_version(), "jax": jax.__version__, "svkc": svkc.__version__, "mujoco": mujoco.__version__}
    return versions | {"backend": jax.default_backend(), "processor": cpu[0], "cores": os.cpu_count()}


def main(cases, dtypes, batches):
    """Measures, prints, writes: rows of a case, a dtype and a number of lanes in place of their old ones."""
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
    if sys.argv[1:2] == [WORKER]:
        mjx_worker(*sys.argv[2:4], *map(int, sys.argv[4:]))
    else:
        parser = argparse.ArgumentParser()
        parser.add_argument("cases", nargs="*", metavar="case", help=f"of {', '.join(figures.CASES)}; none: all")
        parser.add_argument("--dtype", nargs="+", default=["float64", "float32"])
        parser.add_argument("--batch", nargs="+", type=int, default=BATCHES, help="lanes")
        options = parser.parse_args()
        main(options.cases or figures.CASES, options.dtype, options.batch)
