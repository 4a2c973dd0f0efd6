"""The trade of speed for accuracy: error against time of computing, each integrator and each way against drift, float64 and float32, MuJoCo beside them.

`python benchmarks/accuracy.py [problem ...]` prints results/accuracy.csv and draws results/accuracy_PROBLEM.png, in about an hour. Errors are
those at the end, root mean square over coordinates (rad, m), against closed forms, published digits, or, where the reference says so, Dopri8 at
rtol 1e-12. Seconds are per simulated second, the median of five runs of a compiled program, one run at a time."""

import csv
import os
import pathlib
import platform
import sys
import time

import diffrax
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

ROOT = pathlib.Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "tests"))

import maximal  # the tests' reader of the reference problems
import test_reference as reference
from munthe_kaas import MuntheKaas

import svkc
import svkc.scenes

RESULTS, RUNS, ENOUGH = pathlib.Path(__file__).parent / "results", 5, 10.0
FIXED, ADAPTIVE, SINGLE = (1e-2, 3e-3, 1e-3, 3e-4), (1e-3, 1e-5, 1e-7, 1e-9, 1e-11), (1e-2, 1e-3, 1e-4, 1e-5)
INTEGRATORS = {
    "Rodrigues-Euler": (svkc.RodriguesEuler(), FIXED),
    "symplectic Euler": (svkc.SemiImplicitEuler(), FIXED),
    "Heun, fixed": (diffrax.Heun(), FIXED),
    "Tsit5, fixed": (diffrax.Tsit5(), FIXED),
    "Tsit5": (diffrax.Tsit5(), ADAPTIVE),
    "Dopri8": (diffrax.Dopri8(), ADAPTIVE),
    "Tsit5, Munthe-Kaas": (MuntheKaas(diffrax.Tsit5()), ADAPTIVE),
    "Dopri8, Munthe-Kaas": (MuntheKaas(diffrax.Dopri8()), ADAPTIVE),
    "Kvaerno5": (diffrax.Kvaerno5(), ADAPTIVE[:3]),
}
# with Dopri8, on what has loops
WAYS = {
    "least change": {"stabilization": svkc.Projection(change=svkc.least_change)},
    "dependent change": {"stabilization": svkc.Projection(change=svkc.dependent_change)},
    "exact": {"stabilization": svkc.Exact()},
    "Baumgarte": {"stabilization": svkc.Baumgarte()},
    "drift": {"stabilization": svkc.Drift()},
    "pivots never new": {"dynamics": svkc.Dynamics(hold=0.0)},
    "pivots always new": {"dynamics": svkc.Dynamics(hold=None)},
    "articulated bodies": {"dynamics": svkc.Dynamics(inertia=svkc.by_bodies)},
    "unit vectors": {"dynamics": svkc.Dynamics(inertia=svkc.inertia_by_unit_vectors)},
}


class Problem:
    """A chain and its start; `exact`: coordinates at `end` (None: of a fine run); what else `simulate` is to be given."""

    def __init__(self, chain, state, end, exact=None, **call):
        self.chain, self.state, self.end, self.call = chain, state, end, call
        self.exact = exact
        if exact is None and state.q.dtype == jnp.float64:
            fine = svkc.simulate(chain, state, end, rtol=1e-12, atol=1e-14, solver=diffrax.Dopri8(), max_steps=200000, **call)
            self.exact = np.asarray(fine.final.q[: chain.nq])

    def error(self, q) -> float:
        """Root mean square over the tree's coordinates."""
        full = lambda tree: jnp.concatenate([jnp.asarray(tree, self.state.q.dtype), self.state.q[self.chain.nq :]])
        return float(jnp.sqrt(jnp.mean(svkc.difference(self.chain, full(self.exact), full(q[: self.chain.nq]))[: self.chain.nv] ** 2)))


def _top(model, case):
    chain = svkc.load(model)
    return Problem(chain, chain.state(v={"top": case["omega0_body"]}), case["t_end"], np.array(case["quat_wxyz_body_to_world"][-1]))


def heavy_top():
    """Lagrange's top at 20 rad/s for 3 s: closed form."""
    data, n = reference.given("heavy_top"), reference.numbers
    model, case = data["model"], data["cases"][-1]
    return _top(reference.ROTATION.format(n(model["gravity"]), n(model["com_body"]), model["mass"], n(model["inertia_com_body"])), case)


def free_top():
    """An asymmetric top without gravity for 10 s: closed form."""
    case = reference.given("free_top")["cases"][-1]
    return _top(reference.ROTATION.format("0 0 0", "0 0 0", 1, reference.numbers(case["inertia"])), case)


def n_four_bar():
    """Two windows for 10 s, twenty times through configurations where rank drops."""
    case = next(case for case in reference.given("n_four_bar")["cases"] if case["N"] == 2)
    chain, state = maximal.load(reference.n_four_bar(2))
    angle = -case["theta"][-1]
    return Problem(chain, state, case["t_end"], np.array([angle if name.startswith("vert") else -angle for name in chain.dof_names[: chain.nq]]))


