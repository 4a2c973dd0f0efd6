"""Validation of user arguments: each function returns the converted value, or raises ValueError
that names the argument, what was given and what was expected.

Values of tracers cannot be checked; their shapes and dtypes are.
"""

import inspect
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from svkc._jax.pytrees import is_concrete
from svkc.model.annotations import DType


def as_array(value: Any) -> np.ndarray | jax.Array:
    """Return a value as an array; an array of None if NumPy cannot convert the value."""
    try:
        return (
            value
            if isinstance(value, jax.Array)
            else np.asarray(value)
            if is_concrete(value)
            else jnp.asarray(value)
        )
    except (TypeError, ValueError, OverflowError):
        return np.asarray(None)


def real_array(name: str, value: Any, dtype: DType | None = None) -> Any:
    """Return a value as an array of real numbers, converted to `dtype` if one is given.

    Raises ValueError for strings, objects, Booleans, complex numbers and ragged lists.
    """
    array = as_array(value)
    if not is_real(array):
        raise ValueError(
            f"{name}: expected real numbers, got"
            f" {repr(value) if array.dtype == object else array.dtype}"
        )
    return array if dtype is None else jnp.asarray(array, dtype)


def finite_array(name: str, value: Any, dtype: DType | None = None) -> Any:
    """Return a value as `real_array` does; raise ValueError if a concrete one is not finite."""
    array = real_array(name, value, dtype)
    if is_concrete(array) and not np.isfinite(np.asarray(array)).all():
        raise ValueError(f"{name}: expected finite numbers, got {np.asarray(array)}")
    return array


def scalar(name: str, value: Any) -> Any:
    """Return a real scalar unchanged; raise ValueError for another shape."""
    array = real_array(name, value)
    if array.shape != ():
        raise ValueError(
            f"{name}: got shape {array.shape}, expected one number; use vmap for a batch"
        )
    return value


def vector(name: str, value: Any, count: int) -> Any:
    """Return a value as an array of `count` finite numbers."""
    array = finite_array(name, value)
    if array.shape != (count,):
        raise ValueError(f"{name}: got shape {array.shape}, expected {count} numbers")
    return array


def positive_scalar(name: str, value: Any) -> Any:
    """Return a real scalar unchanged; raise ValueError if a concrete one is not above zero."""
    scalar(name, value)
    if is_concrete(value) and not np.asarray(value) > 0:
        raise ValueError(f"{name}: got {value}, expected a positive number")
    return value


def integer(name: str, value: Any, minimum: int, maximum: int = 2**31 - 1) -> int:
    """Return a concrete whole number from `minimum` to `maximum` as an int."""
    number = np.asarray(as_array(value) if is_concrete(value) else None)
    if (
        number.shape != ()
        or number.dtype.kind not in "iuf"
        or not np.isfinite(number)
        or number != np.floor(number)
        or not minimum <= number <= maximum
    ):
        raise ValueError(
            f"{name}: got {value!r}, expected a whole number from {minimum} to {maximum}"
        )
    return int(number)


def is_real(array: np.ndarray | jax.Array) -> bool:
    """Return whether an array holds real numbers: neither Booleans, complex numbers nor objects."""
    return any(jnp.issubdtype(array.dtype, kind) for kind in (np.integer, np.floating))


def description(value: Any) -> str:
    """Return what a function of the user returned, in words for a message."""
    array = as_array(value)
    if array.dtype == object:
        return "None" if value is None else f"a {type(value).__name__}"
    return f"{array.dtype} of shape {array.shape}"


def check_function(name: str, value: Any, *arguments: str) -> None:
    """Raise ValueError if a value is no function of these positional arguments."""
    got = repr(value)
    if callable(value):
        try:
            signature = inspect.signature(value)
            got = f"one of {signature}"
            signature.bind(*arguments)
            return
        # some functions that are written in C have no signature
        except ValueError:
            return
        except TypeError:
            pass
    raise ValueError(f"{name}: expected a function of ({', '.join(arguments)}), got {got}")


def boolean(name: str, value: Any) -> bool:
    """Return a Boolean of Python or NumPy as a bool."""
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name}: got {value!r}, expected True or False")
    return bool(value)


def names(name: str, value: Any) -> tuple[str, ...]:
    """Return one name or an iterable of names as a tuple."""
    values = (value,) if isinstance(value, str) or not np.iterable(value) else tuple(value)
    if not all(isinstance(x, str) for x in values):
        raise ValueError(f"{name}: expected names, got {value!r}")
    return values


def warn_of_precision(dtype: DType, **values: Any) -> None:
    """Warn about arrays in float64 that become float32.

    dtype: of the chain. values: arguments of `state` by name.
    """
    float64_inputs = [
        name for name, x in values.items() if isinstance(x, np.ndarray) and x.dtype == np.float64
    ]
    if float64_inputs and dtype == np.float32:
        warnings.warn(
            f"state: {' and '.join(float64_inputs)} in float64, kept in float32: jax_enable_x64 was"
            " off when the chain was loaded",
            stacklevel=4,
        )
