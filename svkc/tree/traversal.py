"""Recursions over the tree, from the root and to the root, level by level.

Every recursion of this package goes through this module, so that the choice between unrolled
levels and loops over stacked levels is made in one place.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from svkc._jax.static_gather import static_take
from svkc.model.annotations import DType
from svkc.model.topology import BALL, FREE, HINGE, SLIDE, V_SIZE, Topology

# Trees with more levels use pointer doubling and `lax.scan`: unrolled, their compile time would
# grow with every level.
LEVELS_UNROLLED = 24
# Largest number of descendants of one row in one doubling table. With more, a product with the
# ancestor mask costs less than the gathers.
MAX_DESCENDANTS = 4


def accumulate_from_root(top: Topology, x: Float[Array, "rows *n"]) -> Float[Array, "rows *n"]:
    """Return, for each row, the sum of x over the row and its ancestors."""
    if len(top.levels) > LEVELS_UNROLLED:
        for above, _ in _doubling_tables(top):
            x = x + static_take(x, above)
        return x
    tables, (ground, *own) = level_tables(top), _split_levels(top, x)
    assert isinstance(tables, list)
    levels = [ground]
    for level, rows in zip(tables, own, strict=True):
        levels.append(rows + static_take(levels[-1], level.parent))
    return jnp.concatenate(levels)


def accumulate_to_root(top: Topology, x: Float[Array, "rows *n"]) -> Float[Array, "rows *n"]:
    """Return, for each row, the sum of x over the row and its descendants."""
    if len(top.levels) > LEVELS_UNROLLED:
        if any(below.shape[1] > MAX_DESCENDANTS for _, below in _doubling_tables(top)):
            return jnp.tensordot(jnp.asarray(top.ancestor_mask.T, x.dtype), x, 1)
        for _, below in _doubling_tables(top):
            x = x + jnp.sum(static_take(x, below), 1)
        return x
    tables, (ground, *own) = level_tables(top), _split_levels(top, x)
    assert isinstance(tables, list)
    sums, below = [], None
    for level, rows in reversed(list(zip(tables, own, strict=True))):
        below = rows if below is None else rows + sum_children(level.children, below)
        sums.append(below)
    assert below is not None  # the world has a level of its own
    return jnp.concatenate([ground + jnp.sum(below, 0, keepdims=True), *sums[::-1]])


def _split_levels(top: Topology, x: Float[Array, "rows *n"]) -> list[Float[Array, "_ *n"]]:
    """Return the rows of each level, the world's first.

    The transpose of a split is one concatenation; that of slices is paddings and a sum.
    """
    return jnp.split(x, [first for first, _ in top.levels[1:]])


@functools.cache
def _doubling_tables(top: Topology) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return, for 1, 2, 4, ... generations, the tables (ancestor [rows], descendants [rows n]).

    Each names the rows that many generations above and below a row; entries without such a row
    hold the number of rows. Tables are int32, as in `level_tables`.
    """
    parent = np.array(top.parent)
    none = len(parent)
    ancestor = np.append(np.where(parent < 0, none, parent), none)
    tables = []
    while np.any(ancestor < none):
        descendants = [np.flatnonzero(ancestor[:-1] == i) for i in range(none)]
        tables.append((ancestor[:-1].astype(np.int32), _rectangular(descendants, none)))
        ancestor = ancestor[ancestor]
    return tables


def _rectangular(lists: list[np.ndarray], padding: int, width: int = 0) -> np.ndarray:
    """Return the lists as rows of one int32 table at least `width` wide, padded at the right."""
    table = np.full((len(lists), max(width, *map(len, lists))), padding, np.int32)
    for row, entries in zip(table, lists, strict=True):
        row[: len(entries)] = entries
    return table


def replace_rows(
    x: Float[Array, "rows *n"], rows: np.ndarray, values: Float[Array, "some *n"]
) -> Float[Array, "rows *n"]:
    """Return x with the rows `rows` replaced by `values`.

    This is a gather, not a scatter: XLA's CPU backend fuses a loop body that has a scatter into
    more than one kernel.
    """
    source = np.arange(len(x))
    source[rows] = len(x) + np.arange(len(rows))
    return static_take(jnp.concatenate([x, values]), source)


def sum_dofs_per_row(top: Topology, x: Float[Array, "nv *n"]) -> Float[Array, "rows *n"]:
    """Return, for each row, the sum of x over the coordinates of the row's joint."""
    kinds = ((HINGE, SLIDE), 1), ((BALL,), 3), ((FREE,), 6)
    groups = [(rows, n) for names, n in kinds if len(rows := top.rows_of_kind(*names))]
    # sorted by coordinate, as then the coordinates of most trees need no gather
    groups.sort(key=lambda group: top.v_start[group[0][0]])
    with_joint, parts = [rows for rows, _ in groups], []
    if groups:
        dofs = [np.array(top.v_start)[rows][:, None] + np.arange(n) for rows, n in groups]
        ordered = static_take(x, np.concatenate([d.ravel() for d in dofs]))
        parts = jnp.split(ordered, np.cumsum([d.size for d in dofs])[:-1])
    parts = [
        part if n == 1 else jnp.sum(part.reshape(-1, n, *x.shape[1:]), 1)
        for part, (_, n) in zip(parts, groups, strict=True)
    ]
    fixed = np.setdiff1d(np.arange(len(top.parent)), np.concatenate([*with_joint, []]))
    parts.append(jnp.zeros((len(fixed), *x.shape[1:]), x.dtype))
    return static_take(jnp.concatenate(parts), np.argsort(np.concatenate([*with_joint, fixed])))


