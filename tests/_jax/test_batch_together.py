"""Arrays that `vmap` batches together: values, derivatives of batched programs, lanes last."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from svkc._jax.batch_together import batch_together
from svkc._jax.dependence import dependence
from svkc._jax.lanes_last import with_lanes_last

CONSTANT = np.arange(3.0)


@jax.custom_jvp
def with_zero_rate(x):
    """Return a constant and x ** 2. The rule computes the constant's rate, zero, from x."""
    return batch_together((jnp.asarray(CONSTANT), x**2), x)


@with_zero_rate.defjvp
def _(primals, tangents):
    (x,), (dx,) = primals, tangents
    return with_zero_rate(x), (0 * x[:3] * dx[:3], 2 * x * dx)


def plain(x):
    """Return the values of `with_zero_rate`."""
    return jnp.asarray(CONSTANT), x**2


X, DX = jnp.arange(8.0).reshape(2, 4), jnp.ones((2, 4))
PROGRAMS = {
    "jit": lambda f: jax.jit(jax.vmap(f)),
    "jit twice": lambda f: jax.jit(jax.jit(jax.vmap(f))),
    "last axis": lambda f: jax.jit(lambda x: jax.vmap(f, in_axes=1)(x.T)),
    "scan": lambda f: lambda x: jax.lax.scan(lambda _, x: (None, jax.vmap(f)(x)), None, x[None])[1],
    "cond": lambda f: (
        lambda x: jax.lax.cond(x[0, 0] < 1, jax.vmap(f), lambda x: jax.vmap(f)(2 * x), x)
    ),
    "lanes last": lambda f: jax.jit(jax.vmap(with_lanes_last(f))),
    "two batches": lambda f: lambda x: jax.jit(jax.vmap(jax.vmap(f)))(x[None]),
}


@pytest.mark.parametrize("name", list(PROGRAMS))
def test_derivatives_of_batched_programs(name):
    ours, theirs = PROGRAMS[name](with_zero_rate), PROGRAMS[name](plain)
    derivatives = (
        lambda f: f,
        lambda f: lambda x: jax.jvp(f, (x,), (DX,)),
        lambda f: lambda x: jax.vjp(f, x)[1](f(x)),
        lambda f: jax.jacfwd(jax.jacrev(f)),
    )
    for derivative in derivatives:
        jax.tree.map(np.testing.assert_array_equal, derivative(ours)(X), derivative(theirs)(X))


def test_values_are_not_mixed_in_dependence():
    entries = dependence(lambda x: batch_together((x[:1], x[1:] ** 2), x)[0], X[0])
    np.testing.assert_array_equal(entries, [[1, 0, 0, 0]])
