"""Functions with custom derivative rules that survive every transformation and a second
differentiation, and functions converted so that their closures are differentiable."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax
from jax import core
from jax.interpreters import ad


def custom_primitive(
    name: str,
    function: Callable,
    jvp: Callable,
    transpose: Callable | None = None,
    like: Callable | None = None,
) -> Callable:
    """Return `function` as a JAX primitive with the given derivative rules.

    `jax.custom_jvp` would lose its rule where a scan is linearized and then differentiated again.

    jvp: jvp(primals, tangents) -> (value, tangent), over pytrees with None for zero tangents; the
    rule calls the primitive again for the value.
    transpose: transpose(inputs, cotangents) -> cotangents of the inputs; None: the primitive is not
    linear, and transposing raises NotImplementedError.
    like: a function that is cheaper to trace and whose result has the same shapes and types; None:
        `function` itself.
    """

    def abstract_eval(*args):
        to_struct = lambda x: (
            jax.ShapeDtypeStruct(x.shape, x.dtype) if isinstance(x, core.ShapedArray) else x
        )
        to_aval = lambda x: (
            core.ShapedArray(x.shape, x.dtype) if isinstance(x, jax.ShapeDtypeStruct) else x
        )
        out = eqx.filter_eval_shape(like or function, *jax.tree.map(to_struct, args))
        return jax.tree.map(to_aval, out)

    def not_linear(*_, **__):
        raise NotImplementedError(f"{name} is not linear")

    primitive = eqxi.create_vprim(
        name,
        eqxi.filter_primitive_def(function),
        eqxi.filter_primitive_def(abstract_eval),
        eqxi.filter_primitive_jvp(jvp),
        not_linear
        if transpose is None
        else eqxi.filter_primitive_transpose(transpose, materialise_zeros=True),
    )
    return lambda *args: eqxi.filter_primitive_bind(primitive, *args)


def is_undefined_primal(x) -> bool:
    """Return whether an input of a transpose rule is one whose cotangent the rule returns."""
    return isinstance(x, ad.UndefinedPrimal)


class ClosureConverted(eqx.Module):
    """A function whose closed-over arrays are leaves, as `jax.closure_convert` makes it, so that
    derivatives by these arrays exist.

    `equinox.filter_closure_convert` rejects arguments on another mesh than the example's, and under
    `jax.shard_map` the arguments are on another mesh.
    """

    consts: list[Any]
    jaxpr: Any = eqx.field(static=True)
    out: Any = eqx.field(static=True)

    @classmethod
    def from_function(cls, function: Callable, *example) -> "ClosureConverted":
        """Convert `function` for arguments with the shapes and types of `example`."""
        closed_jaxpr, out, static = eqx.filter_make_jaxpr(function)(*example)
        return cls(closed_jaxpr.consts, closed_jaxpr.jaxpr, (jax.tree.structure(out), static))

    def __call__(self, *args):
        out = core.eval_jaxpr(
            self.jaxpr, self.consts, *jax.tree.leaves(eqx.filter(args, eqx.is_array))
        )
        return eqx.combine(jax.tree.unflatten(self.out[0], out), self.out[1])
