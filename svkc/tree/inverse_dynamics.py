"""Recursive Newton-Euler on the tree (Featherstone chapter 5), and the forces of springs, dampers
and joint limits."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from svkc._jax.static_gather import static_take
from svkc.model.chain import Chain, State
from svkc.model.checked_jit import checked_jit
from svkc.tree.configuration import difference
from svkc.tree.kinematics import Kinematics, kinematics, twists, velocity_products
from svkc.tree.spatial import angular_linear, cross, matvec
from svkc.tree.traversal import (
    accumulate_from_root,
    accumulate_to_root,
    replace_rows,
    sum_dofs_per_row,
)


def newton_euler(
    chain: Chain, kin: Kinematics, V: Float[Array, "rows 6"] | None, A: Float[Array, "rows 6"]
) -> Float[Array, " nv"]:
    """Joint forces S^T F that give every row the spatial acceleration A at the twist V (None: at
    rest); Featherstone section 5.3.

    Each body's force is taken at its centre of mass, where gyroscopic terms need no parallel axes,
    and moved to the root's origin.
    """
    c = kin.r + matvec(kin.R, chain.com)
    alpha, acceleration = angular_linear(A)
    acceleration = acceleration + cross(alpha, c)
    R = kin.R

    def spin(w):
        return matvec(R, matvec(chain.rotational, matvec(jnp.swapaxes(R, -1, -2), w)))

    moment = spin(alpha)
    if V is not None:
        w, u = angular_linear(V)
        acceleration = acceleration + cross(w, u + cross(w, c))
        moment = moment + cross(w, spin(w))
    force = chain.mass[:, None] * acceleration
    F = accumulate_to_root(chain.topology, jnp.concatenate([moment + cross(c, force), force], -1))
    return jnp.sum(kin.S * static_take(F, chain.topology.dof_row), -1)


def rnea(chain: Chain, kin: Kinematics, V, v, vdot: Float[Array, " nv"]) -> Float[Array, " nv"]:
    """ID(q, v, vdot) of the tree with gravity and armature (paper, section III-A, step 2)."""
    A = accumulate_from_root(
        chain.topology,
        sum_dofs_per_row(chain.topology, kin.S * vdot[:, None])
        + velocity_products(chain, kin, V, v),
    )
    A = A - jnp.concatenate([jnp.zeros_like(chain.gravity), chain.gravity])[None]
    tau = newton_euler(chain, kin, V, A)
    return tau if chain.armature is None else tau + chain.armature * vdot


def mass_matrix_product(
    chain: Chain, kin: Kinematics, x: Float[Array, " nv"]
) -> Float[Array, " nv"]:
    """M x: ID(q, 0, x) without gravity."""
    A = accumulate_from_root(chain.topology, sum_dofs_per_row(chain.topology, kin.S * x[:, None]))
    tau = newton_euler(chain, kin, None, A)
    return tau if chain.armature is None else tau + chain.armature * x


def append_virtual_joints(chain: Chain, force: Float[Array, " nv"]) -> Float[Array, " dofs"]:
    """Return forces of the tree's joints, then a zero for each coordinate of virtual joints, which
    have no inertia."""
    return jnp.concatenate([force, jnp.zeros(chain.dofs - chain.nv, force.dtype)])


def passive_forces(
    chain: Chain, q: Float[Array, " q"], v: Float[Array, " dofs"]
) -> Float[Array, " dofs"]:
    """Springs and dampers of the model's joints (N m, N), MuJoCo's meaning: -stiffness (q -
    q_spring) - damping v."""
    tau = jnp.zeros_like(v)
    if chain.damping is not None:
        tau = tau - chain.damping * v
    if chain.stiffness is not None:
        # the stretch of a ball is a rotation vector in body axes
        tau = tau - chain.stiffness * difference(chain, chain.q_spring, q)
    return tau


def limit_forces(
    chain: Chain, q: Float[Array, " q"], v: Float[Array, " dofs"]
) -> Float[Array, " dofs"]:
    """The torque that keeps joints inside their range (paper, section VII-B): a stiff spring and
    damper that act outside of it only.

    With x the distance outside and a = 0.02 rad or m: -(k x + c v) exp(-a / x); zero inside. All
    derivatives are continuous where it sets in: a kink there would cost adaptive steps of high
    order more than the motion itself.
    """
    tau = jnp.zeros_like(v)
    if chain.limit is None:
        return tau
    k, c = chain.limit_spring
    at_q, at_v = chain.topology.scalar_coordinates
    lower, upper = chain.limit[:, at_v]
    x = static_take(q, at_q)
    out = jnp.maximum(x - upper, 0) - jnp.maximum(lower - x, 0)
    onset = jnp.where(out != 0, jnp.exp(-0.02 / jnp.where(out != 0, jnp.abs(out), 1)), 0)
    return replace_rows(tau, at_v, -(k[at_v] * out + c[at_v] * static_take(v, at_v)) * onset)


@checked_jit
def bias_force(chain: Chain, state: State) -> Float[Array, " nv"]:
    """Velocity-product and gravity forces (N, N m) of the tree: ID(q, v, 0) (MuJoCo's qfrc_bias;
    Featherstone section 6.1)."""
    kin = kinematics(chain, state.q)
    V = twists(chain, kin, state.v)
    return rnea(chain, kin, V, state.v, jnp.zeros(chain.nv, state.v.dtype))


@checked_jit
def inverse_dynamics(
    chain: Chain, state: State, vdot: Float[Array, " accelerations"]
) -> Float[Array, " nv"]:
    """Torques (N m, N) the tree's joints must be given for vdot (over the tree, or over every
    coordinate): recursive Newton-Euler.

    What springs and dampers of the joints give by themselves is taken off, so that this is the
    inverse of `forward_dynamics` on a tree.
    """
    if vdot.shape not in ((chain.nv,), (chain.dofs,)):
        raise ValueError(
            f"vdot: got shape {vdot.shape}, expected {chain.nv} (the tree's) or {chain.dofs} (all)"
        )
    kin = kinematics(chain, state.q)
    V = twists(chain, kin, state.v)
    tau = rnea(chain, kin, V, state.v, vdot[: chain.nv])
    return tau - passive_forces(chain, state.q, state.v)[: chain.nv]
