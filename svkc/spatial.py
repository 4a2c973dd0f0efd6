"""F0: rotations, quaternions and 6-vectors, written once and broadcast over leading axes.

Quaternions are wxyz and turn body vectors into world vectors. 6-vectors are angular first (Featherstone, Rigid Body Dynamics
Algorithms, 2008, section 2).
"""

import jax.numpy as jnp
from jaxtyping import Array, Float


def halves(x: Float[Array, "*n 6"]) -> tuple[Float[Array, "*n 3"], Float[Array, "*n 3"]]:
    """The angular and the linear part of a 6-vector."""
    # a split, whose transpose is one concatenation; that of two slices would be two paddings and a sum
    angular, linear = jnp.split(x, 2, -1)
    return angular, linear


def cross(a: Float[Array, "*#n 3"], b: Float[Array, "*#n 3"]) -> Float[Array, "*n 3"]:
    """Vector product a x b."""
    (a0, a1, a2), (b0, b1, b2) = jnp.unstack(a, axis=-1), jnp.unstack(b, axis=-1)
    return jnp.stack([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0], -1)


def rotate(R: Float[Array, "*#n 3 3"], x: Float[Array, "*#n 3"]) -> Float[Array, "*n 3"]:
    """R x, as a product and a sum, which fuse where a small `dot` would not."""
    return jnp.sum(R * x[..., None, :], -1)


def motion_cross(a: Float[Array, "*#n 6"], b: Float[Array, "*#n 6"]) -> Float[Array, "*n 6"]:
    """A x b of two motion vectors (Featherstone 2.9, eq. 2.31)."""
    (w, v), (m, n) = halves(a), halves(b)
    return jnp.concatenate([cross(w, m), cross(v, m) + cross(w, n)], -1)


def shift_motion(S: Float[Array, "*#n 6"], r: Float[Array, "*#n 3"]) -> Float[Array, "*n 6"]:
    """The motion vector S given about the origin, given about the point r instead (Featherstone 2.8)."""
    w, v = halves(S)
    return jnp.concatenate([jnp.broadcast_to(w, jnp.broadcast_shapes(w.shape, r.shape)), v + cross(w, r)], -1)


def quat_multiply(a: Float[Array, "*#n 4"], b: Float[Array, "*#n 4"]) -> Float[Array, "*n 4"]:
    """Hamilton product."""
    (aw, ax, ay, az), (bw, bx, by, bz) = jnp.unstack(a, axis=-1), jnp.unstack(b, axis=-1)
    return jnp.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        -1,
    )


def quat_conjugate(q: Float[Array, "*n 4"]) -> Float[Array, "*n 4"]:
    """The inverse rotation of a unit quaternion."""
    w, u = jnp.split(q, [1], -1)
    return jnp.concatenate([w, -u], -1)


def quat_normalize(q: Float[Array, "*n 4"]) -> Float[Array, "*n 4"]:
    """q/|q|; the identity where q is zero."""
    square = jnp.sum(q * q, -1, keepdims=True)
    zero = square == 0
    identity = jnp.zeros_like(q).at[..., 0].set(1)
    return jnp.where(zero, identity, q / jnp.sqrt(jnp.where(zero, 1, square)))


def quat_matrix(q: Float[Array, "*n 4"]) -> Float[Array, "*n 3 3"]:
    """Rotation matrix of a unit quaternion, body to world."""
    w, x, y, z = jnp.unstack(q, axis=-1)
    entries = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return jnp.stack(entries, -1).reshape(*q.shape[:-1], 3, 3)


def quat_rotate(q: Float[Array, "*#n 4"], x: Float[Array, "*#n 3"]) -> Float[Array, "*n 3"]:
    """The vector x turned by the unit quaternion q."""
    w, u = jnp.split(q, [1], -1)
    t = 2 * cross(u, x)
    return x + w * t + cross(u, t)


def quat_about(axis: Float[Array, "*#n 3"], angle: Float[Array, "*#n"]) -> Float[Array, "*n 4"]:
    """The rotation by `angle` (rad) about a unit axis."""
    half = angle[..., None] / 2
    s = jnp.sin(half) * axis
    return jnp.concatenate([jnp.broadcast_to(jnp.cos(half), (*s.shape[:-1], 1)), s], -1)


def quat_exp(u: Float[Array, "*n 3"]) -> Float[Array, "*n 4"]:
    """The rotation vector u (rad) as a quaternion: Rodrigues' formula (paper (39)-(44)), smooth at u = 0."""
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
    factor = jnp.where(small, 2 / jnp.where(small, w, 1) * (1 - square / (3 * jnp.where(small, w * w, 1))), 2 * jnp.arctan2(s, w) / s)
    return factor * q[..., 1:]


def quat_rate(q: Float[Array, "*#n 4"], w: Float[Array, "*#n 3"]) -> Float[Array, "*n 4"]:
    """Qdot = q (0, w) / 2 with the angular velocity w (rad/s) in body coordinates."""
    return quat_multiply(q, jnp.concatenate([jnp.zeros_like(w[..., :1]), w], -1)) / 2
