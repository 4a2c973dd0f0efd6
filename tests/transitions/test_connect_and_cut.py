"""Structure changes: the velocity after, two ways; cuts, locks, grips where the
hand is."""

import cases
import jax
import jax.numpy as jnp
import models
import numpy as np
import pytest
from references import paper
from tolerances import ROUND_OFF

import svkc


def test_both_forms_of_the_impact_agree():
    chain, state = cases.flight()
    for name in ("left_hand_grip", "right_hand_grip"):
        v, F = paper.velocity_by_impulse(chain, state, name)
        after = svkc.connect(chain, state, name)
        np.testing.assert_allclose(
            after.v[: chain.nv], v[: chain.nv], atol=1e-10 * float(jnp.abs(v).max())
        )
        hinge = chain.dofs - 2 + chain.link_names.index(name)
        np.testing.assert_allclose(after.v[hinge], v[hinge], atol=1e-10 * float(jnp.abs(v).max()))
        # the new joint's freedom carries nothing: J_r^T F = 0 for a hinge about y
        assert abs(float(F[1])) < 1e-10 * float(jnp.abs(F).max())
        state = after


def test_one_by_one_or_together_is_the_same():
    """Plastic latches are projections; their order does not matter."""
    chain, state = cases.flight()
    together = svkc.connect(chain, state, "left_hand_grip", "right_hand_grip")
    left_first = svkc.connect(
        chain, svkc.connect(chain, state, "left_hand_grip"), "right_hand_grip"
    )
    np.testing.assert_allclose(together.v, left_first.v, atol=1e-10)


def test_connecting_what_moves_together_changes_nothing(high_bar):
    chain, state = high_bar
    rng = np.random.default_rng(3)
    moving = chain.state(state.q[: chain.nq], rng.normal(size=chain.nv))
    again = svkc.connect(chain, svkc.cut(chain, moving, "left_hand_grip"), "left_hand_grip")
    np.testing.assert_allclose(again.v, moving.v, atol=ROUND_OFF)
    np.testing.assert_allclose(again.q, moving.q, atol=ROUND_OFF)


def test_a_cut_keeps_every_bit(high_bar):
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
def test_both_forms_of_it_agree_between_free_bodies(joint):
    chain, rng = models.two_boxes(joint), np.random.default_rng(1)
    state = chain.state(v=rng.normal(size=12))
    after = svkc.connect(chain, state, "grip")
    assert float(jnp.abs(svkc.loop_gap_rates(chain, after)).max()) < ROUND_OFF
    v, _ = paper.velocity_by_impulse(chain, state, "grip")
    np.testing.assert_allclose(after.v, v, atol=1e-10)


def test_grip_where_it_is():
    """Bodies away from the declared placement: here=True makes the joint where the real link is."""
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
    """A locked knee stops with the impact of stopping and stays; unlocked it moves again."""
    chain, state = high_bar
    rng = np.random.default_rng(4)
    moving = chain.state(state.q[: chain.nq], rng.normal(size=chain.nv))
    locked = svkc.lock(chain, moving, "right_knee")
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
def test_states_and_changes_under_jit_and_vmap(high_bar):
    """The verbs are functions of arrays: the same numbers compiled, and lane by lane."""
    chain, state = high_bar
    v = jnp.stack([jnp.full(chain.nv, s) for s in (0.1, -0.2)])

    @jax.jit
    @jax.vmap
    def lanes(v):
        moving = chain.state(state.q[: chain.nq], v)
        return moving, svkc.connect(
            chain, svkc.cut(chain, moving, "left_hand_grip"), "left_hand_grip"
        )

    moving, again = lanes(v)
    np.testing.assert_allclose(
        moving.v[1], chain.state(state.q[: chain.nq], v[1]).v, atol=ROUND_OFF
    )
    np.testing.assert_allclose(again.v, moving.v, atol=ROUND_OFF)
