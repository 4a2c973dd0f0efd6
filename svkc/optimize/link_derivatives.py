"""First and second derivatives of the links' rows in closed form, for trees of hinges and slides.

In axes of a link's parent, the gap of a row is E . y: the dot product of a constant vector E and a
vector y that moves with the real link. y is a point of the real link, a direction fixed in it, or
the vector part of its orientation as a quaternion. A motion vector X of the real link changes y at
a rate G(X) y, which is linear in X and in y.

The joints between the parent and the real link are one open chain, along which each joint moves
everything after it. S_dot = V x S and S_ddot = A x S + V x S_dot are as in `tree_derivatives`, with
twists V and accelerations A relative to the parent.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc._jax.static_gather import static_take
from svkc.model.chain import Chain
from svkc.optimize.loop_rows import LinkPoses, LinkRows, link_poses, rotation_table
from svkc.optimize.tree_derivatives import dot, symmetric_from_ancestors
from svkc.tree.kinematics import Kinematics
from svkc.tree.spatial import cross, matvec, motion_cross, quat_matrix


class LinkPath(NamedTuple):
    """The joints on the path through the tree from a link's parent to its real link.

    dofs: indices in v of their coordinates, in the order of the path.
    sign: 1 for joints that move the real link alone, -1 for those that move the parent alone.
    """

    dofs: np.ndarray
    sign: np.ndarray

    @classmethod
    def between(cls, chain: Chain, parent: int, real: int) -> "LinkPath":
        """Return the path between two rows of the tree. Joints that move both are left out."""
        top = chain.topology
        moves = [top.ancestor_mask[row, top.dof_row] for row in (parent, real)]
        up, down = (np.flatnonzero(x & ~y) for x, y in (moves, moves[::-1]))
        return cls(np.concatenate([up[::-1], down]), np.repeat([-1.0, 1.0], [len(up), len(down)]))


def _like(x: Array, y: Array) -> Array:
    """Return y with axes of size 1 in front, until y has as many axes as x."""
    return y.reshape((1,) * (x.ndim - y.ndim) + y.shape)


class HomogeneousVector(NamedTuple):
    """Points and directions y = (scalar, vector) that move with a body.

    scalar: 1 for points, 0 for directions and for rates of either.
    """

    scalar: Array
    vector: Float[Array, "*n 3"]

    def rate(self, X: Float[Array, "*n 6"]) -> "HomogeneousVector":
        """Return G(X) y, the rate of y under motion vectors X, angular part first."""
        scalar, vector = _like(X, self.scalar), _like(X, self.vector)
        vector = cross(X[..., :3], vector) + X[..., 3:] * scalar
        return type(self)(jnp.zeros_like(vector[..., :1]), vector)

    def adjoint(self, E: Float[Array, "*#n 3"]) -> Float[Array, "*n 6"]:
        """Return the spatial force F with F . X = E . G(X) y for every motion vector X."""
        E = _like(self.vector, E)
        return jnp.concatenate([cross(self.vector, E), self.scalar * E], -1)

    def add(self, *others: "HomogeneousVector") -> "HomogeneousVector":
        """Return the sum of this and other vectors."""
        scalar = sum((x.scalar for x in others), self.scalar)
        return type(self)(scalar, sum((x.vector for x in others), self.vector))


class Quaternion(HomogeneousVector):
    """Quaternions (scalar, vector), whose rate is half of the angular velocity times them."""

    def rate(self, X: Float[Array, "*n 6"]) -> "Quaternion":
        w, vector = X[..., :3] / 2, _like(X, self.vector)
        scalar = -jnp.sum(w * vector, -1, keepdims=True)
        return Quaternion(scalar, _like(X, self.scalar) * w + cross(w, vector))

    def adjoint(self, E: Float[Array, "*#n 3"]) -> Float[Array, "*n 6"]:
        E = _like(self.vector, E)
        turning = (self.scalar * E + cross(self.vector, E)) / 2
        return jnp.concatenate([turning, jnp.zeros_like(turning)], -1)


class RowsOfLink:
    """Rows of one link with the same y at one motion: E . y, E . y' and E . y''.

    Primes are derivatives by time in axes of the parent.

    path: from the link's parent to its real link.
    S: motion subspaces of the path in world axes, times their signs.
    y: in world axes, from the origin of S. axes: E of each row, in world axes.
    v, vdot: of the tree.
    """

    def __init__(
        self,
        path: LinkPath,
        S: Float[Array, "path 6"],
        y: HomogeneousVector,
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
        self.S_dot: Float[Array, "path 6"] = motion_cross(V, S)
        self.S_ddot: Float[Array, "path 6"] = motion_cross(A, S) + motion_cross(V, self.S_dot)
        V, A = jnp.sum(rates, 0), jnp.sum(S * of_path(vdot)[:, None] + products, 0)
        velocity = y.rate(V)
        acceleration = y.rate(A).add(velocity.rate(V))
        # derivatives of y, y' and y'' by the coordinates
        self.of_y: HomogeneousVector = y.rate(S)
        self.of_velocity: HomogeneousVector = velocity.rate(S).add(y.rate(self.S_dot))
        self.of_acceleration: HomogeneousVector = acceleration.rate(S).add(
            y.rate(self.S_ddot), velocity.rate(2 * self.S_dot)
        )
        self.acceleration: Float[Array, " rows"] = dot(axes, acceleration.vector[None])

    def _place(self) -> np.ndarray:
        """Return, for each coordinate [nv], its index in the path; others: the path's length."""
        place = np.full(self.nv, len(self.path.dofs))
        place[self.path.dofs] = np.arange(len(self.path.dofs))
        return place

    def over_coordinates(self, x: Float[Array, "*n path"]) -> Float[Array, "*n nv"]:
        """Return values of the path's coordinates as values of all, zero for the others."""
        return jnp.moveaxis(static_take(jnp.moveaxis(x, -1, 0), self._place()), 0, -1)

    def _over_pairs(self, x: Float[Array, "path path"]) -> Float[Array, "nv nv"]:
        """Return the symmetric matrix over all coordinates from its lower half over the path."""
        above = np.tri(len(self.path.dofs), dtype=bool)
        return self.over_coordinates(self.over_coordinates(symmetric_from_ancestors(x, above)).T)

    def _pair(
        self, rows: Float[Array, "path 6"], columns: Float[Array, "path 6"]
    ) -> Float[Array, "path path"]:
        """Return the dot products of all pairs of vectors."""
        return dot(rows[:, None], columns[None])

    def jacobian(self) -> Float[Array, "rows 3 nv"]:
        """Return the derivatives of E . y'' by q, v and vdot."""
        parts = (self.of_acceleration.vector, 2 * self.of_velocity.vector, self.of_y.vector)
        stacked = jnp.stack(parts)
        return self.over_coordinates(dot(self.axes[:, None, None], stacked[None]))

    def rates(self) -> Float[Array, "rows nv"]:
        """Return the derivatives of E . y' by v, which are also those of E . y by q."""
        return self.over_coordinates(dot(self.axes[:, None], self.of_y.vector[None]))

    def force_stiffness(self, f: Float[Array, " rows"]) -> Float[Array, "nv nv"]:
        """Return the derivatives by q of the generalized force J^T f of the multipliers f."""
        force = jnp.sum(self.axes * f[:, None], 0)
        return self._over_pairs(self._pair(self.of_y.adjoint(force), self.S))

    def hessian(
        self,
        multipliers: Float[Array, " rows"],
        f: Float[Array, " rows"],
        virtual: Float[Array, " nv"],
    ) -> tuple[Float[Array, "3 nv"], Float[Array, "4 nv nv"], Float[Array, "rows nv"]]:
        """Return derivatives of the function multipliers . (E . y'') - virtual . J^T f.

        Its gradient by q, v and vdot [3 nv], its second derivatives by pairs of these [4 nv nv] in
        the order of `TreeMotion.hessian`, and its second derivatives by f and q [rows nv].

        f: multipliers of the rows in the dynamics. virtual: multipliers of the dynamics' rows.
        """
        E = jnp.sum(self.axes * multipliers[:, None], 0)
        force = jnp.sum(self.axes * f[:, None], 0)
        rates, S, y = self.S * self._of_path(virtual)[:, None], self.S, self.y
        of_virtual = motion_cross(self._sum_before(rates), S)
        velocity = y.rate(jnp.sum(rates, 0))
        by_q = velocity.rate(S).add(y.rate(of_virtual))
        gradient = [
            dot(self.of_acceleration.vector, E[None]) - dot(by_q.vector, force[None]),
            2 * dot(self.of_velocity.vector, E[None]),
            dot(self.of_y.vector, E[None]),
        ]
        along = self.of_acceleration.adjoint(E) - by_q.adjoint(force)
        of_y, of_velocity = self.of_y.adjoint(E), self.of_velocity.adjoint(E)
        pair = self._pair
        qq = pair(along, S) + pair(of_y, self.S_ddot) + 2 * pair(of_velocity, self.S_dot)
        qq = qq - pair(self.of_y.adjoint(force), of_virtual)
        qv = 2 * (pair(of_velocity, S) + pair(of_y, self.S_dot))
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
    """Return the rows of links, each group with the indices of its rows in the table.

    A link has up to two groups: its rotation rows, and its translation rows.
    """
    poses, out = link_poses(chain, kin, table), []
    for i, (link, parent, real) in enumerate(zip(table.links, table.parent, table.real)):
        path = LinkPath.between(chain, int(parent), int(real))
        own = np.flatnonzero(table.rows // 6 == link)
        S = _subspaces(chain, kin, path, int(real))
        for linear in (False, True):
            places = own[(table.rows[own] % 6 >= 3) == linear]
            if len(places):
                y, axes = _linear(poses, i) if linear else _angular(poses, i, table.freedoms[i])
                axes = static_take(axes, table.rows[places] % 3)
                out.append((places, RowsOfLink(path, S, y, axes, v=v, vdot=vdot)))
    return out


def _subspaces(chain: Chain, kin: Kinematics, path: LinkPath, real: int) -> Float[Array, "path 6"]:
    """Return the signed motion subspaces of a path, about the origin of the real link's root."""
    S, row = static_take(kin.S, path.dofs), chain.topology.dof_row[path.dofs]
    if np.any(np.array(chain.topology.root)[row] != chain.topology.root[real]):
        away = kin.root_position[real][None] - static_take(kin.root_position, row)
        S = jnp.concatenate([S[:, :3], S[:, 3:] + cross(S[:, :3], away)], -1)
    return S * path.sign[:, None]


def _linear(poses: LinkPoses, i: int) -> tuple[HomogeneousVector, Float[Array, "3 3"]]:
    """Return y, the origin of the real link's frame, and E of the three translation rows."""
    return HomogeneousVector(jnp.ones_like(poses.of_real[i, :1]), poses.of_real[i]), poses.base[i].T


def _angular(poses: LinkPoses, i: int, free: tuple[bool, ...]):
    """Return y and E of the three rotation rows. free: which rotations are free."""
    base, quat = poses.base[i], poses.quat[i]
    if not any(free):
        quat = jnp.where(quat[0] < 0, -quat, quat)
        return Quaternion(quat[:1], matvec(base, quat[1:])), 2 * base.T
    axis, rows = rotation_table(free)
    direction = matvec(base, quat_matrix(quat)[:, axis])
    return HomogeneousVector(jnp.zeros_like(direction[:1]), direction), matvec(
        base[None], jnp.asarray(rows)
    )
