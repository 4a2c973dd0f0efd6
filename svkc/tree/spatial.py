"""Rotations, quaternions and spatial vectors, each function broadcast over leading axes.

Quaternions are wxyz and rotate body vectors into world axes. Spatial vectors have their angular
part first (Featherstone, Rigid Body Dynamics Algorithms, 2008, chapter 2).
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc._jax.select import where
from svkc._jax.stored import stored

# Bilinear products as sums over a table, out_k = table[i, k, j] a_i b_j. These are a few operations
# on arrays instead of dozens on entries; compiled programs of a four-bar's run and of its gradient
# have a fifth fewer operations.
SKEW = np.zeros((3, 3, 3))
HAMILTON = np.zeros((4, 4, 4))
for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    SKEW[i, k, j], SKEW[j, k, i] = 1, -1
HAMILTON[1:, 1:, 1:] = SKEW
for i in range(4):
    HAMILTON[0, i, i], HAMILTON[i, i, 0], HAMILTON[i, 0, i] = 1, 1, -1 if i else 1
CONJUGATE = np.array([1.0, -1, -1, -1])
# the table of x -> x q*
RIGHT_CONJUGATE = CONJUGATE[:, None, None] * HAMILTON.transpose(2, 1, 0)


def _table_like(a: Float[Array, "*n i"], table: np.ndarray) -> np.ndarray:
    """Return the table in a's precision, with an axis of size 1 for each leading axis of a."""
    return table.astype(a.dtype)[(None,) * (a.ndim - 1)]


def _left_product_matrix(table: np.ndarray, a: Float[Array, "*n i"]) -> Float[Array, "*n k j"]:
    """Return the matrix of b -> out for a given a."""
    return jnp.sum(a[..., None, None] * _table_like(a, table), -3)


def angular_linear(x: Float[Array, "*n 6"]) -> tuple[Float[Array, "*n 3"], Float[Array, "*n 3"]]:
    """Return the angular and the linear part of a spatial vector."""
    # The transpose of a split is one concatenation; that of two slices is two paddings and a sum.
    angular, linear = jnp.split(x, 2, -1)
    return angular, linear


def cross(a: Float[Array, "*#n 3"], b: Float[Array, "*#n 3"]) -> Float[Array, "*n 3"]:
    """Return the vector product a x b."""
    return matvec(_left_product_matrix(SKEW, a), b)


def matvec(A: Float[Array, "*#n i k"], x: Float[Array, "*#n k"]) -> Float[Array, "*n i"]:
    """Return the matrix-vector product A x, as a product and a sum.

    XLA's CPU backend fuses these with their neighbours, but not a small `dot`.
    """
    return jnp.sum(A * x[..., None, :], -1)


def skew(a: Float[Array, "*n 3"]) -> Float[Array, "*n 3 3"]:
    """Return the matrix of b -> a x b."""
    return _left_product_matrix(SKEW, a)


def inverse_positive(D: Float[Array, "*n k k"], by_adjugate: bool = True) -> Float[Array, "*n k k"]:
    """Return the inverses of small symmetric positive definite matrices, without LAPACK.

    Matrices are inverted by blocks, with Schur complements.

    by_adjugate: whether blocks of size 3 are inverted by the adjugate, with fewer operations. Where
        two pivots of a block are tiny, its differences of products are round-off.
    """
    if D.shape[-1] == 1:
        return 1 / D
    if D.shape[-1] == 3 and by_adjugate:
        scale = None
        if D.dtype == jnp.float32:
            # the determinant of a matrix above 7e12 overflows, and below 2e-13 it is zero
            scale = (D[..., 0, 0] + D[..., 1, 1] + D[..., 2, 2])[..., None, None]
            D = D / scale
        a, b, c = D[..., 0, :], D[..., 1, :], D[..., 2, :]
        adjugate = cross(jnp.stack([b, c, a], -2), jnp.stack([c, a, b], -2))
        determinant = jnp.sum(a * adjugate[..., 0, :], -1)[..., None, None]
        return adjugate / (determinant if scale is None else determinant * scale)
    matmul = lambda x, y: jnp.sum(x[..., None] * y[..., None, :, :], -2)
    n = D.shape[-1] // 2
    A, B, C = D[..., :n, :n], D[..., :n, n:], D[..., n:, n:]
    C_inverse = inverse_positive(C, by_adjugate)
    BC_inverse = matmul(B, C_inverse)
    BC_inverse_T = jnp.swapaxes(BC_inverse, -1, -2)
    upper = inverse_positive(A - matmul(BC_inverse, jnp.swapaxes(B, -1, -2)), by_adjugate)
    right = -matmul(upper, BC_inverse)
    lower = C_inverse - matmul(BC_inverse_T, right)
    return jnp.concatenate(
        [
            jnp.concatenate([upper, right], -1),
            jnp.concatenate([jnp.swapaxes(right, -1, -2), lower], -1),
        ],
        -2,
    )


