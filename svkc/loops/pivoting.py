"""Which columns of a matrix are independent: pivots, rank, and solves with that choice held fixed.

Pivots are integers chosen on stop_gradient(J). What follows from them is exact to differentiate
wherever the rank does not change.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float, Int

from svkc._jax.batched_lapack import batched_solve_triangular, cholesky_solver
from svkc._jax.control_flow import unvmap_any
from svkc._jax.primitive import custom_primitive
from svkc.model.chain import Structure


class PivotedQR(eqx.Module):
    """Pivoted Gram-Schmidt of a matrix: Q [steps, rows], one-hot pivots P [steps, dofs], |R_kk|,
    and which steps count.

    P is frozen; Q and |R_kk| follow the matrix when it is differentiated, so that Q's rows go on
    spanning the range of the pivot columns.
    """

    Q: Float[Array, "steps rows"]
    P: Float[Array, "steps dofs"]
    diag_R: Float[Array, " steps"]
    active: Bool[Array, " steps"]


def rank_tolerance(dtype) -> float:
    """|R_kk| / |R_11| below which a row of the scaled J_C counts as redundant: sqrt(eps), 1.5e-8 in
    float64, 3.5e-4 in float32."""
    return float(np.sqrt(np.finfo(dtype).eps))


def release_threshold(dtype) -> float:
    """The part of the phase's own margin below which a row of the scaled J_C is let go for as long
    as the mechanism passes a singular configuration: eps^(1/4), 1.2e-4 in float64, 1.9e-2 in
    float32. Nearer to it round-off would steer the motion; what moves goes on as it moves."""
    return float(np.finfo(dtype).eps ** 0.25)


def _with_active(selection: PivotedQR, keep: Bool[Array, " steps"]) -> PivotedQR:
    return PivotedQR(
        Q=jnp.where(keep[:, None], selection.Q, 0),
        P=jnp.where(keep[:, None], selection.P, 0),
        diag_R=selection.diag_R,
        active=keep,
    )


def drop_below(selection: PivotedQR, floor: Float[Array, ""]) -> PivotedQR:
    """Steps whose |R_kk| / |R_11| is not above the floor left out: their pivots are independent."""
    return _with_active(
        selection, selection.active & (selection.diag_R > floor * jnp.max(selection.diag_R))
    )


def pivoted_qr(
    J: Float[Array, "rows dofs"],
    rank: Int[Array, ""] | None = None,
    wanted: Bool[Array, " dofs"] | None = None,
) -> PivotedQR:
    """min(rows, dofs) steps of column-pivoted Gram-Schmidt, orthogonalised twice; steps from `rank`
    on are inert (None: all are taken).

    `wanted`: columns to leave independent, taken as pivots only where nothing else is left.
    """
    frozen = jax.lax.stop_gradient(J)
    rows, dofs = J.shape
    steps = min(rows, dofs)
    weight = (
        None
        if wanted is None
        else jnp.where(wanted, rank_tolerance(J.dtype) ** 2, 1).astype(J.dtype)
    )

    def step(k, carry):
        A, Q, P, size = carry
        norms = jnp.sum(A * A, 0) * (1 if weight is None else weight)
        # the first of those that are equal but for round-off, as mirrored limbs are: the same on
        # every machine
        pivot = jnp.arange(dofs) == jnp.argmax(
            norms >= (1 - rank_tolerance(J.dtype)) * jnp.max(norms)
        )
        column = jnp.sum(jnp.where(pivot[None], A, 0), 1)
        column = column - (Q @ column) @ Q
        r = jnp.sqrt(jnp.sum(column * column))
        taken = r > 0 if rank is None else (r > 0) & (k < rank)
        q = jnp.where(taken, column / jnp.where(taken, r, 1), 0)
        A = jnp.where(pivot[None], 0, A - q[:, None] * (q @ A)[None])
        here = jnp.arange(steps) == k
        Q = jnp.where(here[:, None], q[None], Q)
        P = jnp.where(here[:, None] & pivot[None] & taken, 1, P)
        return A, Q, P, jnp.where(here, r, size)

    start = (
        frozen,
        jnp.zeros((steps, rows), J.dtype),
        jnp.zeros((steps, dofs), J.dtype),
        jnp.zeros(steps, J.dtype),
    )
    _, Q, P, size = jax.lax.fori_loop(0, steps, step, start)
    Q, size = frozen_qr(J, Q, P, size)
    return PivotedQR(Q=Q, P=P, diag_R=size, active=jnp.any(P > 0, 1))


def refactor(J: Float[Array, "rows dofs"], P: Float[Array, "steps dofs"]) -> PivotedQR:
    """The same with pivots that were chosen before: only their columns are orthogonalised, nothing
    is searched for."""
    used = jnp.any(P > 0, 1)
    columns = P @ jax.lax.stop_gradient(J).T

    def step(k, carry):
        Q, size = carry
        column = columns[k]
        for _ in range(2):
            column = column - (Q @ column) @ Q
        r = jnp.sqrt(jnp.sum(column * column))
        here = (jnp.arange(used.shape[0]) == k) & (r > 0)
        return jnp.where(here[:, None], (column / jnp.where(r > 0, r, 1))[None], Q), jnp.where(
            here, r, size
        )

    none = jnp.zeros((used.shape[0], J.shape[0]), J.dtype), jnp.zeros(used.shape[0], J.dtype)
    Q, size = jax.lax.fori_loop(0, used.shape[0], step, none)
    Q, size = frozen_qr(J, Q, P, size)
    return PivotedQR(Q=Q, P=P, diag_R=size, active=used & (size > 0))


def _frozen_qr_jvp(primals, tangents):
    """Derivatives of Q = R^-T (J P^T)^T with R frozen, and of the diagonal of the R that J has,
    which is that of Cholesky's factor of Q Q^T times R's."""
    J, _, P, _ = primals
    Q, size = frozen_qr(*primals)
    unused = jnp.diag(jnp.where(jnp.any(P > 0, 1), 0, 1).astype(J.dtype))
    dQ = solve_triangular(
        jax.lax.stop_gradient(Q @ J @ P.T) + unused, (tangents[0] @ P.T).T, trans=1
    )
    L = jnp.linalg.cholesky(Q @ Q.T + unused)
    along = jnp.sum(solve_triangular(L, dQ, lower=True) * solve_triangular(L, Q, lower=True), 1)
    return (Q, size), (dQ, size * along)


# Q and size of J with the pivots P, as they were found
frozen_qr = custom_primitive("following", lambda J, Q, P, size: (Q, size), _frozen_qr_jvp)


def count_rank(size: Float[Array, " steps"]) -> Int[Array, ""]:
    """Steps whose |R_kk| is above the tolerance."""
    return jnp.sum(
        size > rank_tolerance(size.dtype) * jnp.maximum(size[0], jnp.finfo(size.dtype).tiny)
    ).astype(jnp.int32)


def pivot_ratio(selection: PivotedQR) -> Float[Array, ""]:
    """|R_mm| / |R_11|, 1 where no row counts."""
    size, used = selection.diag_R, selection.active
    return jnp.min(jnp.where(used, size, jnp.inf), initial=1, where=used) / jnp.where(
        jnp.any(used), jnp.max(size), 1
    )


def pivoted_qr_with_rank(J: Float[Array, "rows dofs"]) -> tuple[PivotedQR, Int[Array, ""]]:
    """Return the selection of J with its own rank, and the rank, by one search for pivots."""
    full = pivoted_qr(jax.lax.stop_gradient(J))
    rank = count_rank(full.diag_R)
    # later steps do not change earlier ones, and are round-off, which must not be differentiated
    first = _with_active(
        full, full.active & (jnp.arange(full.active.shape[0], dtype=jnp.int32) < rank)
    )
    Q, size = frozen_qr(J, first.Q, first.P, first.diag_R)
    return PivotedQR(Q=Q, P=first.P, diag_R=size, active=first.active), rank


def lacks_pivots(P: Float[Array, "steps dofs"], rank: Int[Array, ""]) -> Bool[Array, ""]:
    """Return whether fewer pivots are held than the rank, as before the first choice."""
    return jnp.sum(jnp.any(P > 0, 1), dtype=jnp.int32) < rank


def solve_pivot_block(
    B: Float[Array, "steps steps"], x: Float[Array, "steps *n"], trans: bool = False
) -> Float[Array, "steps *n"]:
    """B^-1 x, or B^-T x, for a B that the frozen choice leaves upper triangular in value but not in
    derivative."""
    triangle = jax.lax.stop_gradient(B)
    return jax.lax.custom_linear_solve(
        lambda y: (B.T if trans else B) @ y,
        x,
        solve=lambda _, y: batched_solve_triangular(triangle, y, trans),
        transpose_solve=lambda _, y: batched_solve_triangular(triangle, y, not trans),
    )


def solve_positive(A: Float[Array, "n n"], x: Float[Array, "n *m"]) -> Float[Array, "n *m"]:
    """A^-1 x by Cholesky for a symmetric positive A; the derivative is one more solve with the same
    factor."""
    inverse = cholesky_solver(jax.lax.stop_gradient(A))
    return jax.lax.custom_linear_solve(
        lambda y: A @ y, x, solve=lambda _, y: inverse(y), symmetric=True
    )


def pivot_blocks(
    selection: PivotedQR, J: Float[Array, "rows dofs"]
) -> tuple[Float[Array, "steps dofs"], Float[Array, "steps steps"]]:
    """J_Cm = Q J_C, m independent rows (12), and J_S, its pivot columns in order (14), with ones on
    the unused diagonal."""
    Jm = selection.Q @ J
    return Jm, Jm @ selection.P.T + jnp.diag(jnp.where(selection.active, 0, 1).astype(J.dtype))


# part of the phase's own margin below which a configuration is near a singular one; elsewhere the
# motion depends on no choice of pivots
NEAR_SINGULAR = 0.1


def select_pivots(structure: Structure, J: Float[Array, "rows dofs"], pivots=None) -> PivotedQR:
    """The pivots of J_C, with the rank of the phase and the coordinates that are asked to be
    independent; without rows that are too weak just now.

    pivots [steps, dofs]: one-hot, chosen before (None: to be chosen now); near a singular
    configuration, or where they are too few, new ones are.
    """
    new = lambda: pivoted_qr(J, structure.rank, structure.independent)
    if pivots is None:
        selection = new()
    else:
        held = refactor(J, pivots)
        near = (pivot_ratio(held) < NEAR_SINGULAR * structure.margin) | lacks_pivots(
            pivots, structure.rank
        )
        # (one lane near is enough to choose for all)
        selection = jax.lax.cond(
            unvmap_any(near),
            lambda: jax.tree.map(lambda a, b: jnp.where(near, a, b), new(), held),
            lambda: held,
        )
    return drop_below(selection, release_threshold(J.dtype) * structure.margin)
