"""F2: functions that are given to a compiled program, so that a new function object is not a new program."""

import functools
import types
import warnings
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax

from svkc.comparing import IncomparableError, Same, differing, facts, loosened, note_writes, of_library
from svkc.dissection import Reader
from svkc.given import concrete
from svkc.parts import Making

# code of functions that use their arrays as Python does, in conditions or as numpy's own: programs hold those arrays
_arrays_in_program: set = set()
# keys of what was compiled, by the same without what is compared by identity; and what was warned of
_compiled: dict[tuple, tuple] = {}
_warned: set = set()


class Recipe:
    """How a function is made of arrays. Equal where the functions differ by these arrays alone, so that their programs are one."""

    def __init__(self, key, make: Callable, reason=None):
        self.key, self.make, self.reason, self.kept = key, make, reason, []
        self.traced = self.failed = False
        self._hash = hash(key)

    def __eq__(self, other):
        return self is other or (type(other) is Recipe and self._hash == other._hash and self.key == other.key)

    def __hash__(self):
        return self._hash


class Function(eqx.Module):
    """A Python function whose arrays are leaves, and the rest of which is static and compared by content."""

    arrays: list
    recipe: Recipe = eqx.field(static=True)

    def __call__(self, *args):
        # Python is here only while jax traces
        self.recipe.traced = True
        try:
            return self.recipe.make(self.arrays)(*args)
        except Exception:
            self.recipe.failed = True
            raise


def _code(function):
    """What stays the same when a line makes a function anew."""
    if isinstance(function, types.MethodType):
        return _code(function.__func__)
    if isinstance(function, functools.partial):
        return _code(function.func)
    return function.__code__ if isinstance(function, types.FunctionType) else type(function)


def comparable(function) -> Any:
    """The function as `Function`, by identity where it cannot be compared; what jax and equinox compare themselves as it is."""
    plain = isinstance(function, types.FunctionType | types.MethodType) or type(function) is functools.partial
    if not plain and (not callable(function) or isinstance(function, type | eqx.Module) or of_library(type(function))):
        return function
    code = _code(function)
    reader = Reader(code not in _arrays_in_program, isinstance(code, types.CodeType) and facts(code).changes)
    try:
        part = reader.read(function)
        recipe = Recipe(part.key, (lambda arrays: part.make(Making(arrays, {}))) if reader.arrays else lambda arrays: function)
    except Exception as error:
        # (whatever a thing does as it is looked at, the call is to be made)
        reason = error.args[0] if isinstance(error, IncomparableError) else function
        # a bound method is made anew wherever it is named
        key = (Same(function.__func__), Same(function.__self__)) if isinstance(function, types.MethodType) else Same(function)
        return Function([], Recipe(key, lambda arrays: function, reason))
    recipe.kept = reader.kept
    return Function(reader.arrays, recipe)


def shared(program: Callable, functions: list[tuple[str, Any]], rest) -> Any:
    """program(*functions), the functions as `Function`s, each given with the name of the argument that it is; rest: what else the program depends on.

    Arrays are data first. Where tracing fails the functions that had some get them as they are, and are remembered by their code.
    """
    tried = set()
    while True:
        given = [comparable(function) for _, function in functions]
        new = [(name, f, g) for (name, f), g in zip(functions, given, strict=True) if isinstance(g, Function) and g is not f]
        try:
            out = program(*given)
            break
        except Exception as error:
            traced = [(f, g.recipe) for _, f, g in new if g.recipe.traced and g.arrays]
            codes = {_code(f) for f, recipe in traced if recipe.failed} or {_code(f) for f, _ in traced}
            # a program that was compiled and ran may fail too
            if isinstance(error, RuntimeError) or not codes - tried:
                _arrays_in_program.difference_update(tried)
                raise
            tried |= codes
            _arrays_in_program.update(codes)
        finally:
            for _, _, g in new:
                if g.recipe.traced:
                    note_writes(g.recipe.kept)
                g.recipe.kept = []
    if any(g.recipe.traced for _, _, g in new):
        _note(new, rest)
    return out


def _note(functions: list[tuple[str, Any, Function]], rest) -> None:
    """Remembers what was compiled, and warns where it was before, but for function objects that could not be compared."""
    keys = tuple(g.recipe.key for _, _, g in functions)
    loose = [_code(f) if g.recipe.reason is not None else loosened(g.recipe.key) for _, f, g in functions]
    if keys == tuple(loose) or not concrete(rest, [g.arrays for _, _, g in functions]):
        return
    # (not their hash: jax's trees have the same one whatever is static in them)
    before = _compiled.setdefault((_signature(rest), *loose), keys)
    for (name, f, g), old in zip(functions, before, strict=True):
        if g.recipe.key == old or (name, _code(f)) in _warned:
            continue
        _warned.add((name, _code(f)))
        what = g.recipe.reason if g.recipe.reason is not None else next(differing(g.recipe.key, old), f)
        what = "a variable that it assigns" if isinstance(what, types.CellType) else f"an object of type {type(what).__name__} in it"
        warnings.warn(
            f"{name}: a new function object with the same code was compiled again, for {what} cannot be compared; define it outside the loop", stacklevel=4
        )


def _signature(rest):
    """What a program is compiled for, as jax sees it: shapes and types of arrays, everything else as it is."""

    def told(x):
        if eqx.is_array(x):
            return x.shape, str(x.dtype)
        try:
            hash(x)
        except TypeError:
            return id(x)
        return x

    leaves, shape = jax.tree.flatten(rest)
    return shape, tuple(map(told, leaves))
