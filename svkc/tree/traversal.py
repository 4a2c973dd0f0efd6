"""Recursions over the tree, from the root and to the root, level by level."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from svkc._jax.static_gather import static_take
from svkc.model.topology import BALL, FREE, HINGE, SLIDE, V_SIZE, Topology

# deeper trees sum by doubling along the ancestors: compile time would grow with every level
LEVELS_UNROLLED = 24
# children's children and so on that a row may have side by side there; with more the table of
# ancestors is smaller
MAX_DESCENDANTS = 4


def accumulate_from_root(top: Topology, x: Float[Array, "rows *n"]) -> Float[Array, "rows *n"]:
    """Sum of x over each row and its ancestors, level by level."""
    if len(top.levels) > LEVELS_UNROLLED:
        for above, _ in _doubling_tables(top):
            x = x + static_take(x, above)
        return x
    parent, levels = np.array(top.parent), [x[:1]]
    for (start, _), (first, last) in zip(top.levels[:-1], top.levels[1:], strict=True):
        levels.append(x[first:last] + static_take(levels[-1], parent[first:last] - start))
    return jnp.concatenate(levels)


def accumulate_to_root(top: Topology, x: Float[Array, "rows *n"]) -> Float[Array, "rows *n"]:
    """Sum of x over each row and its descendants, level by level."""
    if len(top.levels) > LEVELS_UNROLLED:
        if any(below.shape[1] > MAX_DESCENDANTS for _, below in _doubling_tables(top)):
            return jnp.tensordot(jnp.asarray(top.ancestor_mask.T, x.dtype), x, 1)
        for _, below in _doubling_tables(top):
            x = x + jnp.sum(static_take(x, below), 1)
        return x
    sums, below = [], None
    for level, (first, last) in reversed(list(zip(level_tables(top), top.levels[1:], strict=True))):
        own = x[first:last]
        below = own if below is None else own + sum_children(level.children, below)
        sums.append(below)
    return jnp.concatenate([x[:1] + jnp.sum(below, 0, keepdims=True), *sums[::-1]])


@functools.cache
def _doubling_tables(top: Topology) -> list[tuple[np.ndarray, np.ndarray]]:
    """For 1, 2, 4, ... generations: each row's ancestor so far up, and its descendants so far down;
    one past the last row where there is none."""
    parent = np.array(top.parent)
    none, above = len(parent), np.append(np.where(parent < 0, len(parent), parent), len(parent))
    found = []
    while np.any(above < none):
        below = [np.flatnonzero(above[:-1] == i) for i in range(none)]
        table = np.full((none, max(map(len, below))), none)
        for row, own in zip(table, below, strict=True):
            row[: len(own)] = own
        # (as small as jax has them in both precisions: `levels`)
        found.append((above[:-1].astype(np.int32), table.astype(np.int32)))
        above = above[above]
    return found


def replace_rows(
    x: Float[Array, "rows *n"], rows: np.ndarray, values: Float[Array, "some *n"]
) -> Float[Array, "rows *n"]:
    """X with some of its rows replaced. (No scatter: XLA's CPU backend makes one kernel of a loop's
    whole body only where there is none.)"""
    source = np.arange(len(x))
    source[rows] = len(x) + np.arange(len(rows))
    return static_take(jnp.concatenate([x, values]), source)


def sum_dofs_per_row(top: Topology, x: Float[Array, "nv *n"]) -> Float[Array, "rows *n"]:
    """Sum of x over the coordinates of each row's joint."""
    parts, order = [], []
    for kinds, size in (((HINGE, SLIDE), 1), ((BALL,), 3), ((FREE,), 6)):
        rows = top.rows_of_kind(*kinds)
        if len(rows):
            start = np.array(top.v_start)[rows]
            parts.append(sum(static_take(x, start + k) for k in range(size)))
            order.append(rows)
    fixed = np.setdiff1d(
        np.arange(len(top.parent)), np.concatenate(order) if order else np.zeros(0, int)
    )
    parts.append(jnp.zeros((len(fixed), *x.shape[1:]), x.dtype))
    return static_take(jnp.concatenate(parts), np.argsort(np.concatenate([*order, fixed])))


