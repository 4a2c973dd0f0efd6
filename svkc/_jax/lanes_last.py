"""A `vmap` that keeps the batch axis last, so that SIMD instructions process several lanes at once.

`jax.vmap` puts the batch axis first. The last axes are then of length 3, 6 or 46, too short for
SIMD. Here a function's jaxpr is evaluated with every batched array as [..., lanes]. Primitives
without a rule go through `jax.vmap`.
"""

import functools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.extend import core

from svkc._jax.lanes_last_rules import Batched, apply_rule, broadcast_to_lanes
from svkc._jax.primitive import custom_primitive

# Bytes that one scalar takes over all lanes of a tile on a CPU: 32 lanes in float64, 64 in float32
# (benchmarks/README.md).
TILE_BYTES = 256
# If there are several tiles, these bytes of a tile are a multiple of this: a SIMD register.
SIMD_BYTES = 64
# primitives that call a jaxpr -> name of the parameter that holds the jaxpr
CALL_JAXPR_PARAMETERS = {
    "closed_call": "call_jaxpr",
    "core_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
    "jit": "jaxpr",
    "pjit": "jaxpr",
}


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


def _scan(inputs: list, lanes: int, *, jaxpr, length, reverse, unroll, **params) -> list:
    """Evaluate a `scan` with lanes last in its body; outputs that depend on lanes are `Batched`."""
    if "ft_in" in params:  # since jax 0.11
        num_consts, num_carry, _ = map(len, params["ft_in"].unpack())
    else:
        num_consts, num_carry = params["num_consts"], params["num_carry"]
    consts, xs = inputs[:num_consts], inputs[num_consts + num_carry :]
    carry = [
        v if isinstance(v, Batched) else jnp.asarray(v, aval.dtype)
        for v, aval in zip(inputs, jaxpr.in_avals, strict=True)
    ][num_consts : num_consts + num_carry]
    batched_as = lambda values, others: [
        Batched(broadcast_to_lanes(v, lanes)) if isinstance(other, Batched) else v
        for v, other in zip(values, others, strict=True)
    ]

    def body(carry, xs):
        outputs = evaluate_jaxpr(jaxpr, [*consts, *carry, *xs], lanes)
        return batched_as(outputs[:num_carry], carry), outputs[num_carry:]

    x_shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), xs)
    while True:
        # a carry has lanes if the body makes it depend on a value with lanes
        before, carry = carry, batched_as(carry, jax.eval_shape(body, carry, x_shapes)[0])
        if jax.tree.structure(before) == jax.tree.structure(carry):
            break
    carry, ys = lax.scan(body, carry, xs, length, reverse=reverse, unroll=unroll)
    return [*carry, *ys]


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
        elif name == "scan" and batched:
            out = _scan(values, lanes, **params)
        elif name == "batch_together":
            out = values
        elif name == "unvmap_any" and batched:
            # a `vmap` around this one reduces over its lanes, too
            out = [eqn.primitive.bind(values[0].x)]
        else:
            out = (
                eqn.primitive.bind(*values, **params)
                if not batched
                else apply_rule(eqn.primitive, values, params, eqn.outvars[0].aval.shape, lanes)
            )
            out = out if eqn.primitive.multiple_results else [out]
            out = [Batched(x) for x in out] if batched else out
        env |= dict(zip(eqn.outvars, out, strict=True))
    return [read(v) for v in jaxpr.outvars]


def tile_size(lanes: int, leaves: list) -> int:
    """Return how many lanes are evaluated together: on a CPU as many as fit into `TILE_BYTES`.

    The tiles of a batch are of equal size, with as little padding as `SIMD_BYTES` allows for.

    leaves: the arguments, of which the widest floating-point type counts.
    """
    if jax.default_backend() != "cpu":
        return max(1, lanes)
    dtypes = [jnp.result_type(x) for x in leaves]
    width = max((d.itemsize for d in dtypes if jnp.issubdtype(d, jnp.floating)), default=8)
    if lanes * width <= TILE_BYTES:
        return max(1, lanes)
    tiles = -(-lanes * width // TILE_BYTES)
    tile_bytes = -(-lanes // tiles) * width
    return -(-tile_bytes // SIMD_BYTES) * SIMD_BYTES // width


def _evaluate_batch(function: Callable, lanes: int, flags: list[bool], args):
    """Evaluate a function for a batch, in tiles of `tile_size` lanes.

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
    tile = tile_size(lanes, leaves)
    count = -(-lanes // tile)

    def evaluate_tile(batched_leaves):
        batched_leaves = iter(batched_leaves)
        out = evaluate_jaxpr(
            closed,
            [
                Batched(next(batched_leaves)) if flag else x
                for x, flag in zip(leaves, flags, strict=True)
            ],
            tile,
        )
        return [broadcast_to_lanes(x, tile) for x in out]

    batch = [x for x, flag in zip(leaves, flags, strict=True) if flag]
    if count == 1:
        out = evaluate_tile([jnp.moveaxis(x, 0, -1) for x in batch])
        return unflatten([jnp.moveaxis(x, -1, 0) for x in out])
    if count * tile != lanes:
        # pad the last tile by copies of the last lane
        batch = [
            jnp.concatenate([x, jnp.broadcast_to(x[-1:], (count * tile - lanes, *x.shape[1:]))])
            for x in batch
        ]
    # transposed before and after the loop: XLA then transposes the batch once, not in every tile
    tiles = [jnp.moveaxis(x.reshape(count, tile, *x.shape[1:]), 1, -1) for x in batch]
    out = [jnp.moveaxis(x, -1, 1) for x in lax.map(evaluate_tile, tiles)]
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
