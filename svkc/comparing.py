"""F0: what two Python functions are compared by: what their code reads and writes, what libraries bring, things by identity and things that change."""

import collections
import dis
import functools
import os
import site
import sys
import sysconfig
import types
from collections.abc import Iterator
from typing import Any, NamedTuple, NoReturn

# what libraries bring does not change between two calls; svkc is one of them, wherever its sources are
_PATHS = {sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")} | {*site.getsitepackages(), site.getusersitepackages()}
LIBRARIES = tuple(path + os.sep for path in (*_PATHS, os.path.dirname(os.path.abspath(__file__))))


class Facts(NamedTuple):
    """Of a code object and those nested in it: the names of globals it reads and of modules it imports, of attributes it looks up, of variables outside
    of it that it assigns; and whether it assigns attributes."""

    names: tuple[str, ...]
    modules: tuple[str, ...]
    attributes: tuple[str, ...]
    writes: frozenset[str]
    changes: bool


@functools.cache
def facts(code: types.CodeType) -> Facts:
    """What the instructions say. (`co_names` would not do: it mixes globals with attributes.)"""
    names, modules, attributes, writes, changes = {}, {}, {}, set(), False
    for line in dis.get_instructions(code):
        operation, name = line.opname, line.argval
        if operation in ("LOAD_GLOBAL", "LOAD_NAME", "LOAD_FROM_DICT_OR_GLOBALS"):
            names[name] = None
        elif operation == "IMPORT_NAME":
            modules[name] = None
        elif operation in ("LOAD_ATTR", "LOAD_METHOD", "LOAD_SUPER_ATTR", "IMPORT_FROM"):
            attributes[name] = None
        elif operation in ("STORE_GLOBAL", "DELETE_GLOBAL") or (operation in ("STORE_DEREF", "DELETE_DEREF") and name in code.co_freevars):
            writes.add(name)
        elif operation in ("STORE_ATTR", "DELETE_ATTR"):
            changes = True
    for inner in map(facts, (x for x in code.co_consts if isinstance(x, types.CodeType))):
        names, modules, attributes = names | dict.fromkeys(inner.names), modules | dict.fromkeys(inner.modules), attributes | dict.fromkeys(inner.attributes)
        # a variable of an outer function that is this one's own stays inside
        writes |= inner.writes - set(code.co_cellvars)
        changes |= inner.changes
    return Facts(tuple(names), tuple(modules), tuple(attributes), frozenset(writes), changes)


def from_library(module: dict | types.MappingProxyType) -> bool:
    """Whether a module, by its globals, is one of Python, of an installed package, or of svkc."""
    spec = module.get("__spec__")
    return str(module.get("__file__")).startswith(LIBRARIES) or getattr(spec, "origin", None) in ("built-in", "frozen")


def of_library(kind: type) -> bool:
    """Whether a class is one of a library's."""
    module = sys.modules.get(kind.__module__)
    return module is not None and from_library(vars(module))


def at_home(thing) -> bool:
    """Whether a function or a class is what its module calls by its name: a new one is not made by running the same line again."""
    found = sys.modules.get(getattr(thing, "__module__", None) or "")
    for name in str(getattr(thing, "__qualname__", "")).split("."):
        found = getattr(found, name, None)
    return found is thing or isinstance(thing, types.ModuleType | types.BuiltinFunctionType)


class Same:
    """A thing that is equal to itself alone. It is kept, so that no other gets its id."""

    def __init__(self, thing):
        self.thing = thing

    def __eq__(self, other):
        return type(other) is Same and self.thing is other.thing

    def __hash__(self):
        return id(self.thing)


# things that functions were seen to write to while they were traced, by id
written: dict[int, Any] = {}


class Kept:
    """A thing that can change, compared by its content; by identity where functions write to it while they are traced, such as a list that counts traces."""

    def __init__(self, thing, content, moves: bool = False):
        # what holds data is not kept: it may be tracers
        self.thing, self.kind, self.content = None if moves else thing, type(thing), content

    def __eq__(self, other):
        if type(other) is not Kept:
            return False
        return (self.thing is other.thing and id(self.thing) in written) or (self.kind is other.kind and self.content == other.content)

    def __hash__(self):
        return hash(self.kind)


class IncomparableError(Exception):
    """Something that is neither data nor compared by its content; the thing is its argument. It does not reach the caller of a run."""


def refuse(thing) -> NoReturn:
    """Raises `IncomparableError`."""
    error = IncomparableError(thing)
    raise error


def attributes(thing) -> dict[str, Any]:
    """All that a thing consists of, where Python knows it: what it holds in `__dict__` and in slots."""
    kind = type(thing)
    if isinstance(thing, types.ModuleType | type | types.SimpleNamespace):
        return dict(vars(thing))
    if any(getattr(kind, name) is not getattr(object, name) for name in ("__reduce_ex__", "__reduce__", "__getstate__")):
        refuse(thing)
    try:
        # pickle's own question, which refuses what keeps anything elsewhere
        state = thing.__reduce_ex__(2)[2]
    except TypeError:
        refuse(thing)
    return {name: x for part in (state if isinstance(state, tuple) else (state,)) for name, x in (part or {}).items()}


# built-in things that can change; others are compared by their attributes
CHANGING = (dict, list, set, bytearray, collections.deque)


def content(thing) -> list:
    """What is in a thing that can change, as it is now; the items are the very same ones as long as nothing was written."""
    if not isinstance(thing, CHANGING):
        thing = attributes(thing)
    return [x for item in thing.items() for x in item] if isinstance(thing, dict) else list(thing)


def note_writes(before: list[tuple[Any, list]]) -> None:
    """Remembers which of these things, each with its content before, were written to."""
    for thing, old in before:
        now = content(thing)
        if len(now) != len(old) or any(a is not b for a, b in zip(now, old, strict=True)):
            written[id(thing)] = thing


def loosened(key):
    """A key without the things in it that are compared by identity because nothing better is known of them: their types are left."""
    if isinstance(key, tuple):
        return tuple(map(loosened, key))
    if isinstance(key, frozenset):
        return frozenset(map(loosened, key))
    if isinstance(key, Kept):
        return key.kind, loosened(key.content)
    return key if not isinstance(key, Same) or at_home(key.thing) or isinstance(key.thing, dict) else type(key.thing)


def differing(one, other) -> Iterator[Any]:
    """Things by which two keys differ that are compared by identity."""
    if isinstance(one, Same) and isinstance(other, Same) and one != other:
        yield one.thing
    elif isinstance(one, Kept) and isinstance(other, Kept):
        yield from differing(one.content, other.content)
    elif isinstance(one, tuple) and isinstance(other, tuple):
        for a, b in zip(one, other, strict=False):
            yield from differing(a, b)
