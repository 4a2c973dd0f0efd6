"""Accelerations of a closed chain by articulated bodies and loop forces, without pivots.

Delassus' matrix D = J M^-1 J^T, over the tree's coordinates, is the relative acceleration of every
loop row for a unit force in each. Virtual joints have coordinates without inertia, along which a
loop transmits no force, so that the rows are projected onto the complement of the virtual joints'
motion subspaces. The three angular rows of a ball vanish there and are left out of D.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from svkc._jax.batched_lapack import cholesky_solver
from svkc._jax.static_gather import static_take
from svkc.loops.diagonal_inertia import auxiliary_inertia, with_armature, with_inertia
from svkc.model.chain import Chain
from svkc.tree.articulated_body import articulated_factors, delassus_matrix, solve_mass_matrix
from svkc.tree.inverse_dynamics import mass_matrix_product, pad_to_dofs
from svkc.tree.kinematics import Kinematics
from svkc.tree.spatial import inverse_positive, matvec

# Steps of iterative refinement. In float64, each multiplies by 1e-4 the error of the force along a
# row whose inverse inertia is 1e-6 of the others'.
REFINEMENTS = 2
BALL_FREEDOMS = (True, True, True, False, False, False)
# Least number of rows for which LAPACK factors D. Smaller ones are inverted by blocks, in a program
# that grows with the rows.
LAPACK_MIN_ROWS = 36


class VirtualJoints(eqx.Module):
    """Motion subspaces of the virtual joints, padded to the d freedoms of the freest.

    S: motion subspace of each link. gram_inverse: (S^T S)^-1.
    dof: index of each freedom among the virtual joints' coordinates (padding: `count` or more).
    count: number of these coordinates.
    """

    S: Float[Array, "links 6 d"]
    gram_inverse: Float[Array, "links d d"]
    dof: np.ndarray
    count: int

    def joint_rates(self, x: Float[Array, "*n rows"]) -> Float[Array, "*n links d"]:
        """Return S^+ x, the joint rates that fit the loop rows x best."""
        x = x.reshape(*x.shape[:-1], -1, 6)
        return matvec(
            _align_batch_axes(self.gram_inverse, x),
            matvec(_align_batch_axes(jnp.swapaxes(self.S, -1, -2), x), x),
        )

    def reject(self, x: Float[Array, "*n rows"]) -> Float[Array, "*n rows"]:
        """Return x - S S^+ x, the part of the loop rows that the joints cannot follow."""
        rates = self.joint_rates(x)
        return x - matvec(_align_batch_axes(self.S, rates), rates).reshape(x.shape)

    def subset(self, links: np.ndarray) -> "VirtualJoints":
        """Return the virtual joints of some links."""
        S, gram_inverse, dof = self.S[links], self.gram_inverse[links], self.dof[links]
        return VirtualJoints(S=S, gram_inverse=gram_inverse, dof=dof, count=self.count)

    def gather(self, x: Float[Array, " virtual"]) -> Float[Array, "links d"]:
        """Return x, over the virtual joints' coordinates, by link; zero for padding."""
        return static_take(x, np.minimum(self.dof, self.count))

    def scatter(self, rates: Float[Array, "links d"]) -> Float[Array, " virtual"]:
        """Return rates, by link, over the virtual joints' coordinates."""
        flat = self.dof.ravel()
        return static_take(
            rates.ravel(), np.argsort(flat, kind="stable")[: np.sum(flat < self.count)]
        )


class DelassusRows(NamedTuple):
    """The rows of J that are in D: six of each of `full_links`, then the linear three of each ball.

    full_links: links with all six rows in D. The others are unlocked declared balls.
    rows: index in J of each row of D.
    position: index in D of each row of J; the size of D for rows that are not in D.
    """

    full_links: np.ndarray
    rows: np.ndarray
    position: np.ndarray

    def expand(self, x: Float[Array, " delassus"]) -> Float[Array, " rows"]:
        """Return x over all rows of J, zero for rows that are not in D."""
        return static_take(x, self.position)


def delassus_rows(chain: Chain, any_locked: bool) -> DelassusRows:
    """Return the rows of J that are in D.

    The angular rows of a declared ball are left out unless some joint may be locked. Those of a
    spare slot are kept, as its joint is known at run time only.
    """
    top = chain.topology
    is_free_ball = np.array(
        [
            tuple(f) == BALL_FREEDOMS and not spare and not any_locked
            for f, spare in zip(top.link_freedoms, top.link_spare, strict=True)
        ],
        bool,
    )
    of_link = np.arange(6 * len(is_free_ball)).reshape(-1, 6)
    rows = np.concatenate([of_link[~is_free_ball].ravel(), of_link[is_free_ball][:, 3:].ravel()])
    position = np.full(of_link.size, len(rows))
    position[rows] = np.arange(len(rows))
    return DelassusRows(np.flatnonzero(~is_free_ball), rows, position)


def _align_batch_axes(
    A: Float[Array, "links i j"], x: Float[Array, "*n links k"]
) -> Float[Array, "*m links i j"]:
    """Return A with an axis of size 1 for each batch axis of x."""
    return A.reshape(*(1,) * (x.ndim - 2), *A.shape)


