"""Reductions by code of XLA's CPU backend, not by a library that it calls.

XLA's CPU backend leaves sums, maxima and minima over large arrays to a library: from jax 0.11 on
those over 4,096 numbers or more, with jax 0.10 those over 32,768 or more in float32. The library is
slow for reductions over short axes, and XLA does not compile a loop with such a call into a single
kernel (benchmarks/README.md). XLA recognizes these reductions by their reducers a + b, max(a, b)
and min(a, b). The reducers here have the same results in another form.

Use these functions where nothing is differentiated: JAX has no short derivatives of such reducers.
"""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array


def sum_by_xla(x: Array, axis: int, dtype) -> Array:
    """Return `jnp.sum(x, axis, dtype)`."""
    if not _calls_library(x):
        return jnp.sum(x, axis, dtype)
    return _reduce(x, 0.0, lambda a, b: a - (-b), (axis,))


def max_by_xla(x: Array, axes: Sequence[int]) -> Array:
    """Return `lax.reduce_max(x, axes)`."""
    if not _calls_library(x):
        return lax.reduce_max(x, tuple(axes))
    return _reduce(x, -jnp.inf, lambda a, b: -lax.min(-a, -b), axes)


def min_by_xla(x: Array, axes: Sequence[int]) -> Array:
    """Return `lax.reduce_min(x, axes)`."""
    if not _calls_library(x):
        return lax.reduce_min(x, tuple(axes))
    return _reduce(x, jnp.inf, lambda a, b: -lax.max(-a, -b), axes)


def _calls_library(x: Array) -> bool:
    """Return whether XLA may leave a reduction to the library."""
    return jnp.issubdtype(x.dtype, jnp.floating) and jax.default_backend() == "cpu"


def _reduce(x: Array, init: float, reducer: Callable, axes: Sequence[int]) -> Array:
    return lax.reduce(x, jnp.asarray(init, x.dtype), reducer, tuple(axes))
