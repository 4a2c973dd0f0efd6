"""Functions that have derivatives of their own, in every transformation and where they are
differentiated twice; and functions whose closures do."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax
from jax.interpreters import ad


def custom_primitive(
    name: str, function: Callable, jvp: Callable, transpose: Callable | None = None
) -> Callable:
    """The function as an operation of its own; jax.custom_jvp would lose its rule where a scan is
    linearized and then differentiated again.

    jvp(primals, tangents) and transpose(inputs, cotangents) are over trees, None where nothing
    changes; jvp calls the operation again for its value.
    """

    def shapes(*args):
        shaped = lambda x: (
            jax.ShapeDtypeStruct(x.shape, x.dtype) if isinstance(x, jax.core.ShapedArray) else x
        )
        abstract = lambda x: (
            jax.core.ShapedArray(x.shape, x.dtype) if isinstance(x, jax.ShapeDtypeStruct) else x
        )
        return jax.tree.map(abstract, eqx.filter_eval_shape(function, *jax.tree.map(shaped, args)))

    def not_linear(*_, **__):
        raise NotImplementedError(f"{name} is not linear")

    defined, shaped_like = eqxi.filter_primitive_def(function), eqxi.filter_primitive_def(shapes)
    backwards = (
        not_linear
        if transpose is None
        else eqxi.filter_primitive_transpose(transpose, materialise_zeros=True)
    )
    primitive = eqxi.create_vprim(
        name, defined, shaped_like, eqxi.filter_primitive_jvp(jvp), backwards
    )
    return lambda *args: eqxi.filter_primitive_bind(primitive, *args)


def is_cotangent_of(x) -> bool:
    """Return whether an input of a transpose is one whose cotangent is asked for."""
    return isinstance(x, ad.UndefinedPrimal)


class ClosureConverted(eqx.Module):
    """A function with all the arrays that it closes over as leaves, so that it can be
    differentiated by them.

    (equinox's own refuses arguments on another mesh than the example's, which are the same arrays
    seen from within `jax.shard_map`.)
    """

    consts: list[Any]
    jaxpr: Any = eqx.field(static=True)
    out: Any = eqx.field(static=True)

    @classmethod
    def from_function(cls, function: Callable, *example) -> "Closed":
        """`function`, for arguments like these."""
        made, out, static = eqx.filter_make_jaxpr(function)(*example)
        return cls(made.consts, made.jaxpr, (jax.tree.structure(out), static))

    def __call__(self, *args):
        out = jax.core.eval_jaxpr(
            self.jaxpr, self.consts, *jax.tree.leaves(eqx.filter(args, eqx.is_array))
        )
        return eqx.combine(jax.tree.unflatten(self.out[0], out), self.out[1])
