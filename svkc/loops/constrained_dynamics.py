"""Accelerations and multipliers of a chain with loops, and the choice among the ways to compute
them."""

import abc
from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from svkc._jax.batched_lapack import batched_solve_triangular, cholesky_solver
from svkc.loops.constraint import LoopKinematics, jacobian_scales
from svkc.loops.coordinates import Coordinates, partition_coordinates
from svkc.loops.delassus import loop_force_solver
from svkc.loops.pivoting import PivotedQR, pivot_blocks
from svkc.model.chain import Chain, Structure, active_dofs
from svkc.model.validation import scalar
from svkc.tree.articulated_body import articulated_inertias, solve_mass_matrix
from svkc.tree.inverse_dynamics import append_virtual_joints, mass_matrix_product
from svkc.tree.kinematics import Kinematics
from svkc.tree.mass_matrix import mass_matrix_crba, mass_matrix_unit_vectors


def reduced_mass_matrix(
    chain: Chain, co: Coordinates, M: Float[Array, "nv nv"]
) -> Float[Array, "dofs dofs"]:
    """A = W^T M W (23), ones on the diagonal of coordinates that are not independent."""
    W = co.W[: chain.nv]
    return W.T @ (M @ W) + jnp.diag(jnp.where(co.independent, 0, 1).astype(M.dtype))


class AbstractDynamics(eqx.Module):
    """How accelerations are computed. All ways agree; they differ in what they cost.

    uses_pivots: whether dependent coordinates are chosen. Where they are not, `svkc.stabilization.Projection()`
    puts steps back onto the loops without pivots too.
    hold: dependent coordinates are chosen at every evaluation (None), or held until, at the end of
    a step, the least |R_kk| / |R_11| of their columns is below this part of what a new choice has
    (default 0.3); 0 holds them until the structure changes. Held only where steps are projected by
    pivots; near a singular configuration, and in what is differentiated, they are chosen at every
    evaluation, as the motion does not depend on the choice.
    """

    uses_pivots: eqx.AbstractClassVar[bool]
    hold: float | None = eqx.field(static=True, default=0.3)

    def __check_init__(self):
        _check_hold(self.hold)

    @abc.abstractmethod
    def prepare(
        self,
        chain: Chain,
        structure: Structure,
        loops: LoopKinematics,
        selection: PivotedQR | None = None,
    ) -> Callable:
        """Return solve: (force [dofs], bias [rows]) -> the x with M x = force + J_C^T lambda and
        J_C x + bias = 0 (paper, section III-B).

        selection: the pivots of `loops.J`; None where `uses_pivots` is False.
        """

    @abc.abstractmethod
    def prepare_open(self, chain: Chain, structure: Structure, kin: Kinematics) -> Callable:
        """Return solve: force [nv] -> the x with M x = force, zero for locked joints, on a chain
        without virtual links."""


class ArticulatedBodies(AbstractDynamics):
    """Articulated bodies and the forces of the loops, without pivots.

    The fastest way, and the one for batches. The forces square the loops' conditioning near
    singular configurations. With `Projection()` the certificate has the margin of the phases' ends
    alone, and counts no swaps. hold: for the stabilizations that choose pivots all the same.
    """

    uses_pivots: ClassVar[bool] = False

    def prepare(self, chain, structure, loops, selection=None):
        column, active = jacobian_scales(chain)[1], active_dofs(chain, structure)
        rows, frozen, static = jax.lax.stop_gradient((loops.J, (chain, loops.kin), structure))
        solve = loop_force_solver(
            *frozen,
            jnp.where(active[None], rows / column[None], 0),
            None if static.locked is None else active[: chain.nv],
        )
        # every row as it is, whether or not it repeats others
        used = jnp.ones(loops.J.shape[0], bool)
        return _implicit_solve(chain, structure, loops, solve, lambda x: x, used)

    def prepare_open(self, chain, structure, kin):
        free = None if structure.locked is None else ~structure.locked
        bodies = articulated_inertias(*jax.lax.stop_gradient((chain, kin)), free)
        solve = lambda force: solve_mass_matrix(chain.topology, bodies, force)
        return _implicit_open_solve(chain, structure, kin, solve)


class AbstractMassMatrix(AbstractDynamics):
    """The tree's inertia matrix, reduced to the independent coordinates, as the paper has it."""

    @abc.abstractmethod
    def inertia(self, chain: Chain, kin: Kinematics) -> Float[Array, "nv nv"]:
        """Return the inertia matrix of the tree."""

    def prepare(self, chain, structure, loops, selection=None):
        chosen, rows, frozen, static = jax.lax.stop_gradient(
            (selection, loops.J, (chain, loops.kin), structure)
        )
        solve = _solve_by_partitioning(*frozen, static, chosen, rows, self.inertia)
        return _implicit_solve(
            chain, structure, loops, solve, lambda x: chosen.Q @ x, chosen.active
        )

    def prepare_open(self, chain, structure, kin):
        M = self.inertia(*jax.lax.stop_gradient((chain, kin)))
        if structure.locked is not None:
            free = ~structure.locked
            M = jnp.where(free[:, None] & free[None], M, jnp.eye(chain.nv, dtype=M.dtype))
        return _implicit_open_solve(chain, structure, kin, cholesky_solver(M))


class CompositeBodies(AbstractMassMatrix):
    """The inertia matrix by composite bodies (Featherstone section 6.2)."""

    uses_pivots: ClassVar[bool] = True

    def inertia(self, chain, kin):
        return mass_matrix_crba(chain, kin)