class Level(NamedTuple):
    """Index tables of one level below the world: n rows, each with at most d coordinates.

    rows: rows of the tree (padding: the number of rows).
    dofs: coordinates of each row's joint (padding: nv).
    children: places of each row's children in the next level (padding: that level's size).
    parent: place of each row's parent in the previous level (padding: 0).
    """

    rows: np.ndarray
    dofs: np.ndarray
    children: np.ndarray
    parent: np.ndarray


@functools.cache
def level_tables(top: Topology) -> list[Level] | Level:
    """Return one `Level` for each level below the world, stacked in deep trees.

    A list holds tables as small as possible, for unrolled recursions. A stacked `Level` holds
    tables padded to the largest level, for `lax.scan`.

    Tables are int32: JAX 0.10 accepts an int64 table as an index in only one of the precisions
    that a process computes in.
    """
    levels = [_level(top, i) for i in range(1, len(top.levels))]
    return _pad(top, levels) if len(top.levels) > LEVELS_UNROLLED else levels


def _level(top: Topology, i: int) -> Level:
    """Return the unpadded tables of level i of `top.levels`."""
    parent, end = np.array(top.parent), len(top.parent)
    first, last = top.levels[i]
    next_first, next_last = top.levels[i + 1] if i + 1 < len(top.levels) else (end, end)
    rows = np.arange(first, last, dtype=np.int32)
    dofs = [np.arange(top.v_start[r], top.v_start[r] + V_SIZE[top.kind[r]]) for r in rows]
    children = [np.flatnonzero(parent[next_first:next_last] == r) for r in rows]
    return Level(
        rows=rows,
        dofs=_rectangular(dofs, top.nv, width=1),
        children=_rectangular(children, next_last - next_first),
        parent=(parent[first:last] - top.levels[i - 1][0]).astype(np.int32),
    )


def _pad(top: Topology, levels: list[Level]) -> Level:
    """Return the levels stacked, each padded to the largest."""
    widest = max(len(level.rows) for level in levels)

    def stack(tables, padding: int) -> np.ndarray:
        stacked = np.full((len(tables), *np.max([x.shape for x in tables], 0)), padding, np.int32)
        for i, table in enumerate(tables):
            stacked[(i, *map(slice, table.shape))] = table
        return stacked

    # in the children's tables the padding is the size of the next level, which is now `widest`
    next_lengths = [*(len(level.rows) for level in levels[1:]), 0]
    children = [
        np.where(level.children == size, widest, level.children)
        for level, size in zip(levels, next_lengths, strict=True)
    ]
    return Level(
        rows=stack([level.rows for level in levels], len(top.parent)),
        dofs=stack([level.dofs for level in levels], top.nv),
        children=stack(children, widest),
        parent=stack([level.parent for level in levels], 0),
    )


def scan_levels(step: Callable, start: Any, over: Any, reverse: bool = False) -> Any:
    """Return the outputs of `carry, output = step(carry, level)` over all levels.

    The recursion is unrolled over a list of levels, and a `lax.scan` over stacked levels.
    """
    if not isinstance(over, list):
        return jax.lax.scan(step, start, over, reverse=reverse)[1]
    outputs, carry = [], start
    for level in reversed(over) if reverse else over:
        carry, output = step(carry, level)
        outputs.append(output)
    return outputs[::-1] if reverse else outputs


def initial_carry(top: Topology, *shape: int, dtype: DType) -> Array | None:
    """Return the first carry of `scan_levels`: zeros for stacked levels, None for a list."""
    levels = level_tables(top)
    return None if isinstance(levels, list) else jnp.zeros((levels.rows.shape[1], *shape), dtype)


def sum_children(
    children: Int[Array, "m c"] | np.ndarray, below: Float[Array, "n *k"]
) -> Float[Array, "m *k"]:
    """Return, for each row of a level, the sum of `below` over the row's children.

    children: a level's table. below: values of the next level.
    """
    return jnp.sum(static_take(below, children), 1)


def with_level_data(top: Topology, *functions: Callable) -> Any:
    """Return (level, f(level), ...) for each level, or for the stacked levels at once."""
    levels = level_tables(top)
    return (
        [(level, *(f(level) for f in functions)) for level in levels]
        if isinstance(levels, list)
        else (levels, *(f(levels) for f in functions))
    )


def rows_per_level(top: Topology, x: Any) -> Any:
    """Return a pytree's arrays [rows *n] for each level below the world, or for stacked levels.

    Rows of padding are zero.
    """
    levels = level_tables(top)
    if not isinstance(levels, list):
        return jax.tree.map(lambda a: static_take(a, levels.rows), x)
    leaves, tree = jax.tree.flatten(x)
    # the rows of a level are consecutive, so that no gather copies them
    parts = [_split_levels(top, a)[1:] for a in leaves]
    return [tree.unflatten(of_level) for of_level in zip(*parts, strict=True)]


def zip_levels(a: Any, b: Any) -> Any:
    """Return the pairs of two values for each level, or of two values for stacked levels."""
    return list(zip(a, b, strict=True)) if isinstance(a, list) else (a, b)
