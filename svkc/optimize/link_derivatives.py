"""First and second derivatives of the links' rows in closed form, for trees of hinges and slides.

Seen from the parent of a link, a row's gap is a constant vector times y. Here y is a point of the
real link, a direction that turns with it, or its orientation as a quaternion: all turn linearly, so
that the derivative of y by a coordinate is G y. The joints from the parent to the real link are one
open chain, in which each joint moves what is after it.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc._jax.static_gather import static_take
from svkc.model.chain import Chain
from svkc.optimize.loop_rows import LinkPoses, LinkRows, link_poses, rotation_table
from svkc.optimize.tree_derivatives import dot, sorted_pairs
from svkc.tree.kinematics import Kinematics
from svkc.tree.spatial import cross, matvec, motion_cross, quat_matrix


class Path(NamedTuple):
    """The joints from a link's parent to its real link.

    dofs: their coordinates. sign: -1 where a coordinate moves the parent.
    """

    dofs: np.ndarray
    sign: np.ndarray

    @classmethod
    def between(cls, chain: Chain, parent: int, real: int) -> "Path":
        """Return the path between two rows of the tree."""
        top = chain.topology
        moves = [top.ancestor_mask[row, top.dof_row] for row in (parent, real)]
        up, down = (np.flatnonzero(x & ~y) for x, y in (moves, moves[::-1]))
        return cls(np.concatenate([up[::-1], down]), np.repeat([-1.0, 1.0], [len(up), len(down)]))


def _like(x: Array, y: Array) -> Array:
    """Return y with axes of size 1 in front, as many axes as x."""
    return y.reshape((1,) * (x.ndim - y.ndim) + y.shape)


class Turned(NamedTuple):
    """Values y = (scalar, vector), and how motion vectors turn them: points and directions.

    scalar: 1 for points, 0 for directions and rates.
    """

    scalar: Array
    vector: Float[Array, "*n 3"]

    def by(self, X: Float[Array, "*n 6"]) -> "Turned":
        """Return G y."""
        scalar, vector = _like(X, self.scalar), _like(X, self.vector)
        vector = cross(X[..., :3], vector) + X[..., 3:] * scalar
        return type(self)(jnp.zeros_like(vector[..., :1]), vector)

    def pairing(self, E: Float[Array, "*#n 3"]) -> Float[Array, "*n 6"]:
        """Return the force whose product with a motion vector is E G y."""
        E = _like(self.vector, E)
        return jnp.concatenate([cross(self.vector, E), self.scalar * E], -1)

    def plus(self, *others: "Turned") -> "Turned":
        """Return a sum."""
        scalar = sum((x.scalar for x in others), self.scalar)
        return type(self)(scalar, sum((x.vector for x in others), self.vector))


class Quaternion(Turned):
    """Quaternions, which turn by half of an angular velocity."""

    def by(self, X: Float[Array, "*n 6"]) -> "Quaternion":
        w, vector = X[..., :3] / 2, _like(X, self.vector)
        scalar = -jnp.sum(w * vector, -1, keepdims=True)
        return Quaternion(scalar, _like(X, self.scalar) * w + cross(w, vector))

    def pairing(self, E: Float[Array, "*#n 3"]) -> Float[Array, "*n 6"]:
        E = _like(self.vector, E)
        turning = (self.scalar * E + cross(self.vector, E)) / 2
        return jnp.concatenate([turning, jnp.zeros_like(turning)], -1)


class RowsOfLink:
    """Rows of one link with the same y, along a motion: E y, E y', E y''.

    axes: E of each row, in world axes. y: in world axes from the origin of S. path: of the link.
    S: motion subspaces of the path, signed. v, vdot: of the tree.
    """

    def __init__(
        self,
        path: Path,
        S: Float[Array, "path 6"],
        y: Turned,
        axes: Float[Array, "rows 3"],
        *,
        v: Float[Array, " nv"],
        vdot: Float[Array, " nv"],
    ):
        self.path = path
        self.y = y
        self.S = S
        self.axes = axes
        self.nv: int = len(v)
        of_path = lambda x: static_take(x, path.dofs)
        before = np.tril(np.ones((len(path.dofs),) * 2), -1)
        sum_before = lambda x: jnp.sum(before[:, :, None] * x[None], 1)
        self._sum_before, self._of_path = sum_before, of_path
        rates = S * of_path(v)[:, None]
        V = sum_before(rates)
        products = motion_cross(V, rates)
        A = sum_before(S * of_path(vdot)[:, None] + products)
        self.first: Float[Array, "path 6"] = motion_cross(V, S)
        self.second: Float[Array, "path 6"] = motion_cross(A, S) + motion_cross(V, self.first)
        V, A = jnp.sum(rates, 0), jnp.sum(S * of_path(vdot)[:, None] + products, 0)
        velocity = y.by(V)
        acceleration = y.by(A).plus(velocity.by(V))
        # derivatives of y, y' and y'' by the coordinates
        self.of_y: Turned = y.by(S)
        self.of_velocity: Turned = velocity.by(S).plus(y.by(self.first))
        self.of_acceleration: Turned = acceleration.by(S).plus(
            y.by(self.second), velocity.by(2 * self.first)
        )
        self.acceleration: Float[Array, " rows"] = dot(axes, acceleration.vector[None])

    def _place(self) -> np.ndarray:
        place = np.full(self.nv, len(self.path.dofs))
        place[self.path.dofs] = np.arange(len(self.path.dofs))
        return place

    def over_coordinates(self, x: Float[Array, "*n path"]) -> Float[Array, "*n nv"]:
        """Return values over all coordinates, zero outside of the path, in the last axis."""
        return jnp.moveaxis(static_take(jnp.moveaxis(x, -1, 0), self._place()), 0, -1)

    def _over_pairs(self, x: Float[Array, "path path"]) -> Float[Array, "nv nv"]:
        above = np.tri(len(self.path.dofs), dtype=bool)
        return self.over_coordinates(self.over_coordinates(sorted_pairs(x, above)).T)

    def _pair(
        self, rows: Float[Array, "path 6"], columns: Float[Array, "path 6"]
    ) -> Float[Array, "path path"]:
        return dot(rows[:, None], columns[None])

    def jacobian(self) -> Float[Array, "rows 3 nv"]:
        """Return the derivatives of the rows E y'' by q, v and vdot."""
        parts = (self.of_acceleration.vector, 2 * self.of_velocity.vector, self.of_y.vector)
        stacked = jnp.stack(parts)
        return self.over_coordinates(dot(self.axes[:, None, None], stacked[None]))

    def rates(self) -> Float[Array, "rows nv"]:
        """Return the derivatives of the rates E y' by the velocity."""
        return self.over_coordinates(dot(self.axes[:, None], self.of_y.vector[None]))

    def force_stiffness(self, f: Float[Array, " rows"]) -> Float[Array, "nv nv"]:
        """Return the derivatives of the force of the rows' multipliers by q."""
        force = jnp.sum(self.axes * f[:, None], 0)
        return self._over_pairs(self._pair(self.of_y.pairing(force), self.S))

    def hessian(
        self,
        multipliers: Float[Array, " rows"],
        f: Float[Array, " rows"],
        virtual: Float[Array, " nv"],
    ) -> tuple[Float[Array, "3 nv"], Float[Array, "4 nv nv"], Float[Array, "rows nv"]]:
        """Return the derivatives of multipliers times E y'', less the power of f on a virtual
        velocity: gradient [3 nv], the blocks [4 nv nv] of `TreeMotion.hessian`, and the second
        derivatives [rows nv] by f and q."""
        E = jnp.sum(self.axes * multipliers[:, None], 0)
        force = jnp.sum(self.axes * f[:, None], 0)
        rates, S, y = self.S * self._of_path(virtual)[:, None], self.S, self.y
        of_virtual = motion_cross(self._sum_before(rates), S)
        velocity = y.by(jnp.sum(rates, 0))
        by_q = velocity.by(S).plus(y.by(of_virtual))
        gradient = [
            dot(self.of_acceleration.vector, E[None]) - dot(by_q.vector, force[None]),
            2 * dot(self.of_velocity.vector, E[None]),
            dot(self.of_y.vector, E[None]),
        ]
        along = self.of_acceleration.pairing(E) - by_q.pairing(force)
        of_y, of_velocity = self.of_y.pairing(E), self.of_velocity.pairing(E)
        pair = self._pair
        qq = pair(along, S) + pair(of_y, self.second) + 2 * pair(of_velocity, self.first)
        qq = qq - pair(self.of_y.pairing(force), of_virtual)
        qv = 2 * (pair(of_velocity, S) + pair(of_y, self.first))
        qa = self._over_pairs(pair(of_y, S))
        blocks = jnp.stack([self._over_pairs(qq), self._over_pairs(qv), 2 * qa, qa])
        by_f = -self.over_coordinates(dot(self.axes[:, None], by_q.vector[None]))
        return self.over_coordinates(jnp.stack(gradient)), blocks, by_f


