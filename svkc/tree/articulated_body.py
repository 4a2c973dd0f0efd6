"""F3: articulated bodies (Featherstone chapter 7): M^-1 f on the tree without M, level by level.

In world axes about the root's origin articulated inertias add up along the tree as they are. All rows of a level are one array; a joint of fewer freedoms
than its level's widest has freedoms that are nothing: no motion, an inertia of one.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from svkc._jax.lanes_last import sum_by_few
from svkc._jax.static_gather import take
from svkc.model.chain import Chain
from svkc.model.topology import V_SIZE, Topology
from svkc.tree.inverse_dynamics import central_inertias
from svkc.tree.kinematics import LEVELS_UNROLLED, Kinematics
from svkc.tree.spatial import inverse_positive, skew


class Body(NamedTuple):
    """What `accelerations` needs of the bodies of one level: joint axes S, U = S I^A, (S I^A S^T)^-1."""

    S: Float[Array, "*levels n d 6"]
    U: Float[Array, "*levels n d 6"]
    inverse: Float[Array, "*levels n d d"]


class Level(NamedTuple):
    """The rows of one level below the world's; where there are fewer than n: one past the last row. Coordinates of each row's joint, nv where it has fewer
    than d; its children in the level below, as many as that has where there are fewer; its parent in the level above."""

    rows: np.ndarray
    dofs: np.ndarray
    children: np.ndarray
    parent: np.ndarray


@functools.cache
def levels(top: Topology) -> list[Level] | Level:
    """One for each level, as small as it can be; in deep trees all as large as the largest, stacked, for a loop over them.

    int32: jax (0.10) takes the same array of int64 for an index in one precision only of those that a process computes in.
    """
    deep, parents = len(top.levels) > LEVELS_UNROLLED, np.array(top.parent)
    bounds = [*top.levels[1:], (len(parents), len(parents))]
    families = [[np.flatnonzero(parents[lo:hi] == i) for i in range(first, last)] for (first, last), (lo, hi) in zip(bounds[:-1], bounds[1:], strict=True)]
    sizes = [[V_SIZE[top.kind[i]] for i in range(first, last)] for first, last in bounds[:-1]]
    widest, freest, most = max(map(len, sizes)), max(max(x) for x in sizes), max((len(x) for family in families for x in family), default=0)
    found = []
    for level, (first, last) in enumerate(bounds[:-1]):
        n, below = (widest, widest) if deep else (last - first, len(parents[slice(*bounds[level + 1])]))
        d = max(1, freest if deep else max(sizes[level]))
        filled = lambda shape, value: np.full(shape, value, np.int32)
        children = most if deep else max(map(len, families[level]))
        of = Level(filled(n, len(parents)), filled((n, d), top.nv), filled((n, children), below), filled(n, 0))
        of.rows[: last - first] = np.arange(first, last)
        of.parent[: last - first] = parents[first:last] - top.levels[level][0]
        for i, (size, family) in enumerate(zip(sizes[level], families[level], strict=True)):
            of.dofs[i, :size] = np.arange(top.v_start[first + i], top.v_start[first + i] + size)
            of.children[i, : len(family)] = family
        found.append(of)
    return Level(*map(np.stack, zip(*found, strict=True))) if deep else found


def sweep(step: Callable, start, over, reverse: bool = False):
    """What `step(carried, level)` leaves level by level: unrolled over a list, a loop over what is stacked."""
    if not isinstance(over, list):
        return jax.lax.scan(step, start, over, reverse=reverse)[1]
    found, carried = [], start
    for level in reversed(over) if reverse else over:
        carried, out = step(carried, level)
        found.append(out)
    return found[::-1] if reverse else found


def _zeros(top: Topology, *shape: int, dtype) -> Array | None:
    """What a sweep starts with where levels are stacked; else it starts with nothing."""
    found = levels(top)
    return None if isinstance(found, list) else jnp.zeros((found.rows.shape[1], *shape), dtype)


def _from(children: Int[Array, "m c"] | np.ndarray, below: Float[Array, "n *k"]) -> Float[Array, "m *k"]:
    """For each row of a level, the sum of its children's in the level below."""
    return jnp.sum(take(below, children), 1)


def _beside(top: Topology, *given: Callable):
    """Levels, and beside each what the functions give of them."""
    found = levels(top)
    return [(level, *(f(level) for f in given)) for level in found] if isinstance(found, list) else (found, *(f(found) for f in given))


