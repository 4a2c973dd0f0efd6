"""Sums in short loops, and sums that XLA does not leave to a library."""

import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import svkc
import svkc.scenes
from svkc._jax import chunked_sum
from svkc._jax.lanes_last import with_lanes_last

# so many matrices that XLA leaves the sums of their products to the library
MATRICES, LANES = 30, 32


@pytest.mark.parametrize("sum_over", [jnp.sum, chunked_sum.sum_without_library])
@pytest.mark.parametrize("shape", [(0, 3), (1, 3), (8, 3), (20, 3), (20, 300)])
def test_sums_equal_those_of_numpy(sum_over, shape):
    x = np.random.default_rng(0).normal(size=shape)
    total = chunked_sum.sum_in_chunks(jnp.asarray(x), (0,), sum_over)
    np.testing.assert_allclose(total, x.sum(0), atol=1e-14)
    total = chunked_sum.sum_in_chunks(jnp.asarray(x), (0, 1), sum_over)
    np.testing.assert_allclose(total, x.sum(), atol=1e-12)


@pytest.mark.parametrize("dtype", [jnp.int32, jnp.float32, jnp.float64])
def test_types_are_kept(dtype):
    x = jnp.arange(20, dtype=dtype)
    total = chunked_sum.sum_in_chunks(x, (0,), chunked_sum.sum_without_library)
    assert total.dtype == dtype
    assert total == 190


def products(A, B):
    """Return the products of two arrays of matrices, as sums and by `dot_general`."""
    return jnp.sum(A[..., None] * B[..., None, :, :], -2), A @ B


def library_calls(function, *args) -> int:
    """Return how many sums XLA leaves to a library."""
    return jax.jit(function).lower(*args).compile().as_text().count("__ynn_fusion")


def test_lanes_last_calls_no_library():
    """XLA leaves sums of a plain `vmap` to a library, and none of those with the lanes last."""
    A = jnp.ones((LANES, MATRICES, 3, 3))
    assert library_calls(jax.vmap(with_lanes_last(products)), A, A) == 0
    if chunked_sum.HAS_SUM_LIBRARY and "ynn_fusion_type" not in os.environ.get("XLA_FLAGS", ""):
        assert library_calls(jax.vmap(products), A, A) > 0


def test_a_batch_of_steps_calls_no_library():
    chain, state = svkc.scenes.high_bar(ignore="limit")
    batch = jax.tree.map(lambda x: jnp.broadcast_to(x, (LANES, *x.shape)), state)
    step = lambda state: svkc.step(chain, state, jnp.zeros(chain.nv), 2e-3)
    assert library_calls(jax.vmap(step), batch) == 0
