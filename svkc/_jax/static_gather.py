"""Gather of rows by a static index, whose transpose is a gather and a sum instead of a scatter.

The transpose of JAX's indexing is a scatter. XLA's CPU backend runs a scatter entry by entry, and
does not fuse it with the surrounding operations.
"""

import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Float, Int

# The transpose gathers by a padded index table. Rows with more uses than the table is wide, at most
# MAX_ROWS_USED_OFTEN, are summed one by one. If the table has more than MAX_TABLE_RATIO times the
# entries that are needed, the transpose is a scatter.
MAX_TABLE_RATIO, MAX_ROWS_USED_OFTEN = 8, 4


def static_take(
    x: Float[Array, "rows *n"], index: Int[np.ndarray, "*m"] | Int[Array, "*m"]
) -> Float[Array, "..."]:
    """Return x[index] along the first axis; zeros where the index is one past the last row.

    A numpy index is static and uses the primitive of this module; a JAX index uses JAX's indexing.
    """
    if not isinstance(index, np.ndarray):
        return jnp.concatenate([x, jnp.zeros_like(x[:1])])[index]
    if np.array_equal(index.ravel(), np.arange(x.shape[0])):
        return x.reshape(*index.shape, *x.shape[1:])
    rows = static_take_p.bind(x, index=index.astype(np.int32).tobytes(), axis=0)
    return rows if index.ndim == 1 else rows.reshape(*index.shape, *x.shape[1:])


def _gather_rows(x, *, index: bytes, axis: int):
    table, n = np.frombuffer(index, np.int32), x.shape[axis]
    if table.max(initial=0) == n:
        x = lax.concatenate(
            [x, jnp.zeros((*x.shape[:axis], 1, *x.shape[axis + 1 :]), x.dtype)], axis
        )
    dimension_numbers = lax.GatherDimensionNumbers(
        offset_dims=tuple(i for i in range(x.ndim) if i != axis),
        collapsed_slice_dims=(axis,),
        start_index_map=(axis,),
    )
    return lax.gather(
        x,
        table[:, None],
        dimension_numbers,
        tuple(1 if i == axis else size for i, size in enumerate(x.shape)),
        mode=lax.GatherScatterMode.PROMISE_IN_BOUNDS,
    )


def _abstract_eval(x, *, index: bytes, axis: int):
    return x.update(shape=(*x.shape[:axis], len(index) // 4, *x.shape[axis + 1 :]))


def _transpose(ct, x, *, index: bytes, axis: int):
    """Return, for each row of x, the sum of the cotangents of the rows gathered from that row."""
    table, n = np.frombuffer(index, np.int32), x.aval.shape[axis]
    count = np.bincount(table, minlength=n + 1)[:n]
    width = _table_width(count)
    often = np.flatnonzero(count > width)
    if n * width > MAX_TABLE_RATIO * (n + len(table)):
        shape = (*x.aval.shape[:axis], n + 1, *x.aval.shape[axis + 1 :])
        scattered = jnp.zeros(shape, ct.dtype).at[(slice(None),) * axis + (table,)].add(ct)
        return [lax.slice_in_dim(scattered, 0, n, axis=axis)]
    # padding: an index one past the last row of ct gathers zeros
    uses = np.full((n, width), len(table), np.int32)
    for row in np.flatnonzero((count > 0) & (count <= width)):
        uses[row, : count[row]] = np.flatnonzero(table == row)
    terms = static_take_p.bind(ct, index=uses.tobytes(), axis=axis)
    shape = (*ct.shape[:axis], n, width, *ct.shape[axis + 1 :])
    total = terms if width == 1 else jnp.sum(terms.reshape(shape), axis + 1)
    for row in often.tolist():
        places = np.flatnonzero(table == row).astype(np.int32).tobytes()
        of_row = jnp.sum(static_take_p.bind(ct, index=places, axis=axis), axis, keepdims=True)
        before, after = (
            lax.slice_in_dim(total, *ends, axis=axis) for ends in ((0, row), (row + 1, n))
        )
        total = lax.concatenate([before, of_row, after], axis)
    return [total]


def _table_width(count: np.ndarray) -> int:
    """Return the table width at which the fewest entries are gathered in all.

    Rows with more uses, at most `MAX_ROWS_USED_OFTEN`, are gathered separately.

    count: number of uses of each row.
    """
    widths = np.sort(np.append(count, 0))[::-1][: MAX_ROWS_USED_OFTEN + 1]
    entries = [len(count) * width + np.sum(count[count > width]) for width in widths]
    return int(widths[np.argmin(entries)])


def _batch(args, axes, *, index: bytes, axis: int):
    (x,), (lane,) = args, axes
    return static_take_p.bind(x, index=index, axis=axis + (lane <= axis)), lane


# `lanes_last` recognises this primitive by its name
static_take_p = Primitive("static_take")
static_take_p.def_impl(_gather_rows)
static_take_p.def_abstract_eval(_abstract_eval)
ad.deflinear2(static_take_p, _transpose)
batching.primitive_batchers[static_take_p] = _batch
mlir.register_lowering(static_take_p, mlir.lower_fun(_gather_rows, multiple_results=False))
