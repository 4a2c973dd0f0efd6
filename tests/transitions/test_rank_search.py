"""The search for the rank of the loops at a change of structure."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import svkc
from svkc.transitions.newton import solve_structure
from svkc.transitions.newton_state import RANK_SEARCH, Schedule

# angles of two bars of length 1, whose end is sqrt(2) away, and of the pin (rad)
TRIANGLE = (-jnp.pi / 4, jnp.pi / 2, 0.0)

PRECISIONS = pytest.mark.parametrize("x64", [True, pytest.param(False, marks=pytest.mark.slow)])


def two_bars(a: float, b: float, reach: float) -> tuple[svkc.Chain, svkc.State]:
    """Return two hinged bars of lengths a and b along x, whose end can be pinned to the ground at
    x = reach."""
    model = f"""<mujoco><worldbody><body name="first"><joint name="first" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 {a} 0 0" size="0.02"/><body name="second" pos="{a} 0 0">
    <joint name="second" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 {b} 0 0" size="0.02"/>
    </body></body></worldbody></mujoco>"""
    pin = svkc.VirtualLink(
        "pin", "world", "second", "hinge", pos=(reach, 0, 0), axis=(0, 1, 0), real_pos=(b, 0, 0)
    )
    chain = svkc.load(model, virtual_links=[pin])
    return chain, chain.state()


def search(chain: svkc.Chain, state: svkc.State, q):
    """Return the state after the search for the rank of the pinned bars."""
    structure = eqx.tree_at(lambda s: s.connected, state.structure, jnp.ones(1, bool))
    v = jnp.zeros(chain.dofs, state.q.dtype)
    return solve_structure(chain, structure, q, v, Schedule(RANK_SEARCH))


@PRECISIONS
@pytest.mark.parametrize(
    ("a", "b"),
    [
        (1.0, 0.5),
        *(pytest.param(*x, marks=pytest.mark.slow) for x in ((1.0, 0.99), (1.0, 1.0), (0.3, 1.2))),
    ],
)
def test_stretched_bars_have_the_rank_of_their_only_closed_configuration(a, b, x64):
    """Newton's steps halve the distance of the probe from this singular configuration. In float32
    the search must not stop as soon as the gap, its square, is small."""
    with jax.enable_x64(x64):
        chain, state = two_bars(a, b, a + b)
        end = search(chain, state, state.q)
    assert int(end.rank) == 2


@PRECISIONS
def test_the_search_ends_where_the_probe_is_closed(x64):
    """A triangle of two bars and the ground: the loop of the probe is closed to round-off."""
    with jax.enable_x64(x64):
        end = search(*two_bars(1.0, 1.0, 2**0.5), jnp.array(TRIANGLE))
        eps = float(jnp.finfo(end.q.dtype).eps)
    assert int(end.rank) == 3
    assert float(end.search_gaps[1, 0]) < 8 * eps
    assert float(end.margin) > 0.1


@PRECISIONS
def test_the_search_of_a_lane_does_not_depend_on_other_lanes(x64):
    """Lanes whose probe is closed do not move while another lane iterates."""
    with jax.enable_x64(x64):
        lanes = jax.jit(jax.vmap(functools.partial(search, *two_bars(1.0, 1.0, 2**0.5))))
        q = jnp.array([TRIANGLE, TRIANGLE])
        ends = lanes(q), lanes(q.at[1].set(jnp.nan))
    for x, y in zip(*map(jax.tree.leaves, ends), strict=True):
        np.testing.assert_array_equal(x[0], y[0])