def body_inertias(chain: Chain, kin: Kinematics) -> Float[Array, "rows 6 6"]:
    """Spatial inertia of each row in world axes about its root's origin (Featherstone (2.63))."""
    (c, central), m = central_inertias(chain, kin), chain.mass[:, None, None]
    cx = skew(c)
    square = jnp.sum(cx[:, :, None, :] * cx[:, None, :, :], -1)
    upper = jnp.concatenate([central + m * square, m * cx], -1)
    lower = jnp.concatenate([-m * cx, m * jnp.eye(3, dtype=c.dtype)[None]], -1)
    return jnp.concatenate([upper, lower], -2)


def articulate(chain: Chain, kin: Kinematics, free: Bool[Array, " nv"] | None = None) -> list[Body] | Body:
    """Articulated inertias from the leaves to the roots. free: coordinates that are not locked (None: all)."""
    top, own = chain.topology, body_inertias(chain, kin)
    S = kin.S if free is None else jnp.where(free[:, None], kin.S, 0)
    more = jnp.zeros(chain.nv, S.dtype) if chain.armature is None else chain.armature
    more = more if free is None else jnp.where(free, more, 1)
    more = jnp.concatenate([more, jnp.ones(1, S.dtype)])

    def step(below, given):
        level, A, s, m = given
        A = A if below is None else A + _from(level.children, below)
        U = jnp.sum(s[:, :, :, None] * A[:, None], 2)
        D = jnp.sum(U[:, :, None] * s[:, None], -1) + m[:, :, None] * np.eye(s.shape[1])[None]
        inverse = inverse_positive(D)
        along = jnp.sum(inverse[..., None] * U[:, None], 2)
        return A - jnp.sum(U[:, :, :, None] * along[:, :, None, :], 1), Body(s, U, inverse)

    given = _beside(top, lambda x: take(own, x.rows), lambda x: take(S, x.dofs), lambda x: take(more, x.dofs))
    return sweep(step, _zeros(top, 6, 6, dtype=S.dtype), given, reverse=True)


def _apply(A: Float[Array, "n i j"], x: Float[Array, "n j *k"]) -> Float[Array, "n i *k"]:
    return jnp.sum(A.reshape(*A.shape, *(1,) * (x.ndim - 2)) * x[:, None], 2)


def _carried(top: Topology, bodies, f: Float[Array, "nv *k"]):
    """For each level the forces that its joints are left with, those from below taken off, and the accelerations that these give each joint alone."""

    def step(below, given):
        (level, force), body = given
        p = None if below is None else _from(level.children, below)
        u = force if p is None else force - _apply(body.S, p)
        x = _apply(body.inverse, u)
        passed = _apply(jnp.swapaxes(body.U, 1, 2), x)
        return passed if p is None else passed + p, (u, x)

    return sweep(step, _zeros(top, 6, *f.shape[1:], dtype=f.dtype), _paired(_beside(top, lambda x: take(f, x.dofs)), bodies), reverse=True)


def _paired(a, b):
    return list(zip(a, b, strict=True)) if isinstance(a, list) else (a, b)


def seen_by(top: Topology, bodies, J: Float[Array, "rows nv"]) -> Float[Array, "rows rows"]:
    """J M^-1 J^T. M = L D L^T with a joint's block of D for each (Featherstone section 6.5), so that half the way to M^-1 J^T is enough."""
    parts = _carried(top, bodies, J.T)
    parts = parts if isinstance(parts, list) else [parts]
    u, x = (jnp.concatenate([part[i].reshape(-1, J.shape[0]) for part in parts]) for i in (0, 1))
    # sums, not a `dot`, which XLA's CPU backend would not put into one kernel with what is around it
    return sum_by_few(u[:, :, None] * x[:, None], (0,))


def accelerations(top: Topology, bodies, f: Float[Array, " nv"]) -> Float[Array, " nv"]:
    """M^-1 f: the joints' accelerations at rest, without gravity (Featherstone table 7.1)."""

    def step(above, given):
        (level, body), (_, x) = given
        if above is not None:
            a = take(above, level.parent)
            x = x - jnp.sum(body.inverse * jnp.sum(body.U * a[:, None], -1)[:, None], -1)
        moved = jnp.sum(body.S * x[..., None], 1)
        return moved if above is None else a + moved, x

    found = levels(top)
    x = sweep(step, _zeros(top, 6, dtype=f.dtype), _paired(_paired(found, bodies), _carried(top, bodies, f)))
    x, order = (jnp.concatenate([y.ravel() for y in x]), [y.dofs for y in found]) if isinstance(found, list) else (x.ravel(), [found.dofs])
    return take(x, np.argsort(np.concatenate([y.ravel() for y in order]), kind="stable")[: top.nv])


def by_bodies(chain: Chain, kin: Kinematics) -> list[Body] | Body:
    """Names articulated bodies as the way to accelerations, for `svkc.Dynamics(inertia=...)`."""
    return articulate(chain, kin)
