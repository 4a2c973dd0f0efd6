"""First and second derivatives of inverse dynamics in closed form, for trees of hinges and slides.

A displacement of coordinate i turns everything below joint i by the motion subspace S_i. All first
derivatives of a row's motion then follow from three motion vectors of a joint, in which p is the
row above the joint: V_p x S_i, A_p x S_i + V_p x (V_p x S_i), and W_p x S_i for a virtual twist W.
Derivatives of forces are products of these with sums over the bodies below a joint (Featherstone
2008; Singh, Russell and Wensing 2022). Spatial vectors are in world axes about the root's origin.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc._jax.static_gather import static_take
from svkc.model.chain import Chain
from svkc.model.topology import Topology
from svkc.tree.kinematics import Kinematics, twists, velocity_products
from svkc.tree.spatial import angular_linear, cross, matvec, motion_cross, skew
from svkc.tree.traversal import accumulate_from_root, accumulate_to_root, sum_dofs_per_row

Vectors = Float[Array, "nv 6"]


class Below(NamedTuple):
    """Sums over the bodies below each coordinate's joint.

    mass, first, second: of the inertia about the root's origin: kg, kg m, kg m^2.
    force: of the motion. turning, momentum: of the twists V, such that the force of velocity
        products changes by (turning w, 2 w x momentum) with a twist of angular velocity w.
    """

    mass: Float[Array, "nv 1"]
    first: Float[Array, "nv 3"]
    second: Float[Array, "nv 3 3"]
    force: Vectors
    turning: Float[Array, "nv 3 3"]
    momentum: Float[Array, "nv 3"]


class VirtualBelow(NamedTuple):
    """Sums over the bodies below each coordinate's joint that depend on the virtual twists W.

    turning, momentum: as of `Below`, of W. momenta: angular and linear momentum of W.
    products: derivative of the virtual power by the angular velocity in the velocity products.
    """

    turning: Float[Array, "nv 3 3"]
    momentum: Float[Array, "nv 3"]
    momenta: Vectors
    products: Float[Array, "nv 3"]


def force_cross(a: Float[Array, "*#n 6"], f: Float[Array, "*#n 6"]) -> Float[Array, "*n 6"]:
    """Return the spatial product a x* f of a motion vector and a force."""
    (w, v), (n, force) = angular_linear(a), angular_linear(f)
    return jnp.concatenate([cross(w, n) + cross(v, force), cross(w, force)], -1)


def dot(a: Float[Array, "*#n k"], b: Float[Array, "*#n k"]) -> Float[Array, "*n"]:
    """Return products of vectors, without a matrix product."""
    return jnp.sum(a * b, -1)


def _outer(a, b) -> Float[Array, "*n 3 3"]:
    return a[..., :, None] * b[..., None, :]


def _angular(moment: Float[Array, "*n 3"]) -> Float[Array, "*n 6"]:
    """Return the force that is a moment alone."""
    return jnp.concatenate([moment, jnp.zeros_like(moment)], -1)


def _sums(top: Topology, parts: list) -> list:
    """Return, for each coordinate, the sums of arrays of rows over the rows below its joint."""
    shapes = [x.shape[1:] for x in parts]
    flat = jnp.concatenate([x.reshape(len(x), -1) for x in parts], -1)
    below = static_take(accumulate_to_root(top, flat), top.dof_row)
    ends = np.cumsum([int(np.prod(s)) for s in shapes])
    cut = [below[:, a:b] for a, b in zip((0, *ends), ends)]
    return [x.reshape(-1, *s) for x, s in zip(cut, shapes)]


def ancestors(top: Topology) -> np.ndarray:
    """Return the mask [nv nv]: whether the column's joint is the row's, or above."""
    row = top.dof_row
    return top.ancestor_mask[row[:, None], row[None]]


def sorted_pairs(values: Float[Array, "nv nv"], above: np.ndarray) -> Float[Array, "nv nv"]:
    """Return the symmetric matrix from its entries whose column is the row or above."""
    half = jnp.where(above, values, 0)
    return half + jnp.where(above & ~np.eye(len(above), dtype=bool), values, 0).T


class TreeMotion:
    """A motion of a tree, with the derivatives of its inverse dynamics.

    kin: at q. v, vdot: of the tree's coordinates. gravity: whether forces include the weight.
    """

    def __init__(
        self,
        chain: Chain,
        kin: Kinematics,
        v: Float[Array, " nv"],
        vdot: Float[Array, " nv"],
        gravity: bool = True,
    ):
        self.chain = chain
        self.kin = kin
        self.top: Topology = chain.topology
        self.above: np.ndarray = ancestors(self.top)
        S = kin.S
        V = twists(chain, kin, v)
        joint = sum_dofs_per_row(self.top, S * vdot[:, None]) + velocity_products(chain, kin, V, v)
        A = accumulate_from_root(self.top, joint)
        if gravity:
            A = A - jnp.concatenate([jnp.zeros_like(chain.gravity), chain.gravity])[None]
        self.S: Vectors = S
        self.V: Float[Array, "rows 6"] = V
        V_p, A_p = self._above(V), self._above(A)
        self.first: Vectors = motion_cross(V_p, S)
        self.second: Vectors = motion_cross(A_p, S) + motion_cross(V_p, self.first)
        self._set_bodies(V, A)

    def _above(self, X: Float[Array, "rows 6"]) -> Vectors:
        """Return the values of the rows above the joints."""
        return static_take(X, np.array(self.top.parent)[self.top.dof_row])

    def _momenta(
        self, X: Float[Array, "rows 6"]
    ) -> tuple[Float[Array, "rows 3"], Float[Array, "rows 3"]]:
        """Return linear momentum, and angular momentum about the root's origin, of twists."""
        w, u = angular_linear(X)
        p = self.chain.mass[:, None] * (u + cross(w, self.c))
        return p, matvec(self.J, w) + cross(self.c, p)

    def _turning(self, X, p, L):
        """Return the derivative of the rows' inertia along twists, less the momentum's product."""
        half = jnp.sum(skew(X[:, :3])[..., :, :, None] * self.J[..., None, :, :], -2)
        half = half - _outer(self.c, p)
        square = 2 * dot(self.c, p)[:, None, None] * np.eye(3)[None]
        return half + jnp.swapaxes(half, -1, -2) + square - skew(L)

    def _set_bodies(self, V, A) -> None:
        chain, R = self.chain, self.kin.R
        c = self.kin.r + matvec(R, chain.com)
        self.c: Float[Array, "rows 3"] = c
        turned = jnp.sum(R[..., :, :, None] * chain.symmetric_inertia[..., None, :, :], -2)
        self.J: Float[Array, "rows 3 3"] = jnp.sum(turned[..., :, None, :] * R[..., None, :, :], -1)
        mass = chain.mass[:, None]
        (w, u), (alpha, acceleration) = angular_linear(V), angular_linear(A)
        acceleration = acceleration + cross(alpha, c) + cross(w, u + cross(w, c))
        force = mass * acceleration
        moment = matvec(self.J, alpha) + cross(w, matvec(self.J, w)) + cross(c, force)
        p, L = self._momenta(V)
        self.row_turning: Float[Array, "rows 3 3"] = self._turning(V, p, L)
        self.row_momentum: Float[Array, "rows 3"] = p
        square = dot(c, c)[:, None, None] * np.eye(3)[None] - _outer(c, c)
        wrench = jnp.concatenate([moment, force], -1)
        inertia = self.J + mass[..., None] * square
        parts = [mass, mass * c, inertia, wrench, self.row_turning, p]
        self.below: Below = Below(*_sums(self.top, parts))

    def _inertia_times(self, X: Vectors) -> Vectors:
        """Return the inertia below each joint times a motion vector of the joint."""
        (w, u), b = angular_linear(X), self.below
        moment = matvec(b.second, w) + cross(b.first, u)
        return jnp.concatenate([moment, b.mass * u - cross(b.first, w)], -1)

    @staticmethod
    def _turned(turning, momentum, X: Vectors) -> Vectors:
        w = X[:, :3]
        return jnp.concatenate([matvec(turning, w), 2 * cross(w, momentum)], -1)

    @staticmethod
    def _turned_transposed(turning, momentum, X: Vectors) -> Float[Array, "nv 3"]:
        w, u = angular_linear(X)
        return matvec(jnp.swapaxes(turning, -1, -2), w) + 2 * cross(momentum, u)

    def force(self) -> Float[Array, " nv"]:
        """Return the generalized forces."""
        return dot(self.S, self.below.force)

    def _columns(self):
        """Return the force below each joint by its own coordinate, its velocity, acceleration."""
        b, S = self.below, self.S
        turned = lambda X: self._turned(b.turning, b.momentum, X)
        by_q = self._inertia_times(self.second) + turned(self.first) + force_cross(S, b.force)
        by_v = 2 * self._inertia_times(self.first) + turned(S)
        return by_q, by_v, self._inertia_times(S)

    def jacobian(self) -> Float[Array, "nv 3 nv"]:
        """Return the derivatives of the forces by q, v and vdot."""
        b, S = self.below, self.S
        columns = jnp.stack(self._columns())
        inertia = columns[2]
        products = self._turned_transposed(b.turning, b.momentum, S)
        by_second = jnp.stack([self.second, 2 * self.first, S])
        by_first = jnp.stack([self.first, S, jnp.zeros_like(S)])[..., :3]
        # the row's joint above the column's, and below
        upper = dot(S[:, None, None], columns[None])
        lower = dot(inertia[:, None, None], by_second[None])
        lower = lower + dot(products[:, None, None], by_first[None])
        above, is_above = self.above[:, None], self.above.T[:, None]
        return jnp.where(is_above, upper, jnp.where(above, lower, 0))

    def hessian(
        self, multipliers: Float[Array, " nv"]
    ) -> tuple[Float[Array, "3 nv"], Float[Array, "4 nv nv"]]:
        """Return the derivatives of the forces' sum with multipliers: gradient [3 nv], and the
        second derivatives by q and q, q and v, v and v, q and vdot [4 nv nv]."""
        S, first, second, b = self.S, self.first, self.second, self.below
        W = twists(self.chain, self.kin, multipliers)
        w, virtual = motion_cross(self._above(W), S), self._virtual(W)
        products = _angular(virtual.products)
        turned = lambda X: self._turned(virtual.turning, virtual.momentum, X)
        by_q, by_v, inertia = self._columns()
        momenta = force_cross(S, virtual.momenta)
        of_second = self._inertia_times(w) + momenta
        of_first = force_cross(S, products) + 2 * force_cross(first, virtual.momenta)
        of_first = of_first - turned(first)
        of_first = of_first + _angular(self._turned_transposed(b.turning, b.momentum, w))
        at = _angular(self._turned_transposed(virtual.turning, virtual.momentum, S))
        pair = lambda rows, columns: dot(rows[:, None], columns[None])
        qq = pair(by_q, w) + pair(of_second, second) + pair(of_first, first)
        blocks = [
            sorted_pairs(qq, self.above),
            self._choose(
                2 * pair(of_second, first) + pair(of_first, S), pair(w, by_v) - pair(first, at)
            ),
            sorted_pairs(pair(2 * momenta - turned(S), S), self.above),
            self._choose(pair(of_second, S), pair(w, inertia)),
        ]
        gradient = [
            dot(w, b.force) + dot(second, virtual.momenta) + dot(first, products),
            2 * dot(first, virtual.momenta) + dot(S, products),
            dot(S, virtual.momenta),
        ]
        return jnp.stack(gradient), jnp.stack(blocks)

    def _choose(self, upper: Float[Array, "nv nv"], lower: Float[Array, "nv nv"]):
        """Return entries of `upper` whose column is the row or above, and of `lower` below."""
        return jnp.where(self.above, upper, jnp.where(self.above.T, lower, 0))

    def _virtual(self, W: Float[Array, "rows 6"]) -> VirtualBelow:
        p, L = self._momenta(W)
        w, u = angular_linear(W)
        transposed = jnp.swapaxes(self.row_turning, -1, -2)
        products = matvec(transposed, w) + 2 * cross(self.row_momentum, u)
        momenta = jnp.concatenate([L, p], -1)
        return VirtualBelow(*_sums(self.top, [self._turning(W, p, L), p, momenta, products]))
