"""F4: the acceleration of any structure (paper, section III-B) and the forces its loops carry."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Array, Bool, Float

from svkc.chain import Chain, State, Structure
from svkc.closure import Coordinates, constrain, rank_tolerance, scales, square
from svkc.inverse_dynamics import generalized_forces, inertia_by_composites, inertia_by_unit_vectors, passive_forces
from svkc.kinematics import kinematics, twists


def joint_torques(chain: Chain, tau: Float[Array, " torques"]) -> Float[Array, " dofs"]:
    """Torques over every coordinate; those of virtual joints are zero where only the tree's are given. ValueError: another size."""
    if tau.shape[0] == chain.dofs:
        return tau
    if tau.shape[0] == chain.nv:
        return jnp.concatenate([tau, jnp.zeros(chain.dofs - chain.nv, tau.dtype)])
    raise ValueError(f"tau: got {tau.shape[0]} numbers, expected {chain.dofs} joint torques (or {chain.nv}, the tree's)")


def reduced_inertia(chain: Chain, co: Coordinates, M: Float[Array, "nv nv"]) -> Float[Array, "dofs dofs"]:
    """A = W^T M W (23), ones on the diagonal of coordinates that are not independent."""
    W = co.W[: chain.nv]
    A = W.T @ (M @ W) + jnp.diag(jnp.where(co.independent, 0, 1).astype(M.dtype))
    if chain.link_armature is None:
        return A
    own = co.W[chain.nv :]
    return A + own.T @ (chain.link_armature[:, None] * own)


def with_links(chain: Chain, tree: Float[Array, " nv"], own: Float[Array, " dofs"]) -> Float[Array, " dofs"]:
    """Generalized forces of the tree, and those that the armatures of virtual joints need for `own` (accelerations, or jumps of velocity)."""
    if chain.link_armature is None:
        return jnp.concatenate([tree, jnp.zeros(chain.dofs - chain.nv, tree.dtype)])
    return jnp.concatenate([tree, chain.link_armature * own[chain.nv :]])


@functools.partial(jax.jit, static_argnames="inertia")
def acceleration(chain: Chain, structure: Structure, q, v, tau: Float[Array, " dofs"], inertia=inertia_by_composites, baumgarte=None) -> Float[Array, " dofs"]:
    """Steps 1 to 5 of section III-B. On an open chain W is the identity and nothing of the closure is computed.

    baumgarte: rate (1/s) at which open loops are pulled back; None: not at all.
    """
    nv = chain.nv
    kin = kinematics(chain, q)
    V = twists(chain, kin, v)
    applied = tau + passive_forces(chain, q, v)
    if not len(chain.topology.link_names):
        M = inertia(chain, kin)
        b = generalized_forces(chain, kin, V, v, jnp.zeros_like(v))
        if structure.locked is None:
            return cho_solve(cho_factor(M), applied - b)
        free = ~structure.locked
        M = jnp.where(free[:, None] & free[None], M, jnp.eye(nv, dtype=M.dtype))
        return cho_solve(cho_factor(M), jnp.where(free, applied - b, 0))
    co = constrain(chain, structure, q, v, kin, V, baumgarte)
    W = co.W
    b = W.T @ with_links(chain, generalized_forces(chain, kin, V, v, co.bias[:nv]), co.bias)
    A = reduced_inertia(chain, co, inertia(chain, kin))
    vdot_G = cho_solve(cho_factor(A), W.T @ applied - b)
    return W @ vdot_G + co.bias


@jax.jit
def forward_dynamics(chain: Chain, state: State, tau: Float[Array, " torques"]) -> Float[Array, " dofs"]:
    """Accelerations (rad/s^2, m/s^2) of every joint coordinate for the joint torques tau (N m, N), loops kept (paper, section III-B).

    Springs and dampers of the joints act too. tau: over every coordinate, or the tree's alone. Inertia by composite bodies.
    """
    return acceleration(chain, state.structure, state.q, state.v, joint_torques(chain, tau))


@jax.jit
def forward_dynamics_by_unit_vectors(chain: Chain, state: State, tau: Float[Array, " torques"]) -> Float[Array, " dofs"]:
    """The same with the inertia matrix column by column from inverse dynamics: the paper's own way."""
    return acceleration(chain, state.structure, state.q, state.v, joint_torques(chain, tau), inertia_by_unit_vectors)


def constraint_forces(chain: Chain, co: Coordinates, excess: Float[Array, " dofs"]) -> Float[Array, "links 6"]:
    """Lambda with J_C^T lambda = excess, of least norm where loops are redundant: wrench (N m, N) on the virtual link, at the joint."""
    row, column = scales(chain)
    _, JS = square(co.selection, co.J)
    mu = jnp.linalg.solve(JS.T, co.selection.P @ (column * excess))
    return (row * (co.selection.Q.T @ mu)).reshape(-1, 6)


class LoopForces(eqx.Module):
    """Wrench of each connected virtual link, on `real` from `parent`, at the joint, in world axes; unpacks as force, torque.

    `unique`: nothing but the motion decides it. Where loops are redundant some wrenches are not: they are the least in norm (rows over `chain.length`).
    """

    force: Float[Array, "links 3"]
    torque: Float[Array, "links 3"]
    unique: Bool[Array, " links"]

    def __iter__(self):
        return iter((self.force, self.torque))


@jax.jit
def loop_forces(chain: Chain, state: State, tau: Float[Array, " torques"]) -> LoopForces:
    """Force (N) and torque (N m) that each connected virtual link carries for the joint torques tau: on `real` from `parent`, at the joint, in
    world axes, and whether the motion alone decides it."""
    tau = joint_torques(chain, tau)
    q, v, nv = state.q, state.v, chain.nv
    kin = kinematics(chain, q)
    V = twists(chain, kin, v)
    vdot = acceleration(chain, state.structure, q, v, tau)
    needed = with_links(chain, generalized_forces(chain, kin, V, v, vdot[:nv]), vdot)
    co = constrain(chain, state.structure, q, v, kin, V)
    wrench = -constraint_forces(chain, co, needed - passive_forces(chain, q, v) - tau)
    return LoopForces(wrench[:, 3:], wrench[:, :3], ~self_stressed(state.structure, co))


def self_stressed(structure: Structure, co: Coordinates) -> Bool[Array, " links"]:
    """Links that take part in a self-stress: wrenches of all loops together, J_C^T lambda = 0, that no motion tells of."""
    # a row's length within the range of J_C: 1 where no vector orthogonal to that range has a part in it
    inside = jnp.sum(co.selection.Q**2, 0).reshape(-1, 6)
    return structure.connected & jnp.any(inside < 1 - rank_tolerance(inside.dtype), 1)
