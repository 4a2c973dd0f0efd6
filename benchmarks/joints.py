"""The paper's claim for joints of several freedoms (section VI), fewer links and less computation, measured on the figure of its Fig. 16.

The same 40 joint freedoms as 12 balls and 4 hinges, and as 40 hinges. `python benchmarks/joints.py` prints a table for float64 and for float32 and
writes results/joints.csv. The two figures take turns, so that a busy machine slows both.
"""

import csv
import os
import pathlib
import platform
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import svkc
from svkc.spatial import quat_about, quat_conjugate, quat_multiply

FIGURE = pathlib.Path(svkc.__file__).parent / "scenes" / "figure40.xml"
RESULTS = pathlib.Path(__file__).parent / "results" / "joints.csv"
DT, STEPS, BATCH, TIMES, COMPILES = 1e-3, 300, 64, 15, 7
BALL = mujoco.mjtJoint.mjJNT_BALL


def hinges_for_balls() -> tuple[mujoco.MjSpec, list[str]]:
    """The figure with three hinges about x, y, z where it has a ball, and the names of the balls."""
    spec = mujoco.MjSpec.from_file(str(FIGURE))
    balls = [joint.name for joint in spec.joints if joint.type == BALL]
    for name in balls:
        joint = spec.joint(name)
        body = joint.parent
        spec.delete(joint)
        for letter, axis in zip("xyz", np.eye(3)):
            body.add_joint(name=f"{name}_{letter}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=axis)
    return spec, balls


@jax.jit
@jax.vmap
def as_ball(angles, rates):
    """Quaternion and angular velocity (body axes) of hinges about x, y, z."""

    def turn(angles):
        x, y, z = quat_about(jnp.eye(3), angles)
        return quat_multiply(quat_multiply(x, y), z)

    quat, rate = jax.jvp(turn, (angles,), (rates,))
    return quat, 2 * quat_multiply(quat_conjugate(quat), rate)[1:]


def same_state(chains, balls, rng):
    """One motion in the coordinates of both figures: turns of at most 0.5 rad about each axis, far from where three hinges lock."""
    angles, rates = rng.uniform(-0.5, 0.5, (len(balls), 3)), rng.uniform(-1, 1, (len(balls), 3))
    quats, spins = as_ball(angles, rates)
    bends = [f"{side}_{joint}" for side in ("right", "left") for joint in ("elbow", "knee")]
    q = {"base": [0, 0, 1, 1, 0, 0, 0]} | dict(zip(bends, rng.uniform(0.5, 1, 4)))
    v = {"base": rng.uniform(-1, 1, 6)} | dict(zip(bends, rng.uniform(-1, 1, 4)))
    names = [f"{name}_{letter}" for name in balls for letter in "xyz"]
    return (
        chains["balls"].state(q | dict(zip(balls, quats)), v | dict(zip(balls, spins))),
        chains["hinges"].state(q | dict(zip(names, angles.ravel())), v | dict(zip(names, rates.ravel()))),
    )


def motion_difference(chains, states) -> str:
    """The largest distance and angle between the bodies of the two figures in half a second."""
    fine = {"rtol": 1e-10, "atol": 1e-12} if jax.config.jax_enable_x64 else {}
    runs = [svkc.simulate(chain, s, 0.5, ts=jnp.linspace(0, 0.5, 11), **fine).states for chain, s in zip(chains.values(), states)]
    (x, a), (y, b) = (jax.vmap(lambda s, chain=chain: svkc.poses(chain, s))(run) for chain, run in zip(chains.values(), runs))
    turn = 2 * jnp.linalg.norm(quat_multiply(quat_conjugate(a), b)[..., 1:], axis=-1)
    return f"largest difference of the motions in 0.5 s: {float(jnp.max(jnp.linalg.norm(x - y, axis=-1))):.1e} m, {float(jnp.max(turn)):.1e} rad"


def forward(chain, state):
    """Semi-implicit Euler: the positions after STEPS forward dynamics."""

    def step(s, _):
        v = s.v + DT * svkc.forward_dynamics(chain, s, jnp.zeros_like(s.v))
        return svkc.State(svkc.integrate(chain, s.q, DT * v), v, s.structure), None

    return jax.lax.scan(step, state, None, length=STEPS)[0].q


def inverse(chain, state):
    """The summed torques of STEPS inverse dynamics along a motion of constant velocity."""

    def step(carry, _):
        q, total = carry
        tau = svkc.inverse_dynamics(chain, svkc.State(q, state.v, state.structure), state.v)
        return (svkc.integrate(chain, q, DT * state.v), total + tau), None

    return jax.lax.scan(step, (state.q, jnp.zeros_like(state.v)), None, length=STEPS)[0][1]


def measure(task, chains, states) -> dict:
    """Microseconds a step and seconds to trace and compile, [figure][repetition]."""
    compiled, times = {}, {"us": {n: [] for n in chains}, "compile s": {n: [] for n in chains}}
    for _ in range(COMPILES):
        for name, chain in chains.items():
            jax.clear_caches()
            begin = time.perf_counter()
            compiled[name] = jax.jit(task).lower(chain, states[name]).compile()
            times["compile s"][name].append(time.perf_counter() - begin)
    for i in range(TIMES + 1):
        for name, chain in chains.items():
            begin = time.perf_counter()
            out = jax.block_until_ready(compiled[name](chain, states[name]))
            assert np.isfinite(out).all()
            if i:  # the first is a warm-up
                times["us"][name].append((time.perf_counter() - begin) / STEPS * 1e6)
    return times
