"""Error against computing time, for each integrator and stabilization, with MuJoCo for comparison.

`python benchmarks/accuracy.py [problem ...] [--only TEXT] [--drawn]` prints and writes
results/accuracy.csv and draws results/accuracy_PROBLEM.png.

The error is that at the end of the run: the root mean square over coordinates (rad, m). The
reference is a closed form, published digits, or a run of Dopri8 at rtol 1e-12, as each problem
says. Seconds are per simulated second: the median of at least five runs of a compiled program, and
of runs for half a second if they are shorter, one run at a time.
"""

import argparse
import csv
import os
import pathlib
import platform
import time

import diffrax
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

ROOT = pathlib.Path(__file__).parent.parent

import soft_loops  # first: adds the references of the tests to the path

# isort: split
import maximal
import reference_problems as reference
from munthe_kaas import MuntheKaas

import svkc
import svkc.scenes

RESULTS = pathlib.Path(__file__).parent / "results"
RUNS, LEAST_SECONDS, MAX_SECONDS = 5, 0.5, 4.0
FIXED, ADAPTIVE, SINGLE_PRECISION = (
    (3e-2, 1e-2, 3e-3, 1e-3, 3e-4),
    (1e-1, 1e-3, 1e-5, 1e-7, 1e-9, 1e-11),
    (1e-2, 1e-3, 1e-4, 1e-5),
)
INTEGRATORS = {
    "Rodrigues-Euler": (svkc.integrators.RodriguesEuler(), FIXED),
    "symplectic Euler": (svkc.integrators.SymplecticEuler(), FIXED),
    "Heun, fixed": (diffrax.Heun(), FIXED),
    "Tsit5, fixed": (diffrax.Tsit5(), FIXED),
    "Tsit5": (diffrax.Tsit5(), ADAPTIVE),
    "Dopri8": (diffrax.Dopri8(), ADAPTIVE),
    "Tsit5, Munthe-Kaas": (MuntheKaas(diffrax.Tsit5()), ADAPTIVE),
    "Dopri8, Munthe-Kaas": (MuntheKaas(diffrax.Dopri8()), ADAPTIVE),
    "Kvaerno5": (diffrax.Kvaerno5(), ADAPTIVE[1:4]),
}
# planar problems have no orientations in space
SKIPPED = {
    (name, f"{solver}, Munthe-Kaas")
    for name in ("n_four_bar", "andrews")
    for solver in ("Tsit5", "Dopri8")
}
# each is measured on problems with loops, with every integrator at some settings, and in float32
STABILIZATIONS = {
    "coordinate partitioning": {"stabilization": svkc.stabilization.CoordinatePartitioning()},
    "Baumgarte": {"stabilization": svkc.stabilization.Baumgarte()},
    "no stabilization": {"stabilization": svkc.stabilization.NoStabilization()},
}
# measured on problems with loops, with fixed steps
FAST = {
    "stabilization": svkc.stabilization.Baumgarte(),
    "dynamics": svkc.dynamics.ArticulatedBodies(),
}
FAST_LABEL = "Baumgarte, articulated bodies"
# each is measured on problems with loops, with Dopri8
METHODS = STABILIZATIONS | {
    "composite bodies": {"dynamics": svkc.dynamics.CompositeBodies()},
    "pivots fixed": {"dynamics": svkc.dynamics.CompositeBodies(hold=0.0)},
    "pivots re-selected": {"dynamics": svkc.dynamics.CompositeBodies(hold=None)},
    "articulated bodies": {"dynamics": svkc.dynamics.ArticulatedBodies()},
    "unit vectors": {"dynamics": svkc.dynamics.UnitVectors()},
}


