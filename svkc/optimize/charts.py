"""Charts: coordinates [nv] in which an interval's motion is a polynomial of time.

Scalar joint coordinates are used as they are. A quaternion is the product of a reference quaternion
and the exponential of a rotation vector, whose three components are the coordinates. Each node has
a chart, with a reference of its own. Collocation then keeps its order of accuracy, and nodes need
no unit-length constraint.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc._jax.static_gather import static_take
from svkc.model.chain import Chain
from svkc.model.topology import BALL, FREE
from svkc.tree.spatial import quat_conjugate, quat_log, quat_multiply, quat_normalize

# number of terms of the series of sine and cosine, and the squared half angle (rad^2) below which
# the series are exact to round-off
_TERMS, _SMALL = 7, 0.1


def quaternion_starts(chain: Chain) -> tuple[np.ndarray, np.ndarray]:
    """Return (first index in q, first index in v) of each quaternion of the tree."""
    top, offset = chain.topology, {BALL: 0, FREE: 3}
    rows = top.rows_of_kind(BALL, FREE)
    q, v = ([start[i] + offset[top.kind[i]] for i in rows] for start in (top.q_start, top.v_start))
    return np.array(q, int), np.array(v, int)


def scalar_coordinates(chain: Chain) -> tuple[np.ndarray, np.ndarray]:
    """Return (index in q, index in v) of each scalar coordinate of the tree."""
    top = chain.topology
    q, v = top.scalar_coordinates
    return q[q < top.nq], v[v < top.nv]


def _exponential(u: Float[Array, "n 3"]) -> Float[Array, "n 4"]:
    """Return the quaternions of rotation vectors (rad), with exact derivatives of every order."""
    square = jnp.sum(u * u, -1, keepdims=True) / 4
    small = square < _SMALL
    half = jnp.sqrt(jnp.where(small, 1, square))
    near = jnp.where(small, square, 0)
    c, s, term = jnp.zeros_like(near), jnp.zeros_like(near), jnp.ones_like(near)
    for k in range(_TERMS):
        c, s = c + term, s + term / (2 * k + 1)
        term = -term * near / ((2 * k + 1) * (2 * k + 2))
    c, s = jnp.where(small, c, jnp.cos(half)), jnp.where(small, s, jnp.sin(half) / half)
    return jnp.concatenate([c, s * u / 2], -1)


def _rotation_rate(
    u: Float[Array, "n 3"], rate: Float[Array, "n 3"]
) -> tuple[Float[Array, "n 4"], Float[Array, "n 3"]]:
    """Return quaternions and angular velocities (rad/s, body axes) from rotation vectors.

    u: rotation vectors (rad). rate: their derivatives by time.
    """
    quat, derivative = jax.jvp(_exponential, (u,), (rate,))
    return quat, 2 * quat_multiply(quat_conjugate(quat), derivative)[..., 1:]


def _ordered(scalars, others, at_scalars: np.ndarray, at_others: np.ndarray) -> Array:
    """Return the vector that has `scalars` at `at_scalars`, and `others` at `at_others`."""
    order = np.argsort(np.concatenate([at_scalars, at_others.ravel()]))
    return static_take(jnp.concatenate([scalars, others.ravel()]), order)


def motion_from_chart(
    chain: Chain,
    reference: Float[Array, " nq"],
    x: Float[Array, " nv"],
    rate: Float[Array, " nv"],
    second: Float[Array, " nv"],
) -> tuple[Float[Array, " nq"], Float[Array, " nv"], Float[Array, " nv"]]:
    """Return q, v and vdot of the tree from chart coordinates and their derivatives by time.

    reference: configuration at the chart's origin; only its quaternions are used.
    x, rate, second: chart coordinates, their first and their second derivatives by time.
    """
    at_q, at_v = quaternion_starts(chain)
    if not len(at_q):
        return x, rate, second
    scalar_q, scalar_v = scalar_coordinates(chain)
    turns_v, turns_q = at_v[:, None] + np.arange(3), at_q[:, None] + np.arange(4)
    u, du, ddu = (static_take(y, turns_v) for y in (x, rate, second))
    (quat, w), (_, wdot) = jax.jvp(_rotation_rate, (u, du), (du, ddu))
    quat = quat_multiply(quat_normalize(static_take(reference, turns_q)), quat)
    q = _ordered(static_take(x, scalar_v), quat, scalar_q, turns_q)
    v, vdot = (
        _ordered(static_take(y, scalar_v), turns, scalar_v, turns_v)
        for y, turns in ((rate, w), (second, wdot))
    )
    return q, v, vdot


def _solve_3(A: Float[Array, "n 3 3"], b: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Return A^-1 b by Cramer's rule."""
    x, y, z = (A[..., i] for i in range(3))
    rows = jnp.stack([jnp.cross(y, z), jnp.cross(z, x), jnp.cross(x, y)], -2)
    return jnp.sum(rows * b[:, None], -1) / jnp.sum(rows[:, 0] * x, -1, keepdims=True)


def chart_from_motion(
    chain: Chain,
    reference: Float[Array, " nq"],
    q: Float[Array, " nq"],
    v: Float[Array, " nv"],
) -> tuple[Float[Array, " nv"], Float[Array, " nv"]]:
    """Return the coordinates in a chart, and their rates, from q and v of the tree.

    reference: as of `motion_from_chart`.
    """
    at_q, at_v = quaternion_starts(chain)
    if not len(at_q):
        return q, v
    scalar_q, scalar_v = scalar_coordinates(chain)
    turns_v, turns_q = at_v[:, None] + np.arange(3), at_q[:, None] + np.arange(4)
    w = static_take(v, turns_v)
    from_reference = quat_multiply(
        quat_conjugate(quat_normalize(static_take(reference, turns_q))),
        quat_normalize(static_take(q, turns_q)),
    )
    u = quat_log(from_reference)
    matrix = jax.vmap(jax.jacfwd(lambda du, u: _rotation_rate(u[None], du[None])[1][0]))(w, u)
    du = _solve_3(matrix, w)
    x, rate = (
        _ordered(static_take(y, at), turns, scalar_v, turns_v)
        for y, at, turns in ((q, scalar_q, u), (v, scalar_v, du))
    )
    return x, rate


def to_next_chart(
    chain: Chain,
    reference: Float[Array, " nq"],
    next_reference: Float[Array, " nq"],
    x: Float[Array, " nv"],
    rate: Float[Array, " nv"],
) -> tuple[Float[Array, " nv"], Float[Array, " nv"]]:
    """Return chart coordinates and rates, converted to the chart about another reference."""
    if not len(quaternion_starts(chain)[0]):
        return x, rate
    q, v, _ = motion_from_chart(chain, reference, x, rate, jnp.zeros_like(x))
    return chart_from_motion(chain, next_reference, q, v)
