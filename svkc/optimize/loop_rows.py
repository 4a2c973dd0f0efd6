"""The loop constraints of connected links, without coordinates of their virtual joints.

Each virtual link has six rows along the axes of its joint's frame: three rotations, then three
translations. Rows along freedoms of the joint are left out. The axes are fixed in the parent.
Multipliers of the rows are components of the wrench on the real link, about the origin of its
link frame.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc._jax.static_gather import static_take
from svkc.model.chain import Chain
from svkc.tree.kinematics import Kinematics, kinematics, twists
from svkc.tree.spatial import (
    cross,
    matvec,
    quat_conjugate,
    quat_matrix,
    quat_multiply,
    quat_normalize,
    quat_rotate,
)


@dataclasses.dataclass(frozen=True, eq=False)
class LinkRows:
    """Selected constraint rows of virtual links, with the static data of these links.

    Tables with equal contents are equal, so that functions compiled for one serve the others.

    rows: sorted indices of the selected rows. Those of link i are 6 i ... 6 i + 5.
    links: indices of the virtual links that have selected rows.
    parent, real: of each of `links`, the indices of its two bodies in the tree.
    freedoms: of each of `links`, which of the three rotations are free.
    """

    rows: np.ndarray
    links: np.ndarray
    parent: np.ndarray
    real: np.ndarray
    freedoms: tuple[tuple[bool, ...], ...]

    def _key(self) -> tuple:
        return self.rows.tobytes(), self.parent.tobytes(), self.real.tobytes(), self.freedoms

    def __eq__(self, other: object) -> bool:
        return isinstance(other, LinkRows) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())

    @classmethod
    def of(cls, chain: Chain, rows: np.ndarray) -> "LinkRows":
        """Return the table of some rows of a chain, which must not be traced."""
        links, s = np.unique(rows // 6), chain.structure
        return cls(
            rows=rows,
            links=links,
            parent=np.asarray(s.parent)[links],
            real=np.asarray(s.real)[links],
            freedoms=tuple(chain.topology.link_freedoms[i][:3] for i in links),
        )

    @property
    def flat_indices(self) -> np.ndarray:
        """Indices of the rows in an array of six rows for each of `links`."""
        return 6 * np.searchsorted(self.links, self.rows // 6) + self.rows % 6

    def __len__(self) -> int:
        return len(self.rows)


class LinkPoses(eqx.Module):
    """Poses of the real links' frames.

    base: orientation of each joint's frame in the world, as a rotation matrix.
    quat: orientation of the real link's frame in the joint's frame.
    offset: position of the real link's frame in the joint's frame (m).
    of_parent, of_real: position of the real link's frame in world axes (m), from the origin of the
        parent's root, and from the origin of the real link's root.
    """

    base: Float[Array, "links 3 3"]
    quat: Float[Array, "links 4"]
    offset: Float[Array, "links 3"]
    of_parent: Float[Array, "links 3"]
    of_real: Float[Array, "links 3"]


def link_poses(chain: Chain, kin: Kinematics, table: LinkRows) -> LinkPoses:
    """Return the poses of the real links' frames. table: of the links."""
    s, p, r = chain.structure, table.parent, table.real
    quat, pos, real_quat, real_pos = (
        static_take(x, table.links) for x in (s.quat, s.pos, s.real_quat, s.real_pos)
    )
    of = lambda x, rows: static_take(x, rows)
    base_quat = quat_normalize(quat_multiply(of(kin.quat, p), quat))
    turned = quat_normalize(quat_multiply(of(kin.quat, r), real_quat))
    base = quat_matrix(base_quat)
    of_real = of(kin.r, r) + matvec(of(kin.R, r), real_pos)
    of_parent = of_real + (of(kin.root_position, r) - of(kin.root_position, p))
    origin = of(kin.r, p) + matvec(of(kin.R, p), pos)
    return LinkPoses(
        base=base,
        quat=quat_multiply(quat_conjugate(base_quat), turned),
        offset=matvec(jnp.swapaxes(base, -1, -2), of_parent - origin),
        of_parent=of_parent,
        of_real=of_real,
    )


