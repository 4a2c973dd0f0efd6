"""The vector field of one phase, and the projection of its states onto closed loops."""

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from svkc._jax.one_kernel import one_kernel
from svkc._jax.select import where
from svkc.integration.ode import FieldArgs, ODEState
from svkc.integration.stabilization import (
    AbstractStabilization,
    Baumgarte,
    CoordinatePartitioning,
    Projection,
    needs_projection,
)
from svkc.loops.constrained_dynamics import AbstractDynamics, ArticulatedBodies
from svkc.loops.constraint_rows import RowChoice
from svkc.loops.forward_dynamics import (
    velocity_and_acceleration,
    velocity_and_acceleration_lanes_last,
)
from svkc.loops.loop_force_projection import project_by_loop_forces
from svkc.loops.pivoting import singularity_threshold
from svkc.loops.projection import ProjectionInfo, project
from svkc.model.annotations import Scalar
from svkc.model.chain import Chain, State, Structure, active_dofs
from svkc.model.checked_jit import torques_over_dofs
from svkc.model.validation import as_array, description, is_real
from svkc.tree.configuration import configuration_derivative, normalize
from svkc.tree.inverse_dynamics import limit_forces
from svkc.tree.traversal import LEVELS_UNROLLED


class VectorField(eqx.Module):
    """The vector field of one phase: (t, y, field_args) -> dy/dt = (qdot, vdot, power).

    Reverse mode stores the arguments of the torques, of the rates and of the projection of
    `CoordinatePartitioning`, and recomputes these functions. Without control, torques and rates are
    one function.

    control: joint torques as a function (t, state, args), or None for no torques.
    differentiated: whether derivatives are taken through this field. False in the stepping loop,
        which is never differentiated; accelerations may then be batched with lanes last.
    """

    control: Callable | None
    stabilization: AbstractStabilization
    dynamics: AbstractDynamics
    differentiated: bool = eqx.field(static=True, default=True)

    @property
    def projects_by_loop_forces(self) -> bool:
        """Whether steps are projected by the forces of the loops, by articulated bodies."""
        return (
            not self.dynamics.uses_pivots
            and isinstance(self.stabilization, Projection)
            and not isinstance(self.stabilization, CoordinatePartitioning)
        )

    def __call__(self, t: Scalar, y: ODEState, field_args: FieldArgs) -> ODEState:
        if isinstance(self.stabilization, CoordinatePartitioning):
            y, _ = eqx.filter_checkpoint(project_state)(self, field_args, y)
        if self.control is None:
            return _rates_without_control(self, t, y, field_args)
        tau, power = _torques(self, t, y, field_args)
        return _rates(self, y, field_args, tau, power)

    def batches_lanes_last(self, chain: Chain) -> bool:
        """Return whether a `vmap` of this field computes accelerations with lanes last.

        Lanes last are for articulated bodies whose levels are unrolled; they are never
        differentiated.
        """
        return (
            not self.differentiated
            and isinstance(self.dynamics, ArticulatedBodies)
            and len(chain.topology.levels) <= LEVELS_UNROLLED
        )

    def torques(
        self, t: Scalar, y: ODEState, field_args: FieldArgs
    ) -> tuple[Float[Array, " dofs"], Float[Array, "3"] | None]:
        """Return the joint torques (N m, N) of control and joint limits, and the power (W).

        The power is that of control, of dampers and of joint limits, None where `y.work` is None.
        """
        chain = field_args.chain
        tau = at_limits = jnp.zeros_like(y.v)
        if self.control is not None:
            # The jit makes all call sites share one trace.
            controlled = eqx.filter_jit(self.control)(
                t, State(y.q, y.v, field_args.structure), field_args.args
            )
            tau = tau + _control_torques(chain, controlled, y.v.dtype)
        if chain.limit is not None:
            at_limits = limit_forces(chain, y.q, y.v)
        if y.work is None:
            return tau + at_limits, None
        v = where(active_dofs(chain, field_args.structure), y.v, 0)
        of_dampers = jnp.zeros_like(v) if chain.damping is None else -chain.damping * v
        return tau + at_limits, jnp.stack([tau, of_dampers, at_limits]) @ v


@one_kernel
@eqx.filter_checkpoint
def _torques(
    field: VectorField, t: Scalar, y: ODEState, field_args: FieldArgs
) -> tuple[Float[Array, " dofs"], Float[Array, "3"] | None]:
    """Return `field.torques`. It is a kernel of its own, as not every control fits into one."""
    return field.torques(t, y, field_args)


