"""Functions with custom derivative rules that survive every transformation and a second
differentiation, and functions converted so that their closures are differentiable."""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax
from jax import core
from jax.interpreters import ad

# number of structures of arguments for which a primitive remembers the shapes of its results
SHAPES_CACHE_SIZE = 32


def custom_primitive(
    name: str,
    function: Callable,
    jvp: Callable,
    transpose: Callable | None = None,
    like: Callable | None = None,
) -> Callable:
    """Return `function` as a JAX primitive with the given derivative rules.

    `jax.custom_jvp` would lose its rule where a scan is linearized and then differentiated again.

    jvp: jvp(primals, tangents) -> (value, tangent), over pytrees with None for zero tangents. A
    rule that is to apply in later differentiations, too, calls the primitive for the value.
    transpose: transpose(inputs, cotangents) -> cotangents of the inputs; None: the primitive is not
    linear, and transposing raises NotImplementedError.
    like: a function that is cheaper to trace and whose result has the same shapes and types; None:
        `function` itself.
    """

    def not_linear(*_, **__):
        raise NotImplementedError(f"{name} is not linear")

    implementation = eqxi.filter_primitive_def(function)
    primitive = eqxi.create_vprim(
        name,
        implementation,
        eqxi.filter_primitive_def(abstract_evaluation(like or function)),
        eqxi.filter_primitive_jvp(jvp),
        not_linear
        if transpose is None
        else eqxi.filter_primitive_transpose(transpose, materialise_zeros=True),
    )
    return lambda *args: eqxi.filter_primitive_bind(primitive, *args)


def abstract_evaluation(function: Callable) -> Callable:
    """Return a function that computes the shapes and types of `function`'s results.

    JAX asks for them in every transformation. The latest are remembered.
    """

    @functools.lru_cache(maxsize=SHAPES_CACHE_SIZE)
    def output_shapes(treedef, leaves: tuple, types: tuple, default_dtype: Any):
        return eqx.filter_eval_shape(function, *jax.tree.unflatten(treedef, leaves))

    def abstract_eval(*args):
        to_struct = lambda x: (
            jax.ShapeDtypeStruct(x.shape, x.dtype) if isinstance(x, core.ShapedArray) else x
        )
        to_aval = lambda x: (
            core.ShapedArray(x.shape, x.dtype) if isinstance(x, jax.ShapeDtypeStruct) else x
        )
        leaves, treedef = jax.tree.flatten(jax.tree.map(to_struct, args))
        # the types are part of the key because True == 1
        key = treedef, tuple(leaves), tuple(map(type, leaves)), jax.dtypes.canonicalize_dtype(float)
        shapes = output_shapes if _is_hashable(key) else output_shapes.__wrapped__
        return jax.tree.map(to_aval, shapes(*key))

    return abstract_eval


def _is_hashable(x: Any) -> bool:
    """Return whether `hash(x)` is defined."""
    try:
        hash(x)
    except TypeError:
        return False
    return True


def undefined_primals(tree: Any) -> tuple[Any, Any]:
    """Split the inputs of a transpose rule into undefined primals and known values.

    Returns the shapes and types of the undefined primals, whose cotangents the rule returns, and
    the known values. Each of the two trees has None in place of the leaves of the other.
    """
    is_undefined = lambda x: isinstance(x, ad.UndefinedPrimal)
    struct = lambda x: jax.ShapeDtypeStruct(x.aval.shape, x.aval.dtype)
    split = lambda f, g: jax.tree.map(
        lambda x: f(x) if is_undefined(x) else g(x), tree, is_leaf=is_undefined
    )
    return split(struct, lambda _: None), split(lambda _: None, lambda x: x)


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