def virtual_joints(chain: Chain, J: Float[Array, "rows dofs"]) -> VirtualJoints:
    """Return the virtual joints, with the motion subspaces in the columns of J."""
    dof, count = np.sort(chain.topology.links.dof - chain.nv, 1), chain.dofs - chain.nv
    dof = dof[:, : max(1, np.max(np.sum(dof < count, 1)))]
    columns = jnp.concatenate([J[:, chain.nv :], jnp.zeros_like(J[:, :1])], 1)
    columns = columns.reshape(-1, 6, count + 1)
    S = jnp.swapaxes(columns[np.arange(len(dof))[:, None], :, np.minimum(dof, count)], -1, -2)
    is_padding = jnp.where(jnp.all(S == 0, 1), 1, 0).astype(J.dtype)
    gram = (
        jnp.sum(S[:, :, :, None] * S[:, :, None], 1)
        + is_padding[:, :, None] * np.eye(dof.shape[1], dtype=J.dtype)[None]
    )
    return VirtualJoints(S=S, gram_inverse=inverse_positive(gram), dof=dof, count=count)


def _regularized_inverse(D: Float[Array, "delassus delassus"]) -> Callable:
    """Return x -> (D + regularization)^-1 x, regularized by a multiple of D's largest entry."""
    largest = jnp.max(jnp.where(np.eye(D.shape[0], dtype=bool), D, 0))
    # the largest entry is zero if no loop is closed
    regularization = jnp.finfo(D.dtype).eps ** 0.625 * jnp.where(largest > 0, largest, 1)
    regularized = D + regularization * jnp.eye(D.shape[0], dtype=D.dtype)
    if D.shape[0] >= LAPACK_MIN_ROWS:
        return cholesky_solver(regularized)
    inverse = inverse_positive(regularized)
    return lambda x: matvec(inverse, x)


def loop_force_solver(
    chain: Chain, kin: Kinematics, J: Float[Array, "rows dofs"], free: Bool[Array, " nv"] | None
) -> Callable:
    """Return (force, loop_bias) -> (x, mu) with M x + J^T mu = force and J x = loop_bias.

    Where loops alone hold massless bodies, M is singular, so that D does not exist, or nearly
    singular, so that one entry of D swamps the others. An auxiliary inertia makes M regular;
    Woodbury's formula subtracts this inertia again, and one step of iterative refinement restores
    the digits that the subtraction costs.

    free: coordinates that are not locked (None: all).
    """
    massless = np.array(chain.topology.massless_dofs, int)
    if not len(massless):
        return _solver_of_regular_mass_matrix(chain, kin, J, free)
    inertia = auxiliary_inertia(chain)
    solve = _solver_of_regular_mass_matrix(with_armature(chain, inertia), kin, J, free)
    removed = -inertia if free is None else jnp.where(free, -inertia, 0)
    solve = with_inertia(chain, solve, massless, removed[massless])
    nv = chain.nv

    def refined_solve(force, loop_bias):
        x, mu = solve(force, loop_bias)
        rest = force - pad_to_dofs(chain, mass_matrix_product(chain, kin, x[:nv])) - mu @ J
        if free is not None:
            rest = jnp.concatenate([jnp.where(free, rest[:nv], 0), rest[nv:]])
        dx, dmu = solve(rest, loop_bias - J @ x)
        return x + dx, mu + dmu

    return refined_solve


def _solver_of_regular_mass_matrix(
    chain: Chain, kin: Kinematics, J: Float[Array, "rows dofs"], free: Bool[Array, " nv"] | None
) -> Callable:
    """Return `loop_force_solver` of a chain whose mass matrix M is regular.

    The rows of J may be dependent. D is regularized and factored, and the forces are refined with
    the residual of D itself (the proximal form). Forces of dependent rows stay finite, and the
    motion is that of the independent rows.

    free: coordinates that are not locked (None: all).
    """
    top, nv, J_tree = chain.topology, chain.nv, J[:, : chain.nv]
    bodies, joints, in_D = (
        articulated_factors(chain, kin, free),
        virtual_joints(chain, J),
        delassus_rows(chain, free is not None),
    )
    full_joints, n = joints.subset(in_D.full_links), 6 * len(in_D.full_links)
    # free balls have no joint rates in their three linear rows
    reject = lambda x: jnp.concatenate([full_joints.reject(x[..., :n]), x[..., n:]], -1) if n else x
    D = reject(reject(delassus_matrix(top, bodies, static_take(J_tree, in_D.rows))).T)
    solve_regularized = _regularized_inverse(D)

    def solve(force, loop_bias):
        # a force on a virtual joint, which has no inertia, is transmitted by its loop
        transmitted = -matvec(
            joints.S, matvec(joints.gram_inverse, joints.gather(force[nv:]))
        ).ravel()
        unconstrained = solve_mass_matrix(top, bodies, force[:nv] + transmitted @ J_tree)
        residual = reject(static_take(loop_bias - J_tree @ unconstrained, in_D.rows))
        z = solve_regularized(residual)
        for _ in range(REFINEMENTS):
            z = z + solve_regularized(residual - D @ z)
        mu = transmitted + in_D.expand(reject(z))
        x = solve_mass_matrix(top, bodies, force[:nv] + mu @ J_tree)
        return jnp.concatenate([x, joints.scatter(joints.joint_rates(loop_bias - J_tree @ x))]), -mu

    return solve
