"""Sums, maxima and minima in short loops."""

import jax.numpy as jnp
import numpy as np
import pytest

from svkc._jax.chunked_sum import reduce_in_chunks, sum_in_chunks
from svkc._jax.reductions import max_by_xla, min_by_xla, sum_by_xla


@pytest.mark.parametrize("sum_over", [jnp.sum, sum_by_xla])
@pytest.mark.parametrize("shape", [(0, 3), (1, 3), (8, 3), (20, 3), (20, 300)])
def test_sums_equal_those_of_numpy(sum_over, shape):
    x = np.random.default_rng(0).normal(size=shape)
    np.testing.assert_allclose(sum_in_chunks(jnp.asarray(x), (0,), sum_over), x.sum(0), atol=1e-14)
    np.testing.assert_allclose(sum_in_chunks(jnp.asarray(x), (0, 1), sum_over), x.sum(), atol=1e-12)


@pytest.mark.parametrize("dtype", [jnp.int32, jnp.float32, jnp.float64])
def test_types_are_kept(dtype):
    total = sum_in_chunks(jnp.arange(20, dtype=dtype), (0,), sum_by_xla)
    assert total.dtype == dtype
    assert total == 190


@pytest.mark.parametrize("shape", [(1, 3), (8, 3), (20, 11)])
def test_extremes_equal_those_of_numpy(shape):
    x = np.random.default_rng(0).normal(size=shape)
    for reduce, join, expected in (
        (max_by_xla, jnp.maximum, np.max),
        (min_by_xla, jnp.minimum, np.min),
    ):
        chunked = lambda x, axes, reduce=reduce, join=join: reduce_in_chunks(
            jnp.asarray(x), axes, reduce, join
        )
        np.testing.assert_array_equal(chunked(x, (0,)), expected(x, 0))
        assert chunked(x, (0, 1)) == expected(x)
        with_nan = x.copy()
        with_nan[-1, -1] = np.nan
        assert np.isnan(chunked(with_nan, (0, 1)))