def rows_of_links(
    chain: Chain,
    kin: Kinematics,
    table: LinkRows,
    v: Float[Array, " nv"],
    vdot: Float[Array, " nv"],
) -> list[tuple[np.ndarray, RowsOfLink]]:
    """Return the rows of links, each with its places in the table."""
    poses, out = link_poses(chain, kin, table), []
    for i, (link, parent, real) in enumerate(zip(table.links, table.parent, table.real)):
        path = Path.between(chain, int(parent), int(real))
        own = np.flatnonzero(table.rows // 6 == link)
        S = _subspaces(chain, kin, path, int(real))
        for linear in (False, True):
            places = own[(table.rows[own] % 6 >= 3) == linear]
            if len(places):
                y, axes = _linear(poses, i) if linear else _angular(poses, i, table.freedoms[i])
                axes = static_take(axes, table.rows[places] % 3)
                out.append((places, RowsOfLink(path, S, y, axes, v=v, vdot=vdot)))
    return out


def _subspaces(chain: Chain, kin: Kinematics, path: Path, real: int) -> Float[Array, "path 6"]:
    """Return the signed motion subspaces of a path, about the origin of the real link's root."""
    S, row = static_take(kin.S, path.dofs), chain.topology.dof_row[path.dofs]
    if np.any(np.array(chain.topology.root)[row] != chain.topology.root[real]):
        away = kin.root_position[real][None] - static_take(kin.root_position, row)
        S = jnp.concatenate([S[:, :3], S[:, 3:] + cross(S[:, :3], away)], -1)
    return S * path.sign[:, None]


def _linear(poses: LinkPoses, i: int) -> tuple[Turned, Float[Array, "3 3"]]:
    """Return the point and the axes of a link's translations."""
    return Turned(jnp.ones_like(poses.of_real[i, :1]), poses.of_real[i]), poses.base[i].T


def _angular(poses: LinkPoses, i: int, free: tuple[bool, ...]):
    """Return y and the axes of a link's rotations."""
    base, quat = poses.base[i], poses.quat[i]
    if not any(free):
        quat = jnp.where(quat[0] < 0, -quat, quat)
        return Quaternion(quat[:1], matvec(base, quat[1:])), 2 * base.T
    axis, rows = rotation_table(free)
    direction = matvec(base, quat_matrix(quat)[:, axis])
    return Turned(jnp.zeros_like(direction[:1]), direction), matvec(base[None], jnp.asarray(rows))
