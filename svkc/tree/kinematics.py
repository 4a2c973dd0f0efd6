"""F2: poses, twists and accelerations of the tree, and steps on its configuration.

All vectors are in world axes about the origin of the tree's root body, so that twists and forces add up along the tree without transforms
(Featherstone section 2.8 with X = 1) and keep their digits far from the world's origin.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc._jax.static_gather import take
from svkc.model.chain import Chain, State
from svkc.model.checked_jit import verb
from svkc.model.topology import BALL, FREE, HINGE, SLIDE, Topology
from svkc.tree.spatial import cross, motion_cross, quat_about, quat_conjugate, quat_exp, quat_log, quat_matrix, quat_multiply, quat_normalize, quat_rate, rotate

# deeper trees sum by doubling along the ancestors: compile time would grow with every level
LEVELS_UNROLLED = 24
# children's children and so on that a row may have side by side there; with more the table of ancestors is smaller
WIDEST = 4


def down(top: Topology, x: Float[Array, "rows *n"]) -> Float[Array, "rows *n"]:
    """Sum of x over each row and its ancestors, level by level."""
    if len(top.levels) > LEVELS_UNROLLED:
        for above, _ in _doublings(top):
            x = x + take(x, above)
        return x
    parent, levels = np.array(top.parent), [x[:1]]
    for (start, _), (first, last) in zip(top.levels[:-1], top.levels[1:], strict=True):
        levels.append(x[first:last] + take(levels[-1], parent[first:last] - start))
    return jnp.concatenate(levels)


def up(top: Topology, x: Float[Array, "rows *n"]) -> Float[Array, "rows *n"]:
    """Sum of x over each row and its descendants, level by level."""
    if len(top.levels) > LEVELS_UNROLLED:
        if any(below.shape[1] > WIDEST for _, below in _doublings(top)):
            return jnp.tensordot(jnp.asarray(top.ancestor.T, x.dtype), x, 1)
        for _, below in _doublings(top):
            x = x + jnp.sum(take(x, below), 1)
        return x
    levels, below = [], None
    for level, (first, last) in reversed(list(enumerate(top.levels))):
        below = x[first:last] if below is None else x[first:last] + from_children(top, level, below)
        levels.append(below)
    return jnp.concatenate(levels[::-1])


@functools.cache
def _doublings(top: Topology) -> list[tuple[np.ndarray, np.ndarray]]:
    """For 1, 2, 4, ... generations: each row's ancestor so far up, and its descendants so far down; one past the last row where there is none."""
    parent = np.array(top.parent)
    none, above = len(parent), np.append(np.where(parent < 0, len(parent), parent), len(parent))
    found = []
    while np.any(above < none):
        below = [np.flatnonzero(above[:-1] == i) for i in range(none)]
        table = np.full((none, max(map(len, below))), none)
        for row, own in zip(table, below, strict=True):
            row[: len(own)] = own
        # (as small as jax has them in both precisions: `articulated.levels`)
        found.append((above[:-1].astype(np.int32), table.astype(np.int32)))
        above = above[above]
    return found


def from_children(top: Topology, level: int, below: Float[Array, "below *n"]) -> Float[Array, "here *n"]:
    """For each row of a level, the sum of its children's rows in the level below."""
    (first, last), (lo, hi) = top.levels[level], top.levels[level + 1]
    parent = np.array(top.parent)[lo:hi]
    children = [np.flatnonzero(parent == i) for i in range(first, last)]
    table = np.full((last - first, max(map(len, children))), hi - lo)
    for i, c in enumerate(children):
        table[i, : len(c)] = c
    return jnp.sum(take(below, table), 1)


def put(x: Float[Array, "rows *n"], rows: np.ndarray, values: Float[Array, "some *n"]) -> Float[Array, "rows *n"]:
    """X with some of its rows replaced. (No scatter: XLA's CPU backend makes one kernel of a loop's whole body only where there is none.)"""
    source = np.arange(len(x))
    source[rows] = len(x) + np.arange(len(rows))
    return take(jnp.concatenate([x, values]), source)


def to_rows(top: Topology, x: Float[Array, "nv *n"]) -> Float[Array, "rows *n"]:
    """Sum of x over the coordinates of each row's joint."""
    parts, order = [], []
    for kinds, size in (((HINGE, SLIDE), 1), ((BALL,), 3), ((FREE,), 6)):
        rows = top.rows_of(*kinds)
        if len(rows):
            start = np.array(top.v_start)[rows]
            parts.append(sum(take(x, start + k) for k in range(size)))
            order.append(rows)
    fixed = np.setdiff1d(np.arange(len(top.parent)), np.concatenate(order) if order else np.zeros(0, int))
    parts.append(jnp.zeros((len(fixed), *x.shape[1:]), x.dtype))
    return take(jnp.concatenate(parts), np.argsort(np.concatenate([*order, fixed])))


