"""The configuration manifold: retraction, difference, derivative, unit quaternions."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc._jax.static_gather import static_take
from svkc.model.chain import Chain
from svkc.model.checked_jit import check_chain, checked_jit, float_vector
from svkc.tree.spatial import (
    quat_conjugate,
    quat_derivative,
    quat_exp,
    quat_log,
    quat_multiply,
    quat_normalize,
)
from svkc.tree.traversal import replace_rows


def configuration_derivative(
    chain: Chain, q: Float[Array, " q"], v: Float[Array, " dofs"]
) -> Float[Array, " q"]:
    """Qdot for the velocities v: quaternions turn by qdot = q w / 2, everything else is its own
    rate."""
    quat_q, quat_v = chain.topology.quaternion_starts
    scalar_q, scalar_v = chain.topology.scalar_coordinates
    turn = quat_derivative(
        static_take(q, quat_q[:, None] + np.arange(4)),
        static_take(v, quat_v[:, None] + np.arange(3)),
    )
    order = np.argsort(np.concatenate([scalar_q, (quat_q[:, None] + np.arange(4)).ravel()]))
    return static_take(jnp.concatenate([static_take(v, scalar_v), turn.ravel()]), order)


@checked_jit
def integrate(chain: Chain, q: Float[Array, " q"], dv: Float[Array, " dofs"]) -> Float[Array, " q"]:
    """Q moved by the tangent vector dv (m, rad; body axes for rotations): the exponential map,
    Rodrigues' formula (39)."""
    quat_q, quat_v = chain.topology.quaternion_starts
    scalar_q, scalar_v = chain.topology.scalar_coordinates
    at = quat_q[:, None] + np.arange(4)
    turned = quat_multiply(
        quat_normalize(static_take(q, at)),
        quat_exp(static_take(dv, quat_v[:, None] + np.arange(3))),
    )
    order = np.argsort(np.concatenate([scalar_q, at.ravel()]))
    return static_take(
        jnp.concatenate([static_take(q, scalar_q) + static_take(dv, scalar_v), turned.ravel()]),
        order,
    )


@checked_jit
def difference(
    chain: Chain, q1: Float[Array, " q"], q2: Float[Array, " q"]
) -> Float[Array, " dofs"]:
    """The tangent vector (m, rad, in the coordinates of v) that takes q1 to q2: integrate(q1,
    difference(q1, q2)) = q2."""
    quat_q, quat_v = chain.topology.quaternion_starts
    scalar_q, scalar_v = chain.topology.scalar_coordinates
    at = quat_q[:, None] + np.arange(4)
    turn = quat_log(
        quat_multiply(
            quat_conjugate(quat_normalize(static_take(q1, at))), quat_normalize(static_take(q2, at))
        )
    )
    order = np.argsort(np.concatenate([scalar_v, (quat_v[:, None] + np.arange(3)).ravel()]))
    return static_take(
        jnp.concatenate([static_take(q2, scalar_q) - static_take(q1, scalar_q), turn.ravel()]),
        order,
    )


def normalize(chain: Chain, q: Float[Array, " q"]) -> Float[Array, " q"]:
    """Q with every quaternion of unit length."""
    quat_q, _ = chain.topology.quaternion_starts
    if not len(quat_q):
        return q
    at = quat_q[:, None] + np.arange(4)
    return replace_rows(q, at.ravel(), quat_normalize(static_take(q, at)).ravel())


def tangent_gradient(chain: Chain, q, gradient) -> Float[Array, " dofs"]:
    """A gradient by q as one in the tangent of the configuration (per m, rad): of
    f(integrate(chain, q, dv)) by dv at dv = 0.

    What an optimiser should step along: q <- integrate(chain, q, -rate * tangent(chain, q,
    gradient)) keeps quaternions at unit length.
    """
    check_chain(chain)
    q, gradient = (
        float_vector(chain, name, x, chain.topology.nq_all)
        for name, x in (("q", q), ("gradient", gradient))
    )
    return jax.vjp(lambda dv: integrate(chain, q, dv), jnp.zeros(chain.dofs, q.dtype))[1](gradient)[
        0
    ]


def quaternions_xyzw(chain: Chain, q) -> Float[Array, " q"]:
    """Q with the scalar of every quaternion last, as Pinocchio, ROS and scipy have it."""
    check_chain(chain)
    q = float_vector(chain, "q", q, chain.topology.nq_all)
    starts, _ = chain.topology.quaternion_starts
    if not len(starts):
        return q
    at = starts[:, None] + np.arange(4)
    return q.at[at].set(jnp.roll(q[at], -1, axis=-1))
