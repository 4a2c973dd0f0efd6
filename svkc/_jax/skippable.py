"""Linear functions that are skipped where a flag is false, as are their transposes.

To transpose a `lax.cond`, JAX first evaluates what is known in its branches and stores these values
for the transpose. A branch that is skipped stores zeros of the same size. In a scan, every
iteration stores them. The functions of this module store their arguments alone.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jax import core
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from svkc._jax.control_flow import unvmap_any
from svkc._jax.primitive import abstract_evaluation, undefined_primals


class Lanes(NamedTuple):
    """A `vmap` of a primitive.

    axes: batch axis of each argument, None if the lanes share it. That of a tangent is 0.
    """

    size: int
    name: Any
    axes: tuple[int | None, ...]


def skippable(name: str, function: Callable, skipped: Callable) -> Callable:
    """Return f(tangents, used, *rest): `function` if `used` holds, else `skipped`.

    Under `vmap`, `function` is evaluated if `used` holds for any lane.

    function, skipped: (tangents, *rest) -> outputs of equal shapes and types, both linear in the
        tangents. The tangents are a pytree of floating-point arrays.
    """

    def value(tangents, used, *rest):
        pick = lambda branch: lambda: branch(tangents, *rest)
        return jax.lax.cond(unvmap_any(used), pick(function), pick(skipped))

    def transpose(inputs, cotangents):
        tangents, used, *rest = inputs
        shapes, known = undefined_primals(tangents)

        def pull_back(branch):
            linear = lambda unknown: branch(eqx.combine(unknown, known), *rest)
            return lambda: jax.linear_transpose(linear, shapes)(cotangents)[0]

        result = jax.lax.cond(unvmap_any(used), pull_back(function), pull_back(skipped))
        return result, None, *jax.tree.map(lambda _: None, tuple(rest))

    like = lambda tangents, used, *rest: skipped(tangents, *rest)
    primitive = Primitive(name)
    primitive.multiple_results = True
    value_of_leaves = eqxi.filter_primitive_def(value)
    implementation = lambda *inputs, lanes=(), **params: _over_lanes(
        lambda *inputs: value_of_leaves(*inputs, **params), lanes, lambda lane: lane.axes
    )(*inputs)
    primitive.def_impl(implementation)
    mlir.register_lowering(primitive, mlir.lower_fun(implementation, multiple_results=True))
    primitive.def_abstract_eval(_shapes(eqxi.filter_primitive_def(abstract_evaluation(like))))
    ad.primitive_jvps[primitive] = _jvp(implementation)
    ad.primitive_transposes[primitive] = _transpose(
        eqxi.filter_primitive_transpose(transpose, materialise_zeros=True)
    )
    batching.axis_primitive_batchers[primitive] = _batch(primitive)

    def bind(tangents, used, *rest):
        assert all(map(eqx.is_array, jax.tree.leaves(tangents)))
        return eqxi.filter_primitive_bind(primitive, tangents, used, *rest)

    return bind


def _over_lanes(function: Callable, lanes: tuple[Lanes, ...], in_axes: Callable) -> Callable:
    """Return the function under each `vmap`, with outputs batched along their first axes.

    in_axes: the function's batch axes in a `vmap`.
    """
    for lane in lanes:
        function = jax.vmap(
            function, in_axes=in_axes(lane), axis_size=lane.size, axis_name=lane.name
        )
    return function


def _shapes(abstract_eval: Callable) -> Callable:
    """Return the rule of shapes under `vmap`, given that of a single lane."""

    def shapes(*avals, lanes: tuple[Lanes, ...] = (), **params):
        def in_one_lane(i, aval):
            shape = list(aval.shape)
            for lane in reversed(lanes):
                if lane.axes[i] is not None:
                    del shape[lane.axes[i]]
            return core.ShapedArray(tuple(shape), aval.dtype)

        outputs = abstract_eval(*(in_one_lane(i, x) for i, x in enumerate(avals)), **params)
        batch_shape = tuple(lane.size for lane in reversed(lanes))
        return [core.ShapedArray((*batch_shape, *x.shape), x.dtype) for x in outputs]

    return shapes


def _jvp(implementation: Callable) -> Callable:
    """Return the derivative rule: JAX's derivative of the implementation."""

    def jvp(primals, tangents, **params):
        changing = [i for i, t in enumerate(tangents) if type(t) is not ad.Zero]

        @jax.checkpoint
        def of_changing(*changed):
            inputs = list(primals)
            for i, x in zip(changing, changed, strict=True):
                inputs[i] = x
            return implementation(*inputs, **params)

        pick = lambda xs: tuple(xs[i] for i in changing)
        return jax.jvp(of_changing, pick(primals), pick(tangents))

    return jvp


def _transpose(transpose: Callable) -> Callable:
    """Return the transpose rule under `vmap`, given that of a single lane."""

    def transpose_lanes(cotangents, *inputs, lanes: tuple[Lanes, ...] = (), **params):
        unknown = [ad.is_undefined_primal(x) for x in inputs]
        pick = lambda xs, mask: [x for x, m in zip(xs, mask, strict=True) if m]
        known = [not x for x in unknown]

        def in_one_lane(cotangents, known_inputs):
            rest = iter(known_inputs)
            one_lane = lambda x: ad.UndefinedPrimal(
                core.ShapedArray(x.aval.shape[len(lanes) :], x.aval.dtype)
            )
            lane_inputs = [
                one_lane(x) if m else next(rest) for x, m in zip(inputs, unknown, strict=True)
            ]
            out = transpose(cotangents, *lane_inputs, **params)
            return [ad.instantiate_zeros(x) for x in pick(out, unknown)]

        in_axes = lambda lane: (0, pick(lane.axes, known))
        results = iter(
            _over_lanes(in_one_lane, lanes, in_axes)(
                [ad.instantiate_zeros(x) for x in cotangents], pick(inputs, known)
            )
        )
        return [next(results) if m else None for m in unknown]

    return transpose_lanes


def _batch(primitive: Primitive) -> Callable:
    """Return the rule of `vmap`. It batches all tangents, so that JAX sums the cotangents of those
    that the lanes share."""

    def batch(axis_size, axis_name, _, inputs, axes, *, treedef, lanes=(), **params):
        count = treedef.children()[0].num_leaves

        def to_front(x, axis):
            if axis is None:
                return jnp.broadcast_to(x, (axis_size, *jnp.shape(x)))
            return jnp.moveaxis(x, axis, 0)

        front = map(to_front, inputs[:count], axes[:count])
        lane = Lanes(axis_size, axis_name, (0,) * count + tuple(axes[count:]))
        out = primitive.bind(
            *front, *inputs[count:], treedef=treedef, lanes=(*lanes, lane), **params
        )
        return out, [0] * len(out)

    return batch
