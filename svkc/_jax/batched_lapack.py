"""LAPACK's factors and solves, in a batch a few matrices at a time.

jaxlib 0.10 deals a batch of more than 2e5 operations to its threads and blocks the one that waits
for them. Where several CPU devices share those threads all of them may come to wait, for ever:
there a batch goes in parts that are small enough.
"""

import functools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

# operations that jaxlib does in one thread
SINGLE_THREAD_OPERATIONS = 200_000 - 1


def _in_chunks(function: Callable, cost: Callable) -> Callable:
    """A function of matrices [*lanes, n, m] with any lanes; cost: operations for one of them, from
    shapes."""

    @jax.custom_batching.custom_vmap
    def batch(*matrices):
        lanes = matrices[0].shape[:-2]
        many, most = (
            math.prod(lanes),
            max(1, SINGLE_THREAD_OPERATIONS // max(1, cost(*(x.shape[-2:] for x in matrices)))),
        )
        if many <= most or jax.default_backend() != "cpu" or jax.local_device_count() == 1:
            return function(*matrices)
        size = max(n for n in range(1, most + 1) if many % n == 0)
        out = lax.map(
            lambda own: function(*own),
            tuple(x.reshape(many // size, size, *x.shape[-2:]) for x in matrices),
        )
        return out.reshape(*lanes, *out.shape[-2:])

    @batch.def_vmap
    def _(lanes: int, flags, *matrices):
        return batch(
            *(
                x if flag else jnp.broadcast_to(x, (lanes, *x.shape))
                for x, flag in zip(matrices, flags, strict=True)
            )
        ), True

    return batch


_cholesky = _in_chunks(
    functools.partial(lax.linalg.cholesky, symmetrize_input=False), lambda A: A[0] ** 3 // 3
)


@functools.cache
def _triangular_solver(lower: bool, trans: bool) -> Callable:
    solve = functools.partial(
        lax.linalg.triangular_solve, left_side=True, lower=lower, transpose_a=trans
    )
    return _in_chunks(solve, lambda A, x: x[0] * x[0] * x[1])


def batched_solve_triangular(
    A: Float[Array, "n n"], x: Float[Array, "n *m"], trans: bool = False, lower: bool = False
) -> Float[Array, "n *m"]:
    """A^-1 x or A^-T x; only the triangle that is named is read. Not to be differentiated: for the
    `solve` of a `custom_linear_solve`."""
    return _triangular_solver(lower, trans)(A, x.reshape(x.shape[0], -1)).reshape(x.shape)


def cholesky_solver(A: Float[Array, "n n"]) -> Callable:
    """What takes x [n] or [n m] to A^-1 x, by Cholesky's factor of a symmetric positive A; the same
    is true of it."""
    L = _cholesky(A)
    return lambda x: batched_solve_triangular(
        L, batched_solve_triangular(L, x, lower=True), trans=True, lower=True
    )
