"""Values that XLA's CPU backend is made to store, instead of computing them again where used.

XLA considers sines and cosines of real numbers cheap. It fuses them into each kernel that uses
them, which computes them again for every number that depends on them: up to 16 times in a product
of quaternions.
"""

import jax
from jaxtyping import Array, Float

from svkc._jax.select import where


@jax.custom_jvp
def stored(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Return x. On a CPU it is stored, not computed again for each number that depends on it.

    XLA stores quotients, because it considers divisions expensive. The divisor is one (NaN where x
    is NaN), which XLA does not know. Derivatives of x are not stored.
    """
    if jax.default_backend() != "cpu":
        return x
    return x / where(x == x, 1, x)


@stored.defjvp
def _stored_jvp(primals, tangents):
    return stored(*primals), tangents[0]
