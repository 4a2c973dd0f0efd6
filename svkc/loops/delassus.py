"""Accelerations of a closed chain by articulated bodies and loop forces.

Delassus' matrix D = A M^-1 A^T is the relative acceleration of every constraint row for a unit
force in each, where A are the `constraint_rows` of the loops over the tree's coordinates.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from svkc._jax.batched_lapack import cholesky_solver
from svkc._jax.control_flow import unvmap_any
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

# Steps of iterative refinement with D. In float64, each multiplies by 1e-4 the error of the force
# along a row whose inverse inertia is 1e-6 of the others'.
REFINEMENTS = 2
# Condition number of D, as estimated, above which forces are refined with the equations themselves:
# round-off of D then exceeds 1e-10 of them in float64.
ILL_CONDITIONED = 1e6
# Least number of rows for which LAPACK factors D. Smaller ones are inverted by blocks, in a program
# that grows with the rows.
LAPACK_MIN_ROWS = 36


def _regularized_inverse(
    D: Float[Array, "delassus delassus"], exponent: float
) -> tuple[Callable, Float[Array, ""] | None]:
    """Return x -> (D + r)^-1 x, and an estimate of the condition number of D + r.

    r is eps^exponent of D's largest entry. The estimate is None where LAPACK factors D.
    """
    diagonal = np.eye(D.shape[0], dtype=bool)
    largest = jnp.max(jnp.where(diagonal, D, 0))
    # the largest entry is zero if no loop is closed
    largest = jnp.where(largest > 0, largest, 1)
    regularization = jnp.finfo(D.dtype).eps ** exponent * largest
    regularized = D + regularization * jnp.eye(D.shape[0], dtype=D.dtype)
    if D.shape[0] >= LAPACK_MIN_ROWS:
        return cholesky_solver(regularized), None
    inverse = inverse_positive(regularized)
    # rows of zeros are of links that are not connected
    of_rows = jnp.where(diagonal & (D > 0), inverse, 0)
    return lambda x: matvec(inverse, x), largest * jnp.max(of_rows)


def loop_force_solver(
    chain: Chain,
    kin: Kinematics,
    J: Float[Array, "rows dofs"],
    rows: ConstraintRows,
    free: Bool[Array, " nv"] | None,
    refine_if_ill: bool = False,
) -> Callable:
    """Return (force, loop_bias) -> (x, mu) with M x + J^T mu = force and J x = loop_bias.

    Where loops alone hold massless bodies, M is singular, so that D does not exist, or nearly
    singular, so that one entry of D swamps the others. An auxiliary inertia makes M regular;
    Woodbury's formula subtracts this inertia again, and one step of iterative refinement restores
    the digits that the subtraction costs.

    J: loop Jacobian with scaled rows. rows: its `constraint_rows`.
    free: coordinates that are not locked (None: all).
    refine_if_ill: whether the solution is refined, too, where D is ill-conditioned although the
    rows are independent, as where the masses of a loop differ by many orders of magnitude.
    """
    massless = np.array(chain.topology.massless_dofs, int)
    step = lambda solve, sides, x: _refinement_step(chain, kin, J, free, solve, (sides, x))
    if len(massless):
        inertia = auxiliary_inertia(chain)
        solve, _ = _solver_of_regular_mass_matrix(with_armature(chain, inertia), kin, J, rows, free)
        removed = -inertia if free is None else jnp.where(free, -inertia, 0)
        solve = with_inertia(chain, solve, massless, removed[massless])
        return lambda *sides: step(solve, sides, solve(*sides))
    solve, condition = _solver_of_regular_mass_matrix(chain, kin, J, rows, free)
    if not refine_if_ill or rows.T is None or condition is None:
        return solve
    is_ill = condition > ILL_CONDITIONED

    def solve_and_refine(*sides):
        first = solve(*sides)
        refine = lambda: jax.lax.fori_loop(
            0, REFINEMENTS, lambda _, x: step(solve, sides, x), first
        )
        # under `vmap`, one ill-conditioned lane lets all lanes compute the refinement
        return jax.lax.cond(
            unvmap_any(is_ill),
            lambda: jax.tree.map(lambda a, b: jnp.where(is_ill, a, b), refine(), first),
            lambda: first,
        )

    return solve_and_refine


def _refinement_step(
    chain: Chain,
    kin: Kinematics,
    J: Float[Array, "rows dofs"],
    free: Bool[Array, " nv"] | None,
    solve: Callable,
    system: tuple,
):
    """Return the solution after one step of iterative refinement.

    system: right-hand sides (force, loop_bias), and the solution (x, mu) before.
    """
    ((force, loop_bias), (x, mu)), nv = system, chain.nv
    rest = force - pad_to_dofs(chain, mass_matrix_product(chain, kin, x[:nv])) - mu @ J
    if free is not None:
        rest = jnp.concatenate([jnp.where(free, rest[:nv], 0), rest[nv:]])
    dx, dmu = solve(rest, loop_bias - J @ x)
    return x + dx, mu + dmu


def _solver_of_regular_mass_matrix(
    chain: Chain,
    kin: Kinematics,
    J: Float[Array, "rows dofs"],
    rows: ConstraintRows,
    free: Bool[Array, " nv"] | None,
) -> tuple[Callable, Float[Array, ""] | None]:
    """Return `loop_force_solver` of a chain whose mass matrix M is regular, without refinement by
    the equations, and an estimate of the condition number of D (None: not known).

    The rows of J may be dependent. D is regularized and factored, and the forces are refined with
    the residual of D itself (the proximal form). Forces of dependent rows stay finite, and the
    motion is that of the independent rows.

    free: coordinates that are not locked (None: all).
    """
    top, nv, J_tree, joints = chain.topology, chain.nv, J[:, : chain.nv], rows.joints
    bodies = articulated_factors(chain, kin, free)
    passed = pass_inward(top, bodies, rows.A.T)
    D = inner_product(passed, passed)
    # dependent rows need more regularization; reduced ones are independent, and so are others of a
    # run, which reduces its rows where they may be dependent
    exponent = 0.625 if rows.T is None else 0.875
    solve_regularized, condition = _regularized_inverse(D, exponent)

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

    return solve, condition
