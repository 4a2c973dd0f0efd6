"""Digests of functions and data by content, equal in all processes that run one script.

`function_values` compares functions within one process, where identity is enough for objects of
libraries and for code. A digest holds neither an id nor a hash of Python, which differ between
processes.
"""

import dataclasses
import dis
import enum
import functools
import hashlib
import pathlib
import types
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from svkc._jax.function_values import (
    JIT_FUNCTION_TYPE,
    PLAIN_TYPES,
    defined_by_library,
    is_library_module,
)


def content_digest(x) -> str:
    """Return the SHA-256 of the content of a function, a container, an array or another object.

    A function is its code (without line numbers), its defaults, and the values of its closure and
    of the global variables that its code reads. An object that a library defines, or a module that
    is imported within a function, is its name. Another module is its source files. A dataclass is
    the fields that it compares, and any other object is what `pickle` would keep.

    Raises TypeError if x holds an object that `pickle` cannot keep, such as a lock or an open file.
    """
    return _Digests().of(x).hex()


@functools.cache
def _global_names(code: types.CodeType) -> tuple[str, ...]:
    """Return the sorted names of the globals that a code object, or a function inside it, reads."""
    names = {
        line.argval
        for line in dis.get_instructions(code)
        if line.opname in ("LOAD_GLOBAL", "LOAD_NAME")
    }
    inner = (_global_names(x) for x in code.co_consts if isinstance(x, types.CodeType))
    return tuple(sorted(names.union(*inner)))


class _Digests:
    """Digests of objects that hold each other.

    known: id -> (digest, object). The object is kept so that its id is not used again. While an
        object is read, its position in the order of reading stands for its digest, which ends
        cycles of references.
    """

    def __init__(self):
        self.known: dict[int, tuple[bytes, Any]] = {}

    def of(self, x) -> bytes:
        """Return the digest of an object."""
        if id(x) not in self.known:
            self.known[id(x)] = f"again {len(self.known)}".encode(), x
            description, parts = _content(x)
            digest = hashlib.sha256(repr(description).encode())
            digests = [self.of(part) for part in parts]
            for part in sorted(digests) if isinstance(x, set | frozenset) else digests:
                digest.update(part)
            self.known[id(x)] = digest.digest(), x
        return self.known[id(x)][0]


def _content(x: Any) -> tuple[Any, list]:
    """Return a description that `repr` writes alike in all processes, and the parts of an object.

    Raises TypeError if `pickle` cannot take an object apart.
    """
    kind = type(x)
    name = kind.__qualname__
    if kind in PLAIN_TYPES or isinstance(x, np.dtype):
        return (name, repr(x)), []
    if isinstance(x, np.ndarray | np.generic | jax.Array):
        return _array_content(name, x)
    if kind is types.CodeType:
        numbers = x.co_argcount, x.co_posonlyargcount, x.co_kwonlyargcount, x.co_flags
        names = x.co_names, x.co_varnames, x.co_freevars, x.co_cellvars
        return (name, x.co_code, x.co_exceptiontable, numbers, names), list(x.co_consts)
    wrapped = getattr(x, "__wrapped__", x) if isinstance(x, JIT_FUNCTION_TYPE) else x
    if wrapped is not x and not is_library_module(getattr(wrapped, "__globals__", {})):
        return name, [wrapped]
    if defined_by_library(x):
        own_name = getattr(x, "__qualname__", None) or getattr(x, "__name__", None)
        return (name, getattr(x, "__module__", None), own_name), []
    if isinstance(x, types.FunctionType | types.MethodType | functools.partial):
        return name, _function_parts(x)
    if isinstance(x, types.ModuleType):
        folders = [pathlib.Path(folder) for folder in getattr(x, "__path__", ())]
        files = [file for folder in folders for file in sorted(folder.rglob("*.py"))]
        files = files or [pathlib.Path(str(x.__file__))]
        return (name, x.__name__), [file.read_bytes() for file in files]
    if isinstance(x, type):
        return (name, x.__qualname__), _class_parts(x)
    if isinstance(x, enum.Enum):
        return (name, x.name), [kind]
    return name, [kind, *_object_parts(x)]


def _array_content(name: str, x) -> tuple[Any, list]:
    """Return the description of an array, and its entries if these are objects."""
    if isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jax.dtypes.extended):
        # The content of random keys is their numbers.
        return (name, str(x.dtype)), [jax.random.key_data(x)]
    if np.asarray(x).dtype.hasobject:
        return (name, np.shape(x)), list(np.ravel(x))
    kind = "array" if isinstance(x, jax.Array) else name
    weak = getattr(x, "weak_type", False)
    return (kind, str(x.dtype), np.shape(x), weak, np.asarray(x).tobytes()), []


def _function_parts(f: Any) -> list:
    """Return what determines the results of a Python function, a bound method or a partial."""
    if isinstance(f, functools.partial):
        return [f.func, f.args, f.keywords]
    if isinstance(f, types.MethodType):
        return [f.__func__, f.__self__]
    space = {} if is_library_module(f.__globals__) else f.__globals__
    read = {name: space[name] for name in _global_names(f.__code__) if name in space}
    cells = [cell.cell_contents for cell in f.__closure__ or ()]
    return [f.__code__, f.__defaults__, f.__kwdefaults__, read, cells, vars(f)]


def _class_parts(x: type) -> list:
    """Return the base classes of a class, and its functions and values by name."""
    parts: list = list(x.__bases__)
    for name, value in vars(x).items():
        if isinstance(value, staticmethod | classmethod):
            value = value.__func__
        elif isinstance(value, property | functools.cached_property):
            value = value.fget if isinstance(value, property) else value.func
        # Of names with two underscores only methods are read, such as __call__.
        if callable(value) or not name.startswith(("__", "_abc_impl")):
            parts += [name, value]
    return parts


def _object_parts(x) -> list:
    """Return the parts of an instance of a class."""
    if isinstance(x, dict):
        return [part for item in x.items() for part in item]
    if isinstance(x, list | tuple | set | frozenset):
        return list(x)
    if callable(getattr(x, "__wrapped__", None)):
        return [x.__wrapped__]
    if dataclasses.is_dataclass(x):
        fields = [field.name for field in dataclasses.fields(x) if field.compare]
        return [part for name in fields for part in (name, getattr(x, name, None))]
    reduced = x.__reduce_ex__(4)
    if isinstance(reduced, str):
        return [reduced]
    _, arguments, *rest = reduced
    state, *items = (*rest, None, None, None)[:3]
    return [arguments, state, *(list(i) for i in items if i is not None)]
