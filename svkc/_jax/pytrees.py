"""Operations on pytrees of arrays."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer


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
    """Return `new` where `condition` holds, else `old`, leaf by leaf (`jnp.where`)."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)


def is_concrete(*values) -> bool:
    """Return whether no leaf of the values is a tracer, so that Python can read the numbers."""
    return not any(isinstance(x, Tracer) for v in values for x in jax.tree.leaves(v))