def andrews():
    """Andrews' squeezing mechanism up to 0.03 s; reference: Dopri8 at rtol 1e-12, which has the published digits to 1e-10."""
    data = reference.given("andrews")
    chain, state = maximal.load(data["problem"])
    return Problem(chain, state, 0.03, control=reference.springs(chain, data["problem"]))


def high_bar():
    """Two hands, one, none."""
    chain, state = svkc.scenes.high_bar(ignore="limit")
    events = [svkc.at(0.5, cut="right_hand_grip"), svkc.at(0.7, cut="left_hand_grip")]
    return Problem(chain, state, 1.0, events=events)


def swing():
    """The seat leaves as the thighs slide over its edge, from a swing pushed back."""
    from svkc.scenes.swing import leaving, swing

    chain, seated = swing(ignore="limit")
    back = -jnp.array([np.cos(0.6), 0, -np.sin(0.6), 0, 0, 0])
    return Problem(chain, chain.state(seated.q[: chain.nq], {"base": back, "pivot": 0.0}), 0.2, events=leaving(chain))


PROBLEMS = {f.__name__: f for f in (heavy_top, free_top, n_four_bar, andrews, high_bar, swing)}


def timed(run, *args):
    """What a run gives, and the median of its seconds; no more runs once they have taken long enough."""
    out, seconds = jax.block_until_ready(run(*args)), []
    for _ in range(RUNS):
        begun = time.perf_counter()
        jax.block_until_ready(run(*args))
        seconds.append(time.perf_counter() - begun)
        if sum(seconds) > ENOUGH:
            break
    return out, float(np.median(seconds))


def measured(problem: Problem, label: str, solver, settings, way=None):
    """Rows of one curve."""
    dtype, scale = problem.state.q.dtype, min(1.0, problem.end)

    def run(state, setting):
        steps = {"dt": setting * scale} if settings is FIXED else {"rtol": setting, "atol": setting / 100}
        bound = int(1.2 / FIXED[-1] * max(problem.end, 1)) + 100 if settings is FIXED else 20000
        return svkc.simulate(problem.chain, state, problem.end, solver=solver, throw=False, max_steps=bound, **steps, **problem.call, **(way or {}))

    run = jax.jit(run)
    for setting in settings:
        traj, seconds = timed(run, problem.state, jnp.asarray(setting, dtype))
        report, good = traj.report(), bool(traj.result == svkc.RESULTS.successful)
        error = problem.error(traj.final.q) if good else np.nan
        gap, energy = float(jnp.maximum(report.gap, report.angular_gap)), abs(float(report.energy_drift))
        yield [label, setting, seconds / problem.end, error, gap, energy, int(report.accepted + report.rejected), svkc.RESULTS[traj.result]]


def soft_n_four_bar(problem: Problem, dt: float):
    """MuJoCo's model of the four-bar, its pins soft `connect`s, and no releases."""
    xml, bodies, _, loops = maximal.mjcf(reference.n_four_bar(2))
    soft = ""
    for joint in loops:
        parent = bodies[joint["parent"]]
        anchor = parent.turn.T @ (np.array(joint["point_world0"]) - parent.place)
        soft += f'<connect body1="{joint["parent"]}" body2="{joint["child"]}" anchor="{maximal._numbers(anchor)}" solref="{2 * dt} 1"/>'
    return mujoco.MjModel.from_xml_string(xml.replace("</mujoco>", f"<equality>{soft}</equality></mujoco>")), {}


def soft_high_bar(problem: Problem, dt: float):
    """MuJoCo's model of the figure, each grip two soft `connect`s on the bar's axis, and the times they are let go."""
    spec, chain = mujoco.MjSpec.from_file(str(svkc.scenes.FOLDER / "figure16.xml")), problem.chain
    rows, s, released = {row: name for name, row in zip(chain.body_names, chain.topology.body_row)}, chain.structure, {}
    for i, name in enumerate(chain.link_names):
        turns = int(np.flatnonzero(np.asarray(s.freedoms[i]))[0])
        for side in (-0.05, 0.05):
            sites = []
            for row, place, quat in ((s.real[i], s.real_pos[i], s.real_quat[i]), (s.parent[i], s.pos[i], s.quat[i])):
                along = np.zeros(3)
                mujoco.mju_rotVecQuat(along, np.eye(3)[turns] * side, np.asarray(quat, float))
                body = rows[int(row)]
                sites.append(f"{name}{side}{body}")
                (spec.worldbody if body == "world" else spec.body(body)).add_site(name=sites[-1], pos=np.asarray(place) + along)
            pin = spec.add_equality(name=f"{name}{side}", type=mujoco.mjtEq.mjEQ_CONNECT, objtype=mujoco.mjtObj.mjOBJ_SITE, name1=sites[0], name2=sites[1])
            pin.solref = [2 * dt, 1]
    model = spec.compile()
    for event, name in zip(problem.call["events"], ("right_hand_grip", "left_hand_grip")):
        released[float(event.time)] = [i for i in range(model.neq) if model.equality(i).name.startswith(name)]
    return model, released


