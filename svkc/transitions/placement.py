"""Joint coordinates of virtual links, and links placed where their bodies are."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from svkc.loops.constraint import loop_frames
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
    chain: Chain, structure: Structure, kin: Kinematics, q: Float[Array, " q"]
) -> Float[Array, " q"]:
    """Q with the coordinates of every virtual joint read off from where its two bodies are: what
    the joint's freedoms can express of it."""
    top = chain.topology
    base = loop_frames(chain, structure, kin, q)
    turn = quat_multiply(quat_conjugate(base.base_quat), base.real_quat)
    p = structure.parent
    start = (
        kin.r[p]
        + quat_rotate(kin.quat[p], structure.pos)
        + (kin.root_position[p] - kin.root_position[structure.real])
    )
    slide = jnp.where(
        structure.freedoms[:, 3:],
        quat_rotate(quat_conjugate(base.base_quat), base.real_position - start),
        0,
    )
    angle = _euler_angles(turn, structure.freedoms)
    masked = quat_normalize(
        jnp.concatenate([turn[:, :1], jnp.where(structure.freedoms[:, :3], turn[:, 1:], 0)], -1)
    )
    table = top.links
    for values, index in ((angle, table.angle), (slide, table.slide), (masked, table.quat)):
        at = np.flatnonzero((index < top.nq_all).ravel())
        q = q.at[index.ravel()[at]].set(values.ravel()[at])
    return q


def with_coordinates(
    chain: Chain, which: Bool[Array, " links"], new: Float[Array, " q"], q: Float[Array, " q"]
) -> Float[Array, " q"]:
    """The coordinates of the virtual joints in `which` from `new`, everything else from `q`."""
    table, top = chain.topology.links, chain.topology
    for index in (table.angle, table.slide, table.quat):
        at = np.flatnonzero((index < top.nq_all).ravel())
        slots = index.ravel()[at]
        q = q.at[slots].set(jnp.where(which[at // index.shape[1]], new[slots], q[slots]))
    return q


def _euler_angles(
    turn: Float[Array, "links 4"], freedoms: Bool[Array, "links 6"]
) -> Float[Array, "links 3"]:
    """Turns about x, y, z in sequence; those not free are taken as zero, the others solved from the
    rotation."""
    R = quat_matrix(turn)
    fx, fy, fz = freedoms[:, 0], freedoms[:, 1], freedoms[:, 2]

    def angle(s, c):
        # where there is none, no derivative that is not a number either
        return jnp.arctan2(s, jnp.where((s == 0) & (c == 0), 1, c))

    # each from the entries of Rx Ry, Rx Rz or Ry Rz that hold it alone
    x = jnp.where(
        fx, jnp.where(fz, angle(-R[:, 1, 2], R[:, 2, 2]), angle(R[:, 2, 1], R[:, 1, 1])), 0
    )
    y = jnp.where(fy, angle(R[:, 0, 2], jnp.where(fz, R[:, 2, 2], R[:, 0, 0])), 0)
    z = jnp.where(
        fz, jnp.where(fx, angle(-R[:, 0, 1], R[:, 0, 0]), angle(R[:, 1, 0], R[:, 1, 1])), 0
    )
    return jnp.stack([x, y, z], -1)


def place_at_current_pose(
    chain: Chain, structure: Structure, q, here: Bool[Array, " links"], kin: Kinematics
) -> Structure:
    """Placements of the links in `here` taken from where the bodies are: the point is the real
    link's own, the axes stay the parent's.

    So a palm grips the bar where it touches it, about the bar's direction; floats of the placement
    stay differentiable.
    """
    end = loop_frames(chain, structure, kin, q)
    p = structure.parent
    to_parent = quat_conjugate(kin.quat[p])
    place = (
        end.real_position
        - kin.r[p]
        - (kin.root_position[p] - kin.root_position[structure.real])
    )
    pos = quat_rotate(to_parent, place)
    real_quat = quat_multiply(quat_conjugate(kin.quat[structure.real]), end.base_quat)
    take = here[:, None]
    return eqx.tree_at(
        lambda s: (s.pos, s.real_quat),
        structure,
        (jnp.where(take, pos, structure.pos), jnp.where(take, real_quat, structure.real_quat)),
    )
