"""Kinematics of the tree: poses, twists and accelerations of its rows.

The kinds of joints are few and static: all joints of one kind are one array, and each level of the
tree is one operation.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc._jax.batch_together import batch_together
from svkc._jax.pytrees import only_leaves
from svkc._jax.select import where
from svkc._jax.static_gather import static_take
from svkc.model.chain import Chain
from svkc.model.topology import BALL, FREE, HINGE, SLIDE, Topology
from svkc.tree.configuration import velocities_from_derivative
from svkc.tree.spatial import (
    angular_linear,
    cross,
    matvec,
    motion_cross,
    quat_from_axis_angle,
    quat_matrix,
    quat_multiply,
    quat_normalize,
    skew,
)
from svkc.tree.traversal import (
    LEVELS_UNROLLED,
    accumulate_from_root,
    replace_rows,
    sum_dofs_per_row,
)


class Kinematics(eqx.Module):
    """Poses of the rows and motion subspaces of the joints at one configuration, in world axes.

    R, quat: rotation of each row, as a matrix and as a quaternion.
    r: position of each row relative to its root's origin (m).
    root_position: position of that root's origin (m).
    S: motion subspace of each coordinate of the tree, about its root's origin.
    """

    R: Float[Array, "rows 3 3"]
    quat: Float[Array, "rows 4"]
    r: Float[Array, "rows 3"]
    root_position: Float[Array, "rows 3"]
    S: Float[Array, "nv 6"]


def _joint_poses(chain: Chain, q: Float[Array, " q"]):
    """Return each row's rotation in its parent, the rotation at load, and the slide joints' offset.

    Quaternions are [rows 4]. The offset [rows 3] (m) is in the axes at load; None without slides.
    """
    top, start = chain.topology, np.array(chain.topology.q_start)
    quat, at_load, offset = chain.quat, chain.quat, None
    hinges, balls, slides = top.rows_of_kind(HINGE), top.rows_of_kind(BALL), top.rows_of_kind(SLIDE)
    rotations = []
    if len(hinges):
        rotations.append(
            (
                hinges,
                quat_from_axis_angle(
                    static_take(chain.axis, hinges),
                    static_take(q, start[hinges]) - static_take(chain.q_load, start[hinges]),
                ),
            )
        )
    if len(balls):
        rotations.append(
            (balls, quat_normalize(static_take(q, start[balls][:, None] + np.arange(4))))
        )
    for rows, joint in rotations:
        quat = replace_rows(quat, rows, quat_multiply(static_take(at_load, rows), joint))
    free = top.rows_of_kind(FREE)
    if len(free):
        quat = replace_rows(
            quat, free, quat_normalize(static_take(q, start[free][:, None] + np.arange(3, 7)))
        )
    if len(slides):
        along = static_take(q, start[slides]) - static_take(chain.q_load, start[slides])
        offset = replace_rows(
            jnp.zeros_like(chain.axis), slides, along[:, None] * static_take(chain.axis, slides)
        )
    return quat, at_load, offset


def _absolute_rotations(top: Topology, quat: Float[Array, "rows 4"]) -> Float[Array, "rows 4"]:
    """Return rotations in world axes, from rotations in the parent.

    Level by level, and by pointer doubling along the ancestors in deep trees.
    """
    parent = np.array(top.parent)
    if len(top.levels) > LEVELS_UNROLLED:
        ancestor = np.maximum(parent, 0)
        for _ in range(int(np.ceil(np.log2(len(top.levels))))):
            quat, ancestor = (
                jnp.concatenate([quat[:1], quat_multiply(static_take(quat, ancestor), quat)[1:]]),
                ancestor[ancestor],
            )
        return quat
    levels = [quat[:1]]
    for (start, _), (first, last) in zip(top.levels[:-1], top.levels[1:], strict=True):
        levels.append(
            quat_multiply(static_take(levels[-1], parent[first:last] - start), quat[first:last])
        )
    return jnp.concatenate(levels)


def kinematics(chain: Chain, q: Float[Array, " q"]) -> Kinematics:
    """Return the poses of the rows and the motion subspaces at q (Featherstone section 4.4).

    The derivative with respect to q is in closed form: a change of q moves each row by a twist.
    """
    geometry = lambda c: (c.quat, c.pos, c.axis, c.anchor, c.q_load)
    return _kinematics_with_jvp(only_leaves(chain, geometry), q)


@eqx.filter_custom_jvp
def _kinematics_with_jvp(chain: Chain, q: Float[Array, " q"]) -> Kinematics:
    return batch_together(_kinematics(chain, q), (chain, q))


@_kinematics_with_jvp.def_jvp
def _kinematics_jvp(primals, tangents):
    (chain, q), (d_chain, dq) = primals, tangents
    kin = _kinematics_with_jvp(chain, q)
    d_kin = jax.tree.map(lambda _: None, kin)
    if jax.tree.leaves(d_chain):
        d_kin = eqx.filter_jvp(lambda c: _kinematics(c, q), (chain,), (d_chain,))[1]
    if dq is not None:
        by_q = _kinematics_rate(chain, kin, velocities_from_derivative(chain, q, dq))
        add = lambda a, b: b if a is None else a + b
        d_kin = jax.tree.map(add, d_kin, by_q, is_leaf=lambda x: x is None)
    return kin, d_kin


def _kinematics_rate(chain: Chain, kin: Kinematics, v: Float[Array, " dofs"]) -> Kinematics:
    """Return the derivative of the kinematics in a motion with the velocities v.

    Positions and motion subspaces are about the root's origin, which moves too.
    """
    top = chain.topology
    # Vector products have the factor that depends on v second, where it is cheaper to transpose.
    w, at_origin = angular_linear(twists(chain, kin, v))
    root_velocity = static_take(at_origin, top.root)
    relative = at_origin - root_velocity
    S = -motion_cross(kin.S, static_take(jnp.concatenate([w, relative], -1), np.array(top.dof_row)))
    return Kinematics(
        R=jnp.sum(skew(w)[..., None] * kin.R[:, None], 2),
        quat=quat_multiply(jnp.concatenate([jnp.zeros_like(w[:, :1]), w], -1), kin.quat) / 2,
        r=relative - cross(kin.r, w),
        root_position=root_velocity,
        S=where(_fixed_in_row(top)[:, None], S, 0),
    )


@jax.jit
def _kinematics(chain: Chain, q: Float[Array, " q"]) -> Kinematics:
    """Return `kinematics`, differentiated automatically."""
    top = chain.topology
    local, at_load, offset = _joint_poses(chain, q)
    quat = quat_normalize(_absolute_rotations(top, local))
    R = quat_matrix(quat)
    parent = np.maximum(np.array(top.parent), 0)
    parent_R = static_take(R, parent)
    step = matvec(parent_R, chain.pos)
    if offset is not None:
        step = step + matvec(parent_R, matvec(quat_matrix(at_load), offset))
    if chain.anchor is not None:
        # the row turns about the anchor, which is fixed in the parent
        step = (
            step
            + matvec(parent_R, matvec(quat_matrix(at_load), chain.anchor))
            - matvec(R, chain.anchor)
        )
    free = top.rows_of_kind(FREE)
    if len(free):
        step = replace_rows(
            step, free, static_take(q, np.array(top.q_start)[free][:, None] + np.arange(3))
        )
    roots = np.array(top.parent) <= 0
    r = accumulate_from_root(top, where(roots[:, None], 0, step))
    return Kinematics(
        R=R,
        quat=quat,
        r=r,
        root_position=static_take(step, top.root),
        S=_motion_subspaces(chain, R, r),
    )


def _motion_subspaces(chain: Chain, R, r) -> Float[Array, "nv 6"]:
    """Return the motion subspace of every coordinate, in world axes about the root's origin."""
    top = chain.topology
    eye = jnp.eye(3, dtype=R.dtype)
    point = r if chain.anchor is None else r + matvec(R, chain.anchor)
    parts, order = [], []

    def revolute_axes(rows, axes):
        return jnp.concatenate([axes, cross(static_take(point, rows), axes)], -1)

    hinges, slides = top.rows_of_kind(HINGE), top.rows_of_kind(SLIDE)
    if len(hinges):
        parts.append(
            revolute_axes(hinges, matvec(static_take(R, hinges), static_take(chain.axis, hinges)))
        )
        order.append(np.array(top.v_start)[hinges])
    if len(slides):
        along = matvec(static_take(R, slides), static_take(chain.axis, slides))
        parts.append(jnp.concatenate([jnp.zeros_like(along), along], -1))
        order.append(np.array(top.v_start)[slides])
    for kind, offset in ((BALL, 0), (FREE, 3)):
        rows = top.rows_of_kind(kind)
        for k in range(3) if len(rows) else ():
            parts.append(revolute_axes(rows, static_take(R, rows)[..., k]))
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
    """Return each row's twist (rad/s, m/s), in world axes about its root's origin."""
    return accumulate_from_root(
        chain.topology, sum_dofs_per_row(chain.topology, kin.S * v[: chain.nv, None])
    )


def velocity_products(
    chain: Chain, kin: Kinematics, V: Float[Array, "rows 6"], v: Float[Array, " dofs"]
) -> Float[Array, "rows 6"]:
    """Return Sdot v of each row's joint.

    It is V x (S v) for axes fixed in the row. Translations of a free joint have axes fixed in the
    world and contribute nothing.
    """
    top = chain.topology
    v = where(_fixed_in_row(top), v[: chain.nv], 0)
    return motion_cross(V, sum_dofs_per_row(top, kin.S * v[:, None]))


def _fixed_in_row(top: Topology) -> np.ndarray:
    """Return which coordinates have an axis fixed in their row: not a free joint's translations."""
    fixed, free = np.ones(top.nv, bool), top.rows_of_kind(FREE)
    fixed[(np.array(top.v_start)[free][:, None] + np.arange(3)).ravel()] = False
    return fixed


def bias_accelerations(
    chain: Chain, kin: Kinematics, V: Float[Array, "rows 6"], v: Float[Array, " dofs"]
) -> Float[Array, "rows 6"]:
    """Return each row's spatial acceleration for vdot = 0, without gravity."""
    return accumulate_from_root(chain.topology, velocity_products(chain, kin, V, v))
