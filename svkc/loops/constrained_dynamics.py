"""Methods to compute the accelerations of a chain with loops, each an `AbstractDynamics`."""

import abc
import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from svkc._jax.batched_lapack import batched_solve_triangular, cholesky_solver
from svkc._jax.select import where
from svkc.loops.constraint import LoopKinematics, jacobian_scales, loop_rates_by_twists
from svkc.loops.constraint_rows import constraint_rows
from svkc.loops.coordinates import Coordinates, partition_coordinates
from svkc.loops.delassus import loop_force_solver
from svkc.loops.pivoting import PivotedQR, pivot_blocks
from svkc.model.chain import Chain, Structure, active_dofs
from svkc.model.validation import scalar
from svkc.tree.articulated_body import articulated_factors, solve_mass_matrix
from svkc.tree.inverse_dynamics import mass_matrix_product, pad_to_dofs
from svkc.tree.kinematics import Kinematics
from svkc.tree.mass_matrix import mass_matrix_crba, mass_matrix_unit_vectors


def reduced_mass_matrix(
    chain: Chain, co: Coordinates, M: Float[Array, "nv nv"]
) -> Float[Array, "dofs dofs"]:
    """Return A = W^T M W (paper (23)), with ones on the diagonal of other coordinates."""
    W = co.W[: chain.nv]
    return W.T @ (M @ W) + jnp.diag(where(co.independent, 0, 1).astype(M.dtype))


class AbstractDynamics(eqx.Module):
    """A method to compute accelerations: the same away from singularities, at different cost.

    uses_pivots: whether the method chooses dependent coordinates. If not,
    `svkc.stabilization.Projection` works without pivots too.
    hold: how long pivots are kept. None: choose new ones at every evaluation. A number from 0 to 1
    (default 0.3): keep them until, at the end of a step, their |R_mm| / |R_11| is below this
    fraction of that of new pivots; 0 keeps them until the structure changes. Near a singular
    configuration, under differentiation, and with stabilizations that do not project by pivots,
    new ones are chosen at every evaluation. The motion does not depend on the choice.
    Raises ValueError if hold is neither None nor a number from 0 to 1.
    """

    uses_pivots: eqx.AbstractClassVar[bool]
    hold: float | None = eqx.field(static=True, default=0.3)

    def __check_init__(self) -> None:
        _check_hold(self.hold)

    @abc.abstractmethod
    def prepare(
        self, chain: Chain, structure: Structure, loops: LoopKinematics, selection: Any = None
    ) -> Callable[..., Any]:
        """Return solve: (force [dofs], bias [rows]) -> x on a chain with virtual links.

        x solves M x = force + J_C^T lambda and J_C x + bias = 0 (III-B); bias has scaled rows.

        loops: kinematics of the tree and of its loops.
        selection: the pivoted QR of `loops.J` if `uses_pivots` is True, else its `ConstraintRows`
        (None: not reduced).
        """

    @abc.abstractmethod
    def prepare_open(self, chain: Chain, structure: Structure, kin: Kinematics) -> Callable:
        """Return solve: force [nv] -> x on a chain without virtual links.

        x solves M x = force and is zero for locked coordinates.

        kin: kinematics of the tree.
        """


class ArticulatedBodies(AbstractDynamics):
    """Articulated bodies and loop forces by Delassus' matrix, without pivots.

    The fastest method, and the one for batches. Delassus' matrix squares the condition number of
    J_C near singular configurations. There, a run that uses
    `svkc.stabilization.Projection` reduces the rows of J_C first. Of redundant loops, its steps use
    independent rows only.

    Massless bodies that loops hold cost one more solve for each coordinate of their joints. They
    are those whose mass, or moment of inertia about a joint, is below 1e-7 of the model's largest
    when loaded; both may then be zero too. If another body's mass is set to zero, runs may end with
    `non_finite` or `step_too_small`: load a tiny mass, or use `CompositeBodies`.

    hold: for stabilizations that choose pivots whatever the method; see `AbstractDynamics`.
    """

    uses_pivots: ClassVar[bool] = False

    def prepare(
        self, chain: Chain, structure: Structure, loops: LoopKinematics, selection: Any = None
    ) -> Callable[..., Any]:
        column, active = jacobian_scales(chain)[1], active_dofs(chain, structure)
        rows = constraint_rows(chain, structure, loops) if selection is None else selection
        J, chain_and_kin, locked = jax.lax.stop_gradient(
            (loops.J, (chain, loops.kin), structure.locked)
        )
        solve = loop_force_solver(
            *chain_and_kin,
            where(active[None], J / column[None], 0),
            rows,
            None if locked is None else active[: chain.nv],
        )
        every = jnp.ones(len(loops.J), bool)
        return _implicit_solve(chain, structure, loops, solve, lambda x: x, every)

    def prepare_open(
        self, chain: Chain, structure: Structure, kin: Kinematics
    ) -> Callable[..., Any]:
        free = None if structure.locked is None else ~structure.locked
        bodies = articulated_factors(*jax.lax.stop_gradient((chain, kin)), free)
        solve = lambda force: solve_mass_matrix(chain.topology, bodies, force)
        return _implicit_open_solve(chain, structure, kin, solve)


