"""Values that XLA's CPU backend stores where it would compute them again.

XLA takes sines and cosines of real numbers for cheap operations. It repeats them in every kernel
that uses them, for each number that depends on them: up to 16 times in a product of quaternions.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


@jax.custom_jvp
def evaluated_once(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Return x. On a CPU, x is computed once where several numbers depend on each entry of x.

    x is divided by a one that XLA does not know to be one, as XLA stores the results of divisions.
    """
    return x / jnp.where(x == x, jnp.ones((), x.dtype), x)


@evaluated_once.defjvp
def _evaluated_once_jvp(primals, tangents):
    return evaluated_once(*primals), tangents[0]
