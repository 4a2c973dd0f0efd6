"""Coordinates of virtual joints and placements of virtual links from the poses of their bodies."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from svkc._jax.select import where
from svkc.loops.frames import LoopFrames, loop_frames
from svkc.model.chain import Chain, Structure
from svkc.tree.kinematics import Kinematics
from svkc.tree.spatial import (
    quat_conjugate,
    quat_matrix,
    quat_multiply,
    quat_normalize,
    quat_rotate,
)


def joint_coordinates(
    chain: Chain,
    structure: Structure,
    kin: Kinematics,
    q: Float[Array, " q"],
    frames: LoopFrames | None = None,
) -> Float[Array, " q"]:
    """Return q with the coordinates of every virtual joint computed from the poses of its two
    bodies.

    The part of the relative pose that the joint's freedoms cannot express is left out. Angles are
    on the turn nearest to those of q.
    frames: `loop_frames` at q, if they are known.
    """
    top = chain.topology
    frames = loop_frames(chain, structure, kin, q) if frames is None else frames
    rotation = quat_multiply(quat_conjugate(frames.base_quat), frames.real_quat)
    p = structure.parent
    origin = (
        kin.r[p]
        + quat_rotate(kin.quat[p], structure.pos)
        + (kin.root_position[p] - kin.root_position[structure.real])
    )
    translation = where(
        structure.freedoms[:, 3:],
        quat_rotate(quat_conjugate(frames.base_quat), frames.real_position - origin),
        0,
    )
    angle = _euler_angles(rotation, structure.freedoms)
    ball_quat = quat_normalize(
        jnp.concatenate([rotation[:, :1], where(structure.freedoms[:, :3], rotation[:, 1:], 0)], -1)
    )
    table = top.links
    for values, index in (
        (angle, table.angle),
        (translation, table.slide),
        (ball_quat, table.quat),
    ):
        at = np.flatnonzero((index < top.nq_all).ravel())
        if len(at):
            slots, new = index.ravel()[at], values.ravel()[at]
            new = _on_turn_of(q[slots], new) if index is table.angle else new
            q = q.at[slots].set(new)
    return q


def _on_turn_of(old: Float[Array, " n"], angle: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return the angles plus the full turns that bring them nearest to the old ones.

    Springs and ranges of joints depend on the turn.
    """
    turn = 2 * np.pi
    return angle + turn * jax.lax.stop_gradient(jnp.round((old - angle) / turn))


def with_coordinates(
    chain: Chain, links: Bool[Array, " links"], new: Float[Array, " q"], q: Float[Array, " q"]
) -> Float[Array, " q"]:
    """Return q with the coordinates of the virtual joints in the mask `links` taken from `new`."""
    table, top = chain.topology.links, chain.topology
    for index in (table.angle, table.slide, table.quat):
        at = np.flatnonzero((index < top.nq_all).ravel())
        slots = index.ravel()[at]
        if len(at):
            q = q.at[slots].set(where(links[at // index.shape[1]], new[slots], q[slots]))
    return q


def _euler_angles(
    rotation: Float[Array, "links 4"], freedoms: Bool[Array, "links 6"]
) -> Float[Array, "links 3"]:
    """Return the Euler angles about x, y, z in sequence; zero for an axis that is no freedom."""
    R = quat_matrix(rotation)
    fx, fy, fz = freedoms[:, 0], freedoms[:, 1], freedoms[:, 2]

    def angle(s, c):
        # arctan2(0, 0) has the derivative NaN
        return jnp.arctan2(s, where((s == 0) & (c == 0), 1, c))

    # each angle from entries of Rx Ry, Rx Rz or Ry Rz that depend on this angle alone
    x = where(fx, where(fz, angle(-R[:, 1, 2], R[:, 2, 2]), angle(R[:, 2, 1], R[:, 1, 1])), 0)
    y = where(fy, angle(R[:, 0, 2], where(fz, R[:, 2, 2], R[:, 0, 0])), 0)
    z = where(fz, where(fx, angle(-R[:, 0, 1], R[:, 0, 0]), angle(R[:, 1, 0], R[:, 1, 1])), 0)
    return jnp.stack([x, y, z], -1)


def place_at_current_pose(
    chain: Chain,
    structure: Structure,
    q: Float[Array, " q"],
    links: Bool[Array, " links"],
    kin: Kinematics,
) -> Structure:
    """Return the structure with the links in the mask `links` placed at the current poses of their
    bodies.

    The joint's origin is the declared point of the real link; the joint's axes stay those declared
    in the parent. A palm, for example, grips a bar where it touches the bar, about the direction of
    the bar. Derivatives with respect to the poses pass through the placement.
    """
    frames = loop_frames(chain, structure, kin, q)
    p = structure.parent
    to_parent = quat_conjugate(kin.quat[p])
    offset = (
        frames.real_position - kin.r[p] - (kin.root_position[p] - kin.root_position[structure.real])
    )
    pos = quat_rotate(to_parent, offset)
    real_quat = quat_multiply(quat_conjugate(kin.quat[structure.real]), frames.base_quat)
    mask = links[:, None]
    return eqx.tree_at(
        lambda s: (s.pos, s.real_quat),
        structure,
        (where(mask, pos, structure.pos), where(mask, real_quat, structure.real_quat)),
    )