class Problem:
    """A chain, its initial state, and reference coordinates at the end time.

    exact: the tree's coordinates at `end`. None: those of a reference run of Dopri8 at rtol 1e-12.
    torques: constant joint torques that `control` contains, by joint.
    simulate_options: further arguments of `simulate`.
    released: (time (s), names of the links) of each cut of the reference run.
    """

    def __init__(self, chain, state, end, exact=None, torques=(), **simulate_options):
        self.chain, self.state, self.end, self.simulate_options = (
            chain,
            state,
            end,
            simulate_options,
        )
        self.exact, self.torques, self.released = exact, dict(torques), []
        if exact is None and state.q.dtype == jnp.float64:
            reference_run = svkc.simulate(
                chain,
                state,
                end,
                rtol=1e-12,
                atol=1e-14,
                solver=diffrax.Dopri8(),
                max_steps=200000,
                **simulate_options,
            )
            self.exact = np.asarray(reference_run.final.q[: chain.nq])
            events = zip(
                reference_run.events.time,
                reference_run.events.which[: reference_run.events.count],
                strict=False,
            )
            self.released = [
                (float(time), simulate_options["events"][which].action.cut)
                for time, which in events
            ]

    def error(self, q) -> float:
        """Return the root mean square error of the tree's coordinates (rad, m)."""
        full = lambda tree: jnp.concatenate(
            [jnp.asarray(tree, self.state.q.dtype), self.state.q[self.chain.nq :]]
        )
        return float(
            jnp.sqrt(
                jnp.mean(
                    svkc.difference(self.chain, full(self.exact), full(q[: self.chain.nq]))[
                        : self.chain.nv
                    ]
                    ** 2
                )
            )
        )


def _top(model, case):
    """Return the problem of a top from its model and its closed form."""
    chain = svkc.load(model)
    return Problem(
        chain,
        chain.state(v={"top": case["omega0_body"]}),
        case["t_end"],
        np.array(case["quat_wxyz_body_to_world"][-1]),
    )


def heavy_top():
    """Return Lagrange's top at 20 rad/s for 3 s, with its closed form."""
    data, n = reference.load_reference("heavy_top"), reference.numbers
    model, case = data["model"], data["cases"][-1]
    return _top(
        reference.TOP_MJCF.format(
            n(model["gravity"]), n(model["com_body"]), model["mass"], n(model["inertia_com_body"])
        ),
        case,
    )


def free_top():
    """Return an asymmetric top without gravity for 10 s, with its closed form."""
    case = reference.load_reference("free_top")["cases"][-1]
    return _top(
        reference.TOP_MJCF.format("0 0 0", "0 0 0", 1, reference.numbers(case["inertia"])), case
    )


def n_four_bar(windows: int = 2):
    """Return the N four-bar with two windows for 10 s: twenty passes through singular
    configurations.
    """
    case = next(
        case for case in reference.load_reference("n_four_bar")["cases"] if case["N"] == windows
    )
    chain, state = maximal.load(reference.n_four_bar(windows))
    angle = -case["theta"][-1]
    return Problem(
        chain,
        state,
        case["t_end"],
        np.array(
            [angle if name.startswith("vert") else -angle for name in chain.dof_names[: chain.nq]]
        ),
    )


def forty_windows():
    """Return the N four-bar with forty windows: 81 bars, 40 loops."""
    return n_four_bar(40)


def andrews():
    """Return Andrews' squeezing mechanism up to 0.03 s.

    The reference is Dopri8 at rtol 1e-12, which agrees with the published digits to 1e-10.
    """
    data = reference.load_reference("andrews")
    chain, state = maximal.load(data["problem"])
    torques = {
        force["body"]: force["world"][2]
        for force in data["problem"]["forces"]
        if force["type"] == "torque"
    }
    return Problem(
        chain,
        state,
        0.03,
        torques=torques,
        control=reference.spring_control(chain, data["problem"]),
    )


def high_bar():
    """Return the high bar for 1 s: two hands on the bar, then one, then none."""
    chain, state = svkc.scenes.high_bar(ignore="limit")
    events = [svkc.at(0.5, cut="right_hand_grip"), svkc.at(0.7, cut="left_hand_grip")]
    return Problem(chain, state, 1.0, events=events)


def swing():
    """Return the swing, pushed back, until the seat is lost as the thighs slide over its edge."""
    from svkc.scenes.swing import seat_events, swing

    chain, seated = swing(ignore="limit")
    back = -jnp.array([np.cos(0.6), 0, -np.sin(0.6), 0, 0, 0])
    return Problem(
        chain,
        chain.state(seated.q[: chain.nq], {"base": back, "pivot": 0.0}),
        0.2,
        events=seat_events(chain),
    )


PROBLEMS = {
    f.__name__: f
    for f in (heavy_top, free_top, n_four_bar, andrews, high_bar, swing, forty_windows)
}


def time_runs(run, *args):
    """Return the result of run(*args) and the median of its seconds.

    The first call compiles. Calls stop after `RUNS` calls and `LEAST_SECONDS`, or `MAX_SECONDS`.
    """
    out, seconds = jax.block_until_ready(run(*args)), []
    while sum(seconds) < (LEAST_SECONDS if len(seconds) >= RUNS else MAX_SECONDS):
        start = time.perf_counter()
        jax.block_until_ready(run(*args))
        seconds.append(time.perf_counter() - start)
    return out, float(np.median(seconds))


