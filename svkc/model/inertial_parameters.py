"""Validation of masses, inertias and armatures, which make a mass matrix positive semidefinite.

`svkc.load` refuses invalid models. These functions check chains whose arrays were replaced after
loading.
"""

import weakref
from collections import OrderedDict

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from svkc._jax.pytrees import is_concrete, stop_gradient_tree
from svkc.model.chain import Chain


def _invalid_rows(mass, inertia, xp):
    """Return the masks [rows] of invalid masses and of invalid inertias.

    Zeros are valid. An inertia is valid if its principal minors are at least zero, to round-off.

    xp: numpy or jax.numpy.
    """
    scale = xp.max(xp.abs(inertia), axis=(-2, -1), keepdims=True)
    unit = inertia / xp.where(scale > 0, scale, 1)
    entry = lambda i, j: unit[..., i, j]
    minor = lambda i, j: entry(i, i) * entry(j, j) - entry(i, j) * entry(j, i)
    determinant = (
        entry(0, 0) * minor(1, 2)
        - entry(0, 1) * (entry(1, 0) * entry(2, 2) - entry(1, 2) * entry(2, 0))
        + entry(0, 2) * (entry(1, 0) * entry(2, 1) - entry(1, 1) * entry(2, 0))
    )
    minors = [entry(i, i) for i in range(3)] + [minor(0, 1), minor(0, 2), minor(1, 2), determinant]
    # for round-off in inertias that were rotated into the axes of their rows
    tolerance = 64 * np.finfo(inertia.dtype).eps
    # comparisons with NaN are False, and `unit` of an infinite inertia is NaN
    positive = xp.all(xp.stack(minors) >= -tolerance, axis=0)
    return ~((mass >= 0) & (mass < np.inf)), ~positive


def has_invalid_inertial_parameters(chain: Chain) -> Bool[Array, ""]:
    """Return whether a mass or an armature is negative or not finite, or an inertia is not positive
    semidefinite; for traced chains too.

    Inertias that violate the triangle inequality of their principal moments are valid here: their
    mass matrix is positive semidefinite.
    """
    mass, inertia, armature = stop_gradient_tree((chain.mass, chain.inertia, chain.armature))
    by_mass, by_inertia = _invalid_rows(mass, inertia, jnp)
    invalid = jnp.any(by_mass | by_inertia)
    if armature is None:
        return invalid
    return invalid | ~jnp.all((armature >= 0) & (armature < jnp.inf))


# The arrays of chains that were checked last, by their identities. JAX arrays do not change.
_checked: OrderedDict[tuple[int, ...], tuple] = OrderedDict()
_MOST_CHECKED = 64


def check_inertial_parameters(chain: Chain) -> None:
    """Raise ValueError if a mass or an armature is negative or not finite, or an inertia is not
    positive semidefinite.

    Traced chains and batches of chains are not checked. A second check of the same arrays takes a
    microsecond.
    """
    arrays = [x for x in (chain.mass, chain.inertia, chain.armature) if x is not None]
    key = tuple(map(id, arrays))
    entry = _checked.get(key)
    if entry is not None and all(r() is x for r, x in zip(entry, arrays, strict=True)):
        return
    if not is_concrete(arrays) or np.ndim(chain.mass) != 1:
        return
    _raise_if_invalid(chain)
    if all(isinstance(x, jax.Array) for x in arrays):
        _checked[key] = tuple(map(weakref.ref, arrays))
        while len(_checked) > _MOST_CHECKED:
            _checked.popitem(last=False)


def _raise_if_invalid(chain: Chain) -> None:
    """Raise ValueError for the invalid arrays of a concrete chain."""
    mass, inertia = np.asarray(chain.mass), np.asarray(chain.inertia)
    with np.errstate(all="ignore"):
        masks = _invalid_rows(mass, inertia, np)
    for name, values, mask in zip(("mass", "inertia"), (mass, inertia), masks, strict=True):
        if mask.any():
            # the last invalid row: row 0, the world's, only if every other one is valid
            row = int(np.flatnonzero(mask)[-1])
            raise ValueError(
                f"chain.{name}: got {values[row].tolist()} for {row_name(chain, row)}, expected"
                " finite numbers that make a positive semidefinite inertia"
            )
    if chain.armature is None:
        return
    armature = np.asarray(chain.armature)
    valid = (armature >= 0) & (armature < np.inf)
    if not valid.all():
        index = int(np.argmin(valid))
        raise ValueError(
            f"chain.armature: got {armature[index]} for {chain.dof_names[index]!r}, expected a"
            " finite number that is not negative"
        )


def row_name(chain: Chain, row: int) -> str:
    """Return the body that a row belongs to, as messages name it."""
    parents, rows = chain.topology.parent, chain.topology.body_row
    # a body with several joints has several rows, of which the last is the body's
    while row not in rows:
        row = parents.index(row)
    return f"body {chain.body_names[rows.index(row)]!r}"