class Kinematics(eqx.Module):
    """Poses and joint axes at one configuration: rotation, quaternion, place relative to the root's origin, the root's place, motion subspace S."""

    R: Float[Array, "rows 3 3"]
    quat: Float[Array, "rows 4"]
    r: Float[Array, "rows 3"]
    root: Float[Array, "rows 3"]
    S: Float[Array, "nv 6"]


def _joint_poses(chain: Chain, q: Float[Array, " q"]):
    """Of each row in its parent: rotation [rows 4], the same without the joint's own turn, and offset along the slide [rows]."""
    top, start = chain.topology, np.array(chain.topology.q_start)
    quat, fixed, slide = chain.quat, chain.quat, None
    hinges, balls, slides = top.rows_of(HINGE), top.rows_of(BALL), top.rows_of(SLIDE)
    turn = []
    if len(hinges):
        turn.append((hinges, quat_about(take(chain.axis, hinges), take(q, start[hinges]) - take(chain.q_load, start[hinges]))))
    if len(balls):
        turn.append((balls, quat_normalize(take(q, start[balls][:, None] + np.arange(4)))))
    for rows, joint in turn:
        quat = put(quat, rows, quat_multiply(take(fixed, rows), joint))
    free = top.rows_of(FREE)
    if len(free):
        quat = put(quat, free, quat_normalize(take(q, start[free][:, None] + np.arange(3, 7))))
    if len(slides):
        along = take(q, start[slides]) - take(chain.q_load, start[slides])
        slide = put(jnp.zeros_like(chain.axis), slides, along[:, None] * take(chain.axis, slides))
    return quat, fixed, slide


def _compose(top: Topology, quat: Float[Array, "rows 4"]) -> Float[Array, "rows 4"]:
    """Rotations in the parent -> rotations in the world: level by level, or by doubling along the ancestors in deep trees."""
    parent = np.array(top.parent)
    if len(top.levels) > LEVELS_UNROLLED:
        above = np.maximum(parent, 0)
        for _ in range(int(np.ceil(np.log2(len(top.levels))))):
            quat, above = jnp.concatenate([quat[:1], quat_multiply(take(quat, above), quat)[1:]]), above[above]
        return quat
    levels = [quat[:1]]
    for (start, _), (first, last) in zip(top.levels[:-1], top.levels[1:], strict=True):
        levels.append(quat_multiply(take(levels[-1], parent[first:last] - start), quat[first:last]))
    return jnp.concatenate(levels)


@jax.jit
def kinematics(chain: Chain, q: Float[Array, " q"]) -> Kinematics:
    """Poses of every row and the joint axes at q (Featherstone section 4.4, world axes)."""
    top = chain.topology
    local, fixed, slide = _joint_poses(chain, q)
    quat = quat_normalize(_compose(top, local))
    R = quat_matrix(quat)
    parent = np.maximum(np.array(top.parent), 0)
    above = take(R, parent)
    step = rotate(above, chain.pos)
    if slide is not None:
        step = step + rotate(above, rotate(quat_matrix(fixed), slide))
    if chain.anchor is not None:
        # the anchor stays where it is while the row turns about it
        step = step + rotate(above, rotate(quat_matrix(fixed), chain.anchor)) - rotate(R, chain.anchor)
    free = top.rows_of(FREE)
    if len(free):
        step = put(step, free, take(q, np.array(top.q_start)[free][:, None] + np.arange(3)))
    roots = np.array(top.parent) <= 0
    r = down(top, jnp.where(roots[:, None], 0, step))
    return Kinematics(R, quat, r, take(step, top.root), _axes(chain, R, r))


def _axes(chain: Chain, R, r) -> Float[Array, "nv 6"]:
    """Motion subspace of every joint coordinate, in world axes about the root's origin."""
    top = chain.topology
    eye = jnp.eye(3, dtype=R.dtype)
    point = r if chain.anchor is None else r + rotate(R, chain.anchor)
    parts, order = [], []

    def turning(rows, axes):
        return jnp.concatenate([axes, cross(take(point, rows), axes)], -1)

    hinges, slides = top.rows_of(HINGE), top.rows_of(SLIDE)
    if len(hinges):
        parts.append(turning(hinges, rotate(take(R, hinges), take(chain.axis, hinges))))
        order.append(np.array(top.v_start)[hinges])
    if len(slides):
        along = rotate(take(R, slides), take(chain.axis, slides))
        parts.append(jnp.concatenate([jnp.zeros_like(along), along], -1))
        order.append(np.array(top.v_start)[slides])
    for kind, offset in ((BALL, 0), (FREE, 3)):
        rows = top.rows_of(kind)
        for k in range(3) if len(rows) else ():
            parts.append(turning(rows, take(R, rows)[..., k]))
            order.append(np.array(top.v_start)[rows] + offset + k)
            if kind == FREE:
                parts.append(jnp.broadcast_to(jnp.concatenate([jnp.zeros_like(eye[k]), eye[k]]), (len(rows), 6)))
                order.append(np.array(top.v_start)[rows] + k)
    if not parts:
        return jnp.zeros((0, 6), R.dtype)
    return take(jnp.concatenate(parts), np.argsort(np.concatenate(order)))


