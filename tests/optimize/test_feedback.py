"""Gains of the feedback, growth of errors, and the replay of a solution."""

import jax.numpy as jnp
import models
import numpy as np
import pytest
import wrong_optimizations
from scipy.linalg import expm, solve_discrete_are

import svkc
from svkc import optimize
from svkc.optimize.feedback import EFFORT, error_units, growth, riccati_gains
from svkc.optimize.linearization import linear_maps
from svkc.optimize.loop_rows import LinkRows, rates_at
from svkc.optimize.structures import candidate_rows

INVERTED = (
    '<mujoco><worldbody><body name="rod"><joint name="pivot" axis="0 1 0"/><geom type="capsule"'
    ' fromto="0 0 0 0 0 1" size="0.03"/></body></worldbody></mujoco>'
)


def at_rest(chain, pose, connected=(), **of_phase):
    """Return a problem of one phase of 3 s, and the motion that stays at a pose."""
    options = {"duration": 3.0, "intervals": 60, "connected": connected} | of_phase
    problem = optimize.Problem(
        chain,
        [optimize.Phase("stay", **options)],
        controls=optimize.Torques(),
        scheme=optimize.Radau(3),
    )
    return problem, tuple(problem.guess([pose, pose]).phases)


def test_gains_of_a_cart_are_those_of_the_discrete_riccati_equation():
    """An interval of x'' = u is known in closed form, and so are its gains far from the end."""
    problem, motion = at_rest(wrong_optimizations.cart(), {"x": 0.0})
    maps, h = linear_maps(problem, motion), 3.0 / 60
    A, B = np.array([[1, h], [0, 1]]), np.array([[h**2 / 2], [h]])
    np.testing.assert_allclose(maps.A, np.broadcast_to(A, (60, 2, 2)), atol=1e-12)
    np.testing.assert_allclose(maps.B, np.broadcast_to(B, (60, 2, 1)), atol=1e-12)
    Q = h * np.diag(error_units(problem) ** -2.0)
    R = h * EFFORT / problem.units.torque**2 * np.eye(1)
    P = solve_discrete_are(A, B, Q, R)
    K = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    np.testing.assert_allclose(riccati_gains(problem, motion, maps)[0, 0], K, rtol=1e-6)


def test_growth_of_an_inverted_rod_is_that_of_its_linear_equation():
    chain = svkc.load(INVERTED)
    problem, motion = at_rest(chain, {"pivot": 0.0}, duration=1.0, intervals=20)
    inertia = float(svkc.mass_matrix(chain, chain.state())[0, 0])
    moment = 9.81 * float(np.sum(chain.mass)) * 0.5
    exact = expm(np.array([[0, 1], [moment / inertia, 0]]))
    units = error_units(problem)
    factor = np.linalg.norm(exact * units / units[:, None], 2)
    assert factor > 10
    computed = growth(problem, motion, linear_maps(problem, motion))
    np.testing.assert_allclose(computed, [factor], rtol=1e-6)


BALL = (
    '<mujoco><option gravity="0 0 0"/><worldbody><body name="ball"><freejoint/><geom type="sphere"'
    ' size="0.1"/></body></worldbody></mujoco>'
)


@pytest.mark.slow
def test_errors_of_a_turning_ball_turn_back_in_its_axes():
    """Its plan turns by 1.5 rad about z in 1 s; an error of its pose stays where it is in space.

    Nothing is driven, so that there are no gains.
    """
    chain = svkc.load(BALL)
    start, turned = chain.state(), np.array([np.cos(0.75), 0, 0, np.sin(0.75)])
    end = svkc.State(start.q.at[3:7].set(turned), start.v, start.structure)
    phase = optimize.Phase("turn", duration=1.0, intervals=4)
    problem = optimize.Problem(
        chain, [phase], controls=optimize.Torques(joints=()), scheme=optimize.Radau(3)
    )
    motion = tuple(problem.guess([start, end]).phases)
    maps = linear_maps(problem, motion)
    c, s = np.cos(1.5 / 4), np.sin(1.5 / 4)
    back = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    np.testing.assert_allclose(maps.A[:, 3:6, 3:6], np.tile(back, (4, 1, 1)), atol=1e-6)
    np.testing.assert_allclose(maps.A[:, :3, 6:9], np.tile(np.eye(3) / 4, (4, 1, 1)), atol=1e-12)
    assert riccati_gains(problem, motion, maps).shape == (4, 2, 0, 12)


@pytest.mark.slow
def test_links_project_errors():
    """What links leave of an error is left again, keeps the loop, and is what `connect` leaves."""
    chain = models.four_bar()
    link, state = chain.link_names[0], chain.state(v={"crank": 2.0})
    problem, motion = at_rest(chain, state, link, intervals=4)
    maps = linear_maps(problem, motion)
    after, nv = maps.after[0], chain.nv
    np.testing.assert_allclose(after @ after, after, atol=1e-12)
    q = jnp.asarray(motion[0].q[0])
    table = LinkRows.of(chain, candidate_rows(chain, np.asarray(state.structure.connected)))
    left = after[nv:, nv:] @ np.random.default_rng(0).normal(size=nv)
    assert np.abs(rates_at(chain, q, jnp.asarray(left), table)).max() < 1e-12
    v = np.random.default_rng(1).normal(size=nv)
    opened = chain.state(q, v=v, connected=())
    connected = svkc.connect(chain, opened, link, here=True)
    np.testing.assert_allclose(after[nv:, nv:] @ v, connected.v[:nv], atol=1e-9)


@pytest.mark.slow
def test_feedback_keeps_an_unstable_motion_on_its_plan():
    """An inverted rod is brought upright; an error at its start dies away with feedback alone."""
    chain = svkc.load(INVERTED)
    rest = optimize.between("pivot", 0, 0, of="velocity")
    lift = optimize.Phase(
        "lift", duration=2.0, intervals=8,
        start=[optimize.between("pivot", 0.3, 0.3), rest],
        end=[optimize.between("pivot", 0, 0), rest],
    )  # fmt: skip
    problem = optimize.Problem(
        chain, [lift], controls=optimize.Torques(), running=lambda p: jnp.sum(p.u**2)
    )
    solution = problem.solve(problem.guess([{"pivot": 0.3}, {"pivot": 0.0}]))
    report = solution.report()
    alone, near = report.open_loop[0], report.replay.phases[0]
    assert report.growth[0] > 10
    assert near.position < 0.3 * alone.position
    assert "growth of" in str(report)
    assert "energy drift" in str(report.replay)
    control, plan = solution.control()
    start = chain.state(q={"pivot": 0.31})
    with_feedback = svkc.simulate(chain, start, 2.0, control=control, args=plan)
    control, plan = solution.control(feedback=False)
    without = svkc.simulate(chain, start, 2.0, control=control, args=plan)
    assert abs(float(with_feedback.final.q[0])) < 0.01 < abs(float(without.final.q[0]))
