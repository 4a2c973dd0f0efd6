"""Steps of the 40-freedom figure on a free base (46 freedoms), open and with two grips, and of the high bar's, beside MuJoCo, MJX and Pinocchio.

`python benchmarks/speed.py [case ...]` (extra `bench`) prints and writes results/speed.csv. One step is symplectic Euler of 2 ms
with all that it needs; microseconds per step and lane, the median of rounds in which all that are compared take turns, and the least and most.
XLA is told to make one kernel of a loop (README). svkc on one core is `vmap` of `svkc.step` in one program, on all cores each device has its own lanes.
Grips are hard in svkc, soft in MuJoCo and MJX. Compile seconds: trace, lower, XLA."""

import csv
import os
import pathlib
import platform
import sys
import time

# before jax makes its first program; for all that are compared
os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1000000000000"

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
BATCHES, ROUNDS = (1, 64, 1024, 16384), 7
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
        self.made = [*np.diff([*seconds, time.perf_counter()]), self.program.memory_analysis().temp_size_in_bytes / 1e6]

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


def by_mjx(model, q, v, batch: int, steps: int):
    """MJX in the precision of the moment, one device."""
    from mujoco import mjx

    put = mjx.put_model(model)
    data, step = mjx.make_data(put), lambda d: mjx.step(put, d)
    place = lambda v: data.replace(qpos=jnp.asarray(q, jnp.result_type(float)), qvel=jnp.asarray(v, jnp.result_type(float)))
    if batch == 1:
        yield "MJX", Program(scanned(step, steps), place(v[0]))
    else:
        yield "MJX", Program(scanned(jax.vmap(step), steps), jax.vmap(place)(jnp.asarray(v)))


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
        for name, run in runs.items():
            begun = time.perf_counter()
            run()
            seconds[name].append(time.perf_counter() - begun)
    return {name: np.array(x[1:]) for name, x in seconds.items()}


def compared(name: str, dtype: str, batch: int, said: set):
    """Rows of one case."""
    chain, state = figures.case(name)
    model, q, _ = figures.in_mujoco(name, chain, state)
    v, steps, runs = np.asarray(figures.lanes(chain, state, batch).v[:, : chain.nv], float), steps_for(batch), {}
    peers = [lambda *_: by_svkc(chain, state, batch, steps)]
    peers += [lambda *a: by_mujoco(*a), lambda *a: by_pinocchio(*a)] if dtype == "float64" or batch > 1 else [by_mujoco]
    peers += [by_mjx] if batch <= 1024 else []
    for peer in peers:
        try:
            runs |= dict(peer(model, q, v, batch, steps))
        except (ImportError, NotImplementedError) as missing:
            if str(missing) not in said:
                said.add(str(missing))
                print(f"left out: {missing}", flush=True)
    times = {who: seconds / steps / batch * 1e6 for who, seconds in timed(runs).items()}
    ours = min(float(np.median(x)) for who, x in times.items() if who.startswith("svkc"))
    for who, x in times.items():
        made = [f"{value:.2f}" for value in runs[who].made] if isinstance(runs[who], Program) else [""] * 4
        yield [name, dtype, batch, who, *(f"{f(x):.3g}" for f in (np.median, min, max)), f"{np.median(x) / ours:.2f}", *made]


def machine() -> dict:
    """What it was measured with."""
    cpu = [line.split(":")[1].strip() for line in open("/proc/cpuinfo") if line.startswith("model name")]
    versions = {"python": platform.python_version(), "jax": jax.__version__, "svkc": svkc.__version__, "mujoco": mujoco.__version__}
    return versions | {"backend": jax.default_backend(), "processor": cpu[0], "cores": os.cpu_count()}


def main(cases):
    """Measures, prints, writes."""
    said, table = set(), []
    print("| " + " | ".join(HEAD) + " |")
    for name in cases:
        for dtype in ("float64", "float32"):
            with jax.enable_x64(dtype == "float64"):
                for batch in BATCHES:
                    for row in compared(name, dtype, batch, said):
                        table.append(row)
                        print("| " + " | ".join(map(str, row)) + " |", flush=True)
                    jax.clear_caches()
    with (RESULTS / "speed.csv").open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([[*HEAD, *machine()], *([*row, *machine().values()] for row in table)])
    print(machine())


if __name__ == "__main__":
    main(sys.argv[1:] or figures.CASES)
