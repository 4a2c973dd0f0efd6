"""Rules that evaluate one primitive for arrays [..., lanes], for `lanes_last`."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from svkc._jax.chunked_sum import reduce_in_chunks, sum_in_chunks
from svkc._jax.reductions import max_by_xla, min_by_xla, sum_by_xla
from svkc._jax.stored import stored

ELEMENTWISE = set(
    "abs add add_any and atan2 ceil clamp convert_element_type copy copy_p cos div eq exp exp2"
    " expm1 floor ge gt integer_pow is_finite le log log1p lt max min mul ne neg not or pow rem"
    " round rsqrt select_n sign sin sqrt square stop_gradient sub tan tanh xor".split()
)
# primitives whose parameters name axes counted from the front: lanes last changes nothing
UNBATCHED_AXES = {
    "argmax",
    "argmin",
    "cumsum",
    "reduce_and",
    "reduce_or",
    "reduce_prod",
    "rev",
    "split",
    "squeeze",
}
EXTREMES = {"reduce_max": (max_by_xla, jnp.maximum), "reduce_min": (min_by_xla, jnp.minimum)}
CONCATENATIONS = {"concatenate", "stack"}
# the primitives of one_kernel.py, which batches drop
ONE_KERNEL = {"one_kernel_input", "one_kernel_output", "one_kernel_batched_output"}


class Batched(NamedTuple):
    """An array `x` [..., lanes], as opposed to a value that all lanes share."""

    x: Array


def broadcast_to_lanes(x, lanes: int) -> Array:
    """Return a value as an array [..., lanes]; broadcast a value that all lanes share."""
    return (
        x.x
        if isinstance(x, Batched)
        else jnp.broadcast_to(jnp.asarray(x)[..., None], (*jnp.shape(x), lanes))
    )


def _broadcast(x: Array, lanes: int, *, shape, broadcast_dimensions, **_):
    return lax.broadcast_in_dim(x, (*shape, lanes), (*broadcast_dimensions, len(shape)))


def _slice(x: Array, lanes: int, *, start_indices, limit_indices, strides):
    return lax.slice(
        x, (*start_indices, 0), (*limit_indices, lanes), None if strides is None else (*strides, 1)
    )


SHAPE_RULES = {
    "broadcast_in_dim": _broadcast,
    "reshape": lambda x, lanes, **params: x.reshape(*params["new_sizes"], lanes),
    "slice": _slice,
    "transpose": lambda x, lanes, *, permutation: x.transpose(*permutation, len(permutation)),
}


def _gather(x, index, lanes: int, *, dimension_numbers, slice_sizes, **rest):
    d = dimension_numbers
    if not isinstance(index, Batched):
        last = jnp.ndim(index) - 1 + len(d.offset_dims)
        return lax.gather(
            x.x,
            index,
            d._replace(offset_dims=(*d.offset_dims, last)),
            (*slice_sizes, lanes),
            **rest,
        )
    # lax.gather reads an index vector from the last axis, so that lanes come before it
    index = jnp.swapaxes(index.x, -1, -2)
    if isinstance(x, Batched):
        of_x = (*d.operand_batching_dims, x.x.ndim - 1)
        of_index = (*d.start_indices_batching_dims, index.ndim - 2)
        d = d._replace(operand_batching_dims=of_x, start_indices_batching_dims=of_index)
        x, slice_sizes = x.x, (*slice_sizes, 1)
    rows = lax.gather(x, index, d, slice_sizes, **rest)
    # XLA gathers rows at indices of each lane with the lanes first. On a CPU it would transpose
    # them in each kernel that uses them.
    return stored(rows) if jnp.issubdtype(rows.dtype, jnp.floating) else rows


def _sum(x: Array, axes: tuple[int, ...]) -> Array:
    """Sum over axes. The result is not differentiated: derivatives are of the function itself."""
    return sum_in_chunks(x, axes, sum_by_xla)


def _dot_general(*sides, dimension_numbers, preferred_element_type, **_):
    """Evaluate `dot_general` by products and sums, as XLA has no batch axis last for `dot`."""
    sides = [v.x if isinstance(v, Batched) else jnp.asarray(v)[..., None] for v in sides]
    contracted, batch = dimension_numbers
    free = [
        [i for i in range(x.ndim - 1) if i not in (*c, *b)]
        for x, c, b in zip(sides, contracted, batch, strict=True)
    ]

    axes = len(batch[0])
    middle, end = axes + len(free[0]), axes + len(free[0]) + len(free[1])
    # broadcast: each side has axes of length one for the free axes of the other side
    left, right = (
        jnp.transpose(x, (*b, *f, *c, x.ndim - 1))
        for x, b, f, c in zip(sides, batch, free, contracted, strict=True)
    )
    products = jnp.expand_dims(left, range(middle, end)) * jnp.expand_dims(
        right, range(axes, middle)
    )
    products = (
        products if preferred_element_type is None else products.astype(preferred_element_type)
    )
    return _sum(products, tuple(range(end, end + len(contracted[0]))))


def _apply_vmap(primitive, inputs: list, params: dict, lanes: int):
    """Evaluate one primitive by `jax.vmap`, with the lanes moved to the front and back."""
    axes = [0 if isinstance(v, Batched) else None for v in inputs]
    lanes_first = [jnp.moveaxis(v.x, -1, 0) if isinstance(v, Batched) else v for v in inputs]
    bind = lambda *values: primitive.bind(*values, **params)
    out = jax.vmap(bind, axes, axis_size=lanes)(*lanes_first)
    return jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1), out)


def apply_rule(primitive, inputs: list, params: dict, shape: tuple[int, ...], lanes: int):
    """Evaluate one primitive for inputs of which some are `Batched`; return arrays [..., lanes].

    shape: of the output for one lane.
    """
    name = primitive.name
    if name == "reduce_sum":
        # after a vmap within the function, axes are NumPy's integers
        return _sum(inputs[0].x, tuple(map(int, params["axes"])))
    if name in EXTREMES:
        reduce, join = EXTREMES[name]
        return reduce_in_chunks(inputs[0].x, tuple(map(int, params["axes"])), reduce, join)
    if name in UNBATCHED_AXES:
        return primitive.bind(inputs[0].x, **params)
    if name in CONCATENATIONS:
        return primitive.bind(*(broadcast_to_lanes(v, lanes) for v in inputs), **params)
    if name in ELEMENTWISE:
        # elementwise primitives broadcast neither scalars nor axes of length one
        return primitive.bind(
            *(jnp.broadcast_to(broadcast_to_lanes(v, lanes), (*shape, lanes)) for v in inputs),
            **params,
        )
    if name in ONE_KERNEL:
        return inputs[0].x
    if name in SHAPE_RULES and len(inputs) == 1:
        return SHAPE_RULES[name](inputs[0].x, lanes, **params)
    if name == "static_take":
        # the parameter `axis` counts from the front
        return primitive.bind(inputs[0].x, **params)
    if name == "gather":
        return _gather(inputs[0], inputs[1], lanes, **params)
    if name == "dot_general":
        return _dot_general(*inputs, **params)
    return _apply_vmap(primitive, inputs, params, lanes)
