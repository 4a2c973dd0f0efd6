"""Inverse dynamics of closed chains: square, redundant and missing actuation; weights, bounds; the
round trip through forward dynamics."""

import jax
import jax.numpy as jnp
import models
import numpy as np
import pytest
from tolerances import DIFFERENCE, REFERENCE, ROUND_OFF

import svkc


def mask(chain, *names):
    return np.isin(chain.dof_names, names)


def moving(chain, seed=0, q=None):
    rng = np.random.default_rng(seed)
    return chain.state(q, rng.normal(size=chain.nv)), jnp.asarray(rng.normal(size=chain.dofs))


@pytest.fixture(scope="module")
def five_bar():
    chain = models.five_bar()
    state, vdot = moving(chain, q={"left_arm": -0.2, "right_arm": 0.3})
    return chain, state, vdot, svkc.coordinates(chain, state)


def reached(chain, state, vdot, found):
    """Largest difference of theta_G's accelerations from those asked for, under the torques
    found."""
    independent = svkc.coordinates(chain, state).independent
    return float(
        jnp.abs(
            jnp.where(independent, svkc.forward_dynamics(chain, state, found.tau) - vdot, 0)
        ).max()
    )


def test_square(five_bar):
    """Two motors for two freedoms: (22), nothing left over."""
    chain, state, vdot, co = five_bar
    motors = mask(chain, "left_arm", "right_arm")
    found = svkc.actuation(chain, state, vdot, actuated=motors)
    assert (int(found.rank), int(found.redundancy), int(found.deficiency)) == (2, 0, 0)
    assert reached(chain, state, vdot, found) < 1e-10 * float(jnp.abs(vdot).max())
    assert not np.any(np.asarray(found.tau)[~motors])
    assert not np.any(found.null_space)
    # theta_G's accelerations alone, in order, say the same
    short = svkc.actuation(chain, state, vdot[np.asarray(co.independent)], actuated=motors)
    np.testing.assert_allclose(short.tau, found.tau, rtol=ROUND_OFF)


def test_redundant(five_bar):
    """Three motors: least norm and least weighted norm by numpy's pseudo-inverse; the null space
    changes the loop's load and no motion."""
    chain, state, vdot, _ = five_bar
    motors = mask(chain, "left_arm", "right_arm", "left_fore")
    found = svkc.actuation(chain, state, vdot, actuated=motors)
    assert (int(found.rank), int(found.redundancy), int(found.deficiency)) == (2, 1, 0)
    assert reached(chain, state, vdot, found) < 1e-10 * float(jnp.abs(vdot).max())
    co = svkc.coordinates(chain, state)
    S = np.asarray(co.W)[motors][:, np.asarray(co.independent)]
    wanted = S.T @ np.asarray(found.tau)[motors]
    np.testing.assert_allclose(
        np.asarray(found.tau)[motors], np.linalg.pinv(S.T) @ wanted, rtol=1e-10
    )
    weight = np.where(mask(chain, "left_fore"), 100.0, 1.0)
    weighted = svkc.actuation(chain, state, vdot, weight, actuated=motors)
    root = np.sqrt(weight[motors])
    np.testing.assert_allclose(
        np.asarray(weighted.tau)[motors], np.linalg.pinv(S.T / root) @ wanted / root, rtol=REFERENCE
    )
    assert abs(float(weighted.tau[mask(chain, "left_fore")][0])) < abs(
        float(found.tau[mask(chain, "left_fore")][0])
    )
    null = np.asarray(found.null_space)
    assert int(np.any(null, 0).sum()) == 1
    column = null[:, np.any(null, 0)][:, 0]
    before, after = (
        svkc.forward_dynamics(chain, state, found.tau + k * column) for k in (0.0, 7.0)
    )
    np.testing.assert_allclose(before, after, atol=1e-11 * float(jnp.abs(before).max()))
    load = [svkc.loop_forces(chain, state, found.tau + k * column) for k in (0.0, 1.0)]
    which = int(np.flatnonzero(np.any(null, 0))[0])
    np.testing.assert_allclose(
        load[1].force - load[0].force, found.null_force[:, :, which], atol=REFERENCE
    )
    np.testing.assert_allclose(
        load[1].torque - load[0].torque, found.null_torque[:, :, which], atol=REFERENCE
    )
    assert float(jnp.abs(found.null_force).max()) > 1e-3


