"""Pivoted QR of the loop Jacobian: pivots, rank, and solves with the pivots held fixed.

Pivots are chosen on stop_gradient(J) and have no derivative. Everything computed from them has
exact derivatives wherever the rank does not change.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from svkc._jax.batched_lapack import (
    batched_solve_triangular,
    cholesky,
    cholesky_solver,
    solve_lower,
)
from svkc._jax.control_flow import unvmap_any
from svkc._jax.one_kernel import one_kernel
from svkc._jax.primitive import custom_primitive
from svkc._jax.select import where
from svkc.model.annotations import DType
from svkc.model.chain import Structure


class PivotedQR(eqx.Module):
    """QR decomposition J P^T = Q^T R of a matrix's pivot columns, with inert steps.

    Q: orthonormal rows, zero for inert steps.
    P: one-hot rows that pick the pivot columns, zero for inert steps. It has no derivative.
    diag_R: |R_kk|, decreasing unless columns were weighted (`independent`) or pivots given.
    active: the steps that count; they are as many as the rank.
    Q and diag_R have derivatives by which Q's rows span the pivot columns' range (`frozen_qr`).
    """

    Q: Float[Array, "steps rows"]
    P: Float[Array, "steps dofs"]
    diag_R: Float[Array, " steps"]
    active: Bool[Array, " steps"]


def rank_tolerance(dtype: DType) -> float:
    """Return the |R_kk| / |R_11| below which a row of the scaled J_C counts as redundant.

    It is sqrt(eps): 1.5e-8 in float64, 3.5e-4 in float32.
    """
    return float(np.sqrt(np.finfo(dtype).eps))


def release_threshold(dtype: DType) -> float:
    """Return the fraction of the phase's margin below which a row of the scaled J_C is dropped.

    It is eps^(1/4): 1.2e-4 in float64, 1.9e-2 in float32. A mechanism that passes a singular
    configuration has such weak rows, along which round-off would decide the motion. Weak rows are
    dropped there; the motion continues by inertia.
    """
    return float(np.finfo(dtype).eps ** 0.25)


def _with_active(qr: PivotedQR, keep: Bool[Array, " steps"]) -> PivotedQR:
    """Return the decomposition in which only the steps `keep` are active."""
    return PivotedQR(
        Q=where(keep[:, None], qr.Q, 0),
        P=where(keep[:, None], qr.P, 0),
        diag_R=qr.diag_R,
        active=keep,
    )


def drop_below(qr: PivotedQR, floor: Float[Array, ""]) -> PivotedQR:
    """Return the decomposition without the steps whose |R_kk| / |R_11| is not above the floor.

    The pivots of these steps become independent coordinates.
    """
    return _with_active(qr, qr.active & (qr.diag_R > floor * jnp.max(qr.diag_R)))


def pivoted_qr(
    J: Float[Array, "rows dofs"],
    rank: Int[Array, ""] | None = None,
    independent: Bool[Array, " dofs"] | None = None,
) -> PivotedQR:
    """Return the column-pivoted QR of J by Gram-Schmidt with re-orthogonalisation.

    rank: number of active steps (None: all whose column is not zero).
    independent: columns that become pivots only if no other column is left (None: none).
    """
    Q, P, diag_R = _search_pivots(jax.lax.stop_gradient(J), rank, independent)
    Q, diag_R = frozen_qr(J, Q, P, diag_R)
    return PivotedQR(Q=Q, P=P, diag_R=diag_R, active=jnp.any(P > 0, 1))


@one_kernel
def _search_pivots(
    J: Float[Array, "rows dofs"],
    rank: Int[Array, ""] | None,
    independent: Bool[Array, " dofs"] | None,
) -> tuple[Float[Array, "steps rows"], Float[Array, "steps dofs"], Float[Array, " steps"]]:
    """Choose pivots in min(rows, dofs) steps; return Q, P and diag_R. J has no derivative."""
    rows, dofs = J.shape
    steps = min(rows, dofs)
    weight = 1.0
    if independent is not None:
        weight = where(independent, rank_tolerance(J.dtype) ** 2, 1).astype(J.dtype)

    def step(k, carry):
        A, Q, P, diag_R = carry
        norms = jnp.sum(A * A, 0) * weight
        # Of columns equal but for round-off, such as those of mirrored limbs, the first is taken,
        # so that every machine takes the same.
        pivot = jnp.arange(dofs) == jnp.argmax(
            norms >= (1 - rank_tolerance(J.dtype)) * jnp.max(norms)
        )
        column = jnp.sum(where(pivot[None], A, 0), 1)
        column = column - (Q @ column) @ Q
        r = jnp.sqrt(jnp.sum(column * column))
        accept = r > 0 if rank is None else (r > 0) & (k < rank)
        q = where(accept, column / where(accept, r, 1), 0)
        A = where(pivot[None], 0, A - q[:, None] * (q @ A)[None])
        at_k = jnp.arange(steps) == k
        Q = where(at_k[:, None], q[None], Q)
        P = where(at_k[:, None] & pivot[None] & accept, 1, P)
        return A, Q, P, where(at_k, r, diag_R)

    start = (
        J,
        jnp.zeros((steps, rows), J.dtype),
        jnp.zeros((steps, dofs), J.dtype),
        jnp.zeros(steps, J.dtype),
    )
    return jax.lax.fori_loop(0, steps, step, start)[1:]


def refactor(J: Float[Array, "rows dofs"], P: Float[Array, "steps dofs"]) -> PivotedQR:
    """Return the QR of J for given pivots P, without a search for pivots."""
    active = jnp.any(P > 0, 1)
    columns = P @ jax.lax.stop_gradient(J).T

    def step(k, carry):
        Q, diag_R = carry
        column = columns[k]
        for _ in range(2):
            column = column - (Q @ column) @ Q
        r = jnp.sqrt(jnp.sum(column * column))
        at_k = (jnp.arange(active.shape[0]) == k) & (r > 0)
        return where(at_k[:, None], (column / where(r > 0, r, 1))[None], Q), where(at_k, r, diag_R)

    start = jnp.zeros((active.shape[0], J.shape[0]), J.dtype), jnp.zeros(active.shape[0], J.dtype)
    Q, diag_R = jax.lax.fori_loop(0, active.shape[0], step, start)
    Q, diag_R = frozen_qr(J, Q, P, diag_R)
    return PivotedQR(Q=Q, P=P, diag_R=diag_R, active=active & (diag_R > 0))


def _frozen_qr_jvp(primals, tangents):
    """Return the derivatives of Q and diag_R with respect to J, for fixed pivots.

    From J P^T = Q^T R, with R held fixed: Q = R^-T P J^T and dQ = R^-T P dJ^T. The rows of such a Q
    span the pivot columns' range but do not stay orthonormal, and R is no longer the factor of J.
    That factor follows from the Gram matrix of the pivot columns, R^T (Q Q^T) R = R^T L L^T R with
    the Cholesky factor L of Q Q^T: it is L^T R, with diagonal L_kk R_kk. As dL_kk / L_kk is half of
    (L^-1 d(Q Q^T) L^-T)_kk, d log |R_kk| = (L^-1 dQ . L^-1 Q)_k, a dot product of rows.
    """
    J, _, P, _ = primals
    Q, diag_R = frozen_qr(*primals)
    unused = jnp.diag(where(jnp.any(P > 0, 1), 0, 1).astype(J.dtype))
    R = jax.lax.stop_gradient(Q @ J @ P.T) + unused
    dQ = solve_pivot_block(R, (tangents[0] @ P.T).T, trans=True)
    L = cholesky(Q @ Q.T + unused)
    along = jnp.sum(solve_lower(L, dQ) * solve_lower(L, Q), 1)
    return (Q, diag_R), (dQ, diag_R * along)


# Returns Q and diag_R, already computed from J with the pivots P, with the derivatives above.
frozen_qr: Callable[..., Any] = custom_primitive(
    "frozen_qr", lambda J, Q, P, diag_R: (Q, diag_R), _frozen_qr_jvp
)


def count_rank(diag_R: Float[Array, " steps"]) -> Int[Array, ""]:
    """Return the rank: how many |R_kk| are above `rank_tolerance` times |R_11|."""
    return jnp.sum(
        diag_R > rank_tolerance(diag_R.dtype) * jnp.maximum(diag_R[0], jnp.finfo(diag_R.dtype).tiny)
    ).astype(jnp.int32)


def pivot_ratio(qr: PivotedQR) -> Float[Array, ""]:
    """Return the least |R_kk| of the active steps over the largest, and 1 if no step is active."""
    diag_R, has_active = qr.diag_R, jnp.any(qr.active)
    least = jnp.min(diag_R, initial=jnp.inf, where=qr.active)
    return where(has_active, least, 1) / where(has_active, jnp.max(diag_R), 1)


def pivoted_qr_with_rank(J: Float[Array, "rows dofs"]) -> tuple[PivotedQR, Int[Array, ""]]:
    """Return the pivoted QR of J with its own rank, and that rank, by one search for pivots."""
    full = pivoted_qr(jax.lax.stop_gradient(J))
    rank = count_rank(full.diag_R)
    # Steps past the rank do not change earlier ones. They are round-off, whose derivative is not
    # finite.
    first = _with_active(
        full, full.active & (jnp.arange(full.active.shape[0], dtype=jnp.int32) < rank)
    )
    Q, diag_R = frozen_qr(J, first.Q, first.P, first.diag_R)
    return PivotedQR(Q=Q, P=first.P, diag_R=diag_R, active=first.active), rank


def lacks_pivots(P: Float[Array, "steps dofs"], rank: Int[Array, ""]) -> Bool[Array, ""]:
    """Return whether P has fewer pivots than the rank, as before the first choice of pivots."""
    return jnp.sum(jnp.any(P > 0, 1), dtype=jnp.int32) < rank


def solve_pivot_block(
    B: Float[Array, "steps steps"], x: Float[Array, "steps *n"], trans: bool = False
) -> Float[Array, "steps *n"]:
    """Return B^-1 x, or B^-T x, for the block B = J_S of `pivot_blocks`.

    B is upper triangular in value, but its derivative is not, as the pivots are fixed.
    """
    triangle = jax.lax.stop_gradient(B)
    return jax.lax.custom_linear_solve(
        lambda y: (B.T if trans else B) @ y,
        x,
        solve=lambda _, y: batched_solve_triangular(triangle, y, trans),
        transpose_solve=lambda _, y: batched_solve_triangular(triangle, y, not trans),
    )


def solve_positive(A: Float[Array, "n n"], x: Float[Array, "n *m"]) -> Float[Array, "n *m"]:
    """Return A^-1 x for a symmetric positive definite A, by Cholesky.

    A derivative costs one more solve with the same factor.
    """
    inverse = cholesky_solver(jax.lax.stop_gradient(A))
    return jax.lax.custom_linear_solve(
        lambda y: A @ y, x, solve=lambda _, y: inverse(y), symmetric=True
    )


def pivot_blocks(
    qr: PivotedQR, J: Float[Array, "rows dofs"]
) -> tuple[Float[Array, "steps dofs"], Float[Array, "steps steps"]]:
    """Return J_Cm = Q J_C and J_S, for the J_C from which the decomposition was computed.

    J_Cm has the m independent rows (paper (12)), J_S its pivot columns in order (14). J_S has ones
    on the diagonal of inert steps.
    """
    Jm = qr.Q @ J
    return Jm, Jm @ qr.P.T + jnp.diag(where(qr.active, 0, 1).astype(J.dtype))


# Fraction of the phase's margin below which a configuration counts as near a singular one.
# Elsewhere the motion does not depend on the choice of pivots.
NEAR_SINGULAR = 0.1


def singularity_threshold(structure: Structure) -> Float[Array, ""]:
    """Return the margin below which a configuration counts as near a singular one.

    It is `NEAR_SINGULAR` of the phase's margin, and at least eps^(3/16) (float64: 1.2e-3), where
    the square of the loops' condition number leaves too few digits.
    """
    eps = jnp.finfo(structure.margin.dtype).eps
    return jnp.maximum(NEAR_SINGULAR * structure.margin, eps ** (3 / 16))


def has_redundant_rows(structure: Structure) -> Bool[Array, ""]:
    """Return whether the connected virtual links have more rows than the phase's rank."""
    return structure.rank < 6 * jnp.sum(structure.connected, dtype=jnp.int32)


def select_pivots(
    structure: Structure, J: Float[Array, "rows dofs"], pivots: Any = None
) -> PivotedQR:
    """Return the pivoted QR of J_C with the phase's rank, without the rows to be dropped.

    Coordinates in `structure.independent` become pivots only if no other is left. Rows below
    `release_threshold` are dropped.

    pivots [steps, dofs]: one-hot pivots chosen earlier (None: choose now). Near a singular
    configuration, and if they are fewer than the rank, new ones are chosen.
    """
    choose = lambda: pivoted_qr(J, structure.rank, structure.independent)
    if pivots is None:
        qr = choose()
    else:
        kept = refactor(J, pivots)
        near = (pivot_ratio(kept) < NEAR_SINGULAR * structure.margin) | lacks_pivots(
            pivots, structure.rank
        )
        # under `vmap`, one lane near a singular configuration makes all lanes compute new pivots
        qr = jax.lax.cond(
            unvmap_any(near),
            lambda: jax.tree.map(lambda a, b: where(near, a, b), choose(), kept),
            lambda: kept,
        )
    return drop_below(qr, release_threshold(J.dtype) * structure.margin)
