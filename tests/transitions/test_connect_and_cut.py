"""Changes of structure: the velocity after an impact in two formulations, cuts, locks, and
connections at the current poses."""

import cases
import jax
import jax.numpy as jnp
import models
import numpy as np
import pytest
from references import paper
from tolerances import ROUND_OFF

import svkc


@pytest.mark.slow
def test_impact_equals_impulse_equation_for_figure():
    chain, state = cases.flight()
    for name in ("left_hand_grip", "right_hand_grip"):
        v, F = paper.velocity_by_impulse(chain, state, name)
        after = svkc.connect(chain, state, name)
        np.testing.assert_allclose(
            after.v[: chain.nv], v[: chain.nv], atol=1e-10 * float(jnp.abs(v).max())
        )
        hinge = chain.dofs - 2 + chain.link_names.index(name)
        np.testing.assert_allclose(after.v[hinge], v[hinge], atol=1e-10 * float(jnp.abs(v).max()))
        # the freedom of the new joint transmits no impulse: J_r^T F = 0 for a hinge about y
        assert abs(float(F[1])) < 1e-10 * float(jnp.abs(F).max())
        state = after


@pytest.mark.slow
def test_order_of_connections_does_not_matter():
    """Inelastic impacts are projections, so their order does not matter."""
    chain, state = cases.flight()
    together = svkc.connect(chain, state, "left_hand_grip", "right_hand_grip")
    left_first = svkc.connect(
        chain, svkc.connect(chain, state, "left_hand_grip"), "right_hand_grip"
    )
    np.testing.assert_allclose(together.v, left_first.v, atol=1e-10)


def test_reconnecting_consistent_motion_is_a_no_op(high_bar):
    chain, state = high_bar
    rng = np.random.default_rng(3)
    consistent = chain.state(state.q[: chain.nq], rng.normal(size=chain.nv))
    again = svkc.connect(chain, svkc.cut(chain, consistent, "left_hand_grip"), "left_hand_grip")
    np.testing.assert_allclose(again.v, consistent.v, atol=ROUND_OFF)
    np.testing.assert_allclose(again.q, consistent.q, atol=ROUND_OFF)


def test_a_cut_keeps_q_and_v_bit_for_bit(high_bar):
    chain, state = high_bar
    after = svkc.cut(chain, state, "right_hand_grip")
    assert bool(jnp.all(after.q == state.q))
    assert bool(jnp.all(after.v == state.v))
    m = svkc.mobility(chain, after)
    assert (int(m.joint_freedoms), int(m.rank), int(m.freedoms)) == (23, 6, 17)
    for mask in ([True, True], np.array([True, True])):
        np.testing.assert_allclose(
            svkc.transition(chain, after, jnp.asarray(mask)).v, state.v, atol=ROUND_OFF
        )


@pytest.mark.slow
@pytest.mark.parametrize("joint", ["hinge", "weld", "ball", "slide"])
def test_impact_equals_impulse_equation_for_free_bodies(joint):
    chain, rng = models.two_boxes(joint), np.random.default_rng(1)
    state = chain.state(v=rng.normal(size=12))
    after = svkc.connect(chain, state, "grip")
    assert float(jnp.abs(svkc.loop_gap_rates(chain, after)).max()) < ROUND_OFF
    v, _ = paper.velocity_by_impulse(chain, state, "grip")
    np.testing.assert_allclose(after.v, v, atol=1e-10)


def test_connect_at_current_pose():
    """With here=True the joint is made at the current poses, away from the declared placement."""
    chain = svkc.load(
        models.TWO_BOXES,
        virtual_links=[
            svkc.VirtualLink("grip", "a", "b", "hinge", pos=(0, 0, 0), real_pos=(-0.6, 0.1, 0))
        ],
    )
    state = chain.state(v=np.arange(12.0))
    after = svkc.connect(chain, state, "grip", here=True)
    np.testing.assert_allclose(after.q[:14], state.q[:14], atol=1e-15)
    np.testing.assert_allclose(after.structure.pos[0], [0.4, 0.1, 0], atol=1e-15)
    assert float(jnp.abs(svkc.loop_gaps(chain, after)).max()) < 1e-14


