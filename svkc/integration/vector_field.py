"""The vector field of one phase, and steps put back onto the loops."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from svkc.integration.integrators import Motion, Scene
from svkc.integration.stabilization import (
    AbstractStabilization,
    Baumgarte,
    CoordinatePartitioning,
    Projection,
    projects,
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


class Field(eqx.Module):
    """The vector field of one phase: qdot, vdot, power. differentiated: or in a loop that nothing
    differentiates, where a `vmap` keeps lanes last."""

    control: Callable | None
    stabilization: AbstractStabilization
    dynamics: AbstractDynamics
    differentiated: bool = eqx.field(static=True, default=True)

    @property
    def pivotless(self) -> bool:
        """Whether steps are put back onto the loops by the loops' forces, without pivots."""
        return (
            not self.dynamics.uses_pivots
            and isinstance(self.stabilization, Projection)
            and not isinstance(self.stabilization, CoordinatePartitioning)
        )

    def __call__(self, t, y: Motion, scene: Scene) -> Motion:
        chain, structure, held = scene.chain, scene.structure, self.stabilization
        if isinstance(held, CoordinatePartitioning):
            y, _ = settle(self, scene, y)
        tau, power = self.torques(t, y, scene)
        rate, agree = (
            held.rate if isinstance(held, Baumgarte) else None,
            isinstance(held, Projection) and not self.pivotless,
        )
        if self._in_lanes(chain) and not agree:
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
        return Motion(
            configuration_derivative(chain, y.q, jnp.where(active_dofs(chain, structure), v, 0)),
            vdot,
            power,
        )

    def _in_lanes(self, chain: Chain) -> bool:
        """Whether it is for speed alone, and accelerations are had by articulated bodies, level by
        level."""
        return (
            not self.differentiated
            and isinstance(self.dynamics, ArticulatedBodies)
            and len(chain.topology.levels) <= LEVELS_UNROLLED
        )

    def torques(self, t, y: Motion, scene: Scene):
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


class Seen(eqx.Module):
    """What the loops show as a step is put back onto them: how far each loop is open yet (rad,
    `chain.length`s) and, where pivots are chosen, |R_mm| / |R_11| and those to go on with."""

    gap: Float[Array, "links 2"]
    margin: Float[Array, ""] | None = None
    pivots: Float[Array, "steps dofs"] | None = None

    @classmethod
    def first(cls, field: Field, scene: Scene, q) -> "Seen | None":
        """Before the first step."""
        if not projects(field.stabilization, scene):
            return None
        links, dofs = len(scene.chain.link_names), scene.chain.dofs
        gap = jnp.zeros((links, 2), q.dtype)
        # the first evaluation of the field finds no pivots held, and chooses
        return (
            cls(gap)
            if field.pivotless
            else cls(gap, jnp.ones((), q.dtype), jnp.zeros((min(6 * links, dofs), dofs), q.dtype))
        )

    @property
    def dependent(self) -> Bool[Array, " dofs"]:
        """Coordinates that depend on the others."""
        return jnp.any(self.pivots > 0, 0)


def settle(field: Field, scene: Scene, y: Motion) -> tuple[Motion, Seen | None]:
    """The motion put back: quaternions to unit length, loops closed, velocities in agreement; and
    what that showed (None: loops are left alone)."""
    chain, structure, held = scene.chain, scene.structure, field.stabilization
    if not projects(held, scene):
        return eqx.tree_at(lambda y: y.q, y, normalize(chain, y.q)), None
    if field.pivotless:
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
    return eqx.tree_at(lambda y: (y.q, y.v), y, (q, v)), Seen(*seen)
