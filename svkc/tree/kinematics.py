"""Poses, twists and accelerations of the tree.

Joint kinds are few and known beforehand: all joints of one kind are one array, and a level of the
tree is one operation.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc._jax.static_gather import static_take
from svkc.model.chain import Chain, State
from svkc.model.checked_jit import checked_jit
from svkc.model.topology import BALL, FREE, HINGE, SLIDE, Topology
from svkc.tree.spatial import (
    cross,
    matvec,
    motion_cross,
    quat_from_axis_angle,
    quat_matrix,
    quat_multiply,
    quat_normalize,
)
from svkc.tree.traversal import (
    LEVELS_UNROLLED,
    accumulate_from_root,
    replace_rows,
    sum_dofs_per_row,
)


class Kinematics(eqx.Module):
    """Poses and joint axes at one configuration: rotation, quaternion, place relative to the root's
    origin, the root's place, motion subspace S."""

    R: Float[Array, "rows 3 3"]
    quat: Float[Array, "rows 4"]
    r: Float[Array, "rows 3"]
    root_position: Float[Array, "rows 3"]
    S: Float[Array, "nv 6"]


def _joint_poses(chain: Chain, q: Float[Array, " q"]):
    """Of each row in its parent: rotation [rows 4], the same without the joint's own turn, and
    offset along the slide [rows]."""
    top, start = chain.topology, np.array(chain.topology.q_start)
    quat, fixed, slide = chain.quat, chain.quat, None
    hinges, balls, slides = top.rows_of_kind(HINGE), top.rows_of_kind(BALL), top.rows_of_kind(SLIDE)
    turn = []
    if len(hinges):
        turn.append(
            (
                hinges,
                quat_from_axis_angle(
                    static_take(chain.axis, hinges),
                    static_take(q, start[hinges]) - static_take(chain.q_load, start[hinges]),
                ),
            )
        )
    if len(balls):
        turn.append((balls, quat_normalize(static_take(q, start[balls][:, None] + np.arange(4)))))
    for rows, joint in turn:
        quat = replace_rows(quat, rows, quat_multiply(static_take(fixed, rows), joint))
    free = top.rows_of_kind(FREE)
    if len(free):
        quat = replace_rows(
            quat, free, quat_normalize(static_take(q, start[free][:, None] + np.arange(3, 7)))
        )
    if len(slides):
        along = static_take(q, start[slides]) - static_take(chain.q_load, start[slides])
        slide = replace_rows(
            jnp.zeros_like(chain.axis), slides, along[:, None] * static_take(chain.axis, slides)
        )
    return quat, fixed, slide


def _rotations_in_ground(top: Topology, quat: Float[Array, "rows 4"]) -> Float[Array, "rows 4"]:
    """Rotations in the parent -> rotations in the world: level by level, or by doubling along the
    ancestors in deep trees."""
    parent = np.array(top.parent)
    if len(top.levels) > LEVELS_UNROLLED:
        above = np.maximum(parent, 0)
        for _ in range(int(np.ceil(np.log2(len(top.levels))))):
            quat, above = (
                jnp.concatenate([quat[:1], quat_multiply(static_take(quat, above), quat)[1:]]),
                above[above],
            )
        return quat
    levels = [quat[:1]]
    for (start, _), (first, last) in zip(top.levels[:-1], top.levels[1:], strict=True):
        levels.append(
            quat_multiply(static_take(levels[-1], parent[first:last] - start), quat[first:last])
        )
    return jnp.concatenate(levels)


@jax.jit
def kinematics(chain: Chain, q: Float[Array, " q"]) -> Kinematics:
    """Poses of every row and the joint axes at q (Featherstone section 4.4, world axes)."""
    top = chain.topology
    local, fixed, slide = _joint_poses(chain, q)
    quat = quat_normalize(_rotations_in_ground(top, local))
    R = quat_matrix(quat)
    parent = np.maximum(np.array(top.parent), 0)
    above = static_take(R, parent)
    step = matvec(above, chain.pos)
    if slide is not None:
        step = step + matvec(above, matvec(quat_matrix(fixed), slide))
    if chain.anchor is not None:
        # the anchor stays where it is while the row turns about it
        step = (
            step + matvec(above, matvec(quat_matrix(fixed), chain.anchor)) - matvec(R, chain.anchor)
        )
    free = top.rows_of_kind(FREE)
    if len(free):
        step = replace_rows(
            step, free, static_take(q, np.array(top.q_start)[free][:, None] + np.arange(3))
        )
    roots = np.array(top.parent) <= 0
    r = accumulate_from_root(top, jnp.where(roots[:, None], 0, step))
    return Kinematics(
        R=R,
        quat=quat,
        r=r,
        root_position=static_take(step, top.root),
        S=_motion_subspaces(chain, R, r),
    )