def measure_curve(problem: Problem, label: str, solver, settings, method=None):
    """Yield the rows of one curve: one row for each step or tolerance in `settings`."""
    dtype, scale = problem.state.q.dtype, min(1.0, problem.end)

    def run(state, setting):
        steps = (
            {"dt": setting * scale}
            if set(settings) <= set(FIXED)
            else {"rtol": setting, "atol": setting / 100}
        )
        max_steps = (
            int(1.2 / FIXED[-1] * max(problem.end, 1)) + 100
            if set(settings) <= set(FIXED)
            else 20000
        )
        return svkc.simulate(
            problem.chain,
            state,
            problem.end,
            solver=solver,
            throw=False,
            max_steps=max_steps,
            **steps,
            **problem.simulate_options,
            **(method or {}),
        )

    run = jax.jit(run)
    for setting in settings:
        traj, seconds = time_runs(run, problem.state, jnp.asarray(setting, dtype))
        # without projection a run can reach its end with loops open by more than the tolerance
        report, at_end = traj.report(), bool(traj.t_final >= problem.end)
        error = problem.error(traj.final.q) if at_end else np.nan
        gap, energy = (
            float(jnp.maximum(report.gap, report.angular_gap)),
            abs(float(report.energy_drift)),
        )
        yield [
            label,
            setting,
            seconds / problem.end,
            error,
            gap,
            energy,
            int(report.accepted + report.rejected),
            svkc.RESULTS[traj.result],
        ]


def measure_mujoco(problem: Problem, name: str):
    """Yield rows of MuJoCo's integrators on this problem. Links are cut at the times of the
    reference.
    """
    for integrator in soft_loops.INTEGRATORS:
        for dt in FIXED:
            run = soft_loops.Run(
                problem, name, integrator=integrator, dt=dt * min(1.0, problem.end)
            )
            q, seconds = time_runs(run)
            failed = "" if np.isfinite(q).all() else "not finite"
            yield [
                f"MuJoCo {integrator}",
                dt,
                seconds / problem.end,
                problem.error(q),
                run.gap,
                abs(run.drift),
                run.steps,
                failed,
            ]


def list_curves(name: str, loops: bool):
    """Yield (dtype, label, solver, settings, method) of each curve of a problem.

    With loops: every integrator with every stabilization at some settings, and Dopri8 with all
    methods.
    """
    if name == "forty_windows":
        yield "float64", "Dopri8", INTEGRATORS["Dopri8"][0], (1e-8,), {}
        yield (
            "float64",
            "Dopri8, pivots re-selected",
            INTEGRATORS["Dopri8"][0],
            (1e-8,),
            METHODS["pivots re-selected"],
        )
        return
    stabilizations = STABILIZATIONS if loops else {}
    for label, (solver, settings) in INTEGRATORS.items():
        if (name, label) in SKIPPED:
            continue
        yield "float64", label, solver, settings, {}
        single = (
            settings[2:4]
            if settings is FIXED
            else SINGLE_PRECISION
            if label == "Tsit5"
            else SINGLE_PRECISION[1::2]
        )
        yield "float32", label, solver, single, {}
        for other, method in stabilizations.items():
            yield "float32", f"{label}, {other}", solver, single, method
            if label != "Dopri8":
                yield "float64", f"{label}, {other}", solver, settings[2:4], method
        if loops and settings is FIXED:
            yield "float64", f"{label}, {FAST_LABEL}", solver, FIXED, FAST
    for other, method in (METHODS if loops else {}).items():
        yield "float64", f"Dopri8, {other}", INTEGRATORS["Dopri8"][0], ADAPTIVE, method


def is_drawn(dtype: str, label: str) -> bool:
    """Return whether a curve is in the picture of its problem.

    These are each integrator, each stabilization with Dopri8, fixed steps by the fastest method,
    MuJoCo, and Tsit5 in float32.
    """
    labels = {
        *INTEGRATORS,
        *(f"Dopri8, {way}" for way in STABILIZATIONS),
        *(f"{label}, {FAST_LABEL}" for label in INTEGRATORS),
        *(f"MuJoCo {name}" for name in soft_loops.INTEGRATORS),
    }
    return label in labels and (dtype == "float64" or label == "Tsit5")


