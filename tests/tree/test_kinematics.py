"""The derivative of the kinematics in closed form, against automatic differentiation."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import svkc
from svkc.tree.kinematics import _kinematics, kinematics

# all kinds of joints, bodies with several joints, joints off the body's origin and three roots
TREE = """<mujoco><worldbody>
  <body pos="1 0 0.5"><freejoint/><geom size="0.1"/>
    <body pos="0.2 0.1 0"><joint type="ball" pos="0 0 0.3"/><geom size="0.1"/>
      <body pos="0 0.3 0" euler="20 10 5"><joint axis="1 2 3" pos="0.1 0 0"/>
        <joint axis="0 1 0"/><geom size="0.1"/>
        <body pos="0.2 0 0"><geom size="0.1"/></body></body></body>
    <body pos="0 0 0.4" euler="0 30 0"><joint type="slide" axis="1 0 1"/><geom size="0.1"/></body>
  </body>
  <body pos="0 1 0"><joint type="slide" axis="0 0 1"/><joint axis="1 0 0" pos="0 0.2 0"/>
    <geom size="0.1"/>
    <body pos="0 0 0.3"><joint type="ball"/><geom size="0.1"/></body></body>
  <body pos="0 -1 0"><joint axis="0 1 0" pos="0.1 0 0.2"/><geom size="0.1"/>
    <body pos="0 0 0.3"><joint axis="1 0 0"/><geom size="0.1"/></body></body>
</worldbody></mujoco>"""
# more levels than are unrolled
CHAIN = "<mujoco><worldbody>{}</worldbody></mujoco>".format(
    '<body pos="0 0 0.1"><joint axis="1 1 0" pos="0 0.02 0"/><geom size="0.02"/>' * 30
    + "</body>" * 30
)


@pytest.fixture(scope="module", params=["tree", pytest.param("deep", marks=pytest.mark.slow)])
def chain_and_q(request):
    chain = svkc.load(TREE if request.param == "tree" else CHAIN)
    q = chain.state().q + 0.5 * jax.random.normal(jax.random.key(0), chain.q_load.shape)
    # quaternions of any length: the kinematics normalize them
    return chain, q


def by_geometry(chain, function):
    """Return q and the parameters of the geometry -> function(chain, q), and the parameters."""
    leaves = lambda c: (c.quat, c.pos, c.axis, c.q_load, c.anchor)
    return lambda q, x: function(eqx.tree_at(leaves, chain, x), q), leaves(chain)


def as_vector(kin):
    return jnp.concatenate([x.ravel() for x in jax.tree.leaves(kin)])


def test_derivatives_are_those_of_automatic_differentiation(chain_and_q):
    chain, q = chain_and_q
    ours, x = by_geometry(chain, kinematics)
    automatic, _ = by_geometry(chain, _kinematics)
    jacobians = lambda f: jax.jit(lambda q, x: jax.jacrev(f, (0, 1))(q, x))(q, x)
    for got, expected in zip(*map(jax.tree.leaves, map(jacobians, (ours, automatic))), strict=True):
        np.testing.assert_allclose(got, expected, atol=1e-13)
    tangent = jax.tree.map(lambda x: jnp.sin(jnp.arange(x.size)).reshape(x.shape), (q, x))
    got, expected = (
        jax.jit(lambda f=f: jax.jvp(f, (q, x), tangent)[1])() for f in (ours, automatic)
    )
    np.testing.assert_allclose(as_vector(got), as_vector(expected), atol=1e-13)


@pytest.mark.slow
def test_second_derivatives_are_those_of_automatic_differentiation(chain_and_q):
    chain, q = chain_and_q
    weights = jnp.cos(jnp.arange(as_vector(kinematics(chain, q)).size))
    hessian = lambda f: jax.jit(jax.hessian(lambda q: as_vector(f(chain, q)) @ weights))(q)
    np.testing.assert_allclose(hessian(kinematics), hessian(_kinematics), atol=1e-12)


def test_derivative_by_q_against_central_differences(chain_and_q):
    chain, q = chain_and_q
    direction, h = jnp.sin(jnp.arange(q.size)), 1e-6
    f = jax.jit(lambda q: as_vector(kinematics(chain, q)))
    differences = (f(q + h * direction) - f(q - h * direction)) / (2 * h)
    np.testing.assert_allclose(jax.jvp(f, (q,), (direction,))[1], differences, atol=1e-8)


def test_a_zero_quaternion_has_finite_derivatives(chain_and_q):
    chain, q = chain_and_q
    assert np.all(
        np.isfinite(jax.jit(jax.jacrev(lambda q: as_vector(kinematics(chain, q))))(0 * q))
    )


def test_parameters_that_are_not_of_the_geometry_have_no_derivative(chain_and_q):
    chain, q = chain_and_q
    by_mass = lambda mass: as_vector(kinematics(eqx.tree_at(lambda c: c.mass, chain, mass), q))
    np.testing.assert_array_equal(jax.jit(jax.jacfwd(by_mass))(chain.mass), 0)


SLIDES = """<mujoco><worldbody><body><joint type="slide" axis="1 0 0"/><geom size="0.1"/>
  <body pos="1 0 0" euler="0 30 0"><joint type="slide" axis="0 1 0"/><geom size="0.1"/></body>
</body></worldbody></mujoco>"""


@pytest.mark.slow
@pytest.mark.parametrize("model", [SLIDES, TREE])
@pytest.mark.parametrize("batched", ["q", "pos"])
def test_derivatives_of_compiled_batches(model, batched):
    """The rotations depend neither on slides nor on `pos`, and `vmap` batches one of these."""
    chain = svkc.load(model)
    lane = lambda q, pos: as_vector(kinematics(eqx.tree_at(lambda c: c.pos, chain, pos), q))
    at = {"q": chain.state().q + 0.3, "pos": chain.pos}
    axes = {name: 0 if name == batched else None for name in at}
    at[batched] = jnp.stack([at[batched], 1.5 * at[batched], 0.5 * at[batched]])
    compiled = jax.jit(jax.vmap(lane, tuple(axes.values())))
    for i, derivative in ((0, jax.jacfwd), (1, jax.jacfwd), (0, jax.jacrev), (1, jax.jacrev)):
        jacobian = derivative(compiled, i)(*at.values())
        if i == list(at).index(batched):  # no lane depends on another
            jacobian = jnp.moveaxis(jnp.diagonal(jacobian, 0, 0, 2), -1, 0)
        for k, own in enumerate(jacobian):
            of_lane = [x[k] if name == batched else x for name, x in at.items()]
            np.testing.assert_allclose(own, jax.jacfwd(lane, i)(*of_lane), atol=1e-14)
