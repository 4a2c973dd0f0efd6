"""Rotations, quaternions and 6-vectors, written once and broadcast over leading axes.

Quaternions are wxyz and turn body vectors into world vectors. 6-vectors are angular first
(Featherstone, Rigid Body Dynamics
Algorithms, 2008, section 2).
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

# Products as sums over a table, out_k = table[i, k, j] a_i b_j: a few operations on whole arrays,
# where entry by entry would be dozens, and everything
# that is compiled is made of these products (a run of the four-bar and its gradient: a fifth fewer
# operations).
SKEW = np.zeros((3, 3, 3))
HAMILTON = np.zeros((4, 4, 4))
for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    SKEW[i, k, j], SKEW[j, k, i] = 1, -1
HAMILTON[1:, 1:, 1:] = SKEW
for i in range(4):
    HAMILTON[0, i, i], HAMILTON[i, i, 0], HAMILTON[i, 0, i] = 1, 1, -1 if i else 1
# of q* in x -> x q*
CONJUGATE = np.array([1.0, -1, -1, -1])
RIGHT_CONJUGATE = CONJUGATE[:, None, None] * HAMILTON.transpose(2, 1, 0)


def _table_like(a: Float[Array, "*n i"], table: np.ndarray) -> np.ndarray:
    """The table with a's precision, and an axis of one for each that a has before its last."""
    return table.astype(a.dtype)[(None,) * (a.ndim - 1)]


def _left_product_matrix(table: np.ndarray, a: Float[Array, "*n i"]) -> Float[Array, "*n k j"]:
    """The matrix of b -> out."""
    return jnp.sum(a[..., None, None] * _table_like(a, table), -3)


def angular_linear(x: Float[Array, "*n 6"]) -> tuple[Float[Array, "*n 3"], Float[Array, "*n 3"]]:
    """The angular and the linear part of a 6-vector."""
    # a split, whose transpose is one concatenation; that of two slices would be two paddings and a
    # sum
    angular, linear = jnp.split(x, 2, -1)
    return angular, linear


def cross(a: Float[Array, "*#n 3"], b: Float[Array, "*#n 3"]) -> Float[Array, "*n 3"]:
    """Vector product a x b."""
    return matvec(_left_product_matrix(SKEW, a), b)


def matvec(R: Float[Array, "*#n i k"], x: Float[Array, "*#n k"]) -> Float[Array, "*n i"]:
    """R x (of vectors, quaternions, ...), as a product and a sum, which fuse where a small `dot`
    would not."""
    return jnp.sum(R * x[..., None, :], -1)


def skew(a: Float[Array, "*n 3"]) -> Float[Array, "*n 3 3"]:
    """The matrix of b -> a x b."""
    return _left_product_matrix(SKEW, a)


def inverse_positive(D: Float[Array, "*n k k"]) -> Float[Array, "*n k k"]:
    """The inverses of small symmetric positive matrices by their halves, without a call of LAPACK
    for each."""
    if D.shape[-1] == 1:
        return 1 / D
    if D.shape[-1] == 3:
        a, b, c = D[..., 0, :], D[..., 1, :], D[..., 2, :]
        adjugate = cross(jnp.stack([b, c, a], -2), jnp.stack([c, a, b], -2))
        return adjugate / jnp.sum(a * adjugate[..., 0, :], -1)[..., None, None]
    times = lambda x, y: jnp.sum(x[..., None] * y[..., None, :, :], -2)
    n = D.shape[-1] // 2
    A, B, C = D[..., :n, :n], D[..., :n, n:], D[..., n:, n:]
    of_lower = inverse_positive(C)
    part = times(B, of_lower)
    turned = jnp.swapaxes(part, -1, -2)
    upper = inverse_positive(A - times(part, jnp.swapaxes(B, -1, -2)))
    right = -times(upper, part)
    lower = of_lower - times(turned, right)
    return jnp.concatenate(
        [
            jnp.concatenate([upper, right], -1),
            jnp.concatenate([jnp.swapaxes(right, -1, -2), lower], -1),
        ],
        -2,
    )


def motion_cross(a: Float[Array, "*#n 6"], b: Float[Array, "*#n 6"]) -> Float[Array, "*n 6"]:
    """A x b of two motion vectors (Featherstone 2.9, eq. 2.31)."""
    (w, v), (m, n) = angular_linear(a), angular_linear(b)
    by_w, by_v = _left_product_matrix(SKEW, w), _left_product_matrix(SKEW, v)
    return jnp.concatenate([matvec(by_w, m), matvec(by_v, m) + matvec(by_w, n)], -1)


