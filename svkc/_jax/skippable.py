"""Linear functions that are skipped where a flag is false, as are their transposes.

JAX transposes a `lax.cond` in two passes. The first pass stores residuals for both branches. Those
of the branch that is not taken are zeros of full size, and in a scan each iteration stores them. A
function made by `skippable` stores only its arguments and computes the rest again.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jax import core
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from svkc._jax.control_flow import unvmap_any
from svkc._jax.primitive import abstract_evaluation


class _Vmap(NamedTuple):
    """One `vmap` that was applied to a primitive.

    axes: batch axis of each argument. None: it is not batched.
    """

    size: int
    axis_name: Any
    axes: tuple[int | None, ...]


def skippable(name: str, function: Callable, skipped: Callable) -> Callable:
    """Return f(tangents, used, *rest): `function` if `used` holds, else `skipped`.

    Under `vmap`, `function` is evaluated for all lanes if `used` holds for any. It must return the
    values of `skipped` in lanes that are not used, and its derivatives must be finite there.

    function, skipped: (tangents, *rest) -> outputs of equal shapes and types, both linear in the
        tangents. The tangents are a pytree of floating-point arrays, `used` is an array.
    """

    def value(tangents, used, *rest):
        pick = lambda branch: lambda: branch(tangents, *rest)
        return jax.lax.cond(unvmap_any(used), pick(function), pick(skipped))

    without_flag = lambda branch: lambda tangents, used, *rest: branch(tangents, *rest)
    of_leaves = eqxi.filter_primitive_def
    primitive = Primitive(name)
    primitive.multiple_results = True
    implementation = _over_lanes(of_leaves(value))
    primitive.def_impl(implementation)
    mlir.register_lowering(primitive, mlir.lower_fun(implementation, multiple_results=True))
    primitive.def_abstract_eval(_shapes(of_leaves(abstract_evaluation(without_flag(skipped)))))
    ad.primitive_jvps[primitive] = _jvp(implementation)
    ad.primitive_transposes[primitive] = _transpose(
        *(_over_lanes(of_leaves(without_flag(branch))) for branch in (function, skipped))
    )
    batching.axis_primitive_batchers[primitive] = _batch(primitive)
    return lambda *args: eqxi.filter_primitive_bind(primitive, *args)


def _over_lanes(function: Callable) -> Callable:
    """Return a function of leaves under each `vmap` that was applied to the primitive."""

    def over_lanes(*inputs, vmaps: tuple[_Vmap, ...] = (), **params):
        batched = lambda *inputs: function(*inputs, **params)
        for one in vmaps:
            batched = jax.vmap(
                batched, in_axes=one.axes, axis_size=one.size, axis_name=one.axis_name
            )
        return batched(*inputs)

    return over_lanes


def _shapes(abstract_eval: Callable) -> Callable:
    """Return the rule of shapes under `vmap`, given that of a single lane."""

    def shapes(*avals, vmaps: tuple[_Vmap, ...] = (), **params):
        def in_one_lane(i, aval):
            shape = list(aval.shape)
            for one in reversed(vmaps):
                if one.axes[i] is not None:
                    del shape[one.axes[i]]
            return core.ShapedArray(tuple(shape), aval.dtype)

        outputs = abstract_eval(*(in_one_lane(i, x) for i, x in enumerate(avals)), **params)
        batch_shape = tuple(one.size for one in reversed(vmaps))
        return [core.ShapedArray((*batch_shape, *x.shape), x.dtype) for x in outputs]

    return shapes


def _jvp(implementation: Callable) -> Callable:
    """Return the derivative rule: JAX's derivative of the implementation."""

    def jvp(primals, tangents, **params):
        changing = [i for i, t in enumerate(tangents) if type(t) is not ad.Zero]
        of_changing = lambda *xs: implementation(*_merged(primals, changing, xs), **params)
        pick = lambda xs: tuple(xs[i] for i in changing)
        return jax.jvp(jax.checkpoint(of_changing), pick(primals), pick(tangents))

    return jvp


def _transpose(function: Callable, skipped: Callable) -> Callable:
    """Return the transpose rule, given functions of leaves under each `vmap`.

    JAX transposes the batched functions, so that it sums over lanes that share a tangent.
    """

    def transpose(cotangents, *inputs, treedef, **params):
        unknown = [i for i, x in enumerate(inputs) if ad.is_undefined_primal(x)]
        shapes = [
            jax.ShapeDtypeStruct(x.aval.shape, x.aval.dtype)
            for x in map(inputs.__getitem__, unknown)
        ]
        cotangents = [ad.instantiate_zeros(x) for x in cotangents]

        def pull_back(branch):
            linear = lambda *xs: branch(*_merged(inputs, unknown, xs), treedef=treedef, **params)
            return lambda: jax.linear_transpose(linear, *shapes)(cotangents)

        used = inputs[treedef.children()[0].num_leaves]
        results = jax.lax.cond(unvmap_any(jnp.any(used)), pull_back(function), pull_back(skipped))
        return _merged([None] * len(inputs), unknown, results)

    return transpose


def _merged(inputs, indices: list[int], xs) -> list[Any]:
    """Return the inputs with those at the indices replaced by xs."""
    replaced = dict(zip(indices, xs, strict=True))
    return [replaced.get(i, x) for i, x in enumerate(inputs)]


def _batch(primitive: Primitive) -> Callable:
    """Return the rule of `vmap`, which keeps the primitive."""

    def batch(axis_size, axis_name, _, inputs, axes, *, vmaps=(), **params):
        vmaps = (*vmaps, _Vmap(axis_size, axis_name, tuple(axes)))
        out = primitive.bind(*inputs, vmaps=vmaps, **params)
        return out, [0] * len(out)

    return batch
