"""Joints of several freedoms need fewer links and less computation (the paper's section VI).

The 40-freedom figure of the paper's Fig. 16 is measured with 12 balls and 4 hinges, and with 40
hinges. `python benchmarks/joints.py` prints and writes results/joints.csv. The two figures
alternate, so that other load slows both. The time of a batch is that of all its lanes together.
"""

import argparse
import csv
import functools
import itertools
import os
import pathlib
import platform
import time

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import svkc
from svkc.tree.spatial import quat_conjugate, quat_from_axis_angle, quat_multiply

FIGURE = pathlib.Path(svkc.__file__).parent / "scenes" / "figure40.xml"
RESULTS = pathlib.Path(__file__).parent / "results" / "joints.csv"
DT, STEPS, BATCH, COMPILES, RUNS = 1e-3, 300, 64, 7, 5


def hinges_for_balls() -> tuple[mujoco.MjSpec, list[str]]:
    """Return the figure with three hinges about x, y, z for each ball, and the balls' names."""
    spec = mujoco.MjSpec.from_file(str(FIGURE))
    balls = [joint.name for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_BALL]
    for name in balls:
        body = spec.joint(name).parent
        spec.delete(spec.joint(name))
        for letter, axis in zip("xyz", np.eye(3)):
            body.add_joint(name=f"{name}_{letter}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=axis)
    return spec, balls


def ball_state(angles, rates):
    """Return quaternion and angular velocity (body axes) of three hinges about x, y, z."""
    quat, rate = jax.jvp(
        lambda turns: functools.reduce(quat_multiply, quat_from_axis_angle(jnp.eye(3), turns)),
        (angles,),
        (rates,),
    )
    return quat, 2 * quat_multiply(quat_conjugate(quat), rate)[1:]


def matching_states(chains, balls, rng):
    """Return one random configuration and velocity as states of both figures.

    Rotations are at most 0.5 rad about each axis, far from gimbal lock.
    """
    angles, rates = rng.uniform(-0.5, 0.5, (len(balls), 3)), rng.uniform(-1, 1, (len(balls), 3))
    quats, angular_velocities = jax.vmap(ball_state)(angles, rates)
    hinges, names = (
        ["right_elbow", "left_elbow", "right_knee", "left_knee"],
        [f"{name}_{letter}" for name in balls for letter in "xyz"],
    )
    q, v = (
        dict(zip(hinges, rng.uniform(0.5, 1, 4))),
        {"base": rng.uniform(-1, 1, 6)} | dict(zip(hinges, rng.uniform(-1, 1, 4))),
    )
    with_balls = chains["balls"].state(
        q | dict(zip(balls, quats)), v | dict(zip(balls, angular_velocities))
    )
    return with_balls, chains["hinges"].state(
        q | dict(zip(names, angles.ravel())), v | dict(zip(names, rates.ravel()))
    )


def motion_difference(chains, states) -> str:
    """Return a sentence with the largest distance and angle between the two figures' bodies in 0.5
    s.
    """
    tolerances = {"rtol": 1e-10, "atol": 1e-12} if jax.config.jax_enable_x64 else {}
    runs = [
        svkc.simulate(chain, s, 0.5, ts=jnp.linspace(0, 0.5, 11), **tolerances).states
        for chain, s in zip(chains.values(), states)
    ]
    (x, a), (y, b) = (
        jax.vmap(svkc.poses, (None, 0))(chain, run) for chain, run in zip(chains.values(), runs)
    )
    angle = 2 * jnp.linalg.norm(quat_multiply(quat_conjugate(a), b)[..., 1:], axis=-1)
    return (
        f"the motions differ by {float(jnp.max(jnp.linalg.norm(x - y, axis=-1))):.1e} m,"
        f" {float(jnp.max(angle)):.1e} rad in 0.5 s"
    )


def forward(chain, s):
    """Return the state after one step of symplectic Euler."""
    v = s.v + DT * svkc.forward_dynamics(chain, s, jnp.zeros_like(s.v))
    return svkc.State(svkc.integrate(chain, s.q, DT * v), v, s.structure), None


def inverse(chain, s):
    """Return the state after one step at constant velocity, and the torques for an acceleration."""
    return svkc.State(
        svkc.integrate(chain, s.q, DT * s.v), s.v, s.structure
    ), svkc.inverse_dynamics(chain, s, s.v)


def measure(task, chains, states) -> dict[str, dict[str, list]]:
    """Return seconds of compilation and microseconds of a step: {unit: {figure: [repetitions]}}.

    The first run of a program is not counted.
    """
    times = {unit: {name: [] for name in chains} for unit in ("s to compile", "us a step")}
    for _, (name, chain) in itertools.product(range(COMPILES), chains.items()):
        jax.clear_caches()
        start = time.perf_counter()
        compiled = jax.jit(task).lower(chain, states[name]).compile()
        times["s to compile"][name].append(time.perf_counter() - start)
        for run in range(RUNS + 1):
            start = time.perf_counter()
            end, _ = jax.block_until_ready(compiled(chain, states[name]))
            if run:
                times["us a step"][name].append((time.perf_counter() - start) / STEPS * 1e6)
        assert np.isfinite(end.q).all(), f"{name}: the motion blew up"
    return times


def compare(dtype: str):
    """Yield rows: task, median, least and most of each figure, and the ratio of the medians."""
    spec, balls = hinges_for_balls()
    chains, rng = (
        {"balls": svkc.load(str(FIGURE)), "hinges": svkc.load(spec)},
        np.random.default_rng(0),
    )
    lanes = [matching_states(chains, balls, rng) for _ in range(BATCH)]
    print(
        dtype,
        [f"{len(chain.topology.parent) - 1} links with {name}" for name, chain in chains.items()],
        motion_difference(chains, lanes[0]),
        flush=True,
    )
    batched = {
        name: jax.tree.map(lambda *x: jnp.stack(x), *column)
        for name, column in zip(chains, zip(*lanes))
    }
    for step, batch in itertools.product((forward, inverse), (1, BATCH)):
        task = lambda chain, s, step=step: jax.lax.scan(
            lambda s, _: step(chain, s), s, None, length=STEPS
        )
        task, states = (
            (task, dict(zip(chains, lanes[0])))
            if batch == 1
            else (jax.vmap(task, (None, 0)), batched)
        )
        for unit, times in measure(task, chains, states).items():
            numbers = [f(times[name]) for name in chains for f in (np.median, min, max)]
            yield [
                dtype,
                f"{step.__name__} dynamics",
                batch,
                unit,
                *(f"{x:.4g}" for x in numbers),
                f"{numbers[3] / numbers[0]:.3f}",
            ]


if __name__ == "__main__":
    argparse.ArgumentParser().parse_args()
    cpu = [
        line.split(":")[1].strip()
        for line in open("/proc/cpuinfo")
        if line.startswith("model name")
    ]
    machine = {
        "python": platform.python_version(),
        "jax": jax.__version__,
        "svkc": svkc.__version__,
        "numpy": np.__version__,
    }
    machine |= {"backend": jax.default_backend(), "processor": cpu[0], "cores": os.cpu_count()}
    head = [
        "dtype",
        "task",
        "batch",
        "unit",
        *(f"{n} {x}" for n in ("balls", "hinges") for x in ("median", "min", "max")),
        "ratio",
        *machine,
    ]
    rows = []
    line = "{} {} {:>2} {:12}: balls {:>6} ({} to {}), hinges {:>6} ({} to {}), ratio {}"
    for dtype in ("float64", "float32"):
        jax.config.update("jax_enable_x64", dtype == "float64")
        for row in compare(dtype):
            rows.append([*row, *machine.values()])
            print(line.format(*row), flush=True)
    with RESULTS.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([head, *rows])
    print(machine)
