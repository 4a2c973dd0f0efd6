"""A `vmap` that keeps the batch axis last, so that SIMD instructions process several lanes at once.

`jax.vmap` puts the batch axis first. The last axes are then of length 3, 6 or 46, too short for
SIMD. Here a function's jaxpr is evaluated with every batched array as [..., lanes]. Primitives
without a rule in this module go through `jax.vmap`.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.extend import core
from jaxtyping import Array

from svkc._jax.chunked_sum import sum_in_chunks
from svkc._jax.primitive import custom_primitive
from svkc._jax.reductions import max_by_xla, min_by_xla, sum_by_xla

# lanes evaluated together on a CPU: intermediate values of 32 lanes stay in the processor's cache
# (benchmarks/README.md)
TILE = 32
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
EXTREMES = {"reduce_max": max_by_xla, "reduce_min": min_by_xla}
CONCATENATIONS = {"concatenate", "stack"}
# the primitives of one_kernel.py, which batches drop
ONE_KERNEL = {"one_kernel_input", "one_kernel_output", "one_kernel_batched_output"}
# primitives that call a jaxpr -> name of the parameter that holds the jaxpr
CALL_JAXPR_PARAMETERS = {
    "closed_call": "call_jaxpr",
    "core_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
    "jit": "jaxpr",
    "pjit": "jaxpr",
}


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
    if not isinstance(x, Batched):
        return lax.gather(x, index, d, slice_sizes, **rest)
    of_x, of_index = (
        (*d.operand_batching_dims, x.x.ndim - 1),
        (*d.start_indices_batching_dims, index.ndim - 2),
    )
    return lax.gather(
        x.x,
        index,
        d._replace(operand_batching_dims=of_x, start_indices_batching_dims=of_index),
        (*slice_sizes, 1),
        **rest,
    )


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


def _solve(inputs: list, lanes: int, *, const_lengths, jaxprs, **_):
    """Evaluate the `solve` of a `custom_linear_solve`; its other jaxprs only serve derivatives."""
    before = const_lengths.matvec + const_lengths.vecmat
    return evaluate_jaxpr(
        jaxprs.solve,
        [*inputs[before : before + const_lengths.solve], *inputs[sum(const_lengths) :]],
        lanes,
    )


def _cond(inputs: list, lanes: int, *, branches, **_) -> list:
    """Evaluate a `cond` whose index all lanes share, with lanes last in its branches."""
    outputs = lambda closed, values: [
        broadcast_to_lanes(x, lanes) for x in evaluate_jaxpr(closed, values, lanes)
    ]
    return lax.switch(inputs[0], [functools.partial(outputs, c) for c in branches], inputs[1:])


def _apply_vmap(primitive, inputs: list, params: dict, lanes: int):
    """Evaluate one primitive by `jax.vmap`, with the lanes moved to the front and back."""
    axes = [0 if isinstance(v, Batched) else None for v in inputs]
    lanes_first = [jnp.moveaxis(v.x, -1, 0) if isinstance(v, Batched) else v for v in inputs]
    bind = lambda *values: primitive.bind(*values, **params)
    out = jax.vmap(bind, axes, axis_size=lanes)(*lanes_first)
    return jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1), out)


def _apply_rule(primitive, inputs: list, params: dict, shape: tuple[int, ...], lanes: int):
    """Evaluate one primitive for inputs of which some are `Batched`; return arrays [..., lanes].

    shape: of the output for one lane.
    """
    name = primitive.name
    if name == "reduce_sum":
        # after a vmap within the function, axes are NumPy's integers
        return _sum(inputs[0].x, tuple(map(int, params["axes"])))
    if name in EXTREMES:
        return EXTREMES[name](inputs[0].x, tuple(map(int, params["axes"])))
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


def evaluate_jaxpr(closed: core.ClosedJaxpr, inputs: list, lanes: int) -> list:
    """Evaluate a jaxpr for inputs of which some are `Batched`; dependent outputs are `Batched`."""
    jaxpr = closed.jaxpr
    env = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*closed.consts, *inputs], strict=True))
    read = lambda v: v.val if isinstance(v, core.Literal) else env[v]
    for eqn in jaxpr.eqns:
        values, name, params = [read(v) for v in eqn.invars], eqn.primitive.name, eqn.params
        batched = any(isinstance(v, Batched) for v in values)
        if name in CALL_JAXPR_PARAMETERS:
            out = evaluate_jaxpr(params[CALL_JAXPR_PARAMETERS[name]], values, lanes)
        elif name in ("custom_linear_solve", "linear_solve") and batched:
            out = _solve(values, lanes, **params)
        elif name == "cond" and batched and not isinstance(values[0], Batched):
            out = [Batched(x) for x in _cond(values, lanes, **params)]
        elif name == "batch_together":
            out = values
        elif name == "unvmap_any" and batched:
            out = [jnp.any(values[0].x)]
        else:
            out = (
                eqn.primitive.bind(*values, **params)
                if not batched
                else _apply_rule(eqn.primitive, values, params, eqn.outvars[0].aval.shape, lanes)
            )
            out = out if eqn.primitive.multiple_results else [out]
            out = [Batched(x) for x in out] if batched else out
        env |= dict(zip(eqn.outvars, out, strict=True))
    return [read(v) for v in jaxpr.outvars]


def _evaluate_batch(function: Callable, lanes: int, flags: list[bool], args):
    """Evaluate a function for a batch, in tiles of `TILE` lanes on a CPU.

    flags: for each leaf of `args`, whether its first axis is the batch.
    Inputs and outputs have the lanes first, as `custom_vmap` requires.
    """
    leaves, tree = jax.tree.flatten(args)
    shapes = [
        jax.ShapeDtypeStruct(jnp.shape(x)[flag:], jnp.result_type(x))
        for x, flag in zip(leaves, flags, strict=True)
    ]
    closed, out_shape = jax.make_jaxpr(function, return_shape=True)(*tree.unflatten(shapes))
    unflatten = jax.tree.structure(out_shape).unflatten
    tile = max(1, min(lanes, TILE) if jax.default_backend() == "cpu" else lanes)
    count = -(-lanes // tile)

    def evaluate_tile(batched_leaves):
        batched_leaves = iter(batched_leaves)
        out = evaluate_jaxpr(
            closed,
            [
                Batched(jnp.moveaxis(next(batched_leaves), 0, -1)) if flag else x
                for x, flag in zip(leaves, flags, strict=True)
            ],
            tile,
        )
        return [jnp.moveaxis(broadcast_to_lanes(x, tile), -1, 0) for x in out]

    batch = [x for x, flag in zip(leaves, flags, strict=True) if flag]
    if count == 1:
        return unflatten(evaluate_tile(batch))
    if count * tile != lanes:
        # pad the last tile by copies of the last lane
        batch = [
            jnp.concatenate([x, jnp.broadcast_to(x[-1:], (count * tile - lanes, *x.shape[1:]))])
            for x in batch
        ]
    out = lax.map(evaluate_tile, [x.reshape(count, tile, *x.shape[1:]) for x in batch])
    return unflatten([x.reshape(count * tile, *x.shape[2:])[:lanes] for x in out])


def with_lanes_last(function: Callable) -> Callable:
    """Return a function whose `jax.vmap` evaluates it with the lanes last.

    Derivatives are those of `function` under JAX's own rules.
    """
    batched = jax.custom_batching.custom_vmap(function)

    @batched.def_vmap
    def _(lanes: int, flags, *args):
        out = _evaluate_batch(function, lanes, jax.tree.leaves(flags), args)
        return out, jax.tree.map(lambda _: True, out)

    def jvp(values, tangents):
        return primitive(*values), eqx.filter_jvp(function, values, tangents)[1]

    primitive = custom_primitive(function.__name__, batched, jvp)
    return primitive
