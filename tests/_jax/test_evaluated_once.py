"""Sines and cosines that XLA computes once."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from svkc._jax.evaluated_once import evaluated_once
from svkc._jax.lanes_last import with_lanes_last
from svkc.tree.spatial import quat_from_axis_angle, quat_multiply


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_value_is_exact(dtype):
    x = jnp.asarray([0.0, -0.0, 1 / 3, -1e-30, 1e30, np.inf, -np.inf, np.nan], dtype)
    result = jax.jit(evaluated_once)(x)
    assert result.dtype == dtype
    np.testing.assert_array_equal(np.asarray(result).view(np.uint8), np.asarray(x).view(np.uint8))


def test_derivatives():
    f = lambda x: jnp.sin(evaluated_once(x**3))
    expected = lambda x: jnp.sin(x**3)
    x = 0.7
    for derivative in (jax.jacfwd, jax.jacrev, jax.hessian):
        np.testing.assert_allclose(derivative(f)(x), derivative(expected)(x), rtol=1e-15)


def cosines_within_sums(function, *args) -> int:
    """Return how many kernels compute both a cosine and a sum."""
    text = jax.jit(function).lower(*args).compile().as_text()
    computations = re.findall(r"^%?\S+ \(.*?^}", text, re.M | re.S)
    return sum(" cosine(" in c and " reduce(" in c for c in computations)


def test_cosines_of_joint_angles_are_computed_once():
    """A product of quaternions computes no cosine; without `evaluated_once` it does."""
    angle, axis = jnp.ones((32, 4)), np.eye(3)[[0, 1, 2, 0]]
    at_load = jnp.asarray([[0.5, 0.5, -0.5, 0.5]])
    rotate = lambda angle: quat_multiply(at_load, quat_from_axis_angle(jnp.asarray(axis), angle))

    def rotate_repeatedly(angle):
        half = angle[:, None] / 2
        turn = jnp.concatenate([jnp.cos(half), jnp.sin(half) * axis], -1)
        return quat_multiply(at_load, turn)

    in_batch = lambda f: jax.vmap(with_lanes_last(f))
    assert cosines_within_sums(in_batch(rotate), angle) == 0
    assert cosines_within_sums(in_batch(rotate_repeatedly), angle) > 0