def test_lock_and_unlock(high_bar):
    """A locked knee has zero velocity and acceleration; an unlocked knee accelerates again."""
    chain, state = high_bar
    rng = np.random.default_rng(4)
    consistent = chain.state(state.q[: chain.nq], rng.normal(size=chain.nv))
    locked = svkc.lock(chain, consistent, "right_knee")
    knee = chain.topology.v_start[chain.topology.joint_row[chain.joint_names.index("right_knee")]]
    assert float(locked.v[knee]) == 0
    assert int(svkc.mobility(chain, locked).freedoms) == 11
    vdot = svkc.forward_dynamics(chain, locked, jnp.zeros(chain.dofs))
    assert float(vdot[knee]) == 0
    assert float(jnp.abs(svkc.loop_gap_rates(chain, locked)).max()) < ROUND_OFF
    free = svkc.unlock(chain, locked, "right_knee")
    assert int(svkc.mobility(chain, free).freedoms) == 12
    assert float(svkc.forward_dynamics(chain, free, jnp.zeros(chain.dofs))[knee]) != 0


@pytest.mark.slow
def test_locking_is_an_impact_also_in_a_chain_with_links():
    """The momentum of a joint that stops goes to the others: M v+ = M v- but for the locked row."""
    link = svkc.VirtualLink("grip", "world", "lower", "ball", pos=(0, 0, 1))
    chain = svkc.load(models.MJCF.format(models.TWO_RODS), virtual_links=[link])
    state = chain.state({"upper": 0.3, "lower": 0.5}, {"upper": 1.0, "lower": 2.0})
    locked = svkc.lock(chain, state, "upper")
    M = np.asarray(svkc.mass_matrix(chain, state))[:2, :2]
    np.testing.assert_allclose(locked.v[:2], [0, M[1] @ [1, 2] / M[1, 1]], atol=ROUND_OFF)
    run = svkc.simulate(chain, state, 0.0, dt=0.01, events=svkc.at(0.0, lock="upper"))
    loss = svkc.energy(chain, state) - svkc.energy(chain, locked)
    np.testing.assert_allclose(run.events.energy_lost, [loss], atol=ROUND_OFF)


@pytest.mark.slow
def test_state_and_connect_under_jit_and_vmap(high_bar):
    """Compiled and batched calls give the numbers of single eager calls."""
    chain, state = high_bar
    v = jnp.stack([jnp.full(chain.nv, s) for s in (0.1, -0.2)])

    @jax.jit
    @jax.vmap
    def reconnect(v):
        consistent = chain.state(state.q[: chain.nq], v)
        return consistent, svkc.connect(
            chain, svkc.cut(chain, consistent, "left_hand_grip"), "left_hand_grip"
        )

    consistent, again = reconnect(v)
    np.testing.assert_allclose(
        consistent.v[1], chain.state(state.q[: chain.nq], v[1]).v, atol=ROUND_OFF
    )
    np.testing.assert_allclose(again.v, consistent.v, atol=ROUND_OFF)


@pytest.mark.slow
def test_a_joint_that_connects_again_keeps_its_turn():
    """Springs and ranges depend on the turn: an angle above pi is not one below zero."""
    rod = models.bar("rod", models.Y + ' range="0 270" limited="true"', "0 0 -0.4")
    chain = svkc.load(models.MJCF.format(rod), cuttable="rod")
    for angle in (3.5, 0.5):
        state = chain.state({"rod": angle})
        again = svkc.connect(chain, svkc.cut(chain, state, "rod"), "rod")
        np.testing.assert_allclose(chain.joint(again, "rod").q, angle, atol=ROUND_OFF)
        elsewhere = svkc.connect(chain, svkc.cut(chain, state, "rod"), "rod", here=True)
        # another joint, which starts at zero on every turn
        np.testing.assert_allclose(chain.joint(elsewhere, "rod").q, 0, atol=ROUND_OFF)


@pytest.mark.slow
def test_changes_that_connect_nothing_do_not_close_loops():
    """Of a state with small gaps, as after many steps: q stays, and no error is raised."""
    chain = models.parallelogram()
    closed = chain.state({"leg0": 0.3}, {"leg0": 1.0})
    q = closed.q + 3e-8 * np.sin(np.arange(closed.q.size))
    state = svkc.State(q, closed.v, closed.structure)
    assert 1e-8 < float(jnp.abs(svkc.loop_gaps(chain, state)).max()) < 1e-7
    for after in (svkc.connect(chain, state, "pin1"), svkc.transition(chain, state, ["pin2"])):
        np.testing.assert_array_equal(after.q, q)
        np.testing.assert_array_equal(after.v, closed.v)
    assert after.structure.connected.tolist() == [False, True]
