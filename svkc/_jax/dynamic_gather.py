"""Gather of rows by an index known at run time; its derivative has masked sums, not a scatter.

A kernel of `one_kernel` cannot hold a scatter at several indices.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int


@jax.custom_jvp
def take_rows(x: Array, index: Int[Array, " m"]) -> Array:
    """Return x[index] along the first axis, for a short index from 0 to the last row of x."""
    return x.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)


@take_rows.defjvp
def _take_rows_jvp(primals, tangents):
    (x, index), (dx, _) = primals, tangents
    rows = jnp.arange(x.shape[0], dtype=index.dtype).reshape(-1, *(1,) * (x.ndim - 1))
    take_row = lambda i: jnp.sum(jnp.where(rows == i, dx, 0), 0)
    # On a CPU a loop: from one masked sum, XLA would recompute the cotangents for each row of x.
    mapped = jax.lax.map if jax.default_backend() == "cpu" else lambda f, xs: jax.vmap(f)(xs)
    return take_rows(x, index), mapped(take_row, index)