class UnitVectors(AbstractMassMatrix):
    """The inertia matrix column by column from inverse dynamics: the paper's own way."""

    uses_pivots: ClassVar[bool] = True

    def inertia(self, chain, kin):
        return mass_matrix_unit_vectors(chain, kin)


def default_dynamics(chain: Chain) -> AbstractDynamics:
    """Return articulated bodies for a chain without virtual links, else composite ones."""
    return CompositeBodies() if chain.topology.link_names else ArticulatedBodies()


def articulated_bodies(chain: Chain, kin: Kinematics):
    """Names articulated bodies in the older spelling, `svkc.dynamics.ArticulatedBodies()`."""
    return articulated_inertias(chain, kin)


DEPRECATED_SPELLINGS = (
    (articulated_bodies, ArticulatedBodies),
    (mass_matrix_crba, CompositeBodies),
    (mass_matrix_unit_vectors, UnitVectors),
)


class Dynamics(eqx.Module):
    """The older spelling of the classes in `svkc.dynamics`.

    inertia: `svkc.by_bodies`, `svkc.inertia_by_composites`, `svkc.inertia_by_unit_vectors`; None
    (default): articulated bodies where the scene has no loops, else composite ones. hold: as in
    `svkc.dynamics.CompositeBodies`.
    """

    inertia: Callable | None = eqx.field(static=True, default=None)
    hold: float | None = eqx.field(static=True, default=0.3)

    def __check_init__(self):
        if self.inertia is not None and not any(
            self.inertia is old for old, _ in DEPRECATED_SPELLINGS
        ):
            raise ValueError(
                f"dynamics.inertia: got {self.inertia!r}, expected None, svkc.by_bodies,"
                " svkc.inertia_by_composites or svkc.inertia_by_unit_vectors"
            )
        _check_hold(self.hold)

    def resolved(self, chain: Chain) -> AbstractDynamics:
        """Return the object of `svkc.dynamics` that this one stands for."""
        if self.inertia is None:
            return type(default_dynamics(chain))(hold=self.hold)
        return next(new for old, new in DEPRECATED_SPELLINGS if old is self.inertia)(hold=self.hold)


def _check_hold(hold) -> None:
    if hold is not None and not 0 <= scalar("dynamics.hold", hold) <= 1:
        raise ValueError(f"dynamics.hold: got {hold}, expected None or a part between 0 and 1")


def _implicit_solve(
    chain: Chain,
    structure: Structure,
    loops: LoopKinematics,
    factored: Callable,
    pick: Callable,
    used: Bool[Array, " picked"],
) -> Callable:
    """Return (force, bias) -> x by `factored`, whose derivatives are those of the equations that
    x solves, with M x by Newton-Euler.

    A derivative is one more solve with the same factors: recursions for M and the search for pivots
    have no part in it. pick: the rows that are solved for, of all. used: which of them count.
    """
    nv, column = chain.nv, jacobian_scales(chain)[1]
    active = active_dofs(chain, structure)

    def equations(unknown):
        x, mu = unknown
        held = pick(loops.J) / column[None]
        moving = jnp.where(active, x, 0)
        force = (
            append_virtual_joints(chain, mass_matrix_product(chain, loops.kin, moving[:nv]))
            + held.T @ mu
        )
        return jnp.where(active, force, x), held @ x + jnp.where(used, 0, mu)

    def solve(force: Float[Array, " dofs"], bias: Float[Array, " rows"]) -> Float[Array, " dofs"]:
        # jax transposes the solve only where both sides take part in the derivative
        right = (
            jnp.where(active, force, 0) + 0 * jnp.sum(bias),
            -pick(bias) + 0 * jnp.sum(force),
        )
        return jax.lax.custom_linear_solve(
            equations, right, solve=lambda _, right: factored(*right), symmetric=True
        )[0]

    return solve


def _solve_by_partitioning(
    chain: Chain, kin: Kinematics, structure: Structure, chosen: PivotedQR, J, inertia: Callable
) -> Callable:
    """The solution through W, A and b, as the paper has it."""
    nv, (_, column) = chain.nv, jacobian_scales(chain)
    co = partition_coordinates(chain, structure, chosen, J, jnp.zeros(J.shape[0], J.dtype))
    tree, W = inertia(chain, kin), co.W
    A_inverse = cholesky_solver(reduced_mass_matrix(chain, co, tree))
    _, JS = pivot_blocks(chosen, J)

    def solve(force, rate):
        x = column * (chosen.P.T @ batched_solve_triangular(JS, rate))
        x = x + W @ A_inverse(W.T @ (force - append_virtual_joints(chain, tree @ x[:nv])))
        rest = column * (force - append_virtual_joints(chain, tree @ x[:nv]))
        return x, jnp.where(
            chosen.active, batched_solve_triangular(JS, chosen.P @ rest, trans=True), rate
        )

    return solve


def _implicit_open_solve(
    chain: Chain, structure: Structure, kin: Kinematics, factored: Callable
) -> Callable:
    """Return force -> x by `factored`, with derivatives as in `_implicit_solve`."""
    locked = structure.locked
    free = jnp.ones(chain.nv, bool) if locked is None else ~locked

    def equations(x):
        return jnp.where(free, mass_matrix_product(chain, kin, jnp.where(free, x, 0)), x)

    def solve(force: Float[Array, " nv"]) -> Float[Array, " nv"]:
        return jax.lax.custom_linear_solve(
            equations,
            jnp.where(free, force, 0),
            solve=lambda _, x: factored(x),
            symmetric=True,
        )

    return solve
