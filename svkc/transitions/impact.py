"""The velocity and the impulses after a change of structure (paper, (29)-(38))."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Array, Float

from svkc.loops.constrained_dynamics import (
    ArticulatedBodies,
    CompositeBodies,
    reduced_inertia,
    with_links,
)
from svkc.loops.constraint import LoopKinematics, ends, loop_jacobian, loop_kinematics, scales
from svkc.loops.coordinates import constrained
from svkc.loops.forward_dynamics import constraint_forces
from svkc.loops.pivoting import Selection
from svkc.model.chain import Chain, State, Structure
from svkc.model.names import link_index
from svkc.transitions.placement import joint_coordinates, with_coordinates
from svkc.tree.inverse_dynamics import inertia_times
from svkc.tree.kinematics import kinematics, twists
from svkc.tree.mass_matrix import inertia_by_composites


def velocity_after_impact(
    chain: Chain, structure: Structure, loops: LoopKinematics, selection: Selection, v
):
    """Return v+ = W (W^T M W)^-1 W^T M v-, the impulse of each loop on its real link, and the
    energy lost: the paper's (29)-(38) in one formula.

    v+ is the projection of v-, orthogonal in the metric of the inertia, on the velocities that the
    structure allows. Redundant loops need no special case.
    """
    solve = CompositeBodies().prepare(chain, structure, loops, selection)
    jump = solve(jnp.zeros_like(v), loops.J @ (v / scales(chain)[1]))
    impulse = with_links(chain, inertia_times(chain, loops.kin, jump[: chain.nv]), jump)
    # v- and v+ differ by a vector orthogonal to v+, so that the loss is a square and cannot be
    # negative
    return v + jump, -constraint_forces(chain, selection, loops.J, impulse), jump @ impulse / 2


class Change(eqx.Module):
    """What a change of structure did: the state after it, impulses on the real links from their
    parents, at the joints, and energy lost (J).

    `gap`: the largest gap of a loop before it was closed; `left`: of each loop after it (rad, or
    `chain.length`s).
    """

    state: State
    impulse: Float[Array, "links 3"]
    angular_impulse: Float[Array, "links 3"]
    energy_lost: Float[Array, ""]
    gap: Float[Array, ""]
    left: Float[Array, " links"]


def lock_projection(chain: Chain, structure: Structure, q, v):
    """The projection where only joints are locked and there are no virtual links; velocity after,
    energy lost."""
    if structure.locked is None:
        return v, jnp.zeros((), v.dtype)
    kin = kinematics(chain, q)
    after = ArticulatedBodies().prepare_open(chain, structure, kin)(inertia_times(chain, kin, v))
    jump = after - v
    return after, jump @ inertia_times(chain, kin, jump) / 2


@functools.partial(jax.jit, static_argnames="name")
def velocity_by_impulse(
    chain: Chain, state: State, name: str
) -> tuple[Float[Array, " dofs"], Float[Array, "6"]]:
    """The velocity after connecting one link and the impulse F_1 on it, by the paper's (34)-(38) in
    the coordinates theta_G of the old structure.

    The paper's own form, good where B is regular; it checks the projection that `connect` uses.
    State: not connected yet, bodies in place.
    """
    slot, nv = link_index(chain, name), chain.nv
    loops = loop_kinematics(chain, state.structure, state.q)
    kin = loops.kin
    before = constrained(chain, state.structure, state.v, loops, twists(chain, kin, state.v))
    after = eqx.tree_at(
        lambda s: s.connected, state.structure, state.structure.connected.at[slot].set(True)
    )
    q = with_coordinates(
        chain,
        after.connected & ~state.structure.connected,
        joint_coordinates(chain, after, kin, state.q),
        state.q,
    )
    J = loop_jacobian(chain, after, kin, ends(chain, after, kin, q))[6 * slot : 6 * slot + 6]
    own = np.array([d for d in chain.topology.links.dof[slot] if d < chain.dofs], int)
    # J_1 - J_2 along theta_G, and the axes of the new joint, on the side where (27) has them
    J_G, J_r = J[:, :nv] @ before.W[:nv], -J[:, own]
    A = cho_factor(reduced_inertia(chain, before, inertia_by_composites(chain, kin)))
    B_inverse = jnp.linalg.inv(J_G @ cho_solve(A, J_G.T))
    C = (
        J_r @ jnp.linalg.solve(J_r.T @ B_inverse @ J_r, J_r.T @ B_inverse)
        if len(own)
        else jnp.zeros_like(B_inverse)
    )
    u = J[:, :nv] @ state.v[:nv]
    F = -B_inverse @ (jnp.eye(6, dtype=u.dtype) - C) @ u
    v = state.v + before.W @ cho_solve(A, J_G.T @ F)
    if len(own):
        v = v.at[own].set(jnp.linalg.lstsq(J_r, J[:, :nv] @ v[:nv])[0])
    return v, F
