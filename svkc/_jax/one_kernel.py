"""Functions that XLA compiles to one kernel on a CPU.

XLA's CPU backend starts each kernel of a program separately, which takes 70 to 90 ns. An evaluation
of the equations of motion consists of some 200 kernels of a few operations each. XLA compiles a
called function that has the attribute `xla_cpu_small_call` to one kernel. XLA itself sets this
attribute for small loops, and from jax 0.12 on for most sequences of operations.

jax 0.11 puts some sums into fusions that such a kernel cannot hold. From 0.11 on, `one_kernel`
returns the function unchanged. Remove this module when jax 0.10 is no longer supported.
"""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
from jax.core import Tracer
from jax.extend.core import Primitive
from jax.extend.mlir.dialects import func, stablehlo
from jax.interpreters import ad, batching, mlir
from jax.interpreters.mlir import ir

HAS_ONE_KERNEL = jax.__version__.startswith("0.10.")
_ATTRIBUTES = "mhlo.frontend_attributes"
# operations that do not call XLA's runtime. Sorts, random bits, LAPACK and scatters at several
# indices call it.
_STABLEHLO = set(
    "abs add and atan2 bitcast_convert broadcast_in_dim case cbrt ceil clamp compare concatenate"
    " constant convert cosine divide dynamic_slice dynamic_update_slice exponential"
    " exponential_minus_one floor gather get_tuple_element if iota is_finite log log_plus_one"
    " logistic maximum minimum multiply negate not optimization_barrier or pad power reduce"
    " reduce_precision reduce_window remainder reshape return reverse round_nearest_afz"
    " round_nearest_even rsqrt select shift_left shift_right_arithmetic shift_right_logical sign"
    " sine slice sqrt subtract tan tanh transpose tuple while xor".split()
)
_CHLO = set(
    "acos acosh asin asinh atan atanh constant cosh digamma erf erf_inv erfc lgamma next_after sinh"
    " square tan".split()
)


def one_kernel(function: Callable) -> Callable:
    """Return a function that XLA compiles to one kernel on a CPU, with jax 0.10.

    Its forward derivative is one kernel, too. In reverse mode the forward pass is a kernel that
    stores residuals, and the backward pass is another. With `jax.checkpoint(function)` the backward
    pass recomputes the residuals in its own kernel.

    The function is compiled as usual if an operation calls XLA's runtime or a library (products of
    two matrices), or under `vmap`, because LLVM takes twice as long for a batch
    (benchmarks/README.md). A kernel may contain others: if the outer function is compiled as usual,
    the inner ones remain kernels. A kernel copies arrays that it changes: keep buffers that are
    written in place out of it.
    """
    if not HAS_ONE_KERNEL:
        return function
    jitted = eqx.filter_jit(function)

    @functools.wraps(function)
    def wrapped(*args: Any, **kwargs: Any) -> Any:
        args, kwargs = _map_traced(_input_p.bind, (args, kwargs))
        return _map_traced(_output_p.bind, jitted(*args, **kwargs))

    return wrapped


def _map_traced(function: Callable, tree: Any) -> Any:
    """Apply a function to the traced arrays of a tree."""
    return jax.tree.map(lambda x: function(x) if isinstance(x, Tracer) else x, tree)


def _identity(name: str, batched: Callable = lambda x: x) -> Primitive:
    """Return a primitive that returns its input.

    batched: what a `vmap` puts in place of the primitive. The default drops it.
    """
    primitive = Primitive(name)
    primitive.def_impl(lambda x: x)
    primitive.def_abstract_eval(lambda x: x)
    batching.primitive_batchers[primitive] = lambda inputs, axes: (batched(inputs[0]), axes[0])
    mlir.register_lowering(primitive, lambda _, x: [x])
    return primitive


def _call_of(x: Any) -> Any:
    """Return the call that x is an output of. None: x is no output of a call."""
    if isinstance(x.owner, ir.Block) or x.owner.operation.name != "func.call":
        return None
    return x.owner.operation


