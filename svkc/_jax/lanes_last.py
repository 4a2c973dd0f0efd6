"""A `vmap` that keeps the lanes on the last axis, where processors take several in one instruction.

jax puts them first; the axes of 3, 6 or 46 that end up last are too short for that. A function's
jaxpr is gone through once more with every array
[..., lanes]; what has no rule here goes through jax's own `vmap`.
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

from svkc._jax.primitive import custom_primitive

# lanes that one processor takes at a time: what they need between two operations stays in its cache
# (benchmarks/README.md)
TILE = 32
# terms of a sum at a time: 46 in one loop cost a step with two grips a quarter of its time, 22 one
# of the high bar's 16-joint figure a third
TERMS_PER_SUM = 8
ELEMENTWISE = set(
    "abs add add_any and atan2 ceil clamp convert_element_type copy copy_p cos div eq exp exp2"
    " expm1 floor ge gt integer_pow is_finite le log log1p lt max min mul ne neg not or pow rem"
    " round rsqrt select_n sign sin sqrt square stop_gradient sub tan tanh xor".split()
)
UNBATCHED_AXES = {
    "argmax",
    "argmin",
    "cumsum",
    "reduce_and",
    "reduce_max",
    "reduce_min",
    "reduce_or",
    "reduce_prod",
    "rev",
    "split",
    "squeeze",
}
CONCATENATIONS = {"concatenate", "stack"}
CALL_JAXPR_PARAMETERS = {
    "closed_call": "call_jaxpr",
    "core_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
    "jit": "jaxpr",
    "pjit": "jaxpr",
}


class Batched(NamedTuple):
    """A value of its own for each lane."""

    x: Array


def broadcast_to_lanes(x, lanes: int) -> Array:
    """[..., lanes] of any value."""
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
    "reshape": lambda x, lanes, *, new_sizes, **_: x.reshape(*new_sizes, lanes),
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
    # the index's own axis stays its last
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


def sum_in_chunks(x: Array, axes: tuple[int, ...]) -> Array:
    """Sums of few at a time: such a loop is unrolled, and the one around it, over lanes or what
    else is last, can take several in one instruction."""
    for axis in sorted(axes, reverse=True):
        size = x.shape[axis]
        parts = [
            jnp.sum(lax.slice_in_dim(x, i, min(i + TERMS_PER_SUM, size), axis=axis), axis, x.dtype)
            for i in range(0, max(size, 1), TERMS_PER_SUM)
        ]
        x = functools.reduce(jnp.add, parts)
    return x


def _dot_general(*sides, dimension_numbers, preferred_element_type, **_):
    """Products and sums: XLA has no `dot` whose lanes come last."""
    sides = [v.x if isinstance(v, Batched) else jnp.asarray(v)[..., None] for v in sides]
    contracted, batch = dimension_numbers
    free = [
        [i for i in range(x.ndim - 1) if i not in (*c, *b)]
        for x, c, b in zip(sides, contracted, batch, strict=True)
    ]

    axes = len(batch[0])
    middle, end = axes + len(free[0]), axes + len(free[0]) + len(free[1])
    # the other side's own axes are of one
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
    return sum_in_chunks(products, tuple(range(end, end + len(contracted[0]))))


def _solve(inputs: list, lanes: int, *, const_lengths, jaxprs, **_):
    """The solve itself; what it is the inverse of matters to derivatives alone."""
    before = const_lengths.matvec + const_lengths.vecmat
    return evaluate_jaxpr(
        jaxprs.solve,
        [*inputs[before : before + const_lengths.solve], *inputs[sum(const_lengths) :]],
        lanes,
    )


def _apply_vmap(primitive, inputs: list, params: dict, lanes: int):
    """Lanes first, through jax's own rule, and back."""
    axes = [0 if isinstance(v, Batched) else None for v in inputs]
    moved = [jnp.moveaxis(v.x, -1, 0) if isinstance(v, Batched) else v for v in inputs]
    out = jax.vmap(lambda *values: primitive.bind(*values, **params), axes, axis_size=lanes)(*moved)
    return jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1), out)


