"""First and second derivatives of inverse dynamics in closed form, for trees of hinges and slides.

A small change of coordinate i displaces every body below joint i along the motion subspace S_i.
Derivatives of twists V and accelerations A follow from two motion vectors of each joint:

    S_dot = V_p x S,  S_ddot = A_p x S + V_p x S_dot,

where p is the row of the tree that the joint connects its body to. A_p includes gravity. With
multipliers of the forces as virtual velocities and W as their twists, second derivatives also need
W_p x S. Derivatives of forces are products of these vectors with sums over the bodies below a joint
(Featherstone 2008; Singh, Russell and Wensing 2022).

Spatial vectors are in world axes about the root's origin, the angular part first. The force of
velocity products of a body is V x* I V. Its derivative along a motion vector X, with the change of
the body's acceleration by V x X taken out, is that of Singh et al.:

    2 B X = V x* I X - I (V x X) + X x* I V = (C w, 2 w x p).

w is the angular part of X, p the linear momentum of the body, and C a 3 x 3 matrix that the code
calls `coriolis`.
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

    mass: kg. first_moment: mass times centre of mass (kg m). inertia: about the root's origin
        (kg m^2).
    force: wrench that the motion needs (N m, N).
    coriolis: C of the module's docstring. momentum: linear momentum (kg m/s). Both are of V.
    """

    mass: Float[Array, "nv 1"]
    first_moment: Float[Array, "nv 3"]
    inertia: Float[Array, "nv 3 3"]
    force: Vectors
    coriolis: Float[Array, "nv 3 3"]
    momentum: Float[Array, "nv 3"]


class VirtualBelow(NamedTuple):
    """Sums over the bodies below each coordinate's joint that depend on the virtual twists W.

    coriolis, momentum: as in `Below`, with W in place of V.
    momenta: angular and linear momentum of W.
    products: (2 B)^T W, the derivative by the bodies' angular velocity of the virtual power of the
        velocity products.
    """

    coriolis: Float[Array, "nv 3 3"]
    momentum: Float[Array, "nv 3"]
    momenta: Vectors
    products: Float[Array, "nv 3"]


def force_cross(a: Float[Array, "*#n 6"], f: Float[Array, "*#n 6"]) -> Float[Array, "*n 6"]:
    """Return the spatial product a x* f of a motion vector and a force."""
    (w, v), (n, force) = angular_linear(a), angular_linear(f)
    return jnp.concatenate([cross(w, n) + cross(v, force), cross(w, force)], -1)


def dot(a: Float[Array, "*#n k"], b: Float[Array, "*#n k"]) -> Float[Array, "*n"]:
    """Return the dot products over the last axis, as an elementwise product and a sum."""
    return jnp.sum(a * b, -1)


def _outer(a, b) -> Float[Array, "*n 3 3"]:
    """Return the outer products a b^T over the last axis."""
    return a[..., :, None] * b[..., None, :]


def _pure_moment(moment: Float[Array, "*n 3"]) -> Float[Array, "*n 6"]:
    """Return the spatial force with this moment and no linear force."""
    return jnp.concatenate([moment, jnp.zeros_like(moment)], -1)


def _sums(top: Topology, parts: list) -> list:
    """Return, for each array [rows ...], the sums [nv ...] over the rows below each joint."""
    shapes = [x.shape[1:] for x in parts]
    flat = jnp.concatenate([x.reshape(len(x), -1) for x in parts], -1)
    below = static_take(accumulate_to_root(top, flat), top.dof_row)
    ends = np.cumsum([int(np.prod(s)) for s in shapes])
    cut = [below[:, a:b] for a, b in zip((0, *ends), ends)]
    return [x.reshape(-1, *s) for x, s in zip(cut, shapes)]


def ancestors(top: Topology) -> np.ndarray:
    """Return the mask [nv nv] of pairs (i, k) where joint k is joint i or an ancestor of it."""
    row = top.dof_row
    return top.ancestor_mask[row[:, None], row[None]]


def symmetric_from_ancestors(
    values: Float[Array, "nv nv"], above: np.ndarray
) -> Float[Array, "nv nv"]:
    """Return the symmetric matrix from its entries in the mask `above` of `ancestors`."""
    half = jnp.where(above, values, 0)
    return half + jnp.where(above & ~np.eye(len(above), dtype=bool), values, 0).T