class Level(NamedTuple):
    """The rows of one level below the world's; where there are fewer than n: one past the last row.
    Coordinates of each row's joint, nv where it has fewer than d; its children in the level below,
    as many as that has where there are fewer; its parent in the level above."""

    rows: np.ndarray
    dofs: np.ndarray
    children: np.ndarray
    parent: np.ndarray


@functools.cache
def level_tables(top: Topology) -> list[Level] | Level:
    """One for each level, as small as it can be; in deep trees all as large as the largest,
    stacked, for a loop over them.

    int32: jax (0.10) takes the same array of int64 for an index in one precision only of those that
    a process computes in.
    """
    deep, parents = len(top.levels) > LEVELS_UNROLLED, np.array(top.parent)
    bounds = [*top.levels[1:], (len(parents), len(parents))]
    families = [
        [np.flatnonzero(parents[lo:hi] == i) for i in range(first, last)]
        for (first, last), (lo, hi) in zip(bounds[:-1], bounds[1:], strict=True)
    ]
    sizes = [[V_SIZE[top.kind[i]] for i in range(first, last)] for first, last in bounds[:-1]]
    widest, freest, most = (
        max(map(len, sizes)),
        max(max(x) for x in sizes),
        max((len(x) for family in families for x in family), default=0),
    )
    found = []
    for level, (first, last) in enumerate(bounds[:-1]):
        n, below = (
            (widest, widest) if deep else (last - first, len(parents[slice(*bounds[level + 1])]))
        )
        d = max(1, freest if deep else max(sizes[level]))
        filled = lambda shape, value: np.full(shape, value, np.int32)
        children = most if deep else max(map(len, families[level]))
        of = Level(
            rows=filled(n, len(parents)),
            dofs=filled((n, d), top.nv),
            children=filled((n, children), below),
            parent=filled(n, 0),
        )
        of.rows[: last - first] = np.arange(first, last)
        of.parent[: last - first] = parents[first:last] - top.levels[level][0]
        for i, (size, family) in enumerate(zip(sizes[level], families[level], strict=True)):
            of.dofs[i, :size] = np.arange(top.v_start[first + i], top.v_start[first + i] + size)
            of.children[i, : len(family)] = family
        found.append(of)
    return Level(*map(np.stack, zip(*found, strict=True))) if deep else found


def scan_levels(step: Callable, start, over, reverse: bool = False):
    """What `step(carried, level)` leaves level by level: unrolled over a list, a loop over what is
    stacked."""
    if not isinstance(over, list):
        return jax.lax.scan(step, start, over, reverse=reverse)[1]
    found, carried = [], start
    for level in reversed(over) if reverse else over:
        carried, out = step(carried, level)
        found.append(out)
    return found[::-1] if reverse else found


def initial_carry(top: Topology, *shape: int, dtype) -> Array | None:
    """What a sweep starts with where levels are stacked; else it starts with nothing."""
    found = level_tables(top)
    return None if isinstance(found, list) else jnp.zeros((found.rows.shape[1], *shape), dtype)


def sum_children(
    children: Int[Array, "m c"] | np.ndarray, below: Float[Array, "n *k"]
) -> Float[Array, "m *k"]:
    """For each row of a level, the sum of its children's in the level below."""
    return jnp.sum(static_take(below, children), 1)


def with_level_data(top: Topology, *given: Callable):
    """Levels, and beside each what the functions give of them."""
    found = level_tables(top)
    return (
        [(level, *(f(level) for f in given)) for level in found]
        if isinstance(found, list)
        else (found, *(f(found) for f in given))
    )


def zip_levels(a, b):
    """Return pairs of what two functions give, level by level or stacked."""
    return list(zip(a, b, strict=True)) if isinstance(a, list) else (a, b)
