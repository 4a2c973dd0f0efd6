"""Rows of an array by an index that is known beforehand, whose derivatives are rows and sums again.

The transpose of jax's own indexing is a scatter, which XLA's CPU backend runs entry by entry, and
never in one kernel with what is around it.
"""

import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Float, Int

# a table of what goes to each row may have so many times the entries that are there and taken; else
# it is a scatter
MAX_TABLE_RATIO = 8


def static_take(
    x: Float[Array, "rows *n"], index: Int[np.ndarray, "*m"] | Int[Array, "*m"]
) -> Float[Array, "..."]:
    """x[index] along the first axis; zeros where the index is one past the last row."""
    if not isinstance(index, np.ndarray):
        return jnp.concatenate([x, jnp.zeros_like(x[:1])])[index]
    if index.ndim == 1 and np.array_equal(index, np.arange(x.shape[0])):
        return x
    taken = static_take_p.bind(x, index=index.astype(np.int32).tobytes(), axis=0)
    return taken if index.ndim == 1 else taken.reshape(*index.shape, *x.shape[1:])


def _gather_rows(x, *, index: bytes, axis: int):
    table, n = np.frombuffer(index, np.int32), x.shape[axis]
    if table.max(initial=0) == n:
        x = lax.concatenate(
            [x, jnp.zeros((*x.shape[:axis], 1, *x.shape[axis + 1 :]), x.dtype)], axis
        )
    others = tuple(i for i in range(x.ndim) if i != axis)
    numbers = lax.GatherDimensionNumbers(
        offset_dims=others, collapsed_slice_dims=(axis,), start_index_map=(axis,)
    )
    sizes = tuple(1 if i == axis else size for i, size in enumerate(x.shape))
    return lax.gather(
        x, table[:, None], numbers, sizes, mode=lax.GatherScatterMode.PROMISE_IN_BOUNDS
    )


def _abstract_eval(x, *, index: bytes, axis: int):
    return x.update(shape=(*x.shape[:axis], len(index) // 4, *x.shape[axis + 1 :]))


def _transpose(ct, x, *, index: bytes, axis: int):
    """For each row of x the sum of what was taken of it."""
    table, n = np.frombuffer(index, np.int32), x.aval.shape[axis]
    order = np.argsort(table, kind="stable")
    count = np.bincount(table, minlength=n + 1)[:n]
    most = int(count.max(initial=0))
    if n * most > MAX_TABLE_RATIO * (n + len(table)):
        shape = (*x.aval.shape[:axis], n + 1, *x.aval.shape[axis + 1 :])
        added = jnp.zeros(shape, ct.dtype).at[(slice(None),) * axis + (table,)].add(ct)
        return [lax.slice_in_dim(added, 0, n, axis=axis)]
    # one past the last: nothing
    back, first = np.full((n, most), len(table), np.int32), np.cumsum(count) - count
    for row in range(n):
        back[row, : count[row]] = order[first[row] : first[row] + count[row]]
    parts = static_take_p.bind(ct, index=back.tobytes(), axis=axis)
    return [
        parts
        if most == 1
        else jnp.sum(parts.reshape(*ct.shape[:axis], n, most, *ct.shape[axis + 1 :]), axis + 1)
    ]


def _batch(args, axes, *, index: bytes, axis: int):
    (x,), (lane,) = args, axes
    return static_take_p.bind(x, index=index, axis=axis + (lane <= axis)), lane


static_take_p = Primitive("taking")
static_take_p.def_impl(_gather_rows)
static_take_p.def_abstract_eval(_abstract_eval)
ad.deflinear2(static_take_p, _transpose)
batching.primitive_batchers[static_take_p] = _batch
mlir.register_lowering(static_take_p, mlir.lower_fun(_gather_rows, multiple_results=False))