class AbstractMassMatrix(AbstractDynamics):
    """The mass matrix of the tree, reduced to the independent coordinates (paper (23), (24))."""

    @abc.abstractmethod
    def mass_matrix(self, chain: Chain, kin: Kinematics) -> Float[Array, "nv nv"]:
        """Return the mass matrix of the tree."""

    def prepare(
        self, chain: Chain, structure: Structure, loops: LoopKinematics, selection: Any = None
    ) -> Callable[..., Any]:
        assert selection is not None
        qr, J, chain_and_kin, frozen_structure = jax.lax.stop_gradient(
            (selection, loops.J, (chain, loops.kin), structure)
        )
        solve = _solve_by_partitioning(*chain_and_kin, frozen_structure, qr, J, self.mass_matrix)
        return _implicit_solve(chain, structure, loops, solve, lambda x: qr.Q @ x, qr.active)

    def prepare_open(
        self, chain: Chain, structure: Structure, kin: Kinematics
    ) -> Callable[..., Any]:
        M = self.mass_matrix(*jax.lax.stop_gradient((chain, kin)))
        if structure.locked is not None:
            free = ~structure.locked
            M = where(free[:, None] & free[None], M, jnp.eye(chain.nv, dtype=M.dtype))
        return _implicit_open_solve(chain, structure, kin, cholesky_solver(M))


class CompositeBodies(AbstractMassMatrix):
    """The mass matrix by composite rigid bodies (Featherstone section 6.2)."""

    uses_pivots: ClassVar[bool] = True

    def mass_matrix(self, chain: Chain, kin: Kinematics) -> Float[Array, "nv nv"]:
        return mass_matrix_crba(chain, kin)


class UnitVectors(AbstractMassMatrix):
    """The mass matrix column by column from inverse dynamics, which is the paper's method."""

    uses_pivots: ClassVar[bool] = True

    def mass_matrix(self, chain: Chain, kin: Kinematics) -> Float[Array, "nv nv"]:
        return mass_matrix_unit_vectors(chain, kin)


def default_dynamics(chain: Chain) -> AbstractDynamics:
    """Return `ArticulatedBodies` for a chain without virtual links, else `CompositeBodies`."""
    return CompositeBodies() if chain.topology.link_names else ArticulatedBodies()


def articulated_bodies(chain: Chain, kin: Kinematics) -> Any:
    """Stand for `ArticulatedBodies` in `svkc.Dynamics(inertia=svkc.by_bodies)`."""
    return articulated_factors(chain, kin)


DEPRECATED_SPELLINGS = (
    (articulated_bodies, ArticulatedBodies),
    (mass_matrix_crba, CompositeBodies),
    (mass_matrix_unit_vectors, UnitVectors),
)


class Dynamics(eqx.Module):
    """Deprecated: use a class of `svkc.dynamics`; this one selects among them by a function.

    inertia: `svkc.by_bodies`, `svkc.inertia_by_composites`, `svkc.inertia_by_unit_vectors`, or None
    (default) for `default_dynamics`.
    hold: as in `AbstractDynamics`.
    Raises ValueError if inertia is anything else.
    """

    inertia: Callable | None = eqx.field(static=True, default=None)
    hold: float | None = eqx.field(static=True, default=0.3)

    def __check_init__(self) -> None:
        if self.inertia is not None and not any(
            self.inertia is old for old, _ in DEPRECATED_SPELLINGS
        ):
            raise ValueError(
                f"dynamics.inertia: got {self.inertia!r}, expected None, svkc.by_bodies,"
                " svkc.inertia_by_composites or svkc.inertia_by_unit_vectors"
            )
        _check_hold(self.hold)

    def resolved(self, chain: Chain) -> AbstractDynamics:
        """Return the equivalent object of `svkc.dynamics`."""
        if self.inertia is None:
            return dataclasses.replace(default_dynamics(chain), hold=self.hold)
        return next(new for old, new in DEPRECATED_SPELLINGS if old is self.inertia)(hold=self.hold)


