"""Velocities and impulses of inelastic impacts at changes of structure (paper, (29)-(38))."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from svkc._jax.select import where
from svkc.loops.constrained_dynamics import ArticulatedBodies, CompositeBodies
from svkc.loops.constraint import LoopKinematics, jacobian_scales
from svkc.loops.forward_dynamics import constraint_forces
from svkc.loops.pivoting import PivotedQR
from svkc.model.chain import Chain, State, Structure
from svkc.tree.inverse_dynamics import mass_matrix_product, pad_to_dofs
from svkc.tree.kinematics import kinematics


def velocity_after_impact(
    chain: Chain,
    structure: Structure,
    loops: LoopKinematics,
    qr: PivotedQR,
    v: Float[Array, " dofs"],
) -> Any:
    """Return v+ = W (W^T M W)^-1 W^T M v-, the impulse of each loop on its real link, and the
    energy lost (J): the paper's (29)-(38) in one formula.

    v+ is the projection of v- onto the velocities that the structure allows, orthogonal in the
    metric of the mass matrix. Redundant loops need no special case. Locked joints stop: the
    momentum of their velocity in v- goes to the other joints.
    """
    solve = CompositeBodies().prepare(chain, structure, loops, qr)
    momentum, remaining = jnp.zeros_like(v), v
    if structure.locked is not None:
        stopped = where(structure.locked, v, 0)
        momentum = pad_to_dofs(chain, mass_matrix_product(chain, loops.kin, stopped[: chain.nv]))
        remaining = v - stopped
    delta_v = solve(momentum, loops.J @ (remaining / jacobian_scales(chain)[1])) + remaining - v
    impulse = pad_to_dofs(chain, mass_matrix_product(chain, loops.kin, delta_v[: chain.nv]))
    # v+ - v- is orthogonal to v+, so the energy lost is a squared norm and cannot be negative
    return v + delta_v, -constraint_forces(chain, qr, loops.J, impulse), delta_v @ impulse / 2


class StructureChange(eqx.Module):
    """The result of a change of structure.

    state: the state after the change.
    impulse, angular_impulse: of each virtual link on its real link from the parent, at the joint,
        in world axes (N s, N m s).
    energy_lost: kinetic energy lost in the impact (J).
    initial_gap: largest loop gap before the new loops were closed (rad, or in `chain.length`s).
    residual_gaps: largest gap of each loop after they were closed (rad, or in `chain.length`s);
        zero if nothing is new.
    """

    state: State
    impulse: Float[Array, "links 3"]
    angular_impulse: Float[Array, "links 3"]
    energy_lost: Float[Array, ""]
    initial_gap: Float[Array, ""]
    residual_gaps: Float[Array, " links"]


def lock_projection(
    chain: Chain, structure: Structure, q: Float[Array, " q"], v: Float[Array, " dofs"]
) -> Any:
    """Return the velocity after locking joints of a chain without virtual links, and the energy
    lost (J)."""
    if structure.locked is None:
        return v, jnp.zeros((), v.dtype)
    kin = kinematics(chain, q)
    after = ArticulatedBodies().prepare_open(chain, structure, kin)(
        mass_matrix_product(chain, kin, v)
    )
    delta_v = after - v
    return after, delta_v @ mass_matrix_product(chain, kin, delta_v) / 2