def _rotation_rows(quat, free: tuple[bool, ...], w=None):
    """Return the three rotation rows of a joint, or their rates if w is given.

    Where the loop is closed, a rate is the component of w about the row's axis.

    quat: orientation of the real link's frame in the joint's frame. free: which rotations are free.
    w: angular velocity of the real link relative to the parent, in the joint's frame (rad/s).
    """
    if all(free):
        return jnp.zeros(3, quat.dtype)
    if not any(free):
        quat = jnp.where(quat[0] < 0, -quat, quat)
        return 2 * quat[1:] if w is None else quat[0] * w + cross(w, quat[1:])
    axis, rows = rotation_table(free)
    column = quat_matrix(quat)[:, axis]
    return jnp.asarray(rows, quat.dtype) @ (column if w is None else cross(w, column))


def rotation_table(free: tuple[bool, ...]) -> tuple[int, np.ndarray]:
    """Return (axis, matrix) of the rotation rows of a joint with one or two free rotations.

    The three rows are the matrix times this axis of the real link's frame, in the joint's frame.
    """
    axes, eye = np.flatnonzero(free), np.eye(3)
    if len(axes) == 1:
        return int(axes[0]), np.cross(eye, eye[axes[0]])
    (last,) = set(range(3)) - set(axes.tolist())
    sign = np.cross(eye[axes[1]], eye[axes[0]])[last]
    return int(axes[1]), sign * np.outer(eye[last], eye[axes[0]])


def _select(table: LinkRows, angular: list, linear) -> Float[Array, " rows"]:
    """Return the selected rows from all rotation and translation rows of the links."""
    six = jnp.concatenate([jnp.stack(angular), linear], -1).ravel()
    return static_take(six, table.flat_indices)


def row_gaps(chain: Chain, kin: Kinematics, table: LinkRows) -> Float[Array, " rows"]:
    """Return the gaps of the rows (rad, m), which are zero where a loop is closed."""
    poses = link_poses(chain, kin, table)
    angular = [_rotation_rows(poses.quat[i], free) for i, free in enumerate(table.freedoms)]
    return _select(table, angular, poses.offset)


def _relative(poses: LinkPoses, of_parent, of_real, relative) -> Float[Array, "links 3"]:
    """Return of_real - of_parent - relative, turned from world axes to the joints' axes."""
    return matvec(jnp.swapaxes(poses.base, -1, -2), of_real - of_parent - relative)


def row_rates(
    chain: Chain, kin: Kinematics, table: LinkRows, V: Float[Array, "tree_rows 6"]
) -> Float[Array, " rows"]:
    """Return the derivatives of the gaps by time (rad/s, m/s). V: twists of the tree's rows."""
    poses = link_poses(chain, kin, table)
    of_parent, of_real = static_take(V, table.parent), static_take(V, table.real)
    velocity = lambda twist, at: twist[:, 3:] + cross(twist[:, :3], at)
    linear = _relative(
        poses, velocity(of_parent, poses.of_parent), velocity(of_real, poses.of_real), 0
    )
    w = _relative(poses, of_parent[:, :3], of_real[:, :3], 0)
    angular = [_rotation_rows(poses.quat[i], free, w[i]) for i, free in enumerate(table.freedoms)]
    return _select(table, angular, linear)


def row_accelerations(
    chain: Chain,
    kin: Kinematics,
    table: LinkRows,
    V: Float[Array, "tree_rows 6"],
    A: Float[Array, "tree_rows 6"],
) -> Float[Array, " rows"]:
    """Return the second derivatives of the gaps by time (rad/s^2, m/s^2).

    V: twists of the tree's rows. A: their spatial accelerations, without gravity.
    """
    poses = link_poses(chain, kin, table)
    of_parent, of_real = static_take(V, table.parent), static_take(V, table.real)
    second_parent, second_real = static_take(A, table.parent), static_take(A, table.real)
    velocity = lambda V, at: V[:, 3:] + cross(V[:, :3], at)
    acceleration = lambda V, A, at: velocity(A, at) + cross(V[:, :3], velocity(V, at))
    turning = of_parent[:, :3]
    apart = velocity(of_real, poses.of_real) - velocity(of_parent, poses.of_parent)
    linear = _relative(
        poses,
        acceleration(of_parent, second_parent, poses.of_parent),
        acceleration(of_real, second_real, poses.of_real),
        2 * cross(turning, apart),
    )
    relative = of_real[:, :3] - turning
    w = _relative(poses, turning, of_real[:, :3], 0)
    wdot = _relative(poses, second_parent[:, :3], second_real[:, :3], cross(turning, relative))
    quat_dot = quat_multiply(jnp.concatenate([jnp.zeros_like(w[:, :1]), w], -1), poses.quat) / 2
    angular = [
        jax.jvp(
            lambda quat, w, free=free: _rotation_rows(quat, free, w),
            (poses.quat[i], w[i]),
            (quat_dot[i], wdot[i]),
        )[1]
        for i, free in enumerate(table.freedoms)
    ]
    return _select(table, angular, linear)


