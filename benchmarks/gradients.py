"""Cost of derivatives: time and memory of a run, its gradient and its directional derivative.

High bar: 1.8 s with both releases, 198 parameters (masses, centers of mass, velocity, release
times, torques), by default, by articulated bodies, and without the parameters of the masses. Open
chain: the same figure in free fall, alone and 64 by `vmap`, 200 steps of 2 ms of the classical
Runge-Kutta method, 198 parameters (velocity, torques). The open chain is compared with MJX's
gradient of the same steps, and with central differences of MuJoCo runs. Both hold the torque
constant during a step, at its value in the middle. All three gradients are compared.

`python benchmarks/gradients.py` (extra `bench`) prints and writes results/gradients.csv. float64.
Times are medians; programs that are compared alternate.
"""

import argparse
import csv
import os
import pathlib
import platform
import statistics
import time

os.environ.setdefault("JAX_PLATFORMS", "cpu")

import jax

jax.config.update("jax_enable_x64", True)

import diffrax
import equinox as eqx
import jax.numpy as jnp
import mujoco
import numpy as np

import svkc
from svkc.scenes import FOLDER, high_bar

RESULTS = pathlib.Path(__file__).parent / "results" / "gradients.csv"
RUNS, STEPS, DT, LANES = 7, 200, 2e-3, 64
RUNGE_KUTTA_4 = diffrax.ButcherTableau(
    c=np.array([0.5, 0.5, 1.0]), b_sol=np.array([1, 2, 2, 1]) / 6, b_error=np.zeros(4),
    a_lower=(np.array([0.5]), np.array([0.0, 0.5]), np.array([0.0, 0.0, 1.0])),
)  # fmt: skip


class ClassicalRungeKutta(diffrax.AbstractERK):
    """The classical Runge-Kutta method, MuJoCo's RK4."""

    tableau = RUNGE_KUTTA_4
    interpolation_cls = diffrax.ThirdOrderHermitePolynomialInterpolation.from_k

    def order(self, terms):
        return 4


def high_bar_loss(**options):
    """Return (loss, parameters) of the high bar with both hands released.

    options: keyword arguments of `simulate`.
    """
    chain, state = high_bar()
    ts = jnp.linspace(0, 1.8, 73)

    def loss(p):
        c = chain
        if "mass" in p:
            floats = (
                chain.mass * p["mass"],
                chain.inertia * p["mass"][:, None, None],
                chain.com * p["com"],
            )
            c = eqx.tree_at(lambda c: (c.mass, c.inertia, c.com), chain, floats)
        start = svkc.State(state.q, state.v + p["v"], state.structure)
        events = (
            svkc.at(p["times"][0], cut="right_hand_grip"),
            svkc.at(p["times"][1], cut="left_hand_grip"),
        )
        control = lambda t, s, a: jnp.pad(
            a @ jnp.sin(jnp.arange(1.0, 7.0) * t), (6, chain.dofs - 22)
        )
        traj = svkc.simulate(
            c,
            start,
            1.8,
            ts=ts,
            events=events,
            rtol=1e-8,
            atol=1e-10,
            control=control,
            args=p["torque"],
            throw=False,
            **options,
        )
        return jnp.sum(traj.final.q[:3]) + 0.1 * jnp.sum(traj.states.q[40])

    bodies = chain.mass.shape[0]
    parameters = {
        "mass": jnp.ones(bodies),
        "com": jnp.ones((bodies, 3)),
        "v": jnp.zeros(chain.dofs),
        "times": jnp.array([0.9, 1.15]),
    }
    return loss, parameters | {"torque": jnp.full((16, 6), 5.0)}


def joint_torques(coefficients, t, pad):
    """Return joint torques at time t: sums of eleven sines."""
    return pad(
        (
            coefficients @ np.sin(np.arange(1, 12) * t)
            if isinstance(t, float)
            else coefficients @ jnp.sin(jnp.arange(1, 12) * t)
        ),
        (6, 0),
    )


