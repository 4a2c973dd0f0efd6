"""Cholesky factorisation and triangular solves whose batches are split into small chunks.

jaxlib 0.10 splits a batch of more than 2e5 operations over its thread pool, and blocks the calling
thread until they are done. If several CPU devices share the pool, all threads may block, which is a
deadlock. There, `lax.map` runs the batch in chunks below that size.
"""

import functools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

# largest number of operations that jaxlib runs in one thread
SINGLE_THREAD_OPERATIONS = 200_000 - 1


def _in_chunks(function: Callable, cost: Callable) -> Callable:
    """Return `function` of matrices [*lanes, n, m], with batches over `lanes` split into chunks.

    cost: the number of operations for one lane, from the shapes [n, m] of the matrices.
    """

    @jax.custom_batching.custom_vmap
    def batch(*matrices):
        lanes = matrices[0].shape[:-2]
        count = math.prod(lanes)
        cost_per_lane = max(1, cost(*(x.shape[-2:] for x in matrices)))
        max_chunk = max(1, SINGLE_THREAD_OPERATIONS // cost_per_lane)
        if count <= max_chunk or jax.default_backend() != "cpu" or jax.local_device_count() == 1:
            return function(*matrices)
        chunk = max(n for n in range(1, max_chunk + 1) if count % n == 0)
        out = lax.map(
            lambda chunk_matrices: function(*chunk_matrices),
            tuple(x.reshape(count // chunk, chunk, *x.shape[-2:]) for x in matrices),
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
    """Return A^-1 x, or A^-T x if `trans`, for a triangular A.

    Only the triangle named by `lower` is read. There is no derivative rule: use this function as
    the `solve` of a `custom_linear_solve`.
    """
    return _triangular_solver(lower, trans)(A, x.reshape(x.shape[0], -1)).reshape(x.shape)


def cholesky_solver(A: Float[Array, "n n"]) -> Callable:
    """Return a function that maps x [n] or [n m] to A^-1 x, for a symmetric positive definite A.

    A is factored once. As for `batched_solve_triangular`, there is no derivative rule.
    """
    L = _cholesky(A)
    return lambda x: batched_solve_triangular(
        L, batched_solve_triangular(L, x, lower=True), trans=True, lower=True
    )