def _motion_subspaces(chain: Chain, R, r) -> Float[Array, "nv 6"]:
    """Motion subspace of every joint coordinate, in world axes about the root's origin."""
    top = chain.topology
    eye = jnp.eye(3, dtype=R.dtype)
    point = r if chain.anchor is None else r + matvec(R, chain.anchor)
    parts, order = [], []

    def turning(rows, axes):
        return jnp.concatenate([axes, cross(static_take(point, rows), axes)], -1)

    hinges, slides = top.rows_of_kind(HINGE), top.rows_of_kind(SLIDE)
    if len(hinges):
        parts.append(
            turning(hinges, matvec(static_take(R, hinges), static_take(chain.axis, hinges)))
        )
        order.append(np.array(top.v_start)[hinges])
    if len(slides):
        along = matvec(static_take(R, slides), static_take(chain.axis, slides))
        parts.append(jnp.concatenate([jnp.zeros_like(along), along], -1))
        order.append(np.array(top.v_start)[slides])
    for kind, offset in ((BALL, 0), (FREE, 3)):
        rows = top.rows_of_kind(kind)
        for k in range(3) if len(rows) else ():
            parts.append(turning(rows, static_take(R, rows)[..., k]))
            order.append(np.array(top.v_start)[rows] + offset + k)
            if kind == FREE:
                parts.append(
                    jnp.broadcast_to(
                        jnp.concatenate([jnp.zeros_like(eye[k]), eye[k]]), (len(rows), 6)
                    )
                )
                order.append(np.array(top.v_start)[rows] + k)
    if not parts:
        return jnp.zeros((0, 6), R.dtype)
    return static_take(jnp.concatenate(parts), np.argsort(np.concatenate(order)))


def twists(chain: Chain, kin: Kinematics, v: Float[Array, " dofs"]) -> Float[Array, "rows 6"]:
    """V = sum of S v along the tree (rad/s, m/s), in world axes about the root's origin."""
    return accumulate_from_root(
        chain.topology, sum_dofs_per_row(chain.topology, kin.S * v[: chain.nv, None])
    )


def velocity_products(
    chain: Chain, kin: Kinematics, V: Float[Array, "rows 6"], v: Float[Array, " dofs"]
) -> Float[Array, "rows 6"]:
    """Sdot v of each row's joint: V x (S v) for axes fixed in the row; a free joint's translations
    have axes fixed in the world."""
    top = chain.topology
    moving = np.ones(chain.nv, bool)
    free = top.rows_of_kind(FREE)
    moving[(np.array(top.v_start)[free][:, None] + np.arange(3)).ravel()] = False
    return motion_cross(
        V, sum_dofs_per_row(top, kin.S * jnp.where(moving, v[: chain.nv], 0)[:, None])
    )


def bias_accelerations(
    chain: Chain, kin: Kinematics, V: Float[Array, "rows 6"], v: Float[Array, " dofs"]
) -> Float[Array, "rows 6"]:
    """Spatial accelerations with vdot = 0 and no gravity."""
    return accumulate_from_root(chain.topology, velocity_products(chain, kin, V, v))


@checked_jit
def poses(chain: Chain, state: State) -> tuple[Float[Array, "bodies 3"], Float[Array, "bodies 4"]]:
    """Positions (m) and quaternions (wxyz, body to world) of the body frames in the world; row 0 is
    the world (Featherstone section 4.4)."""
    rows = np.array(chain.topology.body_row)
    kin = kinematics(chain, state.q)
    return (kin.root + kin.r)[rows], kin.quat[rows]


@checked_jit
def velocities(
    chain: Chain, state: State
) -> tuple[Float[Array, "bodies 3"], Float[Array, "bodies 3"]]:
    """Linear velocity of each body's origin (m/s) and angular velocity (rad/s), in world axes; row
    0 is the world (Featherstone section 5.3)."""
    rows = np.array(chain.topology.body_row)
    kin = kinematics(chain, state.q)
    V = twists(chain, kin, state.v)
    return (V[:, 3:] + cross(V[:, :3], kin.r))[rows], V[rows, :3]