def falling_spec():
    """Return MuJoCo's model of the figure without contacts and joint ranges."""
    spec = mujoco.MjSpec.from_file(str(FOLDER / "figure16.xml"))
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
    spec.option.timestep = DT
    spec.option.disableflags |= (
        mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_CONTACT
    )
    return spec


def falling_loss():
    """Return (loss, parameters) of the open chain in svkc."""
    chain = svkc.load(falling_spec(), ignore=("limit", "contact"))
    state = chain.state()

    def loss(p):
        control = lambda t, s, a: joint_torques(a, t, jnp.pad)
        start = svkc.State(state.q, p["v"], state.structure)
        traj = svkc.simulate(
            chain,
            start,
            STEPS * DT,
            dt=DT,
            control=control,
            args=p["torque"],
            solver=ClassicalRungeKutta(),
            max_steps=STEPS + 2,
            throw=False,
        )
        return jnp.sum(traj.final.q[:7])

    return loss, {"v": jnp.zeros(22), "torque": jnp.ones((16, 11))}


def falling_loss_mjx():
    """Return the loss of the open chain in MJX, with equal steps."""
    from mujoco import mjx

    model = mjx.put_model(falling_spec().compile())
    data = mjx.make_data(model)

    def loss(p):
        def step(data, i):
            return (
                mjx.step(
                    model,
                    data.replace(qfrc_applied=joint_torques(p["torque"], (i + 0.5) * DT, jnp.pad)),
                ),
                None,
            )

        return jnp.sum(jax.lax.scan(step, data.replace(qvel=p["v"]), jnp.arange(STEPS))[0].qpos[:7])

    return loss


def falling_loss_mujoco():
    """Return the loss of the open chain in MuJoCo, and its gradient by central differences."""
    model = falling_spec().compile()
    data = mujoco.MjData(model)

    def loss(v, u):
        mujoco.mj_resetData(model, data)
        data.qvel[:] = v
        for i in range(STEPS):
            data.qfrc_applied[:] = joint_torques(u, (i + 0.5) * DT, np.pad)
            mujoco.mj_step(model, data)
        return data.qpos[:7].sum()

    def gradient(p, h=1e-6):
        x = np.concatenate([np.ravel(p["v"]), np.ravel(p["torque"])])
        at = lambda x: loss(x[:22], x[22:].reshape(16, 11))
        return np.array([(at(x + h * e) - at(x - h * e)) / (2 * h) for e in np.eye(len(x))])

    return lambda p: loss(np.asarray(p["v"]), np.asarray(p["torque"])), gradient


def compile_program(function, p):
    """Return the program, seconds of tracing and lowering, seconds of compilation, temporary memory
    (MB).
    """
    start = time.perf_counter()
    lowered = jax.jit(function).lower(p)
    lowered_at = time.perf_counter()
    program = lowered.compile()
    return (
        program,
        lowered_at - start,
        time.perf_counter() - lowered_at,
        program.memory_analysis().temp_size_in_bytes / 1e6,
    )


def time_in_turns(programs, p, runs=RUNS):
    """Return the median seconds of each program. Programs alternate."""
    times = {name: [] for name in programs}
    for _ in range(runs + 1):
        for name, program in programs.items():
            start = time.perf_counter()
            jax.block_until_ready(program(p))
            times[name].append(time.perf_counter() - start)
    return {name: statistics.median(seconds[1:]) for name, seconds in times.items()}


