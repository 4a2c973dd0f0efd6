"""Enumerations of equinox whose members print by name, and members that have moved from one
enumeration to another.

equinox compares members of one enumeration only. With the metaclasses here, code that was written
before a move may compare a member of the new enumeration with one of the former enumeration.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np


class _Probe(eqx.Enumeration):
    member = ""


# equinox exports neither the metaclass of enumerations nor the class of their members
EnumerationMeta: Any = type(eqx.Enumeration)
EnumerationItem: Any = type(_Probe.member)


def member_names(enumeration) -> tuple[str, ...]:
    """Return the names of the members, in the order of their integer values."""
    return tuple(enumeration._name_to_item)


def with_value(member, value):
    """Return the member of the same enumeration with another integer value."""
    return eqx.tree_at(lambda item: item._value, member, value)


class NamedItem(EnumerationItem):
    """A member that prints its name, and for a batch the number of lanes with each name."""

    def __str__(self) -> str:
        values = self._value
        if not isinstance(values, np.ndarray | np.generic | jax.Array) or self.is_traced():
            return repr(self)
        values, names = np.asarray(values), member_names(self._enumeration)
        if not values.ndim:
            return names[int(values)]
        codes, first, counts = np.unique(values, return_index=True, return_counts=True)
        lane = lambda i: ", ".join(map(str, np.unravel_index(i, values.shape)))
        return ", ".join(
            f"{names[codes[i]]}: {counts[i]}" + (f" (first lane {lane(first[i])})" if k else "")
            for k, i in enumerate(np.argsort(-counts, kind="stable"))
        )

    def __repr__(self) -> str:
        if not isinstance(self._value, np.ndarray | np.generic | jax.Array) or self.is_traced():
            return super().__repr__()
        return f"{self._enumeration.__name__}<{self}>"


class NamedMeta(EnumerationMeta):
    """Metaclass of enumerations whose members are of the class `item_class`."""

    item_class: type = NamedItem

    def __new__(mcs, cls_name, bases, namespace):  # pyright: ignore
        cls = super().__new__(mcs, cls_name, bases, namespace)
        where = cls.where
        for name, item in cls._name_to_item.items():
            cls._name_to_item[name] = mcs.item_class(item._value, cls)
        cls.where = staticmethod(lambda pred, a, b: mcs.item_class(where(pred, a, b)._value, cls))
        return cls


class MovedItem(NamedItem):
    """A member that is equal to the member of the same name in the former enumeration as well.

    As this class is a subclass of that of the former members, Python calls its methods for both
    orders of the operands.
    """

    def __eq__(self, other):
        return super().__eq__(self._translated(other))

    def __ne__(self, other):
        return super().__ne__(self._translated(other))

    def _translated(self, other):
        """Return a member of the former enumeration as that of the same name in this enumeration.

        Its value is -1 if this enumeration has no member of that name. Other operands are returned
        unchanged.
        """
        own, former = self._enumeration, self._enumeration._former
        if not isinstance(other, EnumerationItem) or other._enumeration is not former:
            return other
        own._warn("", stacklevel=5)
        names = member_names(own)
        values = [names.index(n) if n in names else -1 for n in member_names(former)]
        return with_value(self, jnp.asarray(values, jnp.int32)[other._value])


class MovedMeta(NamedMeta):
    """Metaclass of the enumeration to which members have moved: all members are `MovedItem`."""

    item_class = MovedItem


class FormerMeta(NamedMeta):
    """Metaclass of the enumeration from which members have moved.

    The former enumeration still gives a moved member by its name, and its text, with a warning.
    """

    def __getattr__(cls, name: str):  # pyright: ignore
        new = cls.__dict__.get("_new")
        if new is not None and name not in cls._name_to_item and name in new._name_to_item:
            new._warn(name, stacklevel=3)
            return new._name_to_item[name]
        return super().__getattr__(name)

    def __getitem__(cls, item):  # pyright: ignore
        new = cls.__dict__.get("_new")
        if new is None or getattr(item, "_enumeration", None) is not new:
            return super().__getitem__(item)
        new._warn("", stacklevel=3)
        return new[item]


def connect_enumerations(former, new, warn: Callable) -> None:
    """Let members that have moved from `former` to `new` be read from `former`, and let members of
    both be compared.

    warn: called with the name of the member, or "" for another use of `former`, and a `stacklevel`.
    """
    former._new, new._former, new._warn = new, former, staticmethod(warn)