def test_missing(five_bar):
    """One motor for two freedoms: the residual is said, and the direction that nobody drives is a
    motion without work."""
    chain, state, vdot, _ = five_bar
    motors = mask(chain, "left_arm")
    found = svkc.actuation(chain, state, vdot, actuated=motors)
    assert (int(found.rank), int(found.redundancy), int(found.deficiency)) == (1, 0, 1)
    assert float(jnp.abs(found.residual).max()) > 1e-2
    undriven = np.asarray(found.undriven)
    assert int(np.any(undriven, 0).sum()) == 1
    direction = undriven[:, np.any(undriven, 0)][:, 0]
    assert np.abs(direction[motors]).max() < ROUND_OFF
    there = svkc.State(state.q, jnp.asarray(direction), state.structure)
    assert float(jnp.abs(svkc.velocity_gaps(chain, there)).max()) < ROUND_OFF
    # what can be reached is: with an acceleration that the one motor makes, nothing is left
    possible = svkc.forward_dynamics(chain, state, jnp.where(motors, 3.0, 0.0))
    exact = svkc.actuation(chain, state, possible, actuated=motors)
    assert float(jnp.abs(exact.residual).max()) < 1e-10
    np.testing.assert_allclose(exact.tau[motors], 3.0, rtol=REFERENCE)


@pytest.mark.slow
def test_actuated_virtual_joint():
    """A four-bar driven at its closing hinge (Fig. 6), with a spring and damper in the tree."""
    xml = models.MJCF.format(models.FOUR_BAR).replace('damping="0"', 'damping="0.2" stiffness="3"')
    chain = svkc.load(xml, virtual_links=[models.pin(actuated=True)])
    state, vdot = moving(chain)
    assert bool(chain.actuated[-1])
    found = svkc.actuation(chain, state, vdot, actuated=mask(chain, "pin"))
    assert float(jnp.abs(found.tau[:-1]).max()) == 0
    assert reached(chain, state, vdot, found) < 1e-10 * float(jnp.abs(vdot).max())


@pytest.mark.slow
def test_over_constrained():
    """Three parallel legs: a redundant loop, six motors for one freedom."""
    chain = models.parallelogram()
    state, vdot = moving(chain)
    found = svkc.actuation(chain, state, vdot)
    assert (int(found.rank), int(found.redundancy), int(found.deficiency)) == (1, chain.nv - 1, 0)
    assert reached(chain, state, vdot, found) < 1e-10 * float(jnp.abs(vdot).max())
    assert not svkc.loop_forces(chain, state, found.tau).unique.any()
    # seven self-stresses: wrenches of both pins that no joint feels
    linear, angular = (np.asarray(x) for x in svkc.jacobian(chain, state))
    force, torque = np.asarray(found.stress_force), np.asarray(found.stress_torque)
    felt = np.einsum("lkd,lkr->dr", linear, force) + np.einsum("lkd,lkr->dr", angular, torque)
    stresses = np.concatenate([force, torque], 1).reshape(12, -1)
    assert np.linalg.matrix_rank(stresses) == int(np.any(stresses, 0).sum()) == 7
    assert np.abs(felt).max() < ROUND_OFF
    assert svkc.loop_forces(chain, chain.state(connected=["pin2"]), found.tau).unique.tolist() == [
        True,
        False,
    ]


