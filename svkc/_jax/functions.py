"""Comparison of functions given to a run by what they read, so that a new function object is not a
new program.

A function reads closure cells, defaults, and the globals that its code names. If all of these are
of simple kinds (numbers, strings, arrays, containers and pytrees, other functions, objects defined
by libraries), floating-point arrays are data and the rest is static, compared by content. Any other
function is compared by identity.
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

# the static part of each function when it was first seen; the first function of each argument
# and code that is compared by identity
_first_static: weakref.WeakKeyDictionary = weakref.WeakKeyDictionary()
_compared_by_identity: dict[tuple, Any] = {}


def comparable(function) -> Any:
    """Return the function as a `Function`. Any error means that it has to be compared by identity.
    Callables that jax or equinox compare are returned as is.

    As in jax, one function object keeps its program when a number or a list that it reads changes.
    Its arrays are read at each call.
    """
    if not isinstance(
        function, types.FunctionType | types.MethodType | functools.partial
    ) or defined_by_library(function):
        return function
    made = Reader(code_of(function) not in needs_concrete_arrays).parts(function)
    arrays, static = eqx.partition(made, eqx.is_array)
    if jax.tree.structure(_first_static.setdefault(function, static)) != jax.tree.structure(static):
        _first_static[function] = static
    return eqx.combine(arrays, _first_static[function])


def call_with_comparable(program: Callable, **functions) -> Any:
    """Call program(**functions) with comparable functions, so that equal function objects share a
    compiled program.

    functions: one function, or a pytree of them, for each argument name. If Python code in a
    function reads the values of its arrays, tracing fails; the call is then repeated with these
    arrays static.
    """
    while True:
        known, identified = len(needs_concrete_arrays), []

        def given(name, function, identified=identified):
            try:
                return comparable(function)
            except Exception as error:
                # whatever error reading an object raises, the run itself can be made
                identified.append((name, function, error))
                return function

        try:
            out = program(
                **{
                    name: jax.tree.map(functools.partial(given, name), tree)
                    for name, tree in functions.items()
                }
            )
            break
        except CONCRETIZATION_ERRORS:
            if len(needs_concrete_arrays) == known:
                raise
    for name, function, error in identified if is_concrete(out) else ():
        key = name, code_of(function)
        if _compared_by_identity.setdefault(key, function) not in (None, function):
            _compared_by_identity[key] = None
            warnings.warn(
                f"{name}: a new function object with the same code is compiled again; {error}"
                " cannot be compared. Define it outside the loop.",
                stacklevel=3,
            )
    return out