def shift_motion(S: Float[Array, "*#n 6"], r: Float[Array, "*#n 3"]) -> Float[Array, "*n 6"]:
    """The motion vector S given about the origin, given about the point r instead (Featherstone
    2.8)."""
    w, v = angular_linear(S)
    return jnp.concatenate(
        [jnp.broadcast_to(w, jnp.broadcast_shapes(w.shape, r.shape)), v + cross(w, r)], -1
    )


def quat_multiply(a: Float[Array, "*#n 4"], b: Float[Array, "*#n 4"]) -> Float[Array, "*n 4"]:
    """Hamilton product."""
    return matvec(_left_product_matrix(HAMILTON, a), b)


def quat_conjugate(q: Float[Array, "*n 4"]) -> Float[Array, "*n 4"]:
    """The inverse rotation of a unit quaternion."""
    return q * _table_like(q, CONJUGATE)


def quat_normalize(q: Float[Array, "*n 4"]) -> Float[Array, "*n 4"]:
    """q/|q|; the identity where q is zero."""
    square = jnp.sum(q * q, -1, keepdims=True)
    zero = square == 0
    return jnp.where(zero, _table_like(q, np.eye(4)[0]), q / jnp.sqrt(jnp.where(zero, 1, square)))


def quat_matrix(q: Float[Array, "*n 4"]) -> Float[Array, "*n 3 3"]:
    """Rotation matrix of a unit quaternion, body to world: the vectors' part of x -> q x q*."""
    left, right = _left_product_matrix(HAMILTON, q), _left_product_matrix(RIGHT_CONJUGATE, q)
    return jnp.sum(left[..., 1:, :, None] * right[..., None, :, 1:], -2)


def quat_rotate(q: Float[Array, "*#n 4"], x: Float[Array, "*#n 3"]) -> Float[Array, "*n 3"]:
    """The vector x turned by the unit quaternion q."""
    return matvec(quat_matrix(q), x)


def quat_from_axis_angle(
    axis: Float[Array, "*#n 3"], angle: Float[Array, "*#n"]
) -> Float[Array, "*n 4"]:
    """The rotation by `angle` (rad) about a unit axis."""
    half = angle[..., None] / 2
    s = jnp.sin(half) * axis
    return jnp.concatenate([jnp.broadcast_to(jnp.cos(half), (*s.shape[:-1], 1)), s], -1)


def quat_exp(u: Float[Array, "*n 3"]) -> Float[Array, "*n 4"]:
    """The rotation vector u (rad) as a quaternion: Rodrigues' formula (paper (39)-(44)), smooth at
    u = 0."""
    square = jnp.sum(u * u, -1, keepdims=True)
    small = square < 1e-8
    angle = jnp.sqrt(jnp.where(small, 1, square))
    # Taylor's next terms are below round-off where `small`
    c = jnp.where(small, 1 - square / 8, jnp.cos(angle / 2))
    s = jnp.where(small, 0.5 - square / 48, jnp.sin(angle / 2) / angle)
    return jnp.concatenate([c, s * u], -1)


def quat_log(q: Float[Array, "*n 4"]) -> Float[Array, "*n 3"]:
    """The rotation vector (rad, at most pi) of a unit quaternion, smooth at the identity."""
    q = jnp.where(q[..., :1] < 0, -q, q)
    square = jnp.sum(q[..., 1:] ** 2, -1, keepdims=True)
    small = square < 1e-8
    s = jnp.sqrt(jnp.where(small, 1, square))
    w = q[..., :1]
    # atan(x) / x at x = s / w, to second order; w is 1 - square / 2 there
    factor = jnp.where(
        small,
        2 / jnp.where(small, w, 1) * (1 - square / (3 * jnp.where(small, w * w, 1))),
        2 * jnp.arctan2(s, w) / s,
    )
    return factor * q[..., 1:]


def quat_derivative(q: Float[Array, "*#n 4"], w: Float[Array, "*#n 3"]) -> Float[Array, "*n 4"]:
    """Qdot = q (0, w) / 2 with the angular velocity w (rad/s) in body coordinates."""
    return quat_multiply(q, jnp.concatenate([jnp.zeros_like(w[..., :1]), w], -1)) / 2
