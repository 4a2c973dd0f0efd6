"""Functions and the containers they read, decomposed into arrays and static values, and rebuilt."""

import dataclasses
import dis
import enum
import functools
import os
import site
import sys
import sysconfig
import types
from collections.abc import Callable
from typing import Any, NoReturn

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from svkc._jax.pytrees import is_concrete

PLAIN_TYPES = (type(None), bool, int, float, complex, str, bytes, range, type(...))
# objects that a library defines are assumed constant between two calls; svkc counts as a library,
# also where it is installed from its sources
_PATHS = {sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")} | {
    *site.getsitepackages(),
    site.getusersitepackages(),
}
LIBRARY_FOLDERS = tuple(
    path + os.sep for path in (*_PATHS, os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
)
# errors of JAX where Python code reads the value of a tracer
CONCRETIZATION_ERRORS = (
    jax.errors.ConcretizationTypeError,
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
)
CONCRETIZATION_ERRORS += (
    jax.errors.TracerBoolConversionError,
    jax.errors.NonConcreteBooleanIndexError,
)
JIT_FUNCTION_TYPE = type(jax.jit(len))
# code objects of functions in which Python reads values of arrays
needs_concrete_arrays: set = set()


@dataclasses.dataclass(frozen=True)
class StaticValue:
    """A static value, compared by `key`: its content or its id.

    `value` is the original object, so that a function can mutate a list that it reads.
    """

    key: Any
    value: Any = dataclasses.field(compare=False)


def _raise_incomparable(what: str) -> NoReturn:
    """Raise the error that makes `call_with_comparable` compare a function by identity."""
    error = TypeError(what)
    raise error


class FunctionPytree(eqx.Module):
    """A function, or a container that a function reads, as build(*parts).

    Each part is an array (a leaf), a `StaticValue`, or a `FunctionPytree`. Writes to a rebuilt
    container are lost.
    """

    parts: list
    build: Callable = eqx.field(static=True)

    def rebuild(self):
        """Return the function or the container."""
        return self.build(
            *(
                x.rebuild()
                if isinstance(x, FunctionPytree)
                else x.value
                if isinstance(x, StaticValue)
                else x
                for x in self.parts
            )
        )

    def __call__(self, *args):
        function = self.rebuild()
        try:
            return function(*args)
        except CONCRETIZATION_ERRORS:
            if any(map(eqx.is_array, jax.tree.leaves(self.parts))):
                needs_concrete_arrays.add(code_of(function))
            raise


def _function(code, space, names, defaults, kwdefaults, *values) -> types.FunctionType:
    # `values` are globals, closure cells, imported modules; a function reaches modules by itself
    cells = tuple(map(types.CellType, values[len(names) :][: len(code.co_freevars)]))
    f = types.FunctionType(
        code, {**space, **dict(zip(names, values))}, code.co_name, defaults, cells
    )
    f.__kwdefaults__ = kwdefaults
    return f


_partial = lambda function, args, keywords: functools.partial(function, *args, **keywords)
_dict = lambda keys, *values: dict(zip(keys, values))
_tree = lambda shape, *parts: jax.tree.unflatten(shape, parts)


def is_library_module(space) -> bool:
    """Return whether these are the globals of a module of Python, a package, or svkc."""
    return str(space.get("__file__")).startswith(LIBRARY_FOLDERS) or getattr(
        space.get("__spec__"), "origin", None
    ) in ("built-in", "frozen")


def defined_by_library(x) -> bool:
    """Return whether x is a library's module, class, or name of a module.

    Also true for jit-wrapped functions of any module, which JAX compares by identity.
    """
    if isinstance(x, types.ModuleType):
        return is_library_module(vars(x))
    # the ufuncs of NumPy 2.0 do not say their module
    module = getattr(x, "__module__", "numpy" if isinstance(x, np.ufunc) else None)
    scope = sys.modules.get(str(module))
    if scope is None or not (is_library_module(vars(scope)) or isinstance(x, JIT_FUNCTION_TYPE)):
        return False
    for name in str(getattr(x, "__qualname__", None) or getattr(x, "__name__", None)).split("."):
        scope = getattr(scope, name, None)
    return scope is x or isinstance(x, type)


@functools.cache
def _code_references(code: types.CodeType) -> tuple[set[str], set[str], set[str]]:
    """Return (names, imported modules, outer variables assigned or deleted) of a code object and
    those nested in it."""
    lines = [(line.opname, line.argval) for line in dis.get_instructions(code)]
    names, imports = (
        set(code.co_names),
        {name for operation, name in lines if operation == "IMPORT_NAME"},
    )
    written = {
        name
        for operation, name in lines
        if operation in ("STORE_GLOBAL", "DELETE_GLOBAL", "STORE_DEREF", "DELETE_DEREF")
    } - set(code.co_cellvars)
    for inner in (_code_references(x) for x in code.co_consts if isinstance(x, types.CodeType)):
        names, imports, written = (
            names | inner[0],
            imports | inner[1],
            written | inner[2] - set(code.co_cellvars),
        )
    return names, imports, written


def _decompose_function(f: types.FunctionType):
    """Return (build, parts) of a function.

    Parts are its code, globals, names of the globals it reads, defaults, and the values it reads.
    """
    names, imports, written = _code_references(f.__code__)
    if written or set(vars(f)) - {"__wrapped__"}:
        _raise_incomparable(
            "a variable outside that it assigns" if written else "a function with attributes"
        )
    # the globals of a library are assumed constant
    space, own = f.__globals__, not is_library_module(f.__globals__)
    names, imports = (
        tuple(sorted(used)) if own else () for used in (names & space.keys(), imports)
    )
    read = [
        *(space[name] for name in names),
        *(cell.cell_contents for cell in f.__closure__ or ()),
        *(sys.modules[name] for name in imports),
    ]
    return _function, [
        StaticValue(f.__code__, f.__code__),
        StaticValue(id(space), space),
        names,
        f.__defaults__,
        f.__kwdefaults__,
        *read,
    ]


class Reader:
    """Decomposes one function: its code, and all values that the function reads.

    arrays_as_data: whether floating-point arrays are leaves, not static values.
    visited: id of an object -> its `StaticValue`, or None while the object is being read.
    """

    def __init__(self, arrays_as_data: bool):
        self.arrays_as_data, self.visited = arrays_as_data, {}

    def read(self, x):
        """Return x as an array, a `StaticValue`, or a `FunctionPytree`.

        Raises TypeError if x, or an object that x holds, is of no comparable kind.
        """
        kind = type(x)
        if kind is StaticValue:
            return x
        if kind in PLAIN_TYPES or isinstance(x, enum.Enum | np.dtype):
            # floats are compared by their text: nan equals nan, and -0.0 differs from 0.0
            return StaticValue((kind, repr(x) if kind in (float, complex) else x), x)
        if isinstance(x, np.ndarray | np.generic | jax.Array):
            return self.array(x)
        if defined_by_library(x):
            return StaticValue(id(x), x)
        if id(x) in self.visited:
            # functions that call each other would otherwise recurse without end
            return self.visited[id(x)] or _raise_incomparable("something that holds itself")
        parts = self.parts(x)
        del self.visited[id(x)]
        leaves, shape = jax.tree.flatten(parts)
        if not all(isinstance(leaf, StaticValue) for leaf in leaves):
            return parts
        self.visited[id(x)] = StaticValue(("again", len(self.visited)), x)
        return StaticValue((shape, *leaves), x)

    def array(self, x):
        """Return an array as a leaf, or as a `StaticValue` compared by its content."""
        if isinstance(x, jax.Array):
            # tracers are always data, and so are arrays whose values this process cannot read
            data = (
                self.arrays_as_data
                or not is_concrete(x)
                or jnp.issubdtype(x.dtype, jax.dtypes.extended)
                or not x.is_fully_addressable
            )
        elif x.dtype.hasobject or type(x) not in (np.ndarray, x.dtype.type):
            _raise_incomparable("an array of objects or of a class of its own")
        else:
            # integers are shapes and indices, which Python has to read; JAX has no long double
            data = (
                self.arrays_as_data
                and jnp.issubdtype(x.dtype, jnp.inexact)
                and x.dtype.char not in "gG"
            )
        return (
            x
            if data
            else StaticValue(
                (
                    type(x),
                    repr(x.dtype),
                    getattr(x, "weak_type", False),
                    x.shape,
                    np.asarray(x).tobytes(),
                ),
                x,
            )
        )

    def parts(self, x) -> FunctionPytree:
        """Return a function or a container as a `FunctionPytree`."""
        kind = type(x)
        self.visited[id(x)] = None
        if kind is types.FunctionType:
            build, parts = _decompose_function(x)
        elif kind is functools.partial:
            build, parts = _partial, [x.func, x.args, x.keywords]
        elif kind is slice:
            build, parts = slice, [x.start, x.stop, x.step]
        elif kind is dict:
            # in insertion order; JAX sorts the keys
            build, parts = _dict, [tuple(x), *x.values()]
        elif isinstance(x, dict) or jax.tree_util.all_leaves([x]):
            _raise_incomparable(f"an object of type {kind.__name__}")
        else:
            parts, shape = eqx.tree_flatten_one_level(x)
            # raise now if the static part is not hashable
            hash(
                tuple(getattr(x, f.name) for f in dataclasses.fields(x) if f.metadata.get("static"))
                if isinstance(x, eqx.Module)
                else shape.node_data()
            )
            build, parts = _tree, [StaticValue(shape, shape), *parts]
        return FunctionPytree([self.read(part) for part in parts], build)


def code_of(function):
    """Return the code object of a function, shared by all functions that one `def` or lambda
    makes."""
    return getattr(getattr(function, "func", function), "__code__", type(function))
