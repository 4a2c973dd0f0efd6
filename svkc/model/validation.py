"""Plain arguments as callers give them: numbers that must be whole, positive, or real; what cannot
be right is said by name."""

import jax
import jax.numpy as jnp
import numpy as np

from svkc._jax.pytrees import is_concrete


def as_array(value):
    """As an array; of objects, where it is none."""
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


def real_array(name: str, value, dtype=None):
    """As an array of real numbers, of type dtype where it is given. ValueError: strings, objects,
    complex numbers, ragged lists."""
    array = as_array(value)
    if not any(jnp.issubdtype(array.dtype, kind) for kind in (np.integer, np.floating)):
        raise ValueError(
            f"{name}: expected real numbers, got"
            f" {repr(value) if array.dtype == object else array.dtype}"
        )
    return array if dtype is None else jnp.asarray(array, dtype)


def finite_array(name: str, value, dtype=None):
    """The same, finite where that can be seen."""
    array = real_array(name, value, dtype)
    if is_concrete(array) and not np.isfinite(np.asarray(array)).all():
        raise ValueError(f"{name}: expected finite numbers, got {np.asarray(array)}")
    return array


def scalar(name: str, value):
    """One real number."""
    array = real_array(name, value)
    if array.shape != ():
        raise ValueError(
            f"{name}: got shape {array.shape}, expected one number; for another in each lane use"
            " vmap"
        )
    return value


def vector(name: str, value, count: int):
    """So many finite numbers."""
    array = finite_array(name, value)
    if array.shape != (count,):
        raise ValueError(f"{name}: got shape {array.shape}, expected {count} numbers")
    return array


def positive_scalar(name: str, value):
    """One number above zero, where that can be seen."""
    scalar(name, value)
    if is_concrete(value) and not np.asarray(value) > 0:
        raise ValueError(f"{name}: got {value}, expected a positive number")
    return value


def integer(name: str, value, minimum: int, maximum: int = 2**31 - 1) -> int:
    """A whole number from `least` to `most`."""
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


def check_function(name: str, value, optional: bool = True) -> None:
    """A function, or, where it is optional, None."""
    if not callable(value) and not (optional and value is None):
        raise ValueError(f"{name}: expected a function, got {value!r}")


def boolean(name: str, value) -> bool:
    """A Boolean."""
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name}: got {value!r}, expected True or False")
    return bool(value)


def names(name: str, value) -> tuple[str, ...]:
    """A name, or several."""
    several = (value,) if isinstance(value, str) or not np.iterable(value) else tuple(value)
    if not all(isinstance(x, str) for x in several):
        raise ValueError(f"{name}: expected names, got {value!r}")
    return several