def twists(chain: Chain, kin: Kinematics, v: Float[Array, " dofs"]) -> Float[Array, "rows 6"]:
    """V = sum of S v along the tree (rad/s, m/s), in world axes about the root's origin."""
    return down(chain.topology, to_rows(chain.topology, kin.S * v[: chain.nv, None]))


def velocity_products(chain: Chain, kin: Kinematics, V: Float[Array, "rows 6"], v: Float[Array, " dofs"]) -> Float[Array, "rows 6"]:
    """Sdot v of each row's joint: V x (S v) for axes fixed in the row; a free joint's translations have axes fixed in the world."""
    top = chain.topology
    moving = np.ones(chain.nv, bool)
    free = top.rows_of(FREE)
    moving[(np.array(top.v_start)[free][:, None] + np.arange(3)).ravel()] = False
    return motion_cross(V, to_rows(top, kin.S * jnp.where(moving, v[: chain.nv], 0)[:, None]))


def bias_accelerations(chain: Chain, kin: Kinematics, V: Float[Array, "rows 6"], v: Float[Array, " dofs"]) -> Float[Array, "rows 6"]:
    """Spatial accelerations with vdot = 0 and no gravity."""
    return down(chain.topology, velocity_products(chain, kin, V, v))


def rates(chain: Chain, q: Float[Array, " q"], v: Float[Array, " dofs"]) -> Float[Array, " q"]:
    """Qdot for the velocities v: quaternions turn by qdot = q w / 2, everything else is its own rate."""
    quat_q, quat_v = chain.topology.quaternions
    scalar_q, scalar_v = chain.topology.scalars
    turn = quat_rate(take(q, quat_q[:, None] + np.arange(4)), take(v, quat_v[:, None] + np.arange(3)))
    order = np.argsort(np.concatenate([scalar_q, (quat_q[:, None] + np.arange(4)).ravel()]))
    return take(jnp.concatenate([take(v, scalar_v), turn.ravel()]), order)


@verb
def integrate(chain: Chain, q: Float[Array, " q"], dv: Float[Array, " dofs"]) -> Float[Array, " q"]:
    """Q moved by the tangent vector dv (m, rad; body axes for rotations): the exponential map, Rodrigues' formula (39)."""
    quat_q, quat_v = chain.topology.quaternions
    scalar_q, scalar_v = chain.topology.scalars
    at = quat_q[:, None] + np.arange(4)
    turned = quat_multiply(quat_normalize(take(q, at)), quat_exp(take(dv, quat_v[:, None] + np.arange(3))))
    order = np.argsort(np.concatenate([scalar_q, at.ravel()]))
    return take(jnp.concatenate([take(q, scalar_q) + take(dv, scalar_v), turned.ravel()]), order)


@verb
def difference(chain: Chain, q1: Float[Array, " q"], q2: Float[Array, " q"]) -> Float[Array, " dofs"]:
    """The tangent vector (m, rad, in the coordinates of v) that takes q1 to q2: integrate(q1, difference(q1, q2)) = q2."""
    quat_q, quat_v = chain.topology.quaternions
    scalar_q, scalar_v = chain.topology.scalars
    at = quat_q[:, None] + np.arange(4)
    turn = quat_log(quat_multiply(quat_conjugate(quat_normalize(take(q1, at))), quat_normalize(take(q2, at))))
    order = np.argsort(np.concatenate([scalar_v, (quat_v[:, None] + np.arange(3)).ravel()]))
    return take(jnp.concatenate([take(q2, scalar_q) - take(q1, scalar_q), turn.ravel()]), order)


def normalize(chain: Chain, q: Float[Array, " q"]) -> Float[Array, " q"]:
    """Q with every quaternion of unit length."""
    quat_q, _ = chain.topology.quaternions
    if not len(quat_q):
        return q
    at = quat_q[:, None] + np.arange(4)
    return put(q, at.ravel(), quat_normalize(take(q, at)).ravel())


@verb
def poses(chain: Chain, state: State) -> tuple[Float[Array, "bodies 3"], Float[Array, "bodies 4"]]:
    """Positions (m) and quaternions (wxyz, body to world) of the body frames in the world; row 0 is the world (Featherstone section 4.4)."""
    rows = np.array(chain.topology.body_row)
    kin = kinematics(chain, state.q)
    return (kin.root + kin.r)[rows], kin.quat[rows]


@verb
def velocities(chain: Chain, state: State) -> tuple[Float[Array, "bodies 3"], Float[Array, "bodies 3"]]:
    """Linear velocity of each body's origin (m/s) and angular velocity (rad/s), in world axes; row 0 is the world (Featherstone section 5.3)."""
    rows = np.array(chain.topology.body_row)
    kin = kinematics(chain, state.q)
    V = twists(chain, kin, state.v)
    return (V[:, 3:] + cross(V[:, :3], kin.r))[rows], V[rows, :3]
