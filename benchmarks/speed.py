"""Time of one step of svkc, MuJoCo, MJX, Pinocchio and JaxSim.

The cases are the 40-freedom figure on a free base (46 freedoms), open and with two grips, and the
high bar's figure. `python benchmarks/speed.py [case ...] [--dtype ..] [--batch ..]` prints and
writes results/speed.csv and draws results/speed.png (extra `viz`). Libraries that are not installed
(extra `bench`) are skipped.

One step is symplectic Euler of 2 ms. Rows hold microseconds per step and lane: median, least and
most of rounds in which all compared libraries alternate. `times svkc` is relative to svkc on as
many cores. XLA compiles each loop to one kernel (see README); with `--default-options` it does
not, and the rows are written to results/speed_default_options.csv, by version of jax. svkc on one
core is `vmap` of `svkc.step` in one program; on all cores each device has its own lanes. Grips are
hard in svkc, soft in MuJoCo and MJX. Compile seconds: tracing, lowering, XLA.
"""

import argparse
import csv
import os
import pathlib
import sys

import peers  # first: saves XLA_FLAGS for its processes

DEFAULT_OPTIONS = "--default-options" in sys.argv
# before XLA compiles anything
os.environ["XLA_FLAGS"] = peers.USER_XLA_FLAGS + (
    ""
    if DEFAULT_OPTIONS
    else " --xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1000000000000"
)

import jax

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", os.cpu_count())

import jax.numpy as jnp
import numpy as np
import speed_cases
from jax.sharding import PartitionSpec
from peers import mujoco_runs
from programs import Program, machine, scan_steps, time_in_turns
from speed_cases import DT

import svkc

RESULTS = pathlib.Path(__file__).parent / "results"
BATCHES = (1, 64, 1024, 16384)
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
    """Return the number of steps in one timed call."""
    return max(5, min(250, 40000 // batch))


def svkc_runs(chain, state, batch: int, steps: int):
    """Yield svkc's steps on one core and on all cores, as (label, program)."""
    tau = jnp.zeros(chain.nv, state.q.dtype)
    run = scan_steps(lambda s: svkc.step(chain, s, tau, DT), steps)
    if batch == 1:
        yield (
            "svkc",
            Program(run, jax.tree.map(lambda x: x[0], speed_cases.random_states(chain, state, 1))),
        )
        return
    states, batch_steps = (
        speed_cases.random_states(chain, state, batch),
        scan_steps(jax.vmap(lambda s: svkc.step(chain, s, tau, DT)), steps),
    )
    yield "svkc, vmap on one core", Program(batch_steps, states)
    cores = jax.device_count()
    if batch % cores == 0:
        mesh = jax.make_mesh((cores,), ("lanes",))
        sharded = jax.shard_map(
            batch_steps,
            mesh=mesh,
            in_specs=PartitionSpec("lanes"),
            out_specs=PartitionSpec("lanes"),
            check_vma=False,
        )
        sharded_states = jax.device_put(
            states, jax.sharding.NamedSharding(mesh, PartitionSpec("lanes"))
        )
        yield "svkc, all cores", Program(sharded, sharded_states)


def compare_case(name: str, dtype: str, batch: int, messages: set):
    """Yield the rows of one case."""
    chain, state = speed_cases.load_case(name)
    model, q, _ = speed_cases.mujoco_case(name, chain, state)
    v, steps, runs = (
        np.asarray(speed_cases.random_states(chain, state, batch).v[:, : chain.nv], float),
        steps_for(batch),
        {},
    )
    libraries = [
        lambda: svkc_runs(chain, state, batch, steps),
        lambda: mujoco_runs(model, q, v, batch, steps),
    ]
    if batch <= 1024:
        libraries += [
            lambda: peers.pinocchio_runs(name, chain, state, batch, steps),
            lambda: [("MJX, one core", peers.Process("mjx", name, dtype, batch, steps))],
        ]
        libraries += (
            [lambda: [("JaxSim, one core", peers.Process("jaxsim", name, dtype, batch, steps))]]
            if name == "open"
            else []
        )
    for peer in libraries:
        try:
            runs |= dict(peer())
        except (ImportError, NotImplementedError) as missing:
            if str(missing) not in messages:
                messages.add(str(missing))
                print(f"left out: {missing}", flush=True)
    times = {who: seconds / steps / batch * 1e6 for who, seconds in time_in_turns(runs).items()}
    for run in runs.values():
        if isinstance(run, peers.Process):
            run.close()
    svkc_medians = {
        "all cores" in who: float(np.median(x))
        for who, x in times.items()
        if who.startswith("svkc")
    }
    for label, x in times.items():
        compile_columns = (
            [f"{value:.2f}" for value in runs[label].compile_stats]
            if isinstance(runs[label], Program | peers.Process)
            else [""] * 4
        )
        yield [
            name,
            dtype,
            batch,
            label,
            *(f"{f(x):.3g}" for f in (np.median, min, max)),
            f"{np.median(x) / svkc_medians.get('all cores' in label, np.nan):.2f}",
            *compile_columns,
        ]


def draw(table):
    """Draw microseconds per step and lane against lanes: a panel for each case, float32 dashed."""
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


def main(cases, dtypes, batches):
    """Measure, print and write the rows of all cases, dtypes and batch sizes."""
    messages = set()
    print("| " + " | ".join(HEAD) + " |")
    for name in cases:
        for dtype in dtypes:
            with jax.enable_x64(dtype == "float64"):
                for batch in batches:
                    rows = []
                    for row in compare_case(name, dtype, batch, messages):
                        rows.append(row)
                        print("| " + " | ".join(map(str, row)) + " |", flush=True)
                    save((name, dtype, str(batch)), rows)
                    jax.clear_caches()
    print(machine())


def save(key: tuple, rows):
    """Replace rows in results/ and redraw the picture.

    The file of XLA's default options keeps the rows of other versions of jax.

    key: case, dtype and batch size of the rows.
    """
    path = RESULTS / ("speed_default_options.csv" if DEFAULT_OPTIONS else "speed.csv")
    version = len(HEAD) + list(machine()).index("jax")
    rows_of_file = []
    if path.exists():
        with path.open() as file:
            rows_of_file = [
                row
                for row in list(csv.reader(file))[1:]
                if tuple(row[:3]) != key or (DEFAULT_OPTIONS and row[version] != jax.__version__)
            ]
    rows_of_file += [[*map(str, row), *map(str, machine().values())] for row in rows]
    rows_of_file.sort(
        key=lambda row: (
            row[version],
            speed_cases.CASES.index(row[0]),
            row[1] != "float64",
            int(row[2]),
        )
    )
    with path.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([[*HEAD, *machine()], *rows_of_file])
    if not DEFAULT_OPTIONS:
        draw([[row[0], row[1], int(row[2]), *row[3:]] for row in rows_of_file])


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument(
        "cases", nargs="*", metavar="case", help=f"of {', '.join(speed_cases.CASES)}; none: all"
    )
    parser.add_argument("--dtype", nargs="+", default=["float64", "float32"])
    parser.add_argument("--batch", nargs="+", type=int, default=BATCHES, help="lanes")
    parser.add_argument("--default-options", action="store_true", help="XLA's default options")
    options = parser.parse_args()
    main(options.cases or speed_cases.CASES, options.dtype, options.batch)
