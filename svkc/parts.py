"""F1: the parts of a function that was taken apart: what each is compared by, and how it is made again with other arrays."""

import types
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from svkc.comparing import Same, refuse


class Making(NamedTuple):
    """Arrays for a function that is put together, and what is made of it already, by number: a function may hold itself."""

    arrays: list
    made: dict[int, Any]


class Part(NamedTuple):
    """Something that a function holds: what it is compared by, how it is made, and whether that depends on arrays."""

    key: Any
    make: Callable[[Making], Any]
    moves: bool = False


class Slot:
    """Where something is met first. The thing itself is kept only where it does not depend on arrays, so that no tracer outlives its trace."""

    def __init__(self, number: int, thing):
        self.number, self.thing = number, thing

    def again(self, making: Making):
        """The thing where it is met again."""
        return making.made.get(self.number, self.thing)

    def first(self, part: Part) -> Part:
        """The part, made once."""
        if not part.moves:
            return part
        self.thing = None

        def make(making: Making):
            thing = part.make(making)
            return making.made.setdefault(self.number, thing)

        return Part(part.key, make, True)


def fixed(key, thing) -> Part:
    """Of something that stays as it is."""
    return Part(key, lambda making: thing)


def joined(x, key, parts, build) -> Part:
    """Of something that is built of its parts at once."""
    key = (type(x), key, *(part.key for part in parts))
    return Part(key, lambda making: build(*(part.make(making) for part in parts)), True) if any(part.moves for part in parts) else fixed(key, x)


def is_data(x: np.ndarray) -> bool:
    """Whether jax can take it in as it is and its numbers are not whole."""
    return type(x) is np.ndarray and jnp.issubdtype(x.dtype, jnp.inexact) and x.dtype.itemsize <= (16 if x.dtype.kind == "c" else 8)


def by_content(x):
    """The key of an array that is not data; by identity where its numbers are not all here."""
    if isinstance(x, jax.Array):
        if not x.is_fully_addressable or jnp.issubdtype(x.dtype, jax.dtypes.extended):
            return Same(x)
    elif type(x) is not np.ndarray or x.dtype.hasobject:
        refuse(x)
    numbers = np.asarray(x)
    return type(x), repr(x.dtype), getattr(x, "weak_type", False), x.shape, numbers.tobytes()


def put_together(making: Making, number: int, code, space, names, inside, own, closed, seen) -> types.FunctionType:
    """A function with the same code and other arrays in closures, defaults and globals."""
    moved = {name: part for name, part in seen.items() if part.moves}
    # its own view of the module, in which the arrays are others
    space = dict(space) if moved else space
    cells = {name: own[name].make(making) if name in own else types.CellType() for name in code.co_freevars}
    f = making.made[number] = types.FunctionType(code, space, names[0], None, tuple(cells.values()))
    f.__qualname__, f.__module__ = names[1:]
    for name, part in closed.items():
        cells[name].cell_contents = part.make(making)
    space.update({name: part.make(making) for name, part in moved.items()})
    f.__defaults__, f.__kwdefaults__, attached = (part.make(making) for part in inside)
    vars(f).update(attached)
    return f
