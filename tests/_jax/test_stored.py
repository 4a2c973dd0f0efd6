"""Sines and cosines that XLA stores."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from svkc._jax.lanes_last import with_lanes_last
from svkc._jax.stored import stored
from svkc.tree.spatial import quat_exp, quat_from_axis_angle, quat_multiply


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_value_is_exact(dtype):
    x = jnp.asarray([0.0, -0.0, 1 / 3, -1e-30, 1e30, np.inf, -np.inf, np.nan], dtype)
    result = jax.jit(stored)(x)
    assert result.dtype == dtype
    np.testing.assert_array_equal(np.asarray(result).view(np.uint8), np.asarray(x).view(np.uint8))


def test_derivatives():
    """The derivative is that of x, also where x is infinite and in a batch."""
    f = lambda x: jnp.sin(stored(x**3))
    expected = lambda x: jnp.sin(x**3)
    x = jnp.asarray([0.7, -1.3])
    for derivative in (jax.jacfwd, jax.jacrev, jax.hessian):
        for batch in (jax.vmap, lambda f: jax.vmap(with_lanes_last(f))):
            got, value = batch(derivative(f))(x), jax.vmap(derivative(expected))(x)
            np.testing.assert_allclose(got, value, rtol=1e-14)
    assert jax.grad(stored)(jnp.asarray(jnp.inf)) == 1


def recomputed(function, *args) -> int:
    """Return how many kernels compute both a sine or a cosine and a sum."""
    text = jax.jit(function).lower(*args).compile().as_text()
    computations = re.findall(r"^(?:ENTRY )?%?\S+ \(.*?^}", text, re.M | re.S)
    return sum(bool(re.search(r" (co)?sine\(", c)) and " reduce(" in c for c in computations)


def by_textbook(axis, angle):
    """Return the quaternion of a rotation, without `stored`."""
    half = angle[..., None] / 2
    return jnp.concatenate([jnp.cos(half), jnp.sin(half) * axis], -1)


def test_sines_and_cosines_are_computed_once():
    """A product of quaternions computes neither; without `stored` it does."""
    angle, axis = jnp.ones((32, 4)), jnp.asarray(np.eye(3)[[0, 1, 2, 0]])
    at_load = jnp.asarray([[0.5, 0.5, -0.5, 0.5]])
    rotate = lambda rotation: lambda angle: quat_multiply(at_load, rotation(angle))
    of_vector = lambda angle: quat_exp(angle[:, None] * axis)
    kernels = lambda f: recomputed(jax.vmap(with_lanes_last(rotate(f))), angle)
    assert kernels(lambda angle: quat_from_axis_angle(axis, angle)) == 0
    assert kernels(of_vector) == 0
    assert kernels(lambda angle: by_textbook(axis, angle)) > 0