def measure_case(case, loss, p, peers=()):
    """Return rows of one case, for svkc and the other libraries, and the gradients by library.

    The rows are the run, its gradient, and (svkc alone) its directional derivative.
    """
    tangent = jax.tree.map(jnp.ones_like, p)
    kinds = {
        "run": loss,
        "gradient": jax.value_and_grad(loss),
        "directional": lambda p: jax.jvp(loss, (p,), (tangent,)),
    }
    compiled = {("svkc", kind): compile_program(f, p) for kind, f in kinds.items()}
    for peer, peer_loss in peers:
        compiled |= {
            (peer, kind): compile_program(f, p)
            for kind, f in (("run", peer_loss), ("gradient", jax.value_and_grad(peer_loss)))
        }
    seconds = time_in_turns({name: program for name, (program, *_) in compiled.items()}, p)
    rows = []
    for (library, kind), (_, trace_seconds, compile_time, memory) in compiled.items():
        ratio = seconds[library, kind] / seconds[library, "run"]
        rows.append(
            [
                case,
                library,
                kind,
                f"{1e3 * seconds[library, kind]:.1f}",
                f"{ratio:.2f}",
                f"{trace_seconds:.1f}",
                f"{compile_time:.1f}",
                f"{memory:.1f}",
            ]
        )
    return rows, {
        who: program(p)[1] for (who, kind), (program, *_) in compiled.items() if kind == "gradient"
    }


def as_vector(gradient):
    """Return a gradient as one vector."""
    return np.concatenate([np.ravel(gradient["v"]), np.ravel(gradient["torque"])])


def main():
    """Measure, print and write all cases."""
    loss, p = high_bar_loss()
    count = sum(x.size for x in jax.tree.leaves(p))
    rows, _ = measure_case(f"high bar, {count} parameters", loss, p)
    articulated = high_bar_loss(dynamics=svkc.dynamics.ArticulatedBodies())[0]
    rows += measure_case("high bar, articulated bodies", articulated, p)[0]
    known = {name: x for name, x in p.items() if name not in ("mass", "com")}
    count = sum(x.size for x in jax.tree.leaves(known))
    rows += measure_case(f"high bar, masses known, {count} parameters", loss, known)[0]
    loss, p = falling_loss()
    count = sum(x.size for x in jax.tree.leaves(p))
    try:
        peers = [("MJX", falling_loss_mjx())]
    except ImportError as missing:
        peers = []
        print(f"no MJX: {missing}; pip install 'svkc[bench]'")
    open_chain_rows, gradients = measure_case(f"open chain, {count} parameters", loss, p, peers)
    batch_parameters = jax.tree.map(
        lambda x: x + 0.01 * jax.random.normal(jax.random.key(0), (LANES, *x.shape)), p
    )
    open_chain_rows += measure_case(
        f"open chain, {LANES} lanes", lambda many: jnp.sum(jax.vmap(loss)(many)), batch_parameters
    )[0]
    value, by_differences = falling_loss_mujoco()
    run_seconds = time_in_turns({"run": lambda p: value(p)}, p)["run"]
    gradient_seconds = time_in_turns({"gradient": lambda p: by_differences(p)}, p, runs=1)[
        "gradient"
    ]
    gradients = {who: as_vector(g) for who, g in gradients.items()} | {"MuJoCo": by_differences(p)}
    for kind, seconds in (("run", run_seconds), ("gradient", gradient_seconds)):
        open_chain_rows.append(
            [
                f"open chain, {count} parameters",
                "MuJoCo, differences",
                kind,
                f"{1e3 * seconds:.1f}",
                f"{seconds / run_seconds:.2f}",
                "",
                "",
                "",
            ]
        )
    head = [
        "case",
        "by",
        "what",
        "ms",
        "times its run",
        "trace and lower s",
        "compile s",
        "temporary MB",
    ]
    for row in (head, *rows, *open_chain_rows):
        print(
            "  ".join(
                cell.ljust(width) for cell, width in zip(row, (28, 20, 12, 10, 14, 18, 10, 12))
            )
        )
    for who, g in gradients.items():
        if who != "svkc":
            print(
                f"gradient of the open chain: {who} differs from svkc by"
                f" {np.abs(g - gradients['svkc']).max() / np.abs(g).max():.1e} of the largest entry"
            )
    versions = (
        f"jax {jax.__version__}, mujoco {mujoco.__version__}, Python {platform.python_version()},"
        f" {os.cpu_count()} cores {platform.machine()}"
    )
    print(versions)
    RESULTS.parent.mkdir(exist_ok=True)
    with RESULTS.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([head, *rows, *open_chain_rows, [versions]])


if __name__ == "__main__":
    argparse.ArgumentParser().parse_args()
    main()