class TreeMotion:
    """Inverse dynamics of a tree at one motion (q, v, vdot), with its derivatives.

    kin: kinematics at q. v, vdot: of the tree's coordinates.
    gravity: whether forces include the bodies' weight.
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
        self.S_dot: Vectors = motion_cross(V_p, S)
        self.S_ddot: Vectors = motion_cross(A_p, S) + motion_cross(V_p, self.S_dot)
        self._set_bodies(V, A)

    def _above(self, X: Float[Array, "rows 6"]) -> Vectors:
        """Return, for each joint, the value of its parent row."""
        return static_take(X, np.array(self.top.parent)[self.top.dof_row])

    def _momenta(
        self, X: Float[Array, "rows 6"]
    ) -> tuple[Float[Array, "rows 3"], Float[Array, "rows 3"]]:
        """Return the linear momentum and the angular momentum about the root's origin.

        X: twists of the rows.
        """
        w, u = angular_linear(X)
        p = self.chain.mass[:, None] * (u + cross(w, self.c))
        return p, matvec(self.J, w) + cross(self.c, p)

    def _coriolis(self, X, p, L):
        """Return C [rows 3 3] of the module's docstring. p, L: momenta of the twists X."""
        half = jnp.sum(skew(X[:, :3])[..., :, :, None] * self.J[..., None, :, :], -2)
        half = half - _outer(self.c, p)
        square = 2 * dot(self.c, p)[:, None, None] * np.eye(3)[None]
        return half + jnp.swapaxes(half, -1, -2) + square - skew(L)

    def _set_bodies(self, V, A) -> None:
        """Set what depends on the bodies' inertia: per row, and summed below each joint."""
        chain, R = self.chain, self.kin.R
        c = self.kin.r + matvec(R, chain.com)
        self.c: Float[Array, "rows 3"] = c
        rotated = jnp.sum(R[..., :, :, None] * chain.symmetric_inertia[..., None, :, :], -2)
        self.J: Float[Array, "rows 3 3"] = jnp.sum(
            rotated[..., :, None, :] * R[..., None, :, :], -1
        )
        mass = chain.mass[:, None]
        (w, u), (alpha, acceleration) = angular_linear(V), angular_linear(A)
        acceleration = acceleration + cross(alpha, c) + cross(w, u + cross(w, c))
        force = mass * acceleration
        moment = matvec(self.J, alpha) + cross(w, matvec(self.J, w)) + cross(c, force)
        p, L = self._momenta(V)
        self.row_coriolis: Float[Array, "rows 3 3"] = self._coriolis(V, p, L)
        self.row_momentum: Float[Array, "rows 3"] = p
        square = dot(c, c)[:, None, None] * np.eye(3)[None] - _outer(c, c)
        wrench = jnp.concatenate([moment, force], -1)
        inertia = self.J + mass[..., None] * square
        parts = [mass, mass * c, inertia, wrench, self.row_coriolis, p]
        self.below: Below = Below(*_sums(self.top, parts))

    def _inertia_times(self, X: Vectors) -> Vectors:
        """Return I X, with the spatial inertia I of the bodies below each joint."""
        (w, u), b = angular_linear(X), self.below
        moment = matvec(b.inertia, w) + cross(b.first_moment, u)
        return jnp.concatenate([moment, b.mass * u - cross(b.first_moment, w)], -1)

    @staticmethod
    def _coriolis_product(coriolis, momentum, X: Vectors) -> Vectors:
        """Return 2 B X."""
        w = X[:, :3]
        return jnp.concatenate([matvec(coriolis, w), 2 * cross(w, momentum)], -1)

    @staticmethod
    def _coriolis_transpose_product(coriolis, momentum, X: Vectors) -> Float[Array, "nv 3"]:
        """Return the angular part of (2 B)^T X; its linear part is zero."""
        w, u = angular_linear(X)
        return matvec(jnp.swapaxes(coriolis, -1, -2), w) + 2 * cross(momentum, u)

    def force(self) -> Float[Array, " nv"]:
        """Return the generalized forces of inverse dynamics (N m, N), without armature."""
        return dot(self.S, self.below.force)

    def _columns(self):
        """Return the derivatives of the wrench below each joint by q, v, vdot of that joint."""
        b, S = self.below, self.S
        two_B = lambda X: self._coriolis_product(b.coriolis, b.momentum, X)
        by_q = self._inertia_times(self.S_ddot) + two_B(self.S_dot) + force_cross(S, b.force)
        by_v = 2 * self._inertia_times(self.S_dot) + two_B(S)
        return by_q, by_v, self._inertia_times(S)

    def jacobian(self) -> Float[Array, "nv 3 nv"]:
        """Return the derivatives of the forces by q, v and vdot."""
        b, S = self.below, self.S
        columns = jnp.stack(self._columns())
        inertia = columns[2]
        products = self._coriolis_transpose_product(b.coriolis, b.momentum, S)
        motion = jnp.stack([self.S_ddot, 2 * self.S_dot, S])
        velocity_products = jnp.stack([self.S_dot, S, jnp.zeros_like(S)])[..., :3]
        # entry (i, k) where joint i is joint k or an ancestor of it, and where it is a descendant
        upper = dot(S[:, None, None], columns[None])
        lower = dot(inertia[:, None, None], motion[None])
        lower = lower + dot(products[:, None, None], velocity_products[None])
        above, is_above = self.above[:, None], self.above.T[:, None]
        return jnp.where(is_above, upper, jnp.where(above, lower, 0))

    def hessian(
        self, multipliers: Float[Array, " nv"]
    ) -> tuple[Float[Array, "3 nv"], Float[Array, "4 nv nv"]]:
        """Return derivatives of the function multipliers . force.

        Its gradient by q, v and vdot [3 nv], and its second derivatives by q and q, q and v, v and
        v, q and vdot [4 nv nv].
        """
        S, S_dot, S_ddot, b = self.S, self.S_dot, self.S_ddot, self.below
        W = twists(self.chain, self.kin, multipliers)
        w, virtual = motion_cross(self._above(W), S), self._virtual(W)
        products = _pure_moment(virtual.products)
        two_B = lambda X: self._coriolis_product(virtual.coriolis, virtual.momentum, X)
        by_q, by_v, inertia = self._columns()
        momenta = force_cross(S, virtual.momenta)
        by_S_ddot = self._inertia_times(w) + momenta
        by_S_dot = force_cross(S, products) + 2 * force_cross(S_dot, virtual.momenta)
        by_S_dot = by_S_dot - two_B(S_dot)
        by_S_dot = by_S_dot + _pure_moment(
            self._coriolis_transpose_product(b.coriolis, b.momentum, w)
        )
        at = _pure_moment(self._coriolis_transpose_product(virtual.coriolis, virtual.momentum, S))
        pair = lambda rows, columns: dot(rows[:, None], columns[None])
        qq = pair(by_q, w) + pair(by_S_ddot, S_ddot) + pair(by_S_dot, S_dot)
        blocks = [
            symmetric_from_ancestors(qq, self.above),
            self._choose(
                2 * pair(by_S_ddot, S_dot) + pair(by_S_dot, S), pair(w, by_v) - pair(S_dot, at)
            ),
            symmetric_from_ancestors(pair(2 * momenta - two_B(S), S), self.above),
            self._choose(pair(by_S_ddot, S), pair(w, inertia)),
        ]
        gradient = [
            dot(w, b.force) + dot(S_ddot, virtual.momenta) + dot(S_dot, products),
            2 * dot(S_dot, virtual.momenta) + dot(S, products),
            dot(S, virtual.momenta),
        ]
        return jnp.stack(gradient), jnp.stack(blocks)

    def _choose(self, upper: Float[Array, "nv nv"], lower: Float[Array, "nv nv"]):
        """Return `upper` where the column's joint is the row's or an ancestor, `lower` where it is
        a descendant, and zero elsewhere."""
        return jnp.where(self.above, upper, jnp.where(self.above.T, lower, 0))

    def _virtual(self, W: Float[Array, "rows 6"]) -> VirtualBelow:
        """Return the sums below each joint that depend on the virtual twists W."""
        p, L = self._momenta(W)
        w, u = angular_linear(W)
        transposed = jnp.swapaxes(self.row_coriolis, -1, -2)
        products = matvec(transposed, w) + 2 * cross(self.row_momentum, u)
        momenta = jnp.concatenate([L, p], -1)
        return VirtualBelow(*_sums(self.top, [self._coriolis(W, p, L), p, momenta, products]))
