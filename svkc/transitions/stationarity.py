"""The point of least change among closed configurations: its equations, its derivative, and the
projection of a velocity.

The point is a stationary one: where the change has several stationary points, the path from the
start decides among them. The equations are separate from this path (`continuation.py`), as
derivatives need the equations alone. Changes are without units: y is a change of q as a tangent
vector, with an entry for each velocity, divided by the `jacobian_scales` of the columns (rad, or in
`chain.length`s).
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from svkc._jax.batched_lapack import solve_general
from svkc._jax.select import where
from svkc.loops.constraint import jacobian_scales, loop_kinematics
from svkc.loops.pivoting import (
    PivotedQR,
    drop_below,
    pivoted_qr,
    rank_tolerance,
    release_threshold,
    solve_positive,
)
from svkc.model.chain import Chain, Structure, active_dofs, without_locks
from svkc.model.topology import FREE, V_SIZE
from svkc.tree.configuration import difference, integrate


class Targets(eqx.Module):
    """The targets of a continuation.

    start: configuration at which the path starts, and from which the change is least; a path that
        is restarted uses `requested` instead.
    requested: the load pose or `near`, with the user's coordinates in it.
    v: requested velocities.
    held_q: coordinates that the second leg of the path is to move to their requested values.
    held_v: velocities that stay as requested where the loops allow it.
    read_links: links whose own coordinates are computed from the poses of their bodies, unless
        they close their loop already.
    tolerance: largest deviation of a held coordinate (rad, or in `chain.length`s).
    """

    start: Float[Array, " q"]
    requested: Float[Array, " q"]
    v: Float[Array, " dofs"]
    held_q: Bool[Array, " dofs"]
    held_v: Bool[Array, " dofs"]
    read_links: Bool[Array, " links"]
    tolerance: Float[Array, ""]


def weights(chain: Chain, structure: Structure) -> Float[Array, " dofs"]:
    """Return the weight of each coordinate's change: 1 for the model's own joints, 0 for
    coordinates that follow from these.

    While a cuttable joint is connected, the free coordinates of its body follow from the joint's.
    Coordinates of a virtual link that closes a loop follow from the tree's. Hence the change does
    not depend on which joint of a loop is the virtual link, nor on which joints may be cut.
    """
    top = chain.topology
    own = np.zeros(top.dofs)
    own[: top.nv] = 1
    for _, link, _ in top.cuttable_joints:
        own[[d for d in top.links.dof[link] if d < top.dofs]] = 1
    weight = jnp.asarray(own, chain.q_load.dtype)
    for link, row in enumerate(top.link_child):
        if row >= 0:
            body = np.isin(np.arange(top.dofs), top.v_start[row] + np.arange(V_SIZE[FREE]))
            weight = where(body & structure.connected[link], 0, weight)
    return weight


def independent_rows(
    structure: Structure,
    J: Float[Array, "rows dofs"],
    qr: PivotedQR,
    rank_known: bool | Bool[Array, ""] = True,
) -> PivotedQR:
    """Return the pivoted QR of J without the pivots that are too small to divide by.

    qr: pivoted QR of J.
    rank_known: whether the rank and the margin of the structure have been decided.
    """
    weak = where(rank_known, release_threshold(J.dtype) * structure.margin, 0)
    return drop_below(qr, jnp.maximum(rank_tolerance(J.dtype), weak))


def optimality_matrix(
    hessian: Float[Array, "dofs dofs"],
    rows: Float[Array, "steps dofs"],
    used: Bool[Array, " steps"],
    fixed: Bool[Array, " dofs"],
) -> Float[Array, "n n"]:
    """Return the KKT matrix, of the size n = dofs + steps.

    Its first rows are stationarity for free coordinates and the identity for fixed ones. Its last
    rows are the loop rows where used, and the identity elsewhere.

    hessian: second derivative of the Lagrangian, or of the change alone for a velocity.
    rows: independent loop rows, zero where not used.
    """
    dtype = rows.dtype
    free = ~fixed[:, None]
    upper = jnp.concatenate([where(free, hessian, 0), where(free, rows.T, 0)], 1)
    lower = jnp.concatenate([rows, jnp.diag((~used).astype(dtype))], 1)
    no_rows = jnp.zeros(rows.shape[0], bool)
    identity = jnp.diag(jnp.concatenate([fixed, no_rows]).astype(dtype))
    return jnp.concatenate([upper, lower]) + identity


def gradient(
    chain: Chain,
    start: Float[Array, " q"],
    q: Float[Array, " q"],
    J: Float[Array, "rows dofs"],
    multiplier: Float[Array, " rows"],
    weight: Float[Array, " dofs"],
) -> Float[Array, " dofs"]:
    """Return the gradient of half the weighted squared change from the start, plus
    J^T multiplier."""
    change = difference(chain, start, q) / jacobian_scales(chain)[1]
    return weight * change + multiplier @ J


def _multiplier(J, selection: PivotedQR, gradient_of_change, fixed):
    """Return the multipliers of the loop rows at a stationary point, by least squares.

    fixed: coordinates without a condition of stationarity.
    """
    rows = selection.Q @ where(fixed, 0, J)
    gram = rows @ rows.T + jnp.diag((~selection.active).astype(J.dtype))
    return -solve_positive(gram, rows @ where(fixed, 0, gradient_of_change)) @ selection.Q


def stationary_tangent(
    primals: tuple[Chain, Structure, Float[Array, " q"], Float[Array, " q"]],
    tangents: tuple[Any, Any, Any, Any],
    q: Float[Array, " q"],
    held: Bool[Array, " dofs"],
    structure: Structure,
) -> Float[Array, " dofs"]:
    """Return the tangent of the stationary point q as a change y, by the implicit function theorem.

    primals, tangents: chain, structure, start and requested coordinates, and their tangents, with
        None for leaves without one.
    held: coordinates that have their requested values.
    structure: the structure with the rank and the margin of the loops at q.
    """
    chain, _, start, _ = primals
    column, weight = jacobian_scales(chain)[1], weights(chain, structure)
    fixed = held | ~active_dofs(chain, structure)
    # columns of locked coordinates are kept: their given values change the loop gaps
    J = loop_kinematics(chain, without_locks(structure), q).J
    free_J = jax.lax.stop_gradient(where(fixed, 0, J))
    selection = independent_rows(structure, free_J, pivoted_qr(free_J, structure.rank))
    selection = jax.lax.stop_gradient(selection)
    change = weight * difference(chain, start, q) / column
    multiplier = _multiplier(J, selection, change, fixed)

    def stationarity(y):
        q_y = integrate(chain, q, column * y)
        J_y = loop_kinematics(chain, structure, q_y).J
        return gradient(chain, start, q_y, J_y, multiplier, weight)

    def residual(chain, structure, start, requested):
        loops = loop_kinematics(chain, structure, q)
        slope = gradient(chain, start, q, loops.J, multiplier, weight)
        target = where(held, difference(chain, q, requested), difference(chain, q, start))
        return jnp.concatenate([where(fixed, -target / column, slope), selection.Q @ loops.gap])

    hessian = jax.jacfwd(stationarity)(jnp.zeros_like(column))
    matrix = optimality_matrix(hessian, selection.Q @ J, selection.active, fixed)
    residual_dot = eqx.filter_jvp(residual, primals, tangents)[1]
    # masses and inertias have no part in the equations
    if residual_dot is None:
        return jnp.zeros_like(column)
    return solve_general(matrix, -residual_dot)[: len(held)]


def projected_velocity(
    chain: Chain,
    structure: Structure,
    q: Float[Array, " q"],
    v: Float[Array, " dofs"],
    held: Bool[Array, " dofs"],
) -> Float[Array, " dofs"]:
    """Return the velocity nearest to v that keeps the loops closed; held velocities stay.

    The distance is that of the velocities of the model's own joints, without units.
    """
    column, active = jacobian_scales(chain)[1], active_dofs(chain, structure)
    fixed = held | ~active
    J = loop_kinematics(chain, structure, q).J
    qr = pivoted_qr(jax.lax.stop_gradient(where(fixed, 0, J)), structure.rank)
    selection = independent_rows(structure, J, qr)
    Q = jax.lax.stop_gradient(selection.Q)
    hessian = jnp.diag(weights(chain, structure))
    matrix = optimality_matrix(hessian, Q @ J, selection.active, fixed)
    v_scaled = where(active, v, 0) / column
    right_side = jnp.concatenate([jnp.zeros_like(v), -(Q @ (J @ v_scaled))])
    return column * (v_scaled + solve_general(matrix, right_side)[: len(column)])
