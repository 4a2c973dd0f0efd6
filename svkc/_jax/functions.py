"""Comparison of user functions by content, so that a new function object with equal content reuses
a compiled program.

The content of a function is its code, closure cells, defaults, and the globals that its code names.
If all of these are of comparable kinds (numbers, strings, arrays, containers and pytrees, other
functions, objects defined by libraries), floating-point arrays are data and the rest is static,
compared by content. Any other function is compared by identity.
"""

import functools
import types
import warnings
import weakref
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax

from svkc._jax.function_values import (
    CONCRETIZATION_ERRORS,
    Reader,
    code_of,
    defined_by_library,
    needs_concrete_arrays,
)
from svkc._jax.pytrees import is_concrete

# function -> its static part at the first call
_first_static: weakref.WeakKeyDictionary = weakref.WeakKeyDictionary()
# (argument name, code) -> the first function compared by identity, None once a warning was issued
_compared_by_identity: dict[tuple, Any] = {}


def comparable(function) -> Any:
    """Return the function as a `FunctionPytree`.

    Callables that JAX or equinox compare themselves are returned unchanged. Raises any error if the
    function has to be compared by identity.

    As with `jax.jit`, one function object keeps its program when a number or a list that the
    function reads changes. Arrays are read at each call.
    """
    if not isinstance(
        function, types.FunctionType | types.MethodType | functools.partial
    ) or defined_by_library(function):
        return function
    decomposed = Reader(code_of(function) not in needs_concrete_arrays).parts(function)
    arrays, static = eqx.partition(decomposed, eqx.is_array)
    if jax.tree.structure(_first_static.setdefault(function, static)) != jax.tree.structure(static):
        _first_static[function] = static
    return eqx.combine(arrays, _first_static[function])


def call_with_comparable(program: Callable, **functions) -> Any:
    """Call program(**functions) with comparable functions, so that function objects with equal
    content share a compiled program.

    If Python code in a function reads values of its arrays, tracing fails. The call is then
    repeated with these arrays static. A UserWarning names a function compared by identity if a
    second function object with the same code is compiled.

    functions: one function, or a pytree of functions, for each argument name.
    """
    while True:
        known_codes, incomparable = len(needs_concrete_arrays), []

        def as_comparable(name, function, incomparable=incomparable):
            try:
                return comparable(function)
            except Exception as error:
                # an object may raise any error when it is read; the call works without comparison
                incomparable.append((name, function, error))
                return function

        try:
            out = program(
                **{
                    name: jax.tree.map(functools.partial(as_comparable, name), tree)
                    for name, tree in functions.items()
                }
            )
            break
        except CONCRETIZATION_ERRORS:
            if len(needs_concrete_arrays) == known_codes:
                raise
    for name, function, error in incomparable if is_concrete(out) else ():
        key = name, code_of(function)
        if _compared_by_identity.setdefault(key, function) not in (None, function):
            _compared_by_identity[key] = None
            warnings.warn(
                f"{name}: a new function object with the same code is compiled again; {error}"
                " cannot be compared. Define it outside the loop.",
                stacklevel=3,
            )
    return out
