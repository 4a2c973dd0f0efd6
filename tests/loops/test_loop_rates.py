"""Rates of the loops' gaps without the loop Jacobian, against the loop Jacobian."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tolerances import ROUND_OFF

import svkc
from svkc.loops.constraint import jacobian_scales, loop_kinematics, loop_rates
from svkc.model.chain import active_dofs

LINKS = """<mujoco><worldbody>
  <body name="base"><freejoint/><geom size="0.1"/>
    <body name="left" pos="0.2 0 0"><joint type="ball"/><geom size="0.1"/>
      <body name="far" pos="0.3 0 0"><joint name="wrist" axis="0 1 0"/><geom size="0.1"/></body>
    </body>
    <body name="right" pos="-0.2 0 0"><joint axis="1 0 0"/><geom size="0.1"/></body></body>
  <body name="other" pos="0 1 0"><joint type="slide" axis="0 0 1"/><geom size="0.1"/></body>
</worldbody></mujoco>"""


@pytest.fixture(scope="module")
def chain_and_q():
    """Loops within a branch, between branches, between trees and to the world, none closed."""
    links = [
        svkc.VirtualLink("within", "base", "far", "ball", real_pos=(0.1, 0, 0)),
        svkc.VirtualLink("between", "right", "far", "universal", real_pos=(0.1, 0.2, 0)),
        svkc.VirtualLink("trees", "other", "left", "slide", axis=(1, 1, 0), real_pos=(0, 0.1, 0)),
        svkc.VirtualLink("world", "world", "right", "weld", real_pos=(0, 0, 0.3)),
        svkc.VirtualLink("unused", "world", "far", "hinge", axis=(0, 1, 0), real_pos=(0, 0, 0.1)),
    ]
    chain = svkc.load(LINKS, virtual_links=links)
    connected = jnp.array([name != "unused" for name in chain.link_names])
    structure = dataclasses.replace(chain.state(connected=()).structure, connected=connected)
    return (
        chain,
        structure,
        chain.q_load + 0.4 * jax.random.normal(jax.random.key(1), chain.q_load.shape),
    )


def test_rows_of_links_not_connected_are_zero(chain_and_q):
    """These rows are zero also where the kinematics are NaN."""
    chain, structure, q = chain_and_q
    rows = loop_kinematics(chain, structure, q * jnp.nan).J.reshape(-1, 6, chain.dofs)
    unused = chain.link_names.index("unused")
    np.testing.assert_array_equal(rows[unused], 0)
    assert jnp.all(jnp.isnan(jnp.delete(rows, unused, 0)).any((1, 2)))


@pytest.mark.slow
def test_rates_are_those_of_the_loop_jacobian(chain_and_q):
    chain, structure, q = chain_and_q
    v = jax.random.normal(jax.random.key(2), (chain.dofs,))
    v = jnp.where(active_dofs(chain, structure), v, 0)

    def by_jacobian(q, v):
        return loop_kinematics(chain, structure, q).J @ (v / jacobian_scales(chain)[1])

    def without(q, v):
        return loop_rates(chain, loop_kinematics(chain, structure, q), v)

    def evaluate(f):
        return jax.jit(lambda q, v: (f(q, v), *jax.jacrev(f, (0, 1))(q, v)))(q, v)

    expected = evaluate(by_jacobian)
    assert np.all(np.max(np.abs(expected[0].reshape(-1, 6)), 1)[:4] > 0.1)
    for x, y in zip(evaluate(without), expected, strict=True):
        np.testing.assert_allclose(x, y, atol=10 * ROUND_OFF)