@pytest.mark.slow
def test_both_hands_on_the_bar(high_bar):
    """16 motors, 12 freedoms, of which the swing about the bar is nobody's: reached by the others,
    over-actuated by five."""
    chain, state = high_bar
    state, vdot = moving(chain, q=state.q[: chain.nq])
    found = svkc.actuation(chain, state, vdot)
    assert (int(found.rank), int(found.redundancy), int(found.deficiency)) == (11, 5, 1)
    possible = svkc.forward_dynamics(chain, state, jnp.where(chain.actuated, vdot, 0))
    exact = svkc.actuation(chain, state, possible)
    assert float(jnp.abs(exact.residual).max()) < REFERENCE
    assert reached(chain, state, possible, exact) < 1e-10 * float(jnp.abs(possible).max())
    # the swing, every joint held: no actuator works on it
    swing = np.asarray(found.undriven)[:, np.any(found.undriven, 0)][:, 0]
    assert np.abs(swing[np.asarray(chain.actuated)]).max() < ROUND_OFF * np.abs(swing).max()


def test_bounds(five_bar):
    """Loose bounds change nothing; tighter ones are kept, and the acceleration with them; too tight
    ones say what is missing."""
    chain, state, vdot, _ = five_bar
    motors = mask(chain, "left_arm", "right_arm", "left_fore")
    free = svkc.actuation(chain, state, vdot, actuated=motors)
    loose = svkc.actuation(chain, state, vdot, actuated=motors, bounds=(-1e3, 1e3))
    np.testing.assert_allclose(loose.tau, free.tau, atol=REFERENCE)
    worst = int(jnp.argmax(jnp.abs(free.tau)))
    limit = np.full(chain.dofs, 1e3)
    limit[worst] = 0.5 * abs(float(free.tau[worst]))
    tight = svkc.actuation(chain, state, vdot, actuated=motors, bounds=(-limit, limit))
    assert np.all(np.abs(tight.tau) <= limit)
    assert reached(chain, state, vdot, tight) < 1e-10 * float(jnp.abs(vdot).max())
    assert float(jnp.abs(tight.residual).max()) < 1e-10
    # the least norm on the face of the box: another point of the same line is longer
    null = np.asarray(free.null_space)
    step = null[:, np.any(null, 0)][:, 0]
    for k in (-1e-3, 1e-3):
        other = np.asarray(tight.tau) + k * step
        assert np.any(np.abs(other) > limit) or np.sum(other**2) > np.sum(
            np.asarray(tight.tau) ** 2
        )
    never = svkc.actuation(chain, state, 1e3 * vdot, actuated=motors, bounds=(-1.0, 1.0))
    assert float(jnp.abs(never.residual).max()) > 1
    assert float(jnp.abs(never.tau).max()) <= 1


@pytest.mark.slow
def test_open_chain_and_derivative(five_bar):
    """Without loops actuation is inverse dynamics; the torques' derivative by q against
    differences, in both modes."""
    tree = svkc.load(models.random_tree(4, 3, kinds=("hinge", "ball")))
    state, vdot = moving(tree)
    found = svkc.actuation(tree, state, vdot)
    np.testing.assert_allclose(
        found.tau, svkc.inverse_dynamics(tree, state, vdot), rtol=1e-10, atol=ROUND_OFF
    )
    chain, state, vdot, _ = five_bar
    state = svkc.prefer(chain, state, "left_arm", "right_arm")
    along = svkc.coordinates(chain, state).W @ jnp.where(
        svkc.coordinates(chain, state).independent, 1.0, 0.0
    )

    at = state.structure
    for motors in (
        mask(chain, "left_arm"),
        mask(chain, "left_arm", "right_arm"),
        mask(chain, "left_arm", "right_arm", "left_fore"),
    ):
        f = lambda step, m=motors: (
            svkc.actuation(
                chain,
                svkc.State(svkc.integrate(chain, state.q, step * along), state.v, at),
                vdot,
                actuated=m,
            ).tau
        )
        forward = jax.jacfwd(f)(0.0)
        np.testing.assert_allclose(jax.jacrev(f)(0.0), forward, rtol=REFERENCE, atol=REFERENCE)
        h = 1e-5
        np.testing.assert_allclose(
            forward, (f(h) - f(-h)) / (2 * h), rtol=DIFFERENCE, atol=DIFFERENCE
        )
