"""Accelerations of a closed chain by articulated bodies and loop forces.

Delassus' matrix D = A M^-1 A^T is the relative acceleration of every constraint row for a unit
force in each, where A are the `constraint_rows` of the loops over the tree's coordinates.
"""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from svkc._jax.batched_lapack import cholesky_solver
from svkc._jax.select import where
from svkc.loops.constraint_rows import ConstraintRows
from svkc.loops.diagonal_inertia import auxiliary_inertia, with_armature, with_inertia
from svkc.model.chain import Chain
from svkc.tree.articulated_body import (
    articulated_factors,
    inner_product,
    pass_inward,
    pass_outward,
)
from svkc.tree.inverse_dynamics import mass_matrix_product, pad_to_dofs
from svkc.tree.kinematics import Kinematics
from svkc.tree.spatial import inverse_positive, matvec

# Steps of iterative refinement. In float64, each multiplies by 1e-4 the error of the force along a
# row whose inverse inertia is 1e-6 of the others'.
REFINEMENTS = 2
# Least number of rows for which LAPACK factors D. Smaller ones are inverted by blocks, in a program
# that grows with the rows.
LAPACK_MIN_ROWS = 36


def _regularized_inverse(
    D: Float[Array, "delassus delassus"], null_projector: Float[Array, "delassus delassus"]
) -> Callable:
    """Return x -> (D + regularization)^-1 x, regularized by a multiple of D's largest entry.

    null_projector: projector onto known null directions of D, in which x is zero, too. The largest
        entry of D is added there.
    """
    largest = jnp.max(where(np.eye(D.shape[0], dtype=bool), D, 0))
    # the largest entry is zero if no loop is closed
    largest = where(largest > 0, largest, 1)
    regularization = jnp.finfo(D.dtype).eps ** 0.625 * largest
    regularized = D + regularization * jnp.eye(D.shape[0], dtype=D.dtype) + largest * null_projector
    if D.shape[0] >= LAPACK_MIN_ROWS:
        return cholesky_solver(regularized)
    # redundant loops make several pivots of D tiny, for which an adjugate loses all digits
    inverse = inverse_positive(regularized, by_adjugate=False)
    return lambda x: matvec(inverse, x)


def loop_force_solver(
    chain: Chain,
    kin: Kinematics,
    J: Float[Array, "rows dofs"],
    rows: ConstraintRows,
    free: Bool[Array, " nv"] | None,
) -> Callable:
    """Return (force, loop_bias) -> (x, mu) with M x + J^T mu = force and J x = loop_bias.

    Where loops alone hold massless bodies, M is singular, so that D does not exist, or nearly
    singular, so that one entry of D swamps the others. An auxiliary inertia makes M regular;
    Woodbury's formula subtracts this inertia again, and one step of iterative refinement restores
    the digits that the subtraction costs.

    J: loop Jacobian with scaled rows. rows: its `constraint_rows`.
    free: coordinates that are not locked (None: all).
    """
    massless = np.array(chain.topology.massless_dofs, int)
    if not len(massless):
        return _solver_of_regular_mass_matrix(chain, kin, J, rows, free)
    inertia = auxiliary_inertia(chain)
    solve = _solver_of_regular_mass_matrix(with_armature(chain, inertia), kin, J, rows, free)
    removed = -inertia if free is None else where(free, -inertia, 0)
    solve = with_inertia(chain, solve, massless, removed[massless])
    nv = chain.nv

    def refined_solve(force, loop_bias):
        x, mu = solve(force, loop_bias)
        rest = force - pad_to_dofs(chain, mass_matrix_product(chain, kin, x[:nv])) - mu @ J
        if free is not None:
            rest = jnp.concatenate([where(free, rest[:nv], 0), rest[nv:]])
        dx, dmu = solve(rest, loop_bias - J @ x)
        return x + dx, mu + dmu

    return refined_solve


def _solver_of_regular_mass_matrix(
    chain: Chain,
    kin: Kinematics,
    J: Float[Array, "rows dofs"],
    rows: ConstraintRows,
    free: Bool[Array, " nv"] | None,
) -> Callable:
    """Return `loop_force_solver` of a chain whose mass matrix M is regular.

    The rows of J may be dependent. D is regularized and factored, and the forces are refined with
    the residual of D itself (the proximal form). Forces of dependent rows stay finite, and the
    motion is that of the independent rows.

    free: coordinates that are not locked (None: all).
    """
    top, nv, J_tree, joints = chain.topology, chain.nv, J[:, : chain.nv], rows.joints
    bodies = articulated_factors(chain, kin, free)
    passed = pass_inward(top, bodies, rows.A.T)
    D = inner_product(passed, passed)
    solve_regularized = _regularized_inverse(D, rows.null_projector())

    def solve(force, loop_bias):
        # a force on a virtual joint, which has no inertia, is transmitted by its loop
        transmitted = -matvec(
            joints.S, matvec(joints.gram_inverse, joints.gather(force[nv:]))
        ).ravel()
        applied = pass_inward(top, bodies, force[:nv] + transmitted @ J_tree)
        residual = rows.reduce(loop_bias) - inner_product(passed, applied)
        z = solve_regularized(residual)
        for _ in range(REFINEMENTS):
            z = z + solve_regularized(residual - D @ z)
        mu = transmitted + rows.expand(z)
        x = pass_outward(top, bodies, applied.x + matvec(passed.x, z))
        return jnp.concatenate([x, joints.scatter(joints.joint_rates(loop_bias - J_tree @ x))]), -mu

    return solve
