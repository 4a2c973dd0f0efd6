"""The velocity and the impulses after a change of structure (paper, (29)-(38))."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from svkc.loops.constrained_dynamics import ArticulatedBodies, CompositeBodies
from svkc.loops.constraint import LoopKinematics, jacobian_scales
from svkc.loops.forward_dynamics import constraint_forces
from svkc.loops.pivoting import PivotedQR
from svkc.model.chain import Chain, State, Structure
from svkc.tree.inverse_dynamics import append_virtual_joints, mass_matrix_product
from svkc.tree.kinematics import kinematics


def velocity_after_impact(
    chain: Chain, structure: Structure, loops: LoopKinematics, selection: PivotedQR, v
):
    """Return v+ = W (W^T M W)^-1 W^T M v-, the impulse of each loop on its real link, and the
    energy lost: the paper's (29)-(38) in one formula.

    v+ is the projection of v-, orthogonal in the metric of the inertia, on the velocities that the
    structure allows. Redundant loops need no special case.
    """
    solve = CompositeBodies().prepare(chain, structure, loops, selection)
    jump = solve(jnp.zeros_like(v), loops.J @ (v / jacobian_scales(chain)[1]))
    impulse = append_virtual_joints(chain, mass_matrix_product(chain, loops.kin, jump[: chain.nv]))
    # v- and v+ differ by a vector orthogonal to v+, so that the loss is a square and cannot be
    # negative
    return v + jump, -constraint_forces(chain, selection, loops.J, impulse), jump @ impulse / 2


class StructureChange(eqx.Module):
    """What a change of structure did: the state after it, impulses on the real links from their
    parents, at the joints, and energy lost (J).

    `gap`: the largest gap of a loop before it was closed; `left`: of each loop after it (rad, or
    `chain.length`s).
    """

    state: State
    impulse: Float[Array, "links 3"]
    angular_impulse: Float[Array, "links 3"]
    energy_lost: Float[Array, ""]
    initial_gap: Float[Array, ""]
    residual_gaps: Float[Array, " links"]


def lock_projection(chain: Chain, structure: Structure, q, v):
    """The projection where only joints are locked and there are no virtual links; velocity after,
    energy lost."""
    if structure.locked is None:
        return v, jnp.zeros((), v.dtype)
    kin = kinematics(chain, q)
    after = ArticulatedBodies().prepare_open(chain, structure, kin)(
        mass_matrix_product(chain, kin, v)
    )
    jump = after - v
    return after, jump @ mass_matrix_product(chain, kin, jump) / 2