def motion_cross(a: Float[Array, "*#n 6"], b: Float[Array, "*#n 6"]) -> Float[Array, "*n 6"]:
    """Return the spatial product a x b of two motion vectors (Featherstone (2.31))."""
    (w, v), (m, n) = angular_linear(a), angular_linear(b)
    by_w, by_v = _left_product_matrix(SKEW, w), _left_product_matrix(SKEW, v)
    return jnp.concatenate([matvec(by_w, m), matvec(by_v, m) + matvec(by_w, n)], -1)


def shift_motion(S: Float[Array, "*#n 6"], r: Float[Array, "*#n 3"]) -> Float[Array, "*n 6"]:
    """Return the motion vector S about the point r. S is given about the origin.

    (Featherstone section 2.8.)
    """
    w, v = angular_linear(S)
    return jnp.concatenate(
        [jnp.broadcast_to(w, jnp.broadcast_shapes(w.shape, r.shape)), v + cross(w, r)], -1
    )


def quat_multiply(a: Float[Array, "*#n 4"], b: Float[Array, "*#n 4"]) -> Float[Array, "*n 4"]:
    """Return the Hamilton product of two quaternions."""
    return matvec(_left_product_matrix(HAMILTON, a), b)


def quat_conjugate(q: Float[Array, "*n 4"]) -> Float[Array, "*n 4"]:
    """Return the conjugate, which is the inverse of a unit quaternion."""
    return q * _table_like(q, CONJUGATE)


def quat_normalize(q: Float[Array, "*n 4"]) -> Float[Array, "*n 4"]:
    """Return q / |q|, and the identity where q is zero."""
    square = jnp.sum(q * q, -1, keepdims=True)
    zero = square == 0
    return where(zero, _table_like(q, np.eye(4)[0]), q / jnp.sqrt(where(zero, 1, square)))


def quat_matrix(q: Float[Array, "*n 4"]) -> Float[Array, "*n 3 3"]:
    """Return the rotation matrix of a unit quaternion, the vector part of x -> q x q*."""
    left, right = _left_product_matrix(HAMILTON, q), _left_product_matrix(RIGHT_CONJUGATE, q)
    return jnp.sum(left[..., 1:, :, None] * right[..., None, :, 1:], -2)


def quat_rotate(q: Float[Array, "*#n 4"], x: Float[Array, "*#n 3"]) -> Float[Array, "*n 3"]:
    """Return the vector x rotated by the unit quaternion q."""
    return matvec(quat_matrix(q), x)


def quat_from_axis_angle(
    axis: Float[Array, "*#n 3"], angle: Float[Array, "*#n"]
) -> Float[Array, "*n 4"]:
    """Return the quaternion of a rotation by `angle` (rad) about a unit axis."""
    half = angle[..., None] / 2
    s = stored(jnp.sin(half)) * axis
    c = stored(jnp.cos(half))
    return jnp.concatenate([jnp.broadcast_to(c, (*s.shape[:-1], 1)), s], -1)


def quat_exp(u: Float[Array, "*n 3"]) -> Float[Array, "*n 4"]:
    """Return the quaternion of the rotation vector u (rad), smooth at u = 0.

    This is Rodrigues' formula (paper (39)-(44)).
    """
    square = jnp.sum(u * u, -1, keepdims=True)
    small = square < 1e-8
    angle = jnp.sqrt(where(small, 1, square))
    # where `small`, the next terms of Taylor's series are below round-off
    c = where(small, 1 - square / 8, stored(jnp.cos(angle / 2)))
    # XLA stores this quotient, too
    s = where(small, 0.5 - square / 48, jnp.sin(angle / 2) / angle)
    return jnp.concatenate([c, s * u], -1)


def quat_log(q: Float[Array, "*n 4"]) -> Float[Array, "*n 3"]:
    """Return the rotation vector (rad, at most pi) of a unit quaternion, smooth at the identity."""
    q = where(q[..., :1] < 0, -q, q)
    square = jnp.sum(q[..., 1:] ** 2, -1, keepdims=True)
    small = square < 1e-8
    s = jnp.sqrt(where(small, 1, square))
    w = q[..., :1]
    # where `small`: 2 atan(x) / s with x = s / w, by atan(x) / x = 1 - x^2 / 3
    factor = where(
        small,
        2 / where(small, w, 1) * (1 - square / (3 * where(small, w * w, 1))),
        2 * jnp.arctan2(s, w) / s,
    )
    return factor * q[..., 1:]


def quat_derivative(q: Float[Array, "*#n 4"], w: Float[Array, "*#n 3"]) -> Float[Array, "*n 4"]:
    """Return qdot = q (0, w) / 2. w: angular velocity (rad/s) in body axes."""
    return quat_multiply(q, jnp.concatenate([jnp.zeros_like(w[..., :1]), w], -1)) / 2
