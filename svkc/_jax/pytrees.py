"""Operations on pytrees of arrays."""

import equinox as eqx
import jax
import jax.numpy as jnp


def stop_gradient_tree(tree):
    """The tree with every array in it held fixed in derivatives."""
    return jax.tree.map(lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x, tree)


def materialise_zeros(x, dx):
    """The tangent of x: zeros where dx is None."""
    return jax.tree.map(
        lambda x, d: jnp.zeros_like(x) if d is None and x is not None else d,
        x,
        dx,
        is_leaf=lambda x: x is None,
    )


def tree_where(condition, new, old):
    """The new tree where `which`, else the old one."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)


def is_concrete(*values) -> bool:
    """Whether the values can be looked at: none of them is traced."""
    return not any(isinstance(x, jax.core.Tracer) for v in values for x in jax.tree.leaves(v))
