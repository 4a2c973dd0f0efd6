"""Arrays that `vmap` batches all together or not at all.

When `vmap` meets a `jax.custom_jvp` function within `jit`, `scan`, `cond` or `checkpoint`, JAX
notes the batch axes of its outputs from the function alone. The derivative rule may batch more
outputs: the rotations of a chain of slides do not depend on q, but the rule computes their zero
rates from q. Differentiation then fails. Outside of these, JAX broadcasts the values.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir


def batch_together(values: Any, inputs: Any) -> Any:
    """Return the values. If `vmap` batches a value or an input, it batches all values.

    It is the last operation of a `jax.custom_jvp` function.

    values: the function's outputs, a pytree of arrays.
    inputs: all that its derivative rule reads.
    """
    leaves, tree = jax.tree.flatten(values)
    out = batch_together_p.bind(*leaves, *jax.tree.leaves(inputs))
    return jax.tree.unflatten(tree, out[: len(leaves)])


def _batch(args, axes):
    lanes = next(x.shape[axis] for x, axis in zip(args, axes, strict=True) if axis is not None)
    to_front = lambda x, axis: (
        jnp.broadcast_to(x, (lanes, *jnp.shape(x))) if axis is None else jnp.moveaxis(x, axis, 0)
    )
    out = batch_together_p.bind(*map(to_front, args, axes))
    return out, (0,) * len(out)


def _jvp(args, tangents):
    return batch_together_p.bind(*args), tangents


# `lanes_last` and `dependence` recognise this primitive by its name
batch_together_p = Primitive("batch_together")
batch_together_p.multiple_results = True
batch_together_p.def_impl(lambda *args: list(args))
batch_together_p.def_abstract_eval(lambda *avals: list(avals))
ad.primitive_jvps[batch_together_p] = _jvp
batching.primitive_batchers[batch_together_p] = _batch
mlir.register_lowering(batch_together_p, lambda _, *args: list(args))
