"""F4: the acceleration of any structure (paper, section III-B) and the forces its loops carry."""

import functools

import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Array, Float

from svkc.chain import Chain, State, Structure
from svkc.closure import Coordinates, constrain, scales, square
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
    return W.T @ (M @ W) + jnp.diag(jnp.where(co.independent, 0, 1).astype(M.dtype))


@functools.partial(jax.jit, static_argnames="inertia")
def acceleration(chain: Chain, structure: Structure, q, v, tau: Float[Array, " dofs"], inertia=inertia_by_composites, baumgarte=None) -> Float[Array, " dofs"]:
    """Steps 1 to 5 of section III-B. On an open chain W is the identity and nothing of the closure is computed.

    baumgarte: rate (1/s) at which open loops are pulled back; None: not at all.
    """
    nv = chain.nv
    kin = kinematics(chain, q)
    V = twists(chain, kin, v)
    applied = tau[:nv] + passive_forces(chain, q, v)
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
    tau_G = W.T @ jnp.concatenate([applied, tau[nv:]])
    b = W[:nv].T @ generalized_forces(chain, kin, V, v, co.bias[:nv])
    A = reduced_inertia(chain, co, inertia(chain, kin))
    vdot_G = cho_solve(cho_factor(A), tau_G - b)
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


@jax.jit
def loop_forces(chain: Chain, state: State, tau: Float[Array, " torques"]) -> tuple[Float[Array, "links 3"], Float[Array, "links 3"]]:
    """Force (N) and torque (N m) that each connected virtual link carries: on `real` from `parent`, at the joint, in world axes.

    Of all that explain the motion the least in norm, where loops are redundant.
    """
    tau = joint_torques(chain, tau)
    q, v, nv = state.q, state.v, chain.nv
    kin = kinematics(chain, q)
    V = twists(chain, kin, v)
    vdot = acceleration(chain, state.structure, q, v, tau)
    needed = generalized_forces(chain, kin, V, v, vdot[:nv]) - passive_forces(chain, q, v)
    co = constrain(chain, state.structure, q, v, kin, V)
    excess = jnp.concatenate([needed, jnp.zeros(chain.dofs - nv, q.dtype)]) - tau
    wrench = -constraint_forces(chain, co, excess)
    return wrench[:, 3:], wrench[:, :3]