def _rates_for_torques(
    field: VectorField,
    y: ODEState,
    field_args: FieldArgs,
    tau: Float[Array, " dofs"],
    power: Float[Array, "3"] | None,
) -> ODEState:
    """Return dy/dt for joint torques. tau, power: as `VectorField.torques` returns them."""
    chain, structure = field_args.chain, field_args.structure
    stabilization = field.stabilization
    baumgarte = stabilization.rate if isinstance(stabilization, Baumgarte) else None
    project_velocity = isinstance(stabilization, Projection) and not field.projects_by_loop_forces
    if field.batches_lanes_last(chain) and not project_velocity:
        v, vdot = velocity_and_acceleration_lanes_last(
            chain, structure, (y.q, y.v), tau, baumgarte, field_args.row_choice
        )
    else:
        v, vdot = velocity_and_acceleration(
            chain,
            structure,
            y.q,
            y.v,
            tau,
            dynamics=field.dynamics,
            baumgarte=baumgarte,
            project_velocity=project_velocity,
            pivots=field_args.pivots,
            choice=field_args.row_choice,
        )
    qdot = configuration_derivative(chain, y.q, where(active_dofs(chain, structure), v, 0))
    return ODEState(qdot, vdot, power)


_rates = one_kernel(eqx.filter_checkpoint(_rates_for_torques))


@one_kernel
@eqx.filter_checkpoint
def _rates_without_control(
    field: VectorField, t: Scalar, y: ODEState, field_args: FieldArgs
) -> ODEState:
    """Return dy/dt of a field without control: torques and rates in one kernel."""
    return _rates_for_torques(field, y, field_args, *field.torques(t, y, field_args))


def _control_torques(chain: Chain, value, dtype) -> Float[Array, " dofs"]:
    """Return what the user's control returned as torques over every coordinate."""
    if isinstance(value, Mapping):
        return chain.torques(value).astype(dtype)
    tau = as_array(value)
    if not is_real(tau) or tau.shape not in ((chain.dofs,), (chain.nv,)):
        raise ValueError(
            f"control: expected control(t, state, args) to return {chain.dofs} joint torques (or"
            f" {chain.nv}, the tree's), or a dict by joint name, got {description(value)}"
        )
    return torques_over_dofs(chain, jnp.asarray(tau, dtype))


def phase_field_args(
    chain: Chain, structure: Structure, args: Any, field: VectorField
) -> FieldArgs:
    """Return the arguments of the vector field at the start of a phase.

    args: the user's.
    """
    choice = None
    if needs_projection(field.stabilization, chain) and field.projects_by_loop_forces:
        away = structure.margin > singularity_threshold(structure)
        choice = RowChoice.of_first_step(chain, structure, ~away)
    return FieldArgs(chain, structure, args, row_choice=choice)


def initial_projection_info(
    field: VectorField, field_args: FieldArgs, q: Float[Array, " q"]
) -> ProjectionInfo | None:
    """Return the projection's result before the first step. None: steps are not projected."""
    chain, choice = field_args.chain, field_args.row_choice
    if not needs_projection(field.stabilization, chain):
        return None
    if not field.projects_by_loop_forces:
        return ProjectionInfo.of_pivots(chain, q.dtype)
    return ProjectionInfo.of_loop_forces(chain, q.dtype, None if choice is None else choice.kept)


def project_state(
    field: VectorField, field_args: FieldArgs, y: ODEState
) -> tuple[ODEState, ProjectionInfo | None]:
    """Normalize the quaternions of a state, close its loops and make its velocities consistent.

    The second result is None, and q is normalized alone, where steps are not projected.
    """
    chain, structure = field_args.chain, field_args.structure
    stabilization = field.stabilization
    if not needs_projection(stabilization, chain):
        return eqx.tree_at(lambda y: y.q, y, normalize(chain, y.q)), None
    assert isinstance(stabilization, Projection)
    if field.projects_by_loop_forces:
        q, v, info = project_by_loop_forces(
            chain,
            structure,
            y.q,
            y.v,
            field_args.row_choice,
            iterations=stabilization.iterations,
            differentiated=field.differentiated,
        )
    else:
        q, v, info = project(
            chain,
            structure,
            y.q,
            y.v,
            iterations=stabilization.iterations,
            dependent_only=isinstance(stabilization, CoordinatePartitioning),
            pivots=field_args.pivots,
            hold=field.dynamics.hold or 0.0,
        )
    return eqx.tree_at(lambda y: (y.q, y.v), y, (q, v)), info