def _lower_output(ctx: mlir.LoweringRuleContext, x: Any) -> list[Any]:
    """Lower an output of a call, and let XLA compile the called function to one kernel.

    The call is redirected to a function that packs its inputs into a tuple and calls the kernel.
    XLA aborts the process if a function that becomes one kernel has a parameter that it does not
    use, for example because XLA has replaced this parameter by a constant. The tuple stays in use.
    """
    call, functions = _call_of(x), ctx.module_context.symbol_table
    if call is None or _ATTRIBUTES in call.attributes:
        return [x]
    attributes = lambda **text: ir.DictAttr.get({k: ir.StringAttr.get(v) for k, v in text.items()})
    # the default, which marks a call whose other outputs need not look at it again
    call.attributes[_ATTRIBUTES] = attributes(inlineable="true")
    inputs, outputs = [y.type for y in call.operands], [y.type for y in call.results]
    if not inputs or not _fits(call, functions):
        return [x]
    tuple_type = ir.TupleType.get_tuple(inputs)

    def add_function(types: list[Any], callee: Any, operands: Callable, **attributes_of_call: str):
        with ir.InsertionPoint(ctx.module_context.module.body), ir.Location.unknown():
            new = func.FuncOp("one_kernel", (types, outputs), visibility="private")
        functions.insert(new)
        with ir.InsertionPoint(new.add_entry_block()), ir.Location.unknown():
            inner = func.CallOp(outputs, callee, operands(new.arguments))
            inner.operation.attributes[_ATTRIBUTES] = attributes(**attributes_of_call)
            func.ReturnOp(inner.results)
        return ir.FlatSymbolRefAttr.get(new.name.value)

    entries = lambda args: [stablehlo.get_tuple_element(args[0], i) for i in range(len(inputs))]
    kernel = add_function([tuple_type], call.attributes["callee"], entries, inlineable="false")
    call.attributes["callee"] = add_function(
        inputs,
        kernel,
        lambda args: [stablehlo.tuple(list(args))],
        inlineable="false",
        xla_cpu_small_call="true",
    )
    return [x]


def _lower_batched_output(ctx: mlir.LoweringRuleContext, x: Any) -> list[Any]:
    """Lower an output of a call under `vmap`, which is compiled as usual.

    Another output that is the same for all lanes may have made the call one kernel.
    """
    call, functions = _call_of(x), ctx.module_context.symbol_table
    if call is None:
        return [x]
    callee = call.attributes["callee"]
    if _ATTRIBUTES in call.attributes and _name(callee).startswith("one_kernel"):
        for _ in range(2):  # the function that packs the inputs calls the one that unpacks them
            body = functions[_name(callee)].operation.regions[0].blocks[0]
            (inner,) = (op.operation for op in body.operations if op.operation.name == "func.call")
            callee = inner.attributes["callee"]
        call.attributes["callee"] = callee
    call.attributes[_ATTRIBUTES] = ir.DictAttr.get({"inlineable": ir.StringAttr.get("true")})
    return [x]


def _name(callee: Any) -> str:
    """Return the name of a called function."""
    return ir.FlatSymbolRefAttr(callee).value


def _fits(operation: Any, functions: Any) -> bool:
    """Return whether a kernel can hold an operation and those that it contains or calls."""
    if operation.name == "func.call":
        return _fits(functions[_name(operation.attributes["callee"])].operation, functions)
    dialect, _, name = operation.name.partition(".")
    is_supported = (
        dialect == "func"
        or (dialect == "chlo" and name in _CHLO)
        or (
            dialect == "stablehlo"
            and (
                name in _STABLEHLO
                or _is_small_product(operation)
                or _is_scatter_at_one_index(operation)
            )
        )
    )
    return is_supported and all(
        _fits(inner.operation, functions)
        for region in operation.regions
        for block in region.blocks
        for inner in block.operations
    )


def _is_small_product(operation: Any) -> bool:
    """Return whether an operation is a product of a matrix and a vector, or an outer product.

    Products of matrices call a library.
    """
    if operation.name != "stablehlo.dot_general":
        return False
    numbers = stablehlo.DotDimensionNumbers(operation.attributes["dot_dimension_numbers"])
    batch_or_summed = (
        (*numbers.lhs_batching_dimensions, *numbers.lhs_contracting_dimensions),
        (*numbers.rhs_batching_dimensions, *numbers.rhs_contracting_dimensions),
    )
    shapes = [ir.RankedTensorType(x.type).shape for x in operation.operands]
    return not numbers.lhs_contracting_dimensions or any(
        all(size == 1 for i, size in enumerate(shape) if i not in axes)
        for shape, axes in zip(shapes, batch_or_summed, strict=True)
    )


def _is_scatter_at_one_index(operation: Any) -> bool:
    """Return whether an operation is a scatter at one index.

    XLA replaces it by the update of a slice.
    """
    if operation.name != "stablehlo.scatter":
        return False
    numbers = stablehlo.ScatterDimensionNumbers(operation.attributes["scatter_dimension_numbers"])
    indices = operation.operands[(len(operation.operands) - 1) // 2]
    shape = ir.RankedTensorType(indices.type).shape
    return all(size == 1 for i, size in enumerate(shape) if i != numbers.index_vector_dim)


_input_p = _identity("one_kernel_input")
_batched_output_p = _identity("one_kernel_batched_output", lambda x: _batched_output_p.bind(x))
_output_p = _identity("one_kernel_output", _batched_output_p.bind)
for _primitive in (_output_p, _batched_output_p):
    ad.deflinear2(_primitive, lambda cotangent, _: [cotangent])
# the cotangents of the inputs are the outputs of the derivative's call
ad.deflinear2(_input_p, lambda cotangent, _: [_output_p.bind(cotangent)])
mlir.register_lowering(_output_p, _lower_output, platform="cpu", cacheable=False)
mlir.register_lowering(_batched_output_p, _lower_batched_output, platform="cpu", cacheable=False)
