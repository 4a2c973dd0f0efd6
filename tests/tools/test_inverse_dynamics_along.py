"""Inverse dynamics along paths: round trips through forward dynamics, MuJoCo, power, derivatives.

Closed chains are a four-bar with a motor and a Stewart platform with six.
"""

import re

import cases
import equinox as eqx
import jax
import jax.numpy as jnp
import models
import mujoco
import numpy as np
import pytest
from scipy.interpolate import CubicSpline, make_interp_spline
from tolerances import DIFFERENCE, REFERENCE, ROUND_OFF

import svkc
from svkc.tools.quintic_spline import spline_derivatives
from svkc.tree.configuration import configuration_derivative
from svkc.tree.spatial import quat_exp

TIMES = jnp.linspace(0.0, 2.0, 41)
CRANK = 0.3 * jnp.sin(2 * TIMES)


@pytest.fixture(scope="module")
def four_bar():
    """Return a four-bar whose crank has a motor, with a damper."""
    text = models.MJCF.format(models.FOUR_BAR).replace('damping="0"', 'damping="0.1"', 1)
    motor = '<actuator><motor joint="crank"/></actuator></mujoco>'
    return svkc.load(text.replace("</mujoco>", motor), virtual_links=[models.pin()])


@pytest.mark.parametrize(
    "count", [4, *(pytest.param(n, marks=pytest.mark.slow) for n in (5, 6, 7, 30))]
)
def test_spline_of_a_polynomial_is_exact(count):
    """For times at unequal distances, by all that so many points determine."""
    rng = np.random.default_rng(count)
    ts = np.cumsum(rng.uniform(0.5, 1.5, count)) / count
    curve = np.polynomial.Polynomial(rng.normal(size=min(count, 6)))
    first, second = spline_derivatives(jnp.asarray(ts), jnp.asarray(curve(ts))[:, None])
    np.testing.assert_allclose(first[:, 0], curve.deriv()(ts), atol=1e3 * ROUND_OFF)
    # second differences multiply round-off by the squared number of times
    np.testing.assert_allclose(second[:, 0], curve.deriv(2)(ts), atol=1e5 * ROUND_OFF)


