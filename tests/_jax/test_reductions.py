"""Reductions that XLA does not leave to a library."""

import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import svkc
import svkc.scenes
from svkc._jax import reductions
from svkc._jax.lanes_last import with_lanes_last

# so many matrices that XLA leaves the sums of their entries to the library
MATRICES, LANES = 64, 64


@pytest.mark.parametrize("dtype", [jnp.int32, jnp.float32, jnp.float64])
def test_results_and_types(dtype):
    x = np.random.default_rng(0).normal(scale=9, size=(7, 5, 3)).astype(dtype)
    for ours, reference in ((reductions.max_by_xla, np.max), (reductions.min_by_xla, np.min)):
        for axes in ((0,), (0, 2), (0, 1, 2), ()):
            result = ours(jnp.asarray(x), axes)
            assert result.dtype == dtype
            np.testing.assert_array_equal(result, reference(x, axes))
    total = reductions.sum_by_xla(jnp.asarray(x), 1, dtype)
    assert total.dtype == dtype
    np.testing.assert_allclose(total, x.sum(1), rtol=1e-5)


def test_nan_and_infinity():
    nan, infinity = jnp.asarray([1.0, np.nan, 2.0]), jnp.asarray([-np.inf, -np.inf])
    for reduced in (reductions.max_by_xla, reductions.min_by_xla):
        assert jnp.isnan(reduced(nan, (0,)))
        assert reduced(infinity, (0,)) == -jnp.inf
        assert reduced(-infinity, (0,)) == jnp.inf
    assert jnp.isnan(reductions.sum_by_xla(nan, 0, nan.dtype))


def reduce_products(A, B):
    """Return sums of entries, sums, maxima and minima of products, and matrix products."""
    products = A[..., None] * B[..., None, :, :]
    return (
        jnp.sum(A, -2),
        jnp.sum(products, -2),
        jnp.max(products, -2),
        jnp.min(products, -2),
        A @ B,
    )


def library_calls(function, *args) -> int:
    """Return how many reductions XLA leaves to a library."""
    return jax.jit(function).lower(*args).compile().as_text().count("__ynn_fusion")


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_lanes_last_calls_no_library(dtype):
    """XLA leaves reductions of a plain `vmap` to a library, and none of those with lanes last."""
    A = jnp.ones((LANES, MATRICES, 3, 3), dtype)
    assert library_calls(jax.vmap(with_lanes_last(reduce_products)), A, A) == 0
    only_float32 = jax.__version__.startswith("0.10.")
    if only_float32 and dtype == jnp.float64:
        return
    if "ynn_fusion_type" not in os.environ.get("XLA_FLAGS", ""):
        assert library_calls(jax.vmap(reduce_products), A, A) > 0


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_a_batch_of_steps_calls_no_library(dtype):
    with jax.enable_x64(dtype == jnp.float64):
        chain, state = svkc.scenes.high_bar(ignore="limit")
        batch = jax.tree.map(lambda x: jnp.broadcast_to(x, (LANES, *x.shape)), state)
        step = lambda state: svkc.step(chain, state, jnp.zeros(chain.nv, dtype), 2e-3)
        assert library_calls(jax.vmap(step), batch) == 0