def _check_hold(hold) -> None:
    if hold is not None and not 0 <= scalar("dynamics.hold", hold) <= 1:
        raise ValueError(f"dynamics.hold: got {hold}, expected None or a number between 0 and 1")


def _implicit_solve(
    chain: Chain,
    structure: Structure,
    loops: LoopKinematics,
    factor_solve: Callable,
    select_rows: Callable,
    active_rows: Bool[Array, " selected"],
) -> Callable:
    """Return (force, bias) -> x by `factor_solve`, differentiated as an implicit function.

    The derivatives are those of the equations M x + J^T mu = force, J x + bias = 0, with M x by
    Newton-Euler. Each costs one more solve with the same factors; neither the recursions for M nor
    the search for pivots is differentiated.

    factor_solve: (force, -bias) -> (x, mu) on selected rows, which has no derivative.
    select_rows: the linear map from all loop rows to the selected ones.
    active_rows: which of the selected rows count.
    """
    active = active_dofs(chain, structure)
    rates = lambda x: select_rows(loop_rates_by_twists(chain, loops, x))

    def equations(unknown):
        x, mu = unknown
        active_x = where(active, x, 0)
        inertial = pad_to_dofs(chain, mass_matrix_product(chain, loops.kin, active_x[: chain.nv]))
        (transmitted,) = jax.linear_transpose(rates, x)(mu)
        force = where(active, inertial + transmitted, x)
        return force, rates(active_x) + where(active_rows, 0, mu)

    def solve(force: Float[Array, " dofs"], bias: Float[Array, " rows"]) -> Float[Array, " dofs"]:
        right_sides = _link_tangents(where(active, force, 0), -select_rows(bias))
        return jax.lax.custom_linear_solve(
            equations, right_sides, solve=lambda _, sides: factor_solve(*sides), symmetric=True
        )[0]

    return solve


def _link_tangents(a: Float[Array, "..."], b: Float[Array, "..."]):
    """Return (a, b), each made to depend on the other with derivative zero.

    `custom_linear_solve` is transposed only if every right-hand side has a tangent.
    """
    return a + 0 * jnp.sum(b), b + 0 * jnp.sum(a)


def _solve_by_partitioning(
    chain: Chain, kin: Kinematics, structure: Structure, qr: PivotedQR, J, mass_matrix: Callable
) -> Callable:
    """Return (force, loop_bias) -> (x, mu) through W and A (paper (16), (23), (24))."""
    nv, (_, column) = chain.nv, jacobian_scales(chain)
    co = partition_coordinates(chain, structure, qr, J, jnp.zeros(J.shape[0], J.dtype))
    M, W = mass_matrix(chain, kin), co.W
    A_inverse = cholesky_solver(reduced_mass_matrix(chain, co, M))
    _, JS = pivot_blocks(qr, J)

    def solve(force, loop_bias):
        x = column * (qr.P.T @ batched_solve_triangular(JS, loop_bias))
        x = x + W @ A_inverse(W.T @ (force - pad_to_dofs(chain, M @ x[:nv])))
        rest = qr.P @ (column * (force - pad_to_dofs(chain, M @ x[:nv])))
        return x, where(qr.active, batched_solve_triangular(JS, rest, trans=True), loop_bias)

    return solve


def _implicit_open_solve(
    chain: Chain, structure: Structure, kin: Kinematics, factor_solve: Callable
) -> Callable:
    """Return force -> x by `factor_solve`, differentiated as in `_implicit_solve`."""
    locked = structure.locked
    free = jnp.ones(chain.nv, bool) if locked is None else ~locked

    def equations(x):
        return where(free, mass_matrix_product(chain, kin, where(free, x, 0)), x)

    def solve(force: Float[Array, " nv"]) -> Float[Array, " nv"]:
        return jax.lax.custom_linear_solve(
            equations, where(free, force, 0), solve=lambda _, x: factor_solve(x), symmetric=True
        )

    return solve
