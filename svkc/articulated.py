"""F3: articulated bodies (Featherstone chapter 7): M^-1 f on the tree without M, level by level.

In world axes about the root's origin articulated inertias add up along the tree as they are. All rows of a level are one array; a joint of fewer freedoms
than its level's widest has freedoms that are nothing: no motion, an inertia of one.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from svkc.chain import Chain
from svkc.inverse_dynamics import central_inertias
from svkc.kinematics import Kinematics, from_children
from svkc.spatial import inverse_positive, skew
from svkc.topology import V_SIZE, Topology


class Articulated(eqx.Module):
    """What `accelerations` needs, for each level below the world's: joint axes S [n, d, 6], U = S I^A [n, d, 6], (S I^A S^T)^-1 [n, d, d]."""

    S: list[Float[Array, "n d 6"]]
    U: list[Float[Array, "n d 6"]]
    inverse: list[Float[Array, "n d d"]]


def tables(top: Topology) -> list[np.ndarray]:
    """[n, d] for each level below the world's: the coordinates of each row's joint, nv where it has fewer than d."""
    found = []
    for first, last in top.levels[1:]:
        sizes = [V_SIZE[top.kind[i]] for i in range(first, last)]
        table = np.full((last - first, max(1, *sizes)), top.nv)
        for n, size in enumerate(sizes):
            table[n, :size] = np.arange(top.v_start[first + n], top.v_start[first + n] + size)
        found.append(table)
    return found


def body_inertias(chain: Chain, kin: Kinematics) -> Float[Array, "rows 6 6"]:
    """Spatial inertia of each row in world axes about its root's origin (Featherstone (2.63))."""
    (c, central), m = central_inertias(chain, kin), chain.mass[:, None, None]
    cx = skew(c)
    square = jnp.sum(cx[:, :, None, :] * cx[:, None, :, :], -1)
    upper = jnp.concatenate([central + m * square, m * cx], -1)
    lower = jnp.concatenate([-m * cx, m * jnp.eye(3, dtype=c.dtype)[None]], -1)
    return jnp.concatenate([upper, lower], -2)


def articulate(chain: Chain, kin: Kinematics, free: Bool[Array, " nv"] | None = None) -> Articulated:
    """Articulated inertias from the leaves to the roots. free: coordinates that are not locked (None: all)."""
    top, own = chain.topology, body_inertias(chain, kin)
    S = kin.S if free is None else jnp.where(free[:, None], kin.S, 0)
    S = jnp.concatenate([S, jnp.zeros_like(S[:1])])
    more = jnp.zeros(chain.nv, S.dtype) if chain.armature is None else chain.armature
    more = more if free is None else jnp.where(free, more, 1)
    more = jnp.concatenate([more, jnp.ones(1, S.dtype)])
    out, below = Articulated([], [], []), None
    for level, table in reversed(list(enumerate(tables(top), 1))):
        first, last = top.levels[level]
        A = own[first:last] if below is None else own[first:last] + from_children(top, level, below)
        s = S[table]
        U = jnp.sum(s[:, :, :, None] * A[:, None], 2)
        D = jnp.sum(U[:, :, None] * s[:, None], -1) + more[table][:, :, None] * np.eye(table.shape[1])[None]
        inverse = inverse_positive(D)
        along = jnp.sum(inverse[..., None] * U[:, None], 2)
        below = A - jnp.sum(U[:, :, :, None] * along[:, :, None, :], 1)
        for kept, x in zip((out.S, out.U, out.inverse), (s, U, inverse), strict=True):
            kept.insert(0, x)
    return out


def _apply(A: Float[Array, "n i j"], x: Float[Array, "n j *k"]) -> Float[Array, "n i *k"]:
    return jnp.sum(A.reshape(*A.shape, *(1,) * (x.ndim - 2)) * x[:, None], 2)


def _carried(top: Topology, bodies: Articulated, f: Float[Array, "nv *k"]) -> list[tuple[Float[Array, "n d *k"], Float[Array, "n d *k"]]]:
    """For each level the forces that its joints are left with, those from below taken off, and the accelerations that these give each joint alone."""
    index = tables(top)
    f = jnp.concatenate([f, jnp.zeros_like(f[:1])])
    found, below = [], None
    for level in range(len(index), 0, -1):
        S, U, inverse, table = bodies.S[level - 1], bodies.U[level - 1], bodies.inverse[level - 1], index[level - 1]
        p = None if below is None else from_children(top, level, below)
        u = f[table] if p is None else f[table] - _apply(S, p)
        x = _apply(inverse, u)
        passed = _apply(jnp.swapaxes(U, 1, 2), x)
        below = passed if p is None else passed + p
        found.insert(0, (u, x))
    return found


def seen_by(top: Topology, bodies: Articulated, J: Float[Array, "rows nv"]) -> Float[Array, "rows rows"]:
    """J M^-1 J^T. M = L D L^T with a joint's block of D for each (Featherstone section 6.5), so that half the way to M^-1 J^T is enough."""
    parts = _carried(top, bodies, J.T)
    u, x = (jnp.concatenate([part[i].reshape(-1, J.shape[0]) for part in parts]) for i in (0, 1))
    # a sum, not a `dot`, which XLA's CPU backend would not put into one kernel with what is around it
    return jnp.sum(u[:, :, None] * x[:, None], 0)


def accelerations(top: Topology, bodies: Articulated, f: Float[Array, " nv"]) -> Float[Array, " nv"]:
    """M^-1 f: the joints' accelerations at rest, without gravity (Featherstone table 7.1)."""
    index, forces = tables(top), [x for _, x in _carried(top, bodies, f)]
    found, above = [], None
    for level in range(1, len(index) + 1):
        S, U, inverse, x = bodies.S[level - 1], bodies.U[level - 1], bodies.inverse[level - 1], forces[level - 1]
        if above is not None:
            start, (first, last) = top.levels[level - 1][0], top.levels[level]
            a = above[np.array(top.parent)[first:last] - start]
            x = x - jnp.sum(inverse * jnp.sum(U * a[:, None], -1)[:, None], -1)
        moved = jnp.sum(S * x[..., None], 1)
        above = moved if above is None else a + moved
        found.append(x.ravel())
    order = np.concatenate([table.ravel() for table in index])
    return jnp.concatenate(found)[np.argsort(order, kind="stable")[: top.nv]]


def by_bodies(chain: Chain, kin: Kinematics) -> Articulated:
    """Names articulated bodies as the way to accelerations, for `svkc.Dynamics(inertia=...)`."""
    return articulate(chain, kin)
