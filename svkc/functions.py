"""F2: functions given to a run, compared by what they read, so that a new function object is not a new program.

A function reads closure cells, defaults, and globals under the names in its code. Where all of these are of simple kinds (numbers, texts, arrays, containers
and pytrees, other functions, what libraries define) floating-point arrays are data and the rest is compared by content. Any other is compared by identity.
"""

import dataclasses
import dis
import enum
import functools
import os
import site
import sys
import sysconfig
import types
import warnings
import weakref
from collections.abc import Callable
from typing import Any, NoReturn

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from svkc.given import concrete

PLAIN = (type(None), bool, int, float, complex, str, bytes, range, type(...))
# what libraries define does not change between two calls; svkc is one of them, wherever its sources are
_PATHS = {sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")} | {*site.getsitepackages(), site.getusersitepackages()}
LIBRARIES = tuple(path + os.sep for path in (*_PATHS, os.path.dirname(os.path.abspath(__file__))))
# how jax says that Python looks at numbers that are traced
LOOKED_AT = (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError, jax.errors.TracerIntegerConversionError)
LOOKED_AT += (jax.errors.TracerBoolConversionError, jax.errors.NonConcreteBooleanIndexError)
JIT = type(jax.jit(len))
# code of functions that look at their arrays; what is static in a function, as it was first; by argument and code, the first function told by identity
_looking: set = set()
_first: weakref.WeakKeyDictionary = weakref.WeakKeyDictionary()
_identified: dict[tuple, Any] = {}


@dataclasses.dataclass(frozen=True)
class Still:
    """A thing without data, compared by a key: its content, or its id. It is the original, so that what a function writes to a list is there afterwards."""

    key: Any
    thing: Any = dataclasses.field(compare=False)


def _refuse(what: str) -> NoReturn:
    """Raises an error that does not reach the caller of a run."""
    error = TypeError(what)
    raise error


class Function(eqx.Module):
    """A function, or a container that it reads, made anew as build(*parts): arrays, which are leaves, `Still`s, and others. What it writes there is lost."""

    parts: list
    build: Callable = eqx.field(static=True)

    def made(self):
        """The function or the container itself."""
        return self.build(*(x.made() if isinstance(x, Function) else x.thing if isinstance(x, Still) else x for x in self.parts))

    def __call__(self, *args):
        function = self.made()
        try:
            return function(*args)
        except LOOKED_AT:
            if any(map(eqx.is_array, jax.tree.leaves(self.parts))):
                _looking.add(_code(function))
            raise


def _function(code, space, names, defaults, kwdefaults, *values) -> types.FunctionType:
    # (imported modules come last, and Python finds them itself)
    cells = tuple(map(types.CellType, values[len(names) :][: len(code.co_freevars)]))
    f = types.FunctionType(code, {**space, **dict(zip(names, values))}, code.co_name, defaults, cells)
    f.__kwdefaults__ = kwdefaults
    return f


_partial = lambda function, args, keywords: functools.partial(function, *args, **keywords)
_dict = lambda keys, *values: dict(zip(keys, values))
_tree = lambda shape, *parts: jax.tree.unflatten(shape, parts)


def _of_library(space) -> bool:
    """Whether a module, by its globals, is one of Python, of an installed package, or of svkc."""
    return str(space.get("__file__")).startswith(LIBRARIES) or getattr(space.get("__spec__"), "origin", None) in ("built-in", "frozen")


def _named(x) -> bool:
    """Whether a library defines it: a module, a class, or what a module calls so. A jit-wrapped function may be any module's: jax tells it by identity."""
    if isinstance(x, types.ModuleType):
        return _of_library(vars(x))
    found = sys.modules.get(str(getattr(x, "__module__", None)))
    if found is None or not (_of_library(vars(found)) or isinstance(x, JIT)):
        return False
    for name in str(getattr(x, "__qualname__", None) or getattr(x, "__name__", None)).split("."):
        found = getattr(found, name, None)
    return found is x or isinstance(x, type)


@functools.cache
def _facts(code: types.CodeType) -> tuple[set[str], set[str], set[str]]:
    """Names in a code object and those nested in it, modules that they import, and variables outside that they assign or delete."""
    lines = [(line.opname, line.argval) for line in dis.get_instructions(code)]
    names, imports = set(code.co_names), {name for operation, name in lines if operation == "IMPORT_NAME"}
    written = {name for operation, name in lines if operation in ("STORE_GLOBAL", "DELETE_GLOBAL", "STORE_DEREF", "DELETE_DEREF")} - set(code.co_cellvars)
    for inner in (_facts(x) for x in code.co_consts if isinstance(x, types.CodeType)):
        names, imports, written = names | inner[0], imports | inner[1], written | inner[2] - set(code.co_cellvars)
    return names, imports, written


def _split(f: types.FunctionType):
    """How a function is built, and of what: code, globals, names among them, and what it reads."""
    names, imports, written = _facts(f.__code__)
    if written or set(vars(f)) - {"__wrapped__"}:
        _refuse("a variable outside that it assigns" if written else "a function with attributes")
    # globals of libraries stay as they are
    space, own = f.__globals__, not _of_library(f.__globals__)
    names, imports = (tuple(sorted(found)) if own else () for found in (names & space.keys(), imports))
    read = [*(space[name] for name in names), *(cell.cell_contents for cell in f.__closure__ or ()), *(sys.modules[name] for name in imports)]
    return _function, [Still(f.__code__, f.__code__), Still(id(space), space), names, f.__defaults__, f.__kwdefaults__, *read]


class _Reader:
    """Takes apart what one function reads. as_data: whether floating-point arrays are data."""

    def __init__(self, as_data: bool):
        # by id: what was read before, None where it is being read
        self.as_data, self.known = as_data, {}

    def read(self, x):
        """An array, a `Still`, or a `Function` of parts. IncomparableError: it is not of a simple kind."""
        kind = type(x)
        if kind is Still:
            return x
        if kind in PLAIN or isinstance(x, enum.Enum | np.dtype):
            # by their text nan is itself, and -0.0 is not 0.0
            return Still((kind, repr(x) if kind in (float, complex) else x), x)
        if isinstance(x, np.ndarray | np.generic | jax.Array):
            return self.array(x)
        if _named(x):
            return Still(id(x), x)
        if id(x) in self.known:
            # or functions that call each other would be gone through again and again
            return self.known[id(x)] or _refuse("something that holds itself")
        parts = self.parts(x)
        del self.known[id(x)]
        leaves, shape = jax.tree.flatten(parts)
        if not all(isinstance(leaf, Still) for leaf in leaves):
            return parts
        self.known[id(x)] = Still(("again", len(self.known)), x)
        return Still((shape, *leaves), x)

    def array(self, x):
        if isinstance(x, jax.Array):
            # tracers always are data, and so is what cannot be looked at here
            data = self.as_data or not concrete(x) or jnp.issubdtype(x.dtype, jax.dtypes.extended) or not x.is_fully_addressable
        elif x.dtype.hasobject or type(x) not in (np.ndarray, x.dtype.type):
            _refuse("an array of objects or of a class of its own")
        else:
            # whole numbers are sizes and indices, which Python needs to know; jax has no long double
            data = self.as_data and jnp.issubdtype(x.dtype, jnp.inexact) and x.dtype.char not in "gG"
        return x if data else Still((type(x), repr(x.dtype), getattr(x, "weak_type", False), x.shape, np.asarray(x).tobytes()), x)

    def parts(self, x) -> Function:
        """Of a function or a container."""
        kind = type(x)
        self.known[id(x)] = None
        if kind is types.FunctionType:
            build, parts = _split(x)
        elif kind is functools.partial:
            build, parts = _partial, [x.func, x.args, x.keywords]
        elif kind is slice:
            build, parts = slice, [x.start, x.stop, x.step]
        elif kind is dict:
            # in its own order, which jax does not keep
            build, parts = _dict, [tuple(x), *x.values()]
        elif isinstance(x, dict) or jax.tree_util.all_leaves([x]):
            _refuse(f"an object of type {kind.__name__}")
        else:
            parts, shape = eqx.tree_flatten_one_level(x)
            # (jax takes the hash of a tree even where what is static in it has none)
            hash(tuple(getattr(x, f.name) for f in dataclasses.fields(x) if f.metadata.get("static")) if isinstance(x, eqx.Module) else shape.node_data())
            build, parts = _tree, [Still(shape, shape), *parts]
        return Function([self.read(part) for part in parts], build)


def _code(function):
    """What stays the same when a line makes a function anew."""
    return getattr(getattr(function, "func", function), "__code__", type(function))


def comparable(function) -> Any:
    """The function as a `Function`; what jax and equinox compare themselves as it is. Any error: it is to be compared by identity.
    The same function object keeps its static part and so its program, as is usual in jax, also when a number or a list that it reads has changed; its arrays
    are read anew.
    """
    if not isinstance(function, types.FunctionType | types.MethodType | functools.partial) or _named(function):
        return function
    made = _Reader(_code(function) not in _looking).parts(function)
    arrays, static = eqx.partition(made, eqx.is_array)
    if jax.tree.structure(_first.setdefault(function, static)) != jax.tree.structure(static):
        _first[function] = static
    return eqx.combine(arrays, _first[function])


def shared(program: Callable, **functions) -> Any:
    """program(**functions), by a program that new function objects share; functions: by the names of the arguments that they are, or pytrees of them.
    Where a function looks at its arrays, the program is made once more with those as they are.
    """
    while True:
        known, identified = len(_looking), []

        def given(name, function, identified=identified):
            try:
                return comparable(function)
            except Exception as error:
                # (whatever a thing does as it is looked at, the run can be made)
                identified.append((name, function, error))
                return function

        try:
            out = program(**{name: jax.tree.map(functools.partial(given, name), tree) for name, tree in functions.items()})
            break
        except LOOKED_AT:
            if len(_looking) == known:
                raise
    for name, function, error in identified if concrete(out) else ():
        key = name, _code(function)
        if _identified.setdefault(key, function) not in (None, function):
            _identified[key] = None
            warnings.warn(
                f"{name}: a new function object with the same code is compiled again; {error} cannot be compared. Define it outside the loop.", stacklevel=3
            )
    return out
