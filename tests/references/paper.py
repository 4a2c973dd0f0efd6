"""Formulas of the paper in places where svkc computes by other formulas."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Array, Float

from svkc.loops.constrained_dynamics import UnitVectors, reduced_mass_matrix
from svkc.loops.constraint import assemble_loop_jacobian, loop_kinematics
from svkc.loops.coordinates import closed_coordinates
from svkc.loops.forward_dynamics import acceleration
from svkc.loops.frames import loop_frames
from svkc.model.chain import Chain, State
from svkc.model.checked_jit import torques_over_dofs
from svkc.model.names import link_index
from svkc.transitions.placement import joint_coordinates, with_coordinates
from svkc.tree.kinematics import twists
from svkc.tree.mass_matrix import mass_matrix_crba


@jax.jit
def forward_dynamics_by_unit_vectors(
    chain: Chain, state: State, tau: Float[Array, " torques"]
) -> Float[Array, " dofs"]:
    """Return the accelerations of every coordinate by unit vectors, the paper's (23), (24)."""
    return acceleration(
        chain, state.structure, state.q, state.v, torques_over_dofs(chain, tau), UnitVectors()
    )


@functools.partial(jax.jit, static_argnames="name")
def velocity_by_impulse(
    chain: Chain, state: State, name: str
) -> tuple[Float[Array, " dofs"], Float[Array, "6"]]:
    """Return the velocity after connecting one virtual link, and the impulse F_1 on the link.

    The formulas are the paper's (34)-(38), in the coordinates theta_G of the structure before. B
    must be regular.

    state: a state in which the link is not connected and its gap is zero.
    name: name of the virtual link.
    """
    slot, nv = link_index(chain.topology, name), chain.nv
    loops = loop_kinematics(chain, state.structure, state.q)
    kin = loops.kin
    before = closed_coordinates(chain, state.structure, state.v, loops, twists(chain, kin, state.v))
    after = eqx.tree_at(
        lambda s: s.connected, state.structure, state.structure.connected.at[slot].set(True)
    )
    q = with_coordinates(
        chain,
        after.connected & ~state.structure.connected,
        joint_coordinates(chain, after, kin, state.q),
        state.q,
    )
    J = assemble_loop_jacobian(chain, after, kin, loop_frames(chain, after, kin, q))[
        6 * slot : 6 * slot + 6
    ]
    joint_dofs = np.array([d for d in chain.topology.links.dof[slot] if d < chain.dofs], int)
    # J_1 - J_2 along theta_G, and the axes of the new joint with the sign of (27)
    J_G, J_r = J[:, :nv] @ before.W[:nv], -J[:, joint_dofs]
    A = cho_factor(reduced_mass_matrix(chain, before, mass_matrix_crba(chain, kin)))
    B_inverse = jnp.linalg.inv(J_G @ cho_solve(A, J_G.T))
    C = (
        J_r @ jnp.linalg.solve(J_r.T @ B_inverse @ J_r, J_r.T @ B_inverse)
        if len(joint_dofs)
        else jnp.zeros_like(B_inverse)
    )
    u = J[:, :nv] @ state.v[:nv]
    F = -B_inverse @ (jnp.eye(6, dtype=u.dtype) - C) @ u
    v = state.v + before.W @ cho_solve(A, J_G.T @ F)
    if len(joint_dofs):
        v = v.at[joint_dofs].set(jnp.linalg.lstsq(J_r, J[:, :nv] @ v[:nv])[0])
    return v, F
