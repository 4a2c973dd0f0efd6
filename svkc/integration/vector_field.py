"""The vector field of one phase, and steps put back onto the loops."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from svkc.integration.integrators import FieldArgs, ODEState
from svkc.integration.stabilization import (
    AbstractStabilization,
    Baumgarte,
    CoordinatePartitioning,
    Projection,
    needs_projection,
)
from svkc.loops.constrained_dynamics import AbstractDynamics, ArticulatedBodies
from svkc.loops.forward_dynamics import (
    velocity_and_acceleration,
    velocity_and_acceleration_lanes_last,
)
from svkc.loops.projection import project, project_by_loop_forces
from svkc.model.chain import Chain, State, active_dofs
from svkc.model.checked_jit import joint_torques
from svkc.model.validation import real_array
from svkc.tree.configuration import configuration_derivative, normalize
from svkc.tree.inverse_dynamics import limit_forces
from svkc.tree.traversal import LEVELS_UNROLLED


class VectorField(eqx.Module):
    """The vector field of one phase: qdot, vdot, power. differentiated: or in a loop that nothing
    differentiates, where a `vmap` keeps lanes last."""

    control: Callable | None
    stabilization: AbstractStabilization
    dynamics: AbstractDynamics
    differentiated: bool = eqx.field(static=True, default=True)

    @property
    def projects_by_loop_forces(self) -> bool:
        """Whether steps are put back onto the loops by the loops' forces, without pivots."""
        return (
            not self.dynamics.uses_pivots
            and isinstance(self.stabilization, Projection)
            and not isinstance(self.stabilization, CoordinatePartitioning)
        )

    def __call__(self, t, y: ODEState, scene: FieldArgs) -> ODEState:
        chain, structure, held = scene.chain, scene.structure, self.stabilization
        if isinstance(held, CoordinatePartitioning):
            y, _ = project_state(self, scene, y)
        tau, power = self.torques(t, y, scene)
        rate, agree = (
            held.rate if isinstance(held, Baumgarte) else None,
            isinstance(held, Projection) and not self.projects_by_loop_forces,
        )
        if self._batches_lanes_last(chain) and not agree:
            v, vdot = velocity_and_acceleration_lanes_last(chain, structure, y.q, y.v, tau, rate)
        else:
            v, vdot = velocity_and_acceleration(
                chain,
                structure,
                y.q,
                y.v,
                tau,
                dynamics=self.dynamics,
                baumgarte=rate,
                project_velocity=agree,
                pivots=scene.pivots,
            )
        return ODEState(
            configuration_derivative(chain, y.q, jnp.where(active_dofs(chain, structure), v, 0)),
            vdot,
            power,
        )

    def _batches_lanes_last(self, chain: Chain) -> bool:
        """Whether it is for speed alone, and accelerations are had by articulated bodies, level by
        level."""
        return (
            not self.differentiated
            and isinstance(self.dynamics, ArticulatedBodies)
            and len(chain.topology.levels) <= LEVELS_UNROLLED
        )

    def torques(self, t, y: ODEState, scene: FieldArgs):
        """Joint torques of the control and the limits, and the power of all that is not
        conservative (None: there is none)."""
        chain = scene.chain
        tau = jnp.zeros_like(y.v)
        if self.control is not None:
            # traced once for all the places that call it
            asked = eqx.filter_jit(self.control)(t, State(y.q, y.v, scene.structure), scene.args)
            tau = tau + joint_torques(chain, real_array("control", asked, y.v.dtype))
        if chain.limit is not None:
            tau = tau + limit_forces(chain, y.q, y.v)
        if y.work is None:
            return tau, None
        v = jnp.where(active_dofs(chain, scene.structure), y.v, 0)
        return tau, tau @ v if chain.damping is None else tau @ v - jnp.sum(chain.damping * v * v)


class ProjectionInfo(eqx.Module):
    """What the loops show as a step is put back onto them: how far each loop is open yet (rad,
    `chain.length`s) and, where pivots are chosen, |R_mm| / |R_11| and those to go on with."""

    gap: Float[Array, "links 2"]
    margin: Float[Array, ""] | None = None
    pivots: Float[Array, "steps dofs"] | None = None

    @classmethod
    def initial(cls, field: VectorField, scene: FieldArgs, q) -> "Seen | None":
        """Before the first step."""
        if not needs_projection(field.stabilization, scene):
            return None
        links, dofs = len(scene.chain.link_names), scene.chain.dofs
        gap = jnp.zeros((links, 2), q.dtype)
        # the first evaluation of the field finds no pivots held, and chooses
        return (
            cls(gap)
            if field.projects_by_loop_forces
            else cls(gap, jnp.ones((), q.dtype), jnp.zeros((min(6 * links, dofs), dofs), q.dtype))
        )

    @property
    def dependent(self) -> Bool[Array, " dofs"]:
        """Coordinates that depend on the others."""
        return jnp.any(self.pivots > 0, 0)


def project_state(
    field: VectorField, scene: FieldArgs, y: ODEState
) -> tuple[ODEState, ProjectionInfo | None]:
    """The motion put back: quaternions to unit length, loops closed, velocities in agreement; and
    what that showed (None: loops are left alone)."""
    chain, structure, held = scene.chain, scene.structure, field.stabilization
    if not needs_projection(held, scene):
        return eqx.tree_at(lambda y: y.q, y, normalize(chain, y.q)), None
    if field.projects_by_loop_forces:
        q, v, *seen = project_by_loop_forces(
            chain,
            structure,
            y.q,
            y.v,
            iterations=held.iterations,
            differentiated=field.differentiated,
        )
    else:
        q, v, *seen = project(
            chain,
            structure,
            y.q,
            y.v,
            iterations=held.iterations,
            dependent_only=isinstance(held, CoordinatePartitioning),
            pivots=scene.pivots,
            hold=field.dynamics.hold or 0.0,
        )
    return eqx.tree_at(lambda y: (y.q, y.v), y, (q, v)), ProjectionInfo(*seen)
