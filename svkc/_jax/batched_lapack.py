"""Factorisations and solves in pieces that LAPACK computes in one thread.

jaxlib before 0.11.1 splits a batch of more than 2e5 operations over its thread pool, and blocks the
calling thread until they are done. If as many such calls block at once as the pool has threads, the
program deadlocks. The calls may be independent operations of one program, or belong to several CPU
devices. `lax.map` therefore runs large batches in chunks below that size.

OpenBLAS, which jaxlib calls, distributes one large matrix over threads of its own. Where another
thread uses the processor, these wait for one another for milliseconds. Large matrices are therefore
factored by Cholesky in blocks, and many right-hand sides solved in groups. LU is not blocked.
"""

import functools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

# largest number of operations that jaxlib runs in one thread
SINGLE_THREAD_OPERATIONS = 200_000 - 1
# Cholesky factorisations of fewer rows run in one thread of OpenBLAS
CHOLESKY_THREADED_ROWS = 128
# so do triangular solves whose right-hand sides have at most so many entries
SOLVE_SINGLE_THREAD_ENTRIES = 1000


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
        if count <= max_chunk or jax.default_backend() != "cpu":
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
def _triangular_solver(lower: bool, trans: bool, unit: bool) -> Callable:
    solve = functools.partial(
        lax.linalg.triangular_solve,
        left_side=True,
        lower=lower,
        transpose_a=trans,
        unit_diagonal=unit,
    )
    return _in_chunks(solve, lambda A, x: x[0] * x[0] * x[1])


def batched_solve_triangular(
    A: Float[Array, "n n"],
    x: Float[Array, "n *m"],
    trans: bool = False,
    lower: bool = False,
    unit: bool = False,
) -> Float[Array, "n *m"]:
    """Return A^-1 x, or A^-T x if `trans`, for a triangular A.

    Only the triangle named by `lower` is read. If `unit`, its diagonal is taken as ones. There is
    no derivative rule: use this function as the `solve` of a `custom_linear_solve`.
    """
    solver, columns = _triangular_solver(lower, trans, unit), x.reshape(len(x), -1)
    solve = functools.partial(solver, A)
    width = max(1, SOLVE_SINGLE_THREAD_ENTRIES // max(1, len(x)))
    if columns.shape[1] <= width or jax.default_backend() != "cpu":
        return solve(columns).reshape(x.shape)
    rows = columns.T
    padded = jnp.concatenate([rows, jnp.zeros((-len(rows) % width, len(x)), x.dtype)])
    out = lax.map(lambda y: solve(y.T).T, padded.reshape(-1, width, len(x)))
    return out.reshape(padded.shape)[: len(rows)].T.reshape(x.shape)


def _blocked_cholesky(A: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Return the lower Cholesky factor of A, of which the lower triangle is read."""
    if len(A) < CHOLESKY_THREADED_ROWS or jax.default_backend() != "cpu":
        return _cholesky(A)
    n = len(A) // 2
    first = _blocked_cholesky(A[:n, :n])
    below = batched_solve_triangular(first, A[n:, :n].T, lower=True).T
    second = _blocked_cholesky(A[n:, n:] - below @ below.T)
    return jnp.block([[first, jnp.zeros_like(below.T)], [below, second]])


def cholesky_solver(A: Float[Array, "n n"]) -> Callable:
    """Return a function that maps x [n] or [n m] to A^-1 x, for a symmetric positive definite A.

    A is factored once. As for `batched_solve_triangular`, there is no derivative rule.
    """
    L = _blocked_cholesky(A)
    return lambda x: batched_solve_triangular(
        L, batched_solve_triangular(L, x, lower=True), trans=True, lower=True
    )


def _packed_lu(A):
    """Return LU factors, then a column with the permutation and one with the pivots."""
    lu, pivots, order = lax.linalg.lu(A)
    return jnp.concatenate([lu, jnp.stack([order, pivots], -1).astype(A.dtype)], -1)


_lu = _in_chunks(_packed_lu, lambda A: A[0] ** 3)


def factor_general(
    A: Float[Array, "*lanes n n"],
) -> tuple[Float[Array, "*lanes n n"], Int[Array, "*lanes n"], Bool[Array, "*lanes"]]:
    """Return LU factors of regular matrices, the order of their rows, and whether the determinant
    is positive. Not to be differentiated."""
    n, packed = A.shape[-1], _lu(A)
    lu, order, pivots = packed[..., :n], packed[..., n], packed[..., n + 1]
    negative = jnp.diagonal(lu, axis1=-2, axis2=-1) < 0
    odd = negative ^ (pivots != jnp.arange(n, dtype=A.dtype).reshape((1,) * (A.ndim - 2) + (n,)))
    return lu, order.astype(jnp.int32), jnp.sum(odd, -1, dtype=jnp.int32) % 2 == 0


def solve_factored(lu: Float[Array, "n n"], order: Int[Array, " n"], x: Float[Array, "n *m"]):
    """Return A^-1 x from the factors of A."""
    below = batched_solve_triangular(lu, x[order], lower=True, unit=True)
    return batched_solve_triangular(lu, below)


def solve_general(A: Float[Array, "n n"], x: Float[Array, "n *m"]) -> Float[Array, "n *m"]:
    """Return A^-1 x by LU for any regular A; the derivative is one more solve, in both modes."""

    def by(matrix):
        lu, order, _ = factor_general(matrix)
        return lambda _, y: solve_factored(lu, order, y)

    frozen = jax.lax.stop_gradient(A)
    return jax.lax.custom_linear_solve(
        lambda y: A @ y, x, solve=by(frozen), transpose_solve=by(frozen.T)
    )


def solve_lower(L: Float[Array, "n n"], x: Float[Array, "n *m"]) -> Float[Array, "n *m"]:
    """Return L^-1 x for a lower triangular L, differentiable in both arguments."""
    frozen = jax.lax.stop_gradient(L)
    solve = lambda trans: lambda _, y: batched_solve_triangular(frozen, y, trans, lower=True)
    return jax.lax.custom_linear_solve(
        lambda y: L @ y, x, solve=solve(False), transpose_solve=solve(True)
    )


@jax.custom_jvp
def cholesky(A: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Return the lower Cholesky factor L of a symmetric positive definite A.

    With S = L^-1 dA L^-T, the derivative is L times the lower triangle of S, diagonal halved.
    """
    return _blocked_cholesky(A)


@cholesky.defjvp
def _(primals, tangents):
    L = cholesky(*primals)
    S = solve_lower(L, solve_lower(L, tangents[0]).T).T
    return L, L @ (jnp.tril(S, -1) + jnp.diag(jnp.diagonal(S)) / 2)
