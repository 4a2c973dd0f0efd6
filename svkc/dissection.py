"""F1: a Python function taken apart into what it is compared by and arrays, and put together again with other arrays."""

import collections
import contextlib
import copy
import enum
import functools
import sys
import types
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from svkc.comparing import CHANGING, IncomparableError, Kept, Same, at_home, attributes, content, facts, from_library, of_library, refuse, written
from svkc.parts import Making, Part, Slot, by_content, fixed, is_data, joined, put_together

PLAIN = (type(None), bool, int, str, bytes, range, type(...), type(NotImplemented))
REMADE = (dict, list, collections.OrderedDict, collections.defaultdict, collections.deque)
DESCRIPTORS = {staticmethod: "__func__", classmethod: "__func__", property: "fget", functools.cached_property: "func"}


class Reader:
    """Takes apart what functions hold. `arrays`: the data in it; `kept`: things that can change, and what was in them.

    as_data: whether floating-point arrays are data; if not they are compared by content. Tracers always are data.
    `whole`: nothing here can be made anew, such as what belongs to a class or a module. `held`: objects cannot, for attributes are assigned.
    """

    def __init__(self, as_data: bool = True, held: bool = False):
        self.as_data, self.held, self.whole = as_data, held, False
        self.arrays, self.kept = [], []
        self._slots, self._alive, self._looked_up, self._open = {}, [], (), frozenset()

    @contextlib.contextmanager
    def _with(self, **changed):
        before = {name: getattr(self, name) for name in changed}
        vars(self).update(changed)
        try:
            yield
        finally:
            vars(self).update(before)

    def read(self, x) -> Part:
        """Takes anything apart. IncomparableError: it cannot be."""
        kind = type(x)
        if kind in PLAIN:
            return fixed((kind, x), x)
        if kind in (float, complex):
            # nan is itself, and -0.0 is not 0.0
            return fixed((kind, *(part.hex() for part in ((x,) if kind is float else (x.real, x.imag)))), x)
        if isinstance(x, np.generic):
            return fixed((kind, str(x.dtype), x.tobytes()), x)
        if isinstance(x, np.ndarray | jax.Array):
            return self._array(x)
        if kind in (tuple, frozenset, slice):
            return self._constant(x)
        if isinstance(x, types.ModuleType):
            return self._module(x)
        if id(x) in self._slots:
            slot = self._slots[id(x)]
            return Part(("again", slot.number), slot.again, True)
        slot = self._slots[id(x)] = Slot(len(self._slots), x)
        # ids are those of things that are alive
        self._alive.append(x)
        return slot.first(self._reading(x)(x, slot.number))

    def _reading(self, x) -> Callable[[Any, int], Part]:
        for kinds, reading in (
            (types.FunctionType, self._function),
            (types.MethodType, lambda x, _: joined(x, None, [self.read(x.__func__), self.read(x.__self__)], types.MethodType)),
            (type, self._class),
            (CHANGING, self._container),
        ):
            if isinstance(x, kinds):
                return reading
        if type(x) is functools.partial:
            return self._partial
        if not jax.tree_util.all_leaves([x]):
            return self._tree
        return self._instance if isinstance(x, types.SimpleNamespace) or not (of_library(type(x)) or isinstance(x, enum.Enum)) else self._foreign

    def _array(self, x) -> Part:
        if isinstance(x, jax.core.Tracer):
            if self.whole:
                refuse(x)
        # (whole numbers of numpy are sizes and indices, which Python needs to know)
        elif self.whole or not self.as_data or (isinstance(x, np.ndarray) and not is_data(x)):
            return fixed(by_content(x), x)
        self.arrays.append(x)
        place = len(self.arrays) - 1
        return Part("array", lambda making: making.arrays[place], True)

    def _constant(self, x) -> Part:
        if isinstance(x, frozenset):
            return fixed((frozenset, self._elements(x)), x)
        parts = [self.read(y) for y in ((x.start, x.stop, x.step) if isinstance(x, slice) else x)]
        return joined(x, None, parts, slice if isinstance(x, slice) else lambda *items: items)

    def _elements(self, x) -> frozenset:
        with self._with(whole=True):
            return frozenset(self.read(y).key for y in x)

    def _named(self, space, names) -> dict[str, Part]:
        return {name: self.read(space[name]) for name in names if name in space}

    def _function(self, f: types.FunctionType, number: int) -> Part:
        code, told, space, library = f.__code__, facts(f.__code__), f.__globals__, from_library(f.__globals__)
        if library and (not f.__closure__ or at_home(f)):
            return fixed(Same(f), f)
        cells = dict(zip(code.co_freevars, f.__closure__ or (), strict=True))
        # who assigns a variable outside needs the very cell, or the very globals (but for jax.vmap's wrapper, which does so once and for all)
        own = {name: fixed(Same(cell), cell) for name, cell in cells.items() if name in told.writes and not library}
        with self._with(_looked_up=told.attributes):
            inside = [self.read(x) for x in (f.__defaults__, f.__kwdefaults__, vars(f))]
            closed = {name: self.read(_filled(cell, f)) for name, cell in cells.items() if name not in own}
            with self._with(whole=self.whole or not told.writes <= set(cells)):
                seen = {} if library else self._named(space, [name for name in told.names if name not in told.writes])
            imported = {} if library else self._named(sys.modules, [x for x in told.modules if x in sys.modules and not from_library(vars(sys.modules[x]))])
        key = (code, Same(space), *(part.key for part in inside), *((n, p.key) for n, p in (own | closed | seen | imported).items()))
        if not any(part.moves for part in (*inside, *closed.values(), *seen.values())):
            return fixed(key, f)
        names = f.__name__, f.__qualname__, f.__module__
        return Part(key, lambda making: put_together(making, number, code, space, names, inside, own, closed, seen), True)

    def _partial(self, x: functools.partial, number: int) -> Part:
        parts = [self.read(y) for y in (x.func, *x.args, *x.keywords.values())]
        names, plain = tuple(x.keywords), 1 + len(x.args)
        return joined(x, names, parts, lambda *y: functools.partial(*y[:plain], **dict(zip(names, y[plain:], strict=True))))

    def _tree(self, x, number: int) -> Part:
        leaves, shape = jax.tree.flatten(x, is_leaf=lambda y: y is not x)
        return joined(x, shape, [self.read(y) for y in leaves], lambda *y: jax.tree.unflatten(shape, y))

    def _changing(self, x) -> bool:
        """Notes something that can change; whether it is known to be written to by those who read it."""
        self.kept.append((x, content(x)))
        return id(x) in written

    def _container(self, x, number: int) -> Part:
        kind = type(x)
        if self._changing(x):
            return fixed(Kept(x, None), x)
        if isinstance(x, bytearray | set):
            return fixed(Kept(x, bytes(x) if isinstance(x, bytearray) else self._elements(x)), x)
        names = list(x) if isinstance(x, dict) else list(range(len(x)))
        with self._with(whole=True):
            keys = tuple(self.read(name).key for name in names)
        with self._with(whole=self.whole or kind not in REMADE):
            parts = {name: self.read(x[name]) for name in names}
        moves = any(part.moves for part in parts.values())
        key = Kept(x, (keys, *(part.key for part in parts.values())), moves)
        if not moves:
            return fixed(key, x)
        shell = copy.copy(x)
        for name in names:
            shell[name] = None

        def make(making: Making):
            new = making.made[number] = copy.copy(shell)
            for name, part in parts.items():
                new[name] = part.make(making)
            return new

        return Part(key, make, True)

    def _instance(self, x, number: int) -> Part:
        kind, names = type(x), attributes(x)
        if self._changing(x):
            return fixed(Kept(x, None), x)
        with self._with(whole=self.whole or self.held):
            parts = {name: self.read(y) for name, y in names.items()}
        moves = any(part.moves for part in parts.values())
        key = Kept(x, (self.read(kind).key, *((name, part.key) for name, part in parts.items())), moves)
        if not moves:
            return fixed(key, x)

        def make(making: Making):
            new = making.made[number] = kind() if issubclass(kind, types.SimpleNamespace) else object.__new__(kind)
            for name, part in parts.items():
                object.__setattr__(new, name, part.make(making))
            return new

        return Part(key, make, True)

    def _class(self, x: type, number: int) -> Part:
        if of_library(x) or issubclass(x, enum.Enum):
            return fixed(Same(x), x)
        if self._changing(x):
            return fixed(Kept(x, None), x)
        space = {name: y for base in reversed(x.__mro__) if not of_library(base) for name, y in vars(base).items()}
        inside = []
        with self._with(whole=True):
            for name, y in space.items():
                y = getattr(y, DESCRIPTORS.get(type(y), ""), y)
                if isinstance(y, types.FunctionType) or not name.startswith("__"):
                    inside.append((name, self._lenient(y)))
        return fixed(Kept(x, (Same(x), *inside)), x)

    def _lenient(self, y):
        """The key of something in a class, which is full of things of Python's own."""
        try:
            return self.read(y).key
        except IncomparableError:
            return Same(y)

    def _module(self, x: types.ModuleType) -> Part:
        """Of a module that is not a library's, what it holds under the names of attributes that the function looks up."""
        here = (id(x), self._looked_up)
        if here in self._open or from_library(vars(x)):
            return fixed(Same(x), x)
        if self._changing(x):
            return fixed(Kept(x, None), x)
        with self._with(whole=True, _open=self._open | {here}):
            inside = self._named(vars(x), self._looked_up)
        return fixed(Kept(x, (Same(x), *((name, part.key) for name, part in inside.items()))), x)

    def _foreign(self, x, number: int) -> Part:
        """Of a library's object: by equality where it has a hash of its own; what can be called, by identity and by the function that it wraps."""
        kind = type(x)
        if isinstance(x, types.BuiltinFunctionType) and not isinstance(x.__self__, types.ModuleType | None):
            with self._with(whole=True):
                return fixed((kind, x.__name__, self.read(x.__self__).key), x)
        if callable(x):
            with self._with(whole=True):
                inner = getattr(x, "__wrapped__", None)
                return fixed((Same(x), self.read(inner).key if isinstance(inner, types.FunctionType) else None), x)
        if kind is object or isinstance(x, jax.Device | enum.Enum):
            return fixed(Same(x), x)
        if kind.__hash__ in (None, object.__hash__):
            refuse(x)
        return fixed((kind, x), x)


def _filled(cell: types.CellType, f: types.FunctionType):
    try:
        return cell.cell_contents
    except ValueError:
        # it may be anything when the function is called
        refuse(f)