def problem_rows(name: str, measured):
    """Yield the rows of one problem, of the curves for which measured(dtype, label) is true."""
    problem = PROBLEMS[name]()
    for dtype, label, solver, settings, method in list_curves(name, bool(problem.chain.link_names)):
        if not measured(dtype, label):
            continue
        with jax.enable_x64(dtype == "float64"):
            case = problem
            if dtype == "float32":
                case = PROBLEMS[name]()
                case.exact = problem.exact
            yield from (
                [dtype, *row] for row in measure_curve(case, label, solver, settings, method)
            )
        jax.clear_caches()
    if name != "forty_windows" and any(
        measured("float64", f"MuJoCo {integrator}") for integrator in soft_loops.INTEGRATORS
    ):
        yield from (
            ["float64", *row]
            for row in measure_mujoco(problem, name)
            if measured("float64", row[0])
        )


def draw(name: str):
    """Draw error against computing time, from results/accuracy.csv."""
    import matplotlib.pyplot as plt

    with (RESULTS / "accuracy.csv").open() as file:
        table = [[*row[1:3], *map(float, row[3:6])] for row in csv.reader(file) if row[0] == name]
    figure, axes = plt.subplots(figsize=(8, 5), layout="constrained")
    points_of_curve = {}
    for dtype, label, _, seconds, error in table:
        if np.isfinite(error) and error > 0 and is_drawn(dtype, label):
            points_of_curve.setdefault((dtype, label), []).append((seconds, error))
    colors = plt.get_cmap("tab20")(np.arange(20))
    for color, ((dtype, label), points) in zip(colors, points_of_curve.items()):
        style = "s:" if "MuJoCo" in label else ("^--" if dtype == "float32" else "o-")
        legend = label + (", float32" if dtype == "float32" else "")
        axes.loglog(
            *zip(*points, strict=True),
            style,
            color=color,
            markersize=4,
            linewidth=1.2,
            label=legend,
        )
    axes.set(
        xlabel="seconds of computing per simulated second",
        ylabel="error at the end (rad, m; root mean square)",
        title=name.replace("_", " "),
    )
    axes.set_ylim(top=10)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7, loc="center left", bbox_to_anchor=(1, 0.5))
    figure.savefig(RESULTS / f"accuracy_{name}.png", dpi=110)
    plt.close(figure)


def save(name: str, measured, head, table):
    """Replace the rows of a problem in results/accuracy.csv.

    The file is read only now, because another process may have written rows of another problem.
    """
    path, other_rows = RESULTS / "accuracy.csv", []
    if path.exists():
        with path.open() as file:
            other_rows = [
                row
                for row in list(csv.reader(file))[1:]
                if row[0] != name or not measured(row[1], row[2])
            ]
    with path.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([head, *other_rows, *table])


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser()
    parser.add_argument(
        "problems", nargs="*", metavar="problem", help=f"of {', '.join(PROBLEMS)}; none: all"
    )
    parser.add_argument(
        "--only",
        default="",
        help="curves with this in their dtype and label alone, such as 'float32' or 'articulated'",
    )
    parser.add_argument("--drawn", action="store_true", help="the curves of the pictures alone")
    options = parser.parse_args()

    def measured(dtype, label):
        """Return whether the command line selects a curve."""
        return options.only in f"{dtype} {label}" and (not options.drawn or is_drawn(dtype, label))

    cpu = [
        line.split(":")[1].strip()
        for line in open("/proc/cpuinfo")
        if line.startswith("model name")
    ]
    machine = {
        "python": platform.python_version(),
        "jax": jax.__version__,
        "svkc": svkc.__version__,
        "mujoco": mujoco.__version__,
    }
    machine |= {"backend": jax.default_backend(), "processor": cpu[0], "cores": os.cpu_count()}
    head = [
        "problem",
        "dtype",
        "method",
        "dt or rtol",
        "s per s",
        "error",
        "loop gap",
        "energy drift",
        "steps",
        "result",
    ]
    print("| " + " | ".join(head) + " |")
    for name in options.problems or PROBLEMS:
        table = []
        for row in problem_rows(name, measured):
            table.append(row)
            print(
                f"| {name} | {row[0]} | {row[1]} | {row[2]:.0e} | {row[3]:.2e} | {row[4]:.1e} |"
                f" {row[5]:.1e} | {row[6]:.1e} | {row[7]} | {row[8]} |",
                flush=True,
            )
        save(
            name,
            measured,
            [*head, *machine],
            [[name, *row, *machine.values()] for row in table],
        )
        if name != "forty_windows":
            draw(name)
