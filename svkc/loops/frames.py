"""Frames at both ends of every virtual link, and the gaps between them.

Separate from the loop Jacobian, as initial states and guards need frames only.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc._jax.dynamic_gather import take_rows
from svkc._jax.select import where
from svkc._jax.static_gather import static_take
from svkc.model.chain import Chain, Structure
from svkc.model.topology import Topology
from svkc.tree.kinematics import Kinematics
from svkc.tree.spatial import (
    matvec,
    quat_conjugate,
    quat_from_axis_angle,
    quat_log,
    quat_matrix,
    quat_multiply,
    quat_normalize,
    quat_rotate,
)


class LoopFrames(eqx.Module):
    """Frames at both ends of each virtual link, in world axes.

    base_quat: rotation of the joint's frame, fixed in the parent.
    virtual_quat, virtual_position: the virtual link, which the virtual joint moves.
    real_quat, real_position: the frame on the real link that a closed loop makes coincide with it.
    from_parent_root: the virtual link's position from the parent's root. The other positions are
    from the real link's root (m). Twists of the tree are given about these roots.
    axes: of each virtual joint three axes of rotation, then three of translation.
    """

    base_quat: Float[Array, "links 4"]
    virtual_quat: Float[Array, "links 4"]
    virtual_position: Float[Array, "links 3"]
    real_quat: Float[Array, "links 4"]
    real_position: Float[Array, "links 3"]
    from_parent_root: Float[Array, "links 3"]
    axes: Float[Array, "links 6 3"]


def _virtual_joint_coordinates(chain: Chain, q: Float[Array, " q"]):
    """Return angles [links 3], slides [links 3] and quaternions [links 4] of virtual joints."""
    table, end = chain.topology.links, chain.topology.nq_all
    quat = static_take(q, np.minimum(table.quat, end)) + (table.quat > end).astype(q.dtype)
    return static_take(q, table.angle), static_take(q, table.slide), quat_normalize(quat)


def _virtual_joint_rotations(
    top: Topology, angle: Float[Array, "links 3"], ball: Float[Array, "links 4"]
):
    """Return the rotation of each virtual joint and its three axes of rotation.

    Both are in the joint's frame; the rotation is None if no virtual joint of the chain rotates.
    Rotations are in sequence about x, y and z, and each axis is rotated by those before it. A
    ball's axes are those of the virtual link.
    """
    eye = jnp.eye(3, dtype=angle.dtype)
    freedoms = np.array(top.link_freedoms, bool).reshape(-1, 6)[:, :3]
    is_ball = np.all(freedoms, axis=1)
    rotation, axes = None, []
    for k in range(3):
        axis = jnp.broadcast_to(eye[k], (len(is_ball), 3))
        axes.append(axis if rotation is None else quat_rotate(rotation, axis))
        if np.any(freedoms[~is_ball, k]):
            rotation_k = quat_from_axis_angle(eye[k : k + 1], angle[:, k])
            rotation = rotation_k if rotation is None else quat_multiply(rotation, rotation_k)
    axes = jnp.stack(axes, 1)
    if is_ball.any():
        ball_axes = jnp.swapaxes(quat_matrix(ball), -1, -2)
        axes = where(is_ball[:, None, None], ball_axes, axes)
        # of joints that are not balls the quaternion is the identity
        rotation = ball if rotation is None else quat_multiply(ball, rotation)
    return rotation, axes


@jax.jit
def loop_frames(
    chain: Chain, structure: Structure, kin: Kinematics, q: Float[Array, " q"]
) -> LoopFrames:
    """Return the frames at both ends of every virtual link.

    A virtual joint slides along axes fixed in the parent, then rotates: about x, y and z in
    sequence (universal: x and y), or by a quaternion (ball).
    """
    top = chain.topology
    angle, slide, ball = _virtual_joint_coordinates(chain, q)
    p, r = structure.parent, structure.real
    of_bodies = jnp.concatenate([kin.quat, kin.r, kin.root_position], 1)
    both = take_rows(of_bodies, jnp.concatenate([p, r]))
    (of_parent, r_parent, root_parent), (of_real, r_real, root_real) = (
        jnp.split(x, [4, 7], 1) for x in jnp.split(both, 2)
    )
    base_quat = quat_normalize(quat_multiply(of_parent, structure.quat))
    base = quat_matrix(base_quat)
    rotation, rotation_axes = _virtual_joint_rotations(top, angle, ball)
    axes = jnp.sum(base[:, None] * rotation_axes[:, :, None], -1)
    from_parent_root = r_parent + quat_rotate(of_parent, structure.pos)
    if np.any(np.array(top.link_freedoms, bool).reshape(-1, 6)[:, 3:]):
        from_parent_root = from_parent_root + matvec(base, slide)
    return LoopFrames(
        base_quat=base_quat,
        virtual_quat=base_quat if rotation is None else quat_multiply(base_quat, rotation),
        virtual_position=from_parent_root + (root_parent - root_real),
        real_quat=quat_normalize(quat_multiply(of_real, structure.real_quat)),
        real_position=r_real + quat_rotate(of_real, structure.real_pos),
        from_parent_root=from_parent_root,
        axes=jnp.concatenate([axes, jnp.swapaxes(base, -1, -2)], 1),
    )


def frame_gaps(structure: Structure, frames: LoopFrames) -> Float[Array, "links 6"]:
    """Return the rotation vector (rad) and the displacement (m) from real to virtual frame.

    Both are in world axes, and zero for links that are not connected.
    """
    rotation = quat_log(quat_multiply(frames.virtual_quat, quat_conjugate(frames.real_quat)))
    gaps = jnp.concatenate([rotation, frames.virtual_position - frames.real_position], -1)
    return where(structure.connected[:, None], gaps, 0)