def _torque(quat, free: tuple[bool, ...], multipliers) -> Float[Array, "3"]:
    """Return the torque (N m), in the joint's axes, of the multipliers of three rotation rows."""
    if all(free):
        return jnp.zeros(3, multipliers.dtype)
    return jax.vjp(lambda w: _rotation_rows(quat, free, w), jnp.zeros_like(quat[1:]))[1](
        multipliers
    )[0]


def _six_rows(table: LinkRows, multipliers) -> Float[Array, "links 6"]:
    """Return the multipliers of all six rows of each link; those not selected are zero."""
    place = np.full(6 * len(table.links), len(table))
    place[table.flat_indices] = np.arange(len(table))
    return static_take(multipliers, place).reshape(-1, 6)


def link_wrenches(
    chain: Chain, kin: Kinematics, table: LinkRows, multipliers: Float[Array, " rows"]
) -> Float[Array, "tree_rows 6"]:
    """Return the wrenches that links with these multipliers exert on the rows of the tree.

    Torque (N m), then force (N), in world axes about the origins of the rows' roots.
    """
    poses = link_poses(chain, kin, table)
    six = _six_rows(table, multipliers)
    torques = [_torque(poses.quat[i], free, six[i, :3]) for i, free in enumerate(table.freedoms)]
    force, torque = (matvec(poses.base, x) for x in (six[:, 3:], jnp.stack(torques)))
    on = lambda at: jnp.concatenate([torque + cross(at, force), force], -1)
    count = len(chain.topology.parent)
    both = jnp.concatenate([on(poses.of_real), -on(poses.of_parent)])
    receives = np.arange(count)[:, None] == np.concatenate([table.real, table.parent])[None]
    return jnp.sum(jnp.where(receives[:, :, None], both[None], 0), 1)


def gaps_at(chain: Chain, q: Float[Array, " nq"], table: LinkRows) -> Float[Array, " rows"]:
    """Return the gaps of the rows (rad, m) at q of the tree."""
    return row_gaps(chain, kinematics(chain, q), table)


def rates_at(
    chain: Chain, q: Float[Array, " nq"], v: Float[Array, " nv"], table: LinkRows
) -> Float[Array, " rows"]:
    """Return the derivatives of the gaps by time (rad/s, m/s) at q and v of the tree."""
    kin = kinematics(chain, q)
    return row_rates(chain, kin, table, twists(chain, kin, v))


def link_force(
    chain: Chain, table: LinkRows, link: int, multipliers: Float[Array, " rows"]
) -> Float[Array, "3"]:
    """Return the force (N) on the real link, in axes of the parent body.

    link: index of the virtual link in the chain.
    """
    six = _six_rows(table, multipliers)[np.searchsorted(table.links, link)]
    return quat_rotate(chain.structure.quat[link], six[3:])


def link_torque(
    chain: Chain,
    q: Float[Array, " nq"],
    table: LinkRows,
    link: int,
    multipliers: Float[Array, " rows"],
) -> Float[Array, "3"]:
    """Return the torque (N m) on the real link, in axes of the parent body, about the joint.

    The joint is at the origin of the real link's frame.

    link: index of the virtual link in the chain.
    """
    poses, i = link_poses(chain, kinematics(chain, q), table), np.searchsorted(table.links, link)
    torque = _torque(poses.quat[i], table.freedoms[i], _six_rows(table, multipliers)[i, :3])
    return quat_rotate(chain.structure.quat[link], torque)