@pytest.mark.slow
def test_spline_is_of_the_fourth_order_and_as_smooth_as_that_of_scipy():
    """Far from the ends, the spline is scipy's, which has other conditions there."""
    errors = []
    for count in (41, 81):
        ts = np.linspace(0, 1, count)
        y = np.sin(6 * ts)
        _, second = spline_derivatives(jnp.asarray(ts), jnp.asarray(y)[:, None])
        errors.append(np.abs(second[:, 0] + 36 * y).max())
        middle = slice(count // 2 - 3, count // 2 + 3)
        reference = make_interp_spline(ts, y, 5)(ts, 2)
        np.testing.assert_allclose(second[middle, 0], reference[middle], atol=REFERENCE)
    assert errors[0] / errors[1] > 14


def figure_path():
    """Return a figure and a path on which it makes half a turn in each second."""
    chain = svkc.load(cases.FIGURE, ignore="limit")
    rng, q = np.random.default_rng(0), np.tile(chain.q_load, (len(TIMES), 1))
    phase = np.array(TIMES)[:, None] * rng.uniform(1, 3, chain.nq)
    q += 0.3 * np.sin(phase)
    q[:, 3:7] = quat_exp(TIMES[:, None] * jnp.array([[3.1, 0.2, 0.0]]))
    # q and -q are the same rotation
    q[10:20, 3:7] *= -1
    return chain, q


def test_open_chain_against_mj_inverse():
    """Torques and, at the base, the residual are MuJoCo's generalized force."""
    chain, q = figure_path()
    motion = svkc.inverse_dynamics_along(chain, TIMES, q)
    model = chain.model.model
    data = mujoco.MjData(model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    for i in range(0, len(TIMES), 8):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[i], motion.states.v[i], motion.vdot[i]
        mujoco.mj_inverse(model, data)
        force, scale = data.qfrc_inverse, np.abs(data.qfrc_inverse).max()
        np.testing.assert_allclose(motion.tau[i] + motion.residual[i], force, atol=1e-10 * scale)
    # the turn is about a fixed axis at a constant rate, in body axes
    turn = motion.states.v[:, 3:6] - jnp.array([[3.1, 0.2, 0.0]])
    assert float(jnp.abs(turn).max()) < 1e-4
    assert not np.any(motion.torque("base"))
    assert motion.torque("base").shape == (len(TIMES), 6)
    elbow = chain.dof_names.index("right_elbow")
    assert (motion.torque("right_elbow") == motion.tau[:, elbow]).all()
    lines = str(motion).splitlines()
    assert len(lines) == 3 + 16
    assert re.match(r"largest residual \S+ N m or N, of base", lines[-1])


@pytest.mark.slow
def test_torques_move_a_double_pendulum_along_the_path():
    """A cubic spline through the torques gives the path back, as well as it interpolates them."""
    chain = svkc.load(models.MJCF.format(models.TWO_RODS))
    path = {"upper": 0.4 * jnp.sin(TIMES), "lower": 0.5 - 0.5 * jnp.cos(TIMES)}
    motion = svkc.inverse_dynamics_along(chain, TIMES, path)
    spline = jnp.asarray(CubicSpline(TIMES, motion.tau).c)

    def control(t, state, args):
        i = jnp.clip(jnp.searchsorted(TIMES, t, side="right") - 1, 0, len(TIMES) - 2)
        return jnp.polyval(spline[:, i], t - TIMES[i])

    start = jax.tree.map(lambda x: x[0], motion.states)
    traj = svkc.simulate(chain, start, 2.0, ts=TIMES, control=control)
    # 5e-8, and a sixteenth or less of it for half the distance of times
    np.testing.assert_allclose(traj.states.q, motion.states.q, atol=2e-7)


def check_round_trip(chain, motion):
    """Check that torques give the accelerations, the loop forces, and the power dE/dt."""
    states, tau = motion.states, motion.tau

    @jax.jit
    def compute(chain, states, vdot, tau):
        def at_time(state, vdot, tau):
            rate = jax.jvp(
                lambda q, v: svkc.energy(chain, svkc.State(q, v, state.structure)),
                (state.q, state.v),
                (configuration_derivative(chain, state.q, state.v), vdot),
            )[1]
            return (
                svkc.forward_dynamics(chain, state, tau),
                svkc.loop_forces(chain, state, tau),
                rate,
                svkc.loop_gap_rates(chain, state),
            )

        return jax.vmap(at_time)(states, vdot, tau)

    back, forces, rate, gap_rates = compute(chain, states, motion.vdot, tau)
    scale = max(1.0, float(jnp.abs(tau).max()))
    np.testing.assert_allclose(back, motion.vdot, atol=REFERENCE)
    np.testing.assert_allclose(forces.force, motion.loop_force, atol=REFERENCE * scale)
    np.testing.assert_allclose(forces.torque, motion.loop_torque, atol=REFERENCE * scale)
    assert float(jnp.abs(gap_rates).max()) < ROUND_OFF
    damping = 0 if chain.damping is None else jnp.sum(chain.damping[None] * states.v**2, 1)
    power = jnp.sum(tau * states.v, 1) - damping
    np.testing.assert_allclose(power, rate, atol=1e-11 * scale)
    assert float(jnp.abs(motion.residual).max()) < 1e-11 * scale


@pytest.mark.slow
def test_four_bar_driven_by_a_motor(four_bar):
    motion = svkc.inverse_dynamics_along(four_bar, TIMES, {"crank": CRANK})
    check_round_trip(four_bar, motion)
    assert np.flatnonzero(np.any(motion.tau, 0)).tolist() == [0]
    assert (motion.torque("crank") == motion.tau[:, 0]).all()
    force, torque = motion.wrench("pin")
    assert force.shape == torque.shape == (len(TIMES), 3)
    # the error of the spline
    np.testing.assert_allclose(motion.vdot[:, 0], -4 * CRANK, atol=1e-4)
    # another structure: cut open, the named crank turns with the others at rest
    opened = svkc.inverse_dynamics_along(four_bar, TIMES, {"crank": CRANK}, connected=())
    assert not np.any(opened.states.v[:, 1:3])
    assert not np.any(opened.loop_force)


SLIDES = "".join(f'<motor joint="slide{i}"/>' for i in range(6))


@pytest.mark.slow
def test_stewart_platform_follows_a_path_of_its_plate():
    """The plate is on the first leg: its ball is a quaternion of the path."""
    chain = models.stewart(spread=0.3, motors=f"<actuator>{SLIDES}</actuator>")
    turn = jnp.stack([0.2 * jnp.sin(TIMES), 0.1 * jnp.sin(2 * TIMES), 0.15 * TIMES], 1)
    path = {
        "ux0": 0.1 * jnp.sin(TIMES),
        "uy0": -0.05 * TIMES,
        "slide0": 0.05 * jnp.sin(2 * TIMES),
        "plate": quat_exp(turn),
    }
    motion = svkc.inverse_dynamics_along(chain, TIMES, path)
    check_round_trip(chain, motion)
    driven = [chain.dof_names[i] for i in np.flatnonzero(np.any(motion.tau, 0))]
    assert sorted(driven) == [f"slide{i}" for i in range(6)]
    # the same by the lengths of the legs
    start = jax.tree.map(lambda x: x[0], motion.states)
    legs = [chain.joint_names.index(f"slide{i}") for i in range(6)]
    at = np.array(chain.topology.q_start)[np.array(chain.topology.joint_row)[legs]]
    by_legs = {f"slide{i}": motion.states.q[:, k] for i, k in enumerate(at)}
    again = svkc.inverse_dynamics_along(chain, TIMES, by_legs)
    np.testing.assert_allclose(again.states.q, motion.states.q, atol=1e-8)
    np.testing.assert_allclose(start.q, chain.q_load, atol=REFERENCE)
    # the errors of two splines through different coordinates, which are largest at the ends
    error = jnp.abs(again.tau - motion.tau).max(1) / jnp.abs(motion.tau).max()
    assert error[5:-5].max() < 1e-7
    assert error.max() < 1e-4


@pytest.mark.slow
def test_array_of_a_closed_chain_is_as_the_named_joint(four_bar):
    motion = svkc.inverse_dynamics_along(four_bar, TIMES, {"crank": CRANK})
    by_array = svkc.inverse_dynamics_along(four_bar, TIMES, motion.states.q[:, : four_bar.nq])
    np.testing.assert_allclose(by_array.tau, motion.tau, atol=REFERENCE)


@pytest.mark.slow
def test_unnamed_joints_outside_of_loops_rest():
    inside = models.FOUR_BAR + models.bar("rod", models.Y, "0 0 -1", "0 2 0")
    chain = svkc.load(models.MJCF.format(inside), virtual_links=[models.pin()])
    motion = svkc.inverse_dynamics_along(chain, TIMES, {"crank": CRANK})
    check_round_trip(chain, motion)
    assert not np.any(motion.states.q[:, 3])
    assert not np.any(motion.states.v[:, 3])
    assert np.all(motion.torque("rod") != 0)


@pytest.mark.slow
def test_weights_of_redundant_motors(four_bar):
    """Without actuators all joints have motors; a heavy weight relieves the crank's."""
    chain = models.four_bar()
    light, heavy = (
        svkc.inverse_dynamics_along(chain, TIMES, {"crank": CRANK}, weight=weight)
        for weight in (None, np.array([100.0, 1, 1, 1]))
    )
    ratio = jnp.abs(heavy.torque("crank")).max() / jnp.abs(light.torque("crank")).max()
    assert float(ratio) < 0.1
    single = svkc.inverse_dynamics_along(four_bar, TIMES, {"crank": CRANK}).torque("crank")
    # what the motors do is the same power, less that of the damper
    power = jnp.sum(heavy.tau * heavy.states.v, 1)
    damping = 0.1 * heavy.states.v[:, 0] ** 2
    np.testing.assert_allclose(power, single * heavy.states.v[:, 0] - damping, atol=REFERENCE)


@pytest.mark.slow
def test_gradient_of_the_peak_torque(four_bar):
    """By the amplitude of the path, its duration and a mass, in both modes."""

    def peak(x):
        chain = eqx.tree_at(lambda c: c.mass, four_bar, x["mass"])
        path = {"crank": x["amplitude"] * jnp.sin(2 * TIMES)}
        motion = svkc.inverse_dynamics_along(chain, x["duration"] * TIMES, path)
        return jnp.max(jnp.abs(motion.tau)), jnp.max(jnp.abs(motion.loop_force[:, 0, 2]))

    x = {
        "amplitude": jnp.asarray(0.3),
        "duration": jnp.asarray(0.8),
        "mass": four_bar.mass,
    }
    assert svkc.check_grad(peak, x, directions=1).error < DIFFERENCE


@pytest.mark.slow
def test_lanes_and_failures_under_jit(four_bar):
    """Lanes of a vmap are single runs, and a path that cannot be followed is NaN."""
    torques = jax.jit(jax.vmap(lambda q: svkc.inverse_dynamics_along(four_bar, TIMES, q).tau))
    tau = torques({"crank": jnp.stack([CRANK, 2 * CRANK]), "rocker": jnp.zeros((2, len(TIMES)))})
    assert np.isnan(tau).all()
    tau = torques({"crank": jnp.stack([CRANK, 2 * CRANK])})
    for lane, factor in zip(tau, (1, 2), strict=True):
        single = svkc.inverse_dynamics_along(four_bar, TIMES, {"crank": factor * CRANK})
        np.testing.assert_allclose(lane, single.tau, atol=REFERENCE)
    undetermined = jax.jit(lambda ts: svkc.inverse_dynamics_along(four_bar, ts, {}).tau)
    assert np.isnan(undetermined(TIMES)).all()
