"""Types of arguments that svkc validates itself.

A static type checker reads what an argument may be. At run time the type is `Any`, so that a wrong
value gets svkc's ValueError, which names the argument, even where annotations are checked.
"""

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias, TypeVar

import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array

_T = TypeVar("_T")

if TYPE_CHECKING:
    Checked: TypeAlias = Annotated[_T, "validated by svkc"]
else:

    class Checked:
        """`Checked[X]` is X for a static type checker, and `Any` at run time."""

        def __class_getitem__(cls, _):
            return Any


# one real number
Scalar: TypeAlias = Checked[float | np.number[Any] | np.ndarray | Array]
# an array of real numbers or of Booleans, or nested sequences of numbers
Numbers: TypeAlias = Checked[np.ndarray | Array | Sequence[Any]]
# one name or several
Names: TypeAlias = Checked[str | Iterable[str]]
# joint torques: an array, or numbers by joint name
Torques: TypeAlias = Checked[np.ndarray | Array | Sequence[Any] | Mapping[str, Any]]
# a whole number
Integer: TypeAlias = Checked[int | np.integer[Any]]
Function: TypeAlias = Checked[Callable[..., Any]]
Path: TypeAlias = Checked[str | os.PathLike[str]]
DType: TypeAlias = DTypeLike
# objects of mujoco, whose classes have no stubs; importing svkc does not import mujoco
MuJoCo: TypeAlias = Any
