"""Gather by an index known at run time: equality with JAX's indexing, without a scatter."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from svkc._jax.dynamic_gather import take_rows


@pytest.mark.parametrize("platform", ["cpu", "gpu"])
@pytest.mark.parametrize("shape", [(5,), (5, 3), (5, 2, 3)])
def test_take_rows_equals_indexing(shape, platform, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: platform)
    x, index = jax.random.normal(jax.random.key(0), shape), jnp.asarray([4, 0, 0, 2])
    ours, theirs = (lambda x: jnp.sin(take_rows(x, index))), (lambda x: jnp.sin(x[index]))
    np.testing.assert_array_equal(ours(x), theirs(x))
    for derivative in (jax.jacfwd, jax.jacrev):
        got, expected = jax.jit(derivative(ours))(x), jax.jit(derivative(theirs))(x)
        np.testing.assert_allclose(got, expected, rtol=1e-14)
    second = lambda f: jax.jit(jax.hessian(lambda x: jnp.sum(f(x) ** 2)))(x)
    np.testing.assert_allclose(second(ours), second(theirs), rtol=1e-13, atol=1e-14)
    gradient = jax.jit(jax.grad(lambda x, index: jnp.sum(jnp.sin(take_rows(x, index)))))
    text = gradient.lower(x, index).as_text()
    assert "scatter" not in text
    assert ("while" in text) == (platform == "cpu")
