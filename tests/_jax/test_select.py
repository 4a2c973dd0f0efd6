"""`where` of svkc against `jnp.where`: values, dtypes, shapes, derivatives and batches."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from svkc._jax.select import where

MASK, X = jnp.asarray([True, False, True]), jnp.asarray([0.5, -1.0, 2.0])
CASES = {
    "arrays": (MASK, X, -X),
    "one condition": (X[0] > 0, X, -X),
    "a number": (MASK, X, 0),
    "two numbers": (MASK, 1, 2),
    "two numbers of different types": (MASK, 1.5, 2),
    "integers": (MASK, jnp.arange(3, dtype=jnp.int32), -1),
    "booleans": (MASK, MASK, False),
    "float32": (MASK, X.astype(jnp.float32), jnp.inf),
    "broadcast": (MASK[:, None], X[None], 0.0),
    "a mask of NumPy": (np.array([True, False, True]), X, 0),
    "an array that gives way": (MASK, jnp.asarray(1.0), X.astype(jnp.float32)),
    "empty": (jnp.zeros(0, bool), jnp.zeros(0), 0),
}


@pytest.mark.parametrize("case", CASES)
def test_equals_jnp_where(case):
    with jax.numpy_rank_promotion("allow"):
        got, expected = where(*CASES[case]), jnp.where(*CASES[case])
    assert (got.dtype, got.shape, got.weak_type) == (
        expected.dtype,
        expected.shape,
        expected.weak_type,
    )
    np.testing.assert_array_equal(got, expected)


def test_derivatives_and_batches():
    function = lambda condition, x: where(condition, jnp.sin(x), 0)
    np.testing.assert_array_equal(
        jax.jacrev(function, 1)(MASK, X), jnp.diag(jnp.where(MASK, jnp.cos(X), 0))
    )
    got = jax.vmap(function, (0, None))(MASK, X)
    np.testing.assert_array_equal(got, jnp.where(MASK[:, None], jnp.sin(X)[None], 0))


def test_fewer_operations():
    count = lambda f: jax.jit(f).lower(MASK, X).as_text().count(" = stablehlo.")
    assert count(lambda m, x: where(m, x, -x)) < count(lambda m, x: jnp.where(m, x, -x)) + 1
    assert "call @_where" not in jax.jit(lambda m, x: where(m, x, 0)).lower(MASK, X).as_text()
