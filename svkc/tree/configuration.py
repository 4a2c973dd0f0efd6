"""The configuration manifold: retraction, difference, derivative, unit quaternions.

`Topology.quaternion_starts` says which entries of q are quaternions and which of v turn them.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc._jax.select import where
from svkc._jax.static_gather import static_take
from svkc.model.annotations import Numbers
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
    """Return qdot for the velocities v.

    A quaternion has the derivative q w / 2, with w in body axes; every other coordinate's is v.
    """
    quat_q, quat_v = chain.topology.quaternion_starts
    scalar_q, scalar_v = chain.topology.scalar_coordinates
    quat_dot = quat_derivative(
        static_take(q, quat_q[:, None] + np.arange(4)),
        static_take(v, quat_v[:, None] + np.arange(3)),
    )
    order = np.argsort(np.concatenate([scalar_q, (quat_q[:, None] + np.arange(4)).ravel()]))
    return static_take(jnp.concatenate([static_take(v, scalar_v), quat_dot.ravel()]), order)


def velocities_from_derivative(
    chain: Chain, q: Float[Array, " q"], qdot: Float[Array, " q"]
) -> Float[Array, " dofs"]:
    """Return the v at which `configuration_derivative` is qdot, up to quaternions' lengths.

    A quaternion's w is the vector part of 2 q* qdot / |q|^2, and zero where the quaternion is zero.
    """
    quat_q, quat_v = chain.topology.quaternion_starts
    scalar_q, scalar_v = chain.topology.scalar_coordinates
    at = quat_q[:, None] + np.arange(4)
    quat = static_take(q, at)
    square = jnp.sum(quat * quat, -1, keepdims=True)
    inverse = 2 * quat_conjugate(quat) / where(square == 0, 1, square)
    w = quat_multiply(inverse, static_take(qdot, at))[..., 1:]
    order = np.argsort(np.concatenate([scalar_v, (quat_v[:, None] + np.arange(3)).ravel()]))
    return static_take(jnp.concatenate([static_take(qdot, scalar_q), w.ravel()]), order)


@checked_jit
def integrate(chain: Chain, q: Float[Array, " q"], dv: Float[Array, " dofs"]) -> Float[Array, " q"]:
    """Return the configuration q moved by the tangent vector dv, by the exponential map.

    Rotations follow Rodrigues' formula (paper (39)); quaternions of q are normalized first.

    q: configuration (m, rad, unit quaternions wxyz) over every coordinate, as `State.q`.
    dv: displacement in the coordinates of v (m, rad; body axes for rotations).
    """
    quat_q, quat_v = chain.topology.quaternion_starts
    scalar_q, scalar_v = chain.topology.scalar_coordinates
    at = quat_q[:, None] + np.arange(4)
    moved = quat_multiply(
        quat_normalize(static_take(q, at)),
        quat_exp(static_take(dv, quat_v[:, None] + np.arange(3))),
    )
    order = np.argsort(np.concatenate([scalar_q, at.ravel()]))
    return static_take(
        jnp.concatenate([static_take(q, scalar_q) + static_take(dv, scalar_v), moved.ravel()]),
        order,
    )


@checked_jit
def difference(
    chain: Chain, q1: Float[Array, " q"], q2: Float[Array, " q"]
) -> Float[Array, " dofs"]:
    """Return the tangent vector from q1 to q2 (m, rad; body axes for rotations).

    It is the inverse of `integrate`: integrate(chain, q1, difference(chain, q1, q2)) = q2, up to
    the signs of quaternions.

    q1: configuration at which the tangent vector starts.
    q2: configuration at which the tangent vector ends.
    """
    quat_q, quat_v = chain.topology.quaternion_starts
    scalar_q, scalar_v = chain.topology.scalar_coordinates
    at = quat_q[:, None] + np.arange(4)
    rotation_vector = quat_log(
        quat_multiply(
            quat_conjugate(quat_normalize(static_take(q1, at))), quat_normalize(static_take(q2, at))
        )
    )
    order = np.argsort(np.concatenate([scalar_v, (quat_v[:, None] + np.arange(3)).ravel()]))
    return static_take(
        jnp.concatenate(
            [static_take(q2, scalar_q) - static_take(q1, scalar_q), rotation_vector.ravel()]
        ),
        order,
    )


def normalize(chain: Chain, q: Float[Array, " q"]) -> Float[Array, " q"]:
    """Return q with every quaternion normalized."""
    quat_q, _ = chain.topology.quaternion_starts
    if not len(quat_q):
        return q
    at = quat_q[:, None] + np.arange(4)
    return replace_rows(q, at.ravel(), quat_normalize(static_take(q, at)).ravel())


def tangent_gradient(chain: Chain, q: Numbers, gradient: Numbers) -> Float[Array, " dofs"]:
    """Return a gradient with respect to q as one with respect to tangent vectors (per m, per rad).

    The result is the gradient of f(integrate(chain, q, dv)) with respect to dv at dv = 0. An
    optimiser that steps along it, q <- integrate(chain, q, -rate * tangent_gradient(chain, q,
    gradient)), keeps quaternions at unit length.

    q: configuration at which the gradient was taken.
    gradient: gradient of f with respect to q, as `jax.grad` gives it.
    Raises ValueError if q or gradient has another length than a state's q.
    """
    check_chain(chain)
    q, gradient = (
        float_vector(chain, name, x, chain.topology.nq_all)
        for name, x in (("q", q), ("gradient", gradient))
    )
    return jax.vjp(lambda dv: integrate(chain, q, dv), jnp.zeros(chain.dofs, q.dtype))[1](gradient)[
        0
    ]


def quaternions_xyzw(chain: Chain, q: Numbers) -> Float[Array, " q"]:
    """Return q with the scalar part of every quaternion last, as in Pinocchio, ROS and scipy.

    q: configuration with quaternions wxyz.
    Raises ValueError if q has another length than a state's q.
    """
    check_chain(chain)
    q = float_vector(chain, "q", q, chain.topology.nq_all)
    starts, _ = chain.topology.quaternion_starts
    if not len(starts):
        return q
    at = starts[:, None] + np.arange(4)
    return q.at[at].set(jnp.roll(q[at], -1, axis=-1))