def in_mujoco(problem: Problem, name: str):
    """MuJoCo's integrators on the same model; loops as soft `connect`s, as stiff as twice the time step lets them be."""
    soft = {"n_four_bar": soft_n_four_bar, "high_bar": soft_high_bar}
    for integrator in ("Euler", "implicitfast", "RK4"):
        for dt in FIXED:
            dt = dt * min(1.0, problem.end)
            model, released = soft[name](problem, dt) if name in soft else (problem.chain.model.model, {})
            # whole steps to each release, and to the end
            stops = [*sorted(released), problem.end]
            steps = round(problem.end / dt) if not released else sum(round((b - a) / dt) for a, b in zip([0.0, *stops], stops))
            model.opt.timestep, model.opt.jacobian = problem.end / steps, mujoco.mjtJacobian.mjJAC_DENSE
            model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
            model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
            data, worst = mujoco.MjData(model), []

            def run(model=model, data=data, steps=steps, released=released, stops=stops, worst=worst):
                mujoco.mj_resetData(model, data)
                data.qpos[:], data.qvel[:] = problem.state.q[: model.nq], problem.state.v[: model.nv]
                worst.clear()
                for begun, stop in zip([0.0, *stops], stops):
                    mujoco.mj_step(model, data, round((stop - begun) / model.opt.timestep))
                    worst.append(float(np.abs(data.efc_pos).max()) if data.nefc else 0.0)
                    data.eq_active[released.get(stop, [])] = 0
                return data.qpos.copy()

            q, seconds = timed(run)
            failed = "" if np.isfinite(q).all() else "not finite"
            yield [f"MuJoCo {integrator}", dt / min(1.0, problem.end), seconds / problem.end, problem.error(q), max(worst), np.nan, steps, failed]


def rows(name: str):
    """All curves of one problem."""
    problem = PROBLEMS[name]()
    loops = bool(problem.chain.link_names)
    for label, (solver, settings) in INTEGRATORS.items():
        if name in ("high_bar", "swing") and label in ("Heun, fixed", "Kvaerno5"):
            continue
        if name in ("n_four_bar", "andrews") and "Munthe-Kaas" in label:
            # no orientations in space
            continue
        yield from (["float64", *row] for row in measured(problem, label, solver, settings))
    for label, way in WAYS.items() if loops else ():
        yield from (["float64", *row] for row in measured(problem, f"Dopri8, {label}", diffrax.Dopri8(), ADAPTIVE, way))
    if name not in ("andrews", "swing"):
        # (a force of the user's, and an end of contact found by its force, would be Python between MuJoCo's steps)
        yield from (["float64", *row] for row in in_mujoco(problem, name))
    with jax.enable_x64(False):
        single = PROBLEMS[name]()
        single.exact = problem.exact
        yield from (["float32", *row] for row in measured(single, "Tsit5", diffrax.Tsit5(), SINGLE))


def draw(name: str, table):
    """Error against time of computing, a curve for each way."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(8, 5), layout="constrained")
    curves = {}
    for dtype, label, _, seconds, error, *_ in table:
        if np.isfinite(error) and error > 0:
            curves.setdefault((dtype, label), []).append((seconds, error))
    colors = plt.get_cmap("tab20")(np.arange(20))
    for color, ((dtype, label), points) in zip(colors, curves.items(), strict=False):
        style = "s:" if "MuJoCo" in label else ("^--" if dtype == "float32" else "o-")
        name_of = label + (", float32" if dtype == "float32" else "")
        axes.loglog(*zip(*points, strict=True), style, color=color, markersize=4, linewidth=1.2, label=name_of)
    axes.set(xlabel="seconds of computing per simulated second", ylabel="error at the end (rad, m; root mean square)", title=name.replace("_", " "))
    axes.set_ylim(top=10)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7, loc="center left", bbox_to_anchor=(1, 0.5))
    figure.savefig(RESULTS / f"accuracy_{name}.png", dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    cpu = [line.split(":")[1].strip() for line in open("/proc/cpuinfo") if line.startswith("model name")]
    machine = {"python": platform.python_version(), "jax": jax.__version__, "svkc": svkc.__version__, "mujoco": mujoco.__version__}
    machine |= {"backend": jax.default_backend(), "processor": cpu[0], "cores": os.cpu_count()}
    head = ["problem", "dtype", "way", "dt or rtol", "s per s", "error", "loop gap", "energy drift", "steps", "result"]
    asked = sys.argv[1:] or list(PROBLEMS)
    kept = []
    if (RESULTS / "accuracy.csv").exists():
        with (RESULTS / "accuracy.csv").open() as file:
            kept = [row for row in list(csv.reader(file))[1:] if row[0] not in asked]
    print("| " + " | ".join(head) + " |")
    for name in asked:
        table = []
        for row in rows(name):
            table.append(row)
            print(
                f"| {name} | {row[0]} | {row[1]} | {row[2]:.0e} | {row[3]:.2e} | {row[4]:.1e} | {row[5]:.1e} | {row[6]:.1e} | {row[7]} | {row[8]} |", flush=True
            )
        draw(name, table)
        kept += [[name, *row, *machine.values()] for row in table]
        with (RESULTS / "accuracy.csv").open("w", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerows([[*head, *machine], *kept])
