"""A flyball governor after IFToMM's A05 against its own equations of motion.

Its springs have 8e5 N/m, its dampers 4e4 N s/m.
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from tolerances import REFERENCE

import svkc

pytestmark = pytest.mark.slow

STIFFNESS, DAMPING, START_ANGLE = 8e5, 4e4, np.pi / 6
BALL_MASS, ARM_INERTIA, SLIDER_MASS, SHAFT_INERTIA, GRAVITY = 5.0, 0.02, 1.0, 0.1, 9.81
ARM = (
    '<body name="{0}" pos="0 0 1"><joint name="{0}" axis="0 {1} 0"/><inertial pos="0 0 -1" mass="5"'
    ' diaginertia="0.02 0.02 0.02"/></body>'
)
GOVERNOR = (
    '<mujoco><option gravity="0 0 -9.81"/><worldbody><body name="shaft"><joint name="shaft"'
    ' axis="0 0 1"/><inertial pos="0 0 0.5" mass="1" diaginertia="0.1 0.1'
    f' 0.1"/>{ARM.format("left", -1)}{ARM.format("right", 1)}<body name="slider"><joint'
    ' name="slider" type="slide" axis="0 0 1"/><inertial pos="0 0 0" mass="1" diaginertia="0.1 0.1'
    ' 0.1"/></body></body></worldbody></mujoco>'
)


def spring_length(angle, height, jnp=np):
    """Return the length of a spring, from the middle of an arm to the slider."""
    return jnp.sqrt((jnp.sin(angle) / 2) ** 2 + (height - 1 + jnp.cos(angle) / 2) ** 2)


START_HEIGHT = 0.7 - np.cos(START_ANGLE) / 2
REST_LENGTH = spring_length(START_ANGLE, START_HEIGHT)


def reference_motion(t1):
    """Return the angles of the shaft and of the arms, and the height of the slider, at t1.

    Lagrange's equations of the symmetric motion, integrated by LSODA.
    """
    inertia = lambda angle: 2 * SHAFT_INERTIA + 2 * ARM_INERTIA + 2 * BALL_MASS * np.sin(angle) ** 2
    momentum = inertia(START_ANGLE) * 2 * np.pi

    def rates(t, y):
        _, angle, height, angle_rate, height_rate = y
        length = spring_length(angle, height)
        d_angle = (
            (np.sin(angle) * np.cos(angle) / 2 - (height - 1 + np.cos(angle) / 2) * np.sin(angle))
            / 2
            / length
        )
        d_height = (height - 1 + np.cos(angle) / 2) / length
        force = STIFFNESS * (length - REST_LENGTH) + DAMPING * (
            d_angle * angle_rate + d_height * height_rate
        )
        rate = momentum / inertia(angle)
        torque = (
            BALL_MASS * np.sin(angle) * np.cos(angle) * rate**2
            - BALL_MASS * GRAVITY * np.sin(angle)
            - force * d_angle
        )
        return [
            rate,
            angle_rate,
            height_rate,
            torque / (BALL_MASS + ARM_INERTIA),
            -GRAVITY - 2 * force * d_height / SLIDER_MASS,
        ]

    return solve_ivp(
        rates, (0, t1), [0, START_ANGLE, START_HEIGHT, 0, 0], method="LSODA", rtol=1e-10, atol=1e-12
    ).y[:3, -1]


def control(t, state, args):
    """Return the joint torques of the springs and dampers."""
    lengths = lambda q: spring_length(q[1:3], q[3], jnp)
    length, pull_back = jax.vjp(lengths, state.q)
    return pull_back(
        -STIFFNESS * (length - REST_LENGTH) - DAMPING * jax.jvp(lengths, (state.q,), (state.v,))[1]
    )[0]


@pytest.fixture(scope="module")
def governor():
    """Simulate half a second of the governor, as a function of options."""
    chain = svkc.load(GOVERNOR)
    state = chain.state(
        {"left": START_ANGLE, "right": START_ANGLE, "slider": START_HEIGHT}, {"shaft": 2 * np.pi}
    )
    return lambda **kw: svkc.simulate(chain, state, 0.5, control=control, **kw)


@pytest.mark.parametrize(
    ("solver", "error", "max_steps"),
    [(None, 1e-8, 3000), (diffrax.Kvaerno5(), 5e-6, 200)],
    ids=["explicit", "implicit"],
)
def test_flyball_governor(governor, solver, error, max_steps):
    """Both kinds of solvers agree with the reference; the implicit one takes few steps."""
    traj = governor(solver=solver)
    np.testing.assert_allclose(
        traj.final.q[jnp.array([0, 1, 3])], reference_motion(0.5), atol=error
    )
    np.testing.assert_allclose(traj.final.q[1], traj.final.q[2], atol=REFERENCE)
    assert int(traj.report().accepted) < max_steps


def test_an_explicit_root_finder_is_kept(governor):
    """A root finder of the solver is not replaced by the one that svkc fills in.

    This root finder makes the solver reject far more steps.
    """
    solver = diffrax.Kvaerno5(root_finder=diffrax.VeryChord(rtol=1e-7, atol=1e-9))
    assert int(governor(solver=solver).report().accepted) > 500
