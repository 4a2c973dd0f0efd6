"""Operations on pytrees of arrays."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer

from svkc._jax.select import where


def stop_gradient_tree(tree):
    """Apply `lax.stop_gradient` to every array of a pytree."""
    return jax.tree.map(lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x, tree)


def materialise_zeros(x, dx):
    """Return the tangent `dx` of `x`, with zeros where a leaf of `dx` is None."""
    return jax.tree.map(
        lambda x, d: jnp.zeros_like(x) if d is None and x is not None else d,
        x,
        dx,
        is_leaf=lambda x: x is None,
    )


def tree_where(condition, new, old):
    """Return `new` where the scalar `condition` holds, else `old`, leaf by leaf.

    Leaves of equal shape and dtype take one operation.
    """

    def select(a, b):
        a, b = jnp.asarray(a), jnp.asarray(b)
        same = a.shape == b.shape and a.dtype == b.dtype and a.weak_type == b.weak_type
        return jax.lax.select(condition, a, b) if same else where(condition, a, b)

    return jax.tree.map(select, new, old)


def is_concrete(*values) -> bool:
    """Return whether no leaf of the values is a tracer, so that Python can read the numbers."""
    return not any(isinstance(x, Tracer) for v in values for x in jax.tree.leaves(v))


def only_leaves(tree: Any, select: Callable) -> Any:
    """Return the tree with None in place of all leaves that are not selected.

    Pass the result to a function with a custom derivative, which then sees no other tangents.

    select: as `where` of `equinox.tree_at`.
    """
    empty = jax.tree.map(lambda _: None, tree)
    return eqx.tree_at(select, empty, select(tree), is_leaf=lambda x: x is None)
