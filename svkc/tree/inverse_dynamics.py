"""Recursive Newton-Euler on the tree (Featherstone chapter 5).

Also the forces of springs, dampers and joint limits, which act on joints as torques do.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from svkc._jax.select import where
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


def generalized_force(
    chain: Chain, kin: Kinematics, wrenches: Float[Array, "rows 6"]
) -> Float[Array, " nv"]:
    """Return the generalized force (N m, N) of wrenches on the rows of the tree.

    wrenches: torque (N m), then force (N), in world axes about the origins of the rows' roots.
    """
    below = accumulate_to_root(chain.topology, wrenches)
    return jnp.sum(kin.S * static_take(below, chain.topology.dof_row), -1)


def newton_euler(
    chain: Chain, kin: Kinematics, V: Float[Array, "rows 6"] | None, A: Float[Array, "rows 6"]
) -> Float[Array, " nv"]:
    """Return the joint forces S^T F for given motions of the rows (Featherstone section 5.3).

    Each body's force is computed at its centre of mass, where gyroscopic terms need no parallel
    axis theorem, and then moved to the root's origin.

    V: twists (None: at rest). A: spatial accelerations.
    """
    c = kin.r + matvec(kin.R, chain.com)
    alpha, acceleration = angular_linear(A)
    acceleration = acceleration + cross(alpha, c)
    to_body = lambda x: matvec(jnp.swapaxes(kin.R, -1, -2), x)
    moment = matvec(chain.symmetric_inertia, to_body(alpha))
    if V is not None:
        w, u = angular_linear(V)
        acceleration = acceleration + cross(w, u + cross(w, c))
        w = to_body(w)
        moment = moment + cross(w, matvec(chain.symmetric_inertia, w))
    force = chain.mass[:, None] * acceleration
    wrenches = jnp.concatenate([matvec(kin.R, moment) + cross(c, force), force], -1)
    return generalized_force(chain, kin, wrenches)


def rnea(
    chain: Chain,
    kin: Kinematics,
    V: Float[Array, "rows 6"],
    v: Float[Array, " _"],
    vdot: Float[Array, " nv"],
) -> Float[Array, " nv"]:
    """Return ID(q, v, vdot) of the tree with gravity and armature (paper, section III-A, step 2).

    V: twists at v.
    """
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
    """Return M x, which is ID(q, 0, x) without gravity."""
    A = accumulate_from_root(chain.topology, sum_dofs_per_row(chain.topology, kin.S * x[:, None]))
    tau = newton_euler(chain, kin, None, A)
    return tau if chain.armature is None else tau + chain.armature * x


def pad_to_dofs(chain: Chain, force: Float[Array, " nv"]) -> Float[Array, " dofs"]:
    """Return the force with a zero appended for each coordinate of a virtual joint."""
    return jnp.concatenate([force, jnp.zeros(chain.dofs - chain.nv, force.dtype)])


def passive_forces(
    chain: Chain, q: Float[Array, " q"], v: Float[Array, " dofs"]
) -> Float[Array, " dofs"]:
    """Return the forces of the joints' springs and dampers (N m, N), as MuJoCo defines them.

    They are -stiffness (q - q_spring) - damping v.
    """
    tau = jnp.zeros_like(v)
    if chain.damping is not None:
        tau = tau - chain.damping * v
    if chain.stiffness is not None:
        # of a ball joint the difference is a rotation vector in body axes
        tau = tau - chain.stiffness * difference(chain, chain.q_spring, q)
    return tau


def limit_forces(
    chain: Chain, q: Float[Array, " q"], v: Float[Array, " dofs"]
) -> Float[Array, " dofs"]:
    """Return the torques of stiff springs and dampers outside the joints' ranges.

    Outside by x, negative below (paper, section VII-B), and with a = 0.02 rad or m, the torque
    is -(k x + c v) exp(-a / |x|); inside it is zero. All its derivatives are continuous at the end
    of the range: a kink would cost adaptive steps of high order more than the motion itself.
    """
    tau = jnp.zeros_like(v)
    if chain.limit is None or chain.limit_spring is None:
        return tau
    k, c = chain.limit_spring
    scalar_q, scalar_v = chain.topology.scalar_coordinates
    lower, upper = chain.limit[:, scalar_v]
    x = static_take(q, scalar_q)
    outside = jnp.maximum(x - upper, 0) - jnp.maximum(lower - x, 0)
    # less than 1e-6 outside of the range the exponential is zero, but its derivative is 0 * inf
    past = jnp.abs(outside) > 1e-6
    onset = where(past, jnp.exp(-0.02 / where(past, jnp.abs(outside), 1)), 0)
    return replace_rows(
        tau, scalar_v, -(k[scalar_v] * outside + c[scalar_v] * static_take(v, scalar_v)) * onset
    )


@checked_jit
def bias_force(chain: Chain, state: State) -> Float[Array, " nv"]:
    """Return ID(q, v, 0), the velocity-product and gravity forces of the tree (N, N m).

    MuJoCo calls it qfrc_bias (Featherstone section 6.1).
    """
    kin = kinematics(chain, state.q)
    V = twists(chain, kin, state.v)
    return rnea(chain, kin, V, state.v, jnp.zeros(chain.nv, state.v.dtype))


@checked_jit
def inverse_dynamics(
    chain: Chain, state: State, vdot: Float[Array, " accelerations"]
) -> Float[Array, " nv"]:
    """Return the joint torques (N m, N) of the tree for the accelerations vdot.

    The forces of the joints' springs and dampers are subtracted. If no virtual link is connected
    and no joint is locked, this is the inverse of `forward_dynamics`. Otherwise the result is tau
    plus the generalized forces of the links and locks. Neither function has the torques of joint
    ranges, which `simulate` and `step` add. Computed by recursive Newton-Euler (Featherstone
    chapter 5).

    vdot: accelerations (rad/s^2, m/s^2) of the tree's coordinates, or of every coordinate.
    Raises ValueError if vdot has neither length.
    """
    if vdot.shape not in ((chain.nv,), (chain.dofs,)):
        raise ValueError(
            f"vdot: got shape {vdot.shape}, expected {chain.nv} (the tree's) or {chain.dofs} (all)"
        )
    kin = kinematics(chain, state.q)
    V = twists(chain, kin, state.v)
    tau = rnea(chain, kin, V, state.v, vdot[: chain.nv])
    return tau - passive_forces(chain, state.q, state.v)[: chain.nv]