def _apply_rule(primitive, inputs: list, params: dict, shape: tuple[int, ...], lanes: int):
    """What one operation makes of values of which some are `Lanes`, in arrays [..., lanes]."""
    name, alone = primitive.name, len(inputs) == 1
    if name == "reduce_sum":
        return sum_in_chunks(inputs[0].x, params["axes"])
    if name in UNBATCHED_AXES:
        return primitive.bind(inputs[0].x, **params)
    if name in CONCATENATIONS:
        return primitive.bind(*(broadcast_to_lanes(v, lanes) for v in inputs), **params)
    if name in ELEMENTWISE:
        # (numbers and axes of one go with any size)
        return primitive.bind(
            *(jnp.broadcast_to(broadcast_to_lanes(v, lanes), (*shape, lanes)) for v in inputs),
            **params,
        )
    if name in SHAPE_RULES and alone:
        return SHAPE_RULES[name](inputs[0].x, lanes, **params)
    if name == "taking":
        # (its axis is counted from the front)
        return primitive.bind(inputs[0].x, **params)
    if name == "gather":
        return _gather(inputs[0], inputs[1], lanes, **params)
    if name == "dot_general":
        return _dot_general(*inputs, **params)
    return _apply_vmap(primitive, inputs, params, lanes)


def evaluate_jaxpr(closed: core.ClosedJaxpr, inputs: list, lanes: int) -> list:
    """The outputs of a jaxpr for inputs of which some are `Lanes`."""
    jaxpr = closed.jaxpr
    known = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*closed.consts, *inputs], strict=True))
    read = lambda v: v.val if isinstance(v, core.Literal) else known[v]
    for eqn in jaxpr.eqns:
        values, name, params = [read(v) for v in eqn.invars], eqn.primitive.name, eqn.params
        mixed = any(isinstance(v, Batched) for v in values)
        if name in CALL_JAXPR_PARAMETERS:
            out = evaluate_jaxpr(params[CALL_JAXPR_PARAMETERS[name]], values, lanes)
        elif name in ("custom_linear_solve", "linear_solve") and mixed:
            out = _solve(values, lanes, **params)
        else:
            out = (
                eqn.primitive.bind(*values, **params)
                if not mixed
                else _apply_rule(eqn.primitive, values, params, eqn.outvars[0].aval.shape, lanes)
            )
            out = out if eqn.primitive.multiple_results else [out]
            out = [Batched(x) for x in out] if mixed else out
        known |= dict(zip(eqn.outvars, out, strict=True))
    return [read(v) for v in jaxpr.outvars]


def _evaluate_batch(function: Callable, lanes: int, flags: list[bool], args):
    """All lanes first and last to the eye, last in between."""
    leaves, tree = jax.tree.flatten(args)
    shapes = [
        jax.ShapeDtypeStruct(jnp.shape(x)[flag:], jnp.result_type(x))
        for x, flag in zip(leaves, flags, strict=True)
    ]
    closed, made = jax.make_jaxpr(function, return_shape=True)(*tree.unflatten(shapes))
    gathered = jax.tree.structure(made).unflatten
    tile = max(1, min(lanes, TILE) if jax.default_backend() == "cpu" else lanes)
    count = -(-lanes // tile)

    def some(own):
        own = iter(own)
        out = evaluate_jaxpr(
            closed,
            [
                Batched(jnp.moveaxis(next(own), 0, -1)) if flag else x
                for x, flag in zip(leaves, flags, strict=True)
            ],
            tile,
        )
        return [jnp.moveaxis(broadcast_to_lanes(x, tile), -1, 0) for x in out]

    own = [x for x, flag in zip(leaves, flags, strict=True) if flag]
    if count == 1:
        return gathered(some(own))
    if count * tile != lanes:
        # the last lane stands in for those that a whole number of tiles would have more
        own = [
            jnp.concatenate([x, jnp.broadcast_to(x[-1:], (count * tile - lanes, *x.shape[1:]))])
            for x in own
        ]
    out = lax.map(some, [x.reshape(count, tile, *x.shape[1:]) for x in own])
    return gathered([x.reshape(count * tile, *x.shape[2:])[:lanes] for x in out])


def with_lanes_last(function: Callable) -> Callable:
    """The function, whose `jax.vmap` keeps lanes last, on processors a few at a time. Its
    derivatives are those of the function as it is."""
    batched = jax.custom_batching.custom_vmap(function)

    @batched.def_vmap
    def _(lanes: int, flags, *args):
        out = _evaluate_batch(function, lanes, jax.tree.leaves(flags), args)
        return out, jax.tree.map(lambda _: True, out)

    def jvp(values, tangents):
        return whole(*values), eqx.filter_jvp(function, values, tangents)[1]

    whole = custom_primitive(function.__name__, batched, jvp)
    return whole
