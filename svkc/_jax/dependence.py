"""On which of its inputs each output of a function depends, found in its JAX expression.

The result holds at all points. Derivatives at sample points would not do: those of max(0, q - 3)
are zero at most points. The result is conservative: an output may be reported as dependent on an
input on which it does not depend. Custom derivative rules are not looked at: they must agree with
the values of the function.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Literal

# how an output depends on an input: not, with a constant derivative, or in another way
NONE, LINEAR, NONLINEAR = np.uint8(0), np.uint8(1), np.uint8(2)
# primitives whose outputs are linear in all inputs, element by element
_SUMS = {"add", "sub", "add_any", "neg", "copy", "copy_p", "real", "reduce_precision"}
# other primitives that act element by element
_ELEMENTWISE = {
    *("abs", "acos", "acosh", "and", "asin", "asinh", "atan", "atan2", "atanh", "cbrt", "ceil"),
    *("clamp", "cos", "cosh", "digamma", "div", "eq", "erf", "erf_inv", "erfc", "exp", "exp2"),
    *("expm1", "floor", "ge", "gt", "integer_pow", "is_finite", "le", "lgamma", "log", "log1p"),
    *("log2", "logistic", "lt", "max", "min", "ne", "not", "one_minus_square", "or", "pow"),
    *("rem", "round", "rsqrt"),
    *("select_n", "sign", "sin", "sinh", "sqrt", "square", "tan", "tanh", "xor"),
}
# primitives that only move entries of inputs, and the number of these inputs; indices follow
_MOVES = {"gather": 1, "dynamic_slice": 1, "static_take": 1}
# primitives that call an expression, and the parameters that may hold it
_CALLS = {
    *("jit", "pjit", "closed_call", "core_call", "checkpoint", "remat", "remat2"),
    *("custom_jvp_call", "custom_vjp_call", "custom_vjp_call_jaxpr"),
}
_EXPRESSIONS = ("jaxpr", "call_jaxpr", "fun_jaxpr")


def dependence(function: Callable, *arguments: jax.Array) -> np.ndarray:
    """Return how each output number depends on each input number [outputs inputs].

    The entries are NONE, LINEAR and NONLINEAR. An input is linear if the derivative by it is
    constant, also where other inputs change.

    function: of the arguments, returns one array [outputs]. arguments: only shapes are used.
    """
    closed = jax.make_jaxpr(function)(*arguments)
    n = sum(int(np.size(x)) for x in arguments)
    entries, begin = [], 0
    for x in arguments:
        own = np.zeros((int(np.size(x)), n), np.uint8)
        own[:, begin : begin + len(own)] = LINEAR * np.eye(len(own), dtype=np.uint8)
        entries.append(own.reshape(*np.shape(x), n))
        begin += len(own)
    (result,) = _Walk(n).outputs(closed.jaxpr, closed.consts, entries)
    return result


def _used(x: np.ndarray) -> np.ndarray:
    """Return an array of dependence in which every dependence is nonlinear."""
    return NONLINEAR * (x > 0).astype(np.uint8)


class _Walk:
    """Walk through an expression. Arrays of dependence have a last axis over the n inputs."""

    def __init__(self, n: int):
        self.n = n

    def outputs(
        self, jaxpr: Any, consts: Sequence[Any], inputs: Sequence[np.ndarray]
    ) -> list[np.ndarray]:
        """Return the dependence of an expression's outputs from that of its inputs."""
        # dependence of each variable, and values of constant indices
        known = {var: self._none(var) for var in jaxpr.constvars}
        known |= dict(zip(jaxpr.invars, inputs, strict=True))
        values = dict(zip(jaxpr.constvars, consts, strict=True))
        read = lambda x: self._none(x) if isinstance(x, Literal) else known[x]
        value = lambda x: x.val if isinstance(x, Literal) else values.get(x)
        for eqn in jaxpr.eqns:
            constants = [value(x) for x in eqn.invars]
            if _is_index(eqn) and all(x is not None for x in constants):
                values[eqn.outvars[0]] = eqn.primitive.bind(*constants, **eqn.params)
            result = self._equation(eqn, [read(x) for x in eqn.invars], constants)
            known |= dict(zip(eqn.outvars, result, strict=True))
        return [read(x) for x in jaxpr.outvars]

    def _none(self, var: Any) -> np.ndarray:
        return np.zeros((*var.aval.shape, self.n), np.uint8)

    def _equation(
        self, eqn: Any, inputs: list[np.ndarray], constants: list[Any]
    ) -> list[np.ndarray]:
        """Return the dependence of the outputs of one equation. constants: known inputs."""
        shapes, name = [var.aval.shape for var in eqn.outvars], eqn.primitive.name
        if not any(x.any() for x in inputs):
            return [np.zeros((*shape, self.n), np.uint8) for shape in shapes]
        inner = next((eqn.params[key] for key in _EXPRESSIONS if key in eqn.params), None)
        if inner is not None and name in _CALLS:
            jaxpr, consts = getattr(inner, "jaxpr", inner), getattr(inner, "consts", ())
            if len(jaxpr.invars) == len(inputs) and len(jaxpr.constvars) == len(consts):
                return self.outputs(jaxpr, consts, inputs)
        if name == "batch_together":
            return inputs
        if name == "split":
            ends = np.cumsum(eqn.params["sizes"])
            return np.split(inputs[0], ends[:-1], eqn.params["axis"])
        if name == "unstack":
            return list(np.moveaxis(inputs[0], eqn.params["axis"], 0))
        if len(shapes) > 1:
            return [self._anywhere(inputs, shape, NONLINEAR) for shape in shapes]
        if name in _MOVES and all(x is not None for x in constants[_MOVES[name] :]):
            return [self._gathered(eqn, inputs[0], constants[1:])]
        if name == "scatter" and constants[1] is not None:
            return [self._scattered(eqn, inputs[0], constants[1], inputs[2])]
        return [self._single(name, eqn.params, inputs, shapes[0])]

    def _gathered(self, eqn: Any, x: np.ndarray, indices: list[Any]) -> np.ndarray:
        """Return the dependence of entries of x at constant indices."""
        places = jnp.arange(1, x.size // self.n + 1).reshape(x.shape[:-1])
        places = np.asarray(eqn.primitive.bind(places, *indices, **eqn.params))
        flat = np.concatenate([np.zeros((1, self.n), np.uint8), x.reshape(-1, self.n)])
        # entries outside the array are filled with zeros, or with the largest or smallest integer
        return flat[np.where((places > 0) & (places < len(flat)), places, 0)]

    def _scattered(self, eqn: Any, x: np.ndarray, index: Any, updates: np.ndarray) -> np.ndarray:
        """Return the dependence of x with some entries replaced, at constant indices."""
        rows = np.concatenate([x.reshape(-1, self.n), updates.reshape(-1, self.n)])
        places = jnp.arange(len(rows))
        of_x, of_updates = jnp.split(places, [x.size // self.n])
        of_x, of_updates = of_x.reshape(x.shape[:-1]), of_updates.reshape(updates.shape[:-1])
        return rows[np.asarray(eqn.primitive.bind(of_x, index, of_updates, **eqn.params))]

    def _single(self, name: str, params: Any, inputs: list[np.ndarray], shape) -> np.ndarray:
        """Return the dependence of the single output, of this shape, of a primitive."""
        x, rest = inputs[0], inputs[1:]
        moved = _moved(name, params, x, shape)
        if moved is not None:
            return moved
        if name == "concatenate":
            return np.concatenate(inputs, params["dimension"])
        if name == "stack":
            return np.stack(inputs, params["axis"])
        if name in _SUMS:
            return self._elementwise(inputs, shape)
        if name in ("mul", "dot_general"):
            a, b = inputs if name == "mul" else _factors(params, inputs)
            return self._product(a, b, shape)
        if name == "div" and not rest[0].any():
            return self._elementwise(inputs, shape)
        if name == "select_n" and not x.any():
            return self._elementwise(rest, shape)
        if name in _ELEMENTWISE:
            return _used(self._elementwise(inputs, shape))
        return self._anywhere(inputs, shape, NONLINEAR)

    def _elementwise(self, inputs: list[np.ndarray], shape) -> np.ndarray:
        """Return the dependence of an output whose elements depend on those of the inputs."""
        result = np.zeros((*shape, self.n), np.uint8)
        for x in inputs:
            result = np.maximum(result, x)
        return result

    def _product(self, a: np.ndarray, b: np.ndarray, shape) -> np.ndarray:
        """Return the dependence of a product: nonlinear where both factors depend on inputs."""
        both = a.any(-1, keepdims=True) & b.any(-1, keepdims=True)
        total = self._elementwise([a, b], shape)
        return np.where(both, _used(total), total)

    def _anywhere(self, inputs: list[np.ndarray], shape, least: np.uint8 = NONE) -> np.ndarray:
        """Return the dependence of an output whose elements depend on all those of the inputs."""
        union = np.zeros(self.n, np.uint8)
        for x in inputs:
            union = np.maximum(union, x.reshape(-1, self.n).max(0, initial=0))
        union = np.where(union > 0, np.maximum(union, least), NONE)
        return np.broadcast_to(union, (*shape, self.n))


def _moved(name: str, params: Any, x: np.ndarray, shape) -> np.ndarray | None:
    """Return the dependence of the output of a primitive that reorders or sums entries, or None."""
    n, result = x.shape[-1], None
    if name in ("reshape", "squeeze", "expand_dims"):
        result = x.reshape(*shape, n)
    elif name == "transpose":
        result = x.transpose(*params["permutation"], x.ndim - 1)
    elif name == "broadcast_in_dim":
        axes = [1] * len(shape)
        for i, axis in enumerate(params["broadcast_dimensions"]):
            axes[axis] = x.shape[i]
        result = np.broadcast_to(x.reshape(*axes, n), (*shape, n))
    elif name == "slice":
        steps = params["strides"] or (1,) * len(shape)
        bounds = zip(params["start_indices"], params["limit_indices"], steps)
        result = x[tuple(slice(*b) for b in bounds)]
    elif name == "rev":
        result = np.flip(x, params["dimensions"])
    elif name == "reduce_sum":
        result = x.max(tuple(params["axes"]), initial=0)
    elif name == "convert_element_type":
        result = x if np.issubdtype(params["new_dtype"], np.inexact) else _used(x)
    return result


def _factors(params: Any, inputs: list[np.ndarray]) -> list[np.ndarray]:
    """Return the factors of a `dot_general` such that its output is their product by elements."""
    (contract, batch), result = params["dimension_numbers"], []
    free = [
        [i for i in range(x.ndim - 1) if i not in (*c, *b)]
        for x, c, b in zip(inputs, contract, batch)
    ]
    for k, (x, c, b) in enumerate(zip(inputs, contract, batch)):
        x = x.transpose(*b, *free[k], *c, x.ndim - 1)
        x = x.max(tuple(range(len(b) + len(free[k]), x.ndim - 1)), initial=0)
        other = [1] * len(free[1 - k])
        own = x.shape[len(b) : -1]
        middle = (*own, *other) if k == 0 else (*other, *own)
        result.append(x.reshape(*x.shape[: len(b)], *middle, x.shape[-1]))
    return result


def _is_index(eqn: Any) -> bool:
    """Return whether the output of an equation is an array of integers or Booleans."""
    return len(eqn.outvars) == 1 and eqn.outvars[0].aval.dtype.kind in "iub"
