"""Gather by a static index: equality with JAX's indexing, and derivatives without a scatter."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from svkc._jax.static_gather import static_take

# one past the last row, 7: zeros
INDICES = {
    "some": np.array([0, 3, 3, 7, 1]),
    "a table": np.array([[0, 7, 6], [2, 2, 5]]),
    "all": np.arange(7),
    "all as a table": np.arange(7)[:, None],
    "one of many": np.array([4]),
    "one row for all": np.zeros(90, int),
    "none": np.zeros(0, int),
}


SLOW = [
    pytest.param(index, id=name, marks=pytest.mark.slow)
    for name, index in INDICES.items()
    if name != "some"
]


@pytest.mark.parametrize("index", [pytest.param(INDICES["some"], id="some"), *SLOW])
def test_static_take_equals_indexing(index):
    x, many = (
        jax.random.normal(jax.random.key(0), (7, 3)),
        jax.random.normal(jax.random.key(1), (7, 5, 3)),
    )
    ours = lambda x: jnp.sin(static_take(x, index))
    theirs = lambda x: jnp.sin(jnp.concatenate([x, jnp.zeros((1, *x.shape[1:]))])[index])
    once, twice = jax.vmap(ours, 1, -1), jax.vmap(theirs, 1, -1)
    for f, g, at in (
        (ours, theirs, x),
        (jax.jit(ours), theirs, x),
        (ours, theirs, x[:, 0]),
        (once, twice, many),
    ):
        np.testing.assert_array_equal(f(at), g(at))
        both = lambda f, at=at: jax.jit(lambda x: (jax.jacfwd(f)(x), jax.jacrev(f)(x)))(at)
        for got, expected in zip(both(f), both(g), strict=True):
            np.testing.assert_allclose(got, expected, rtol=1e-14)
    second = lambda f: jax.jit(jax.hessian(lambda x: jnp.sum(f(x) ** 2)))(x)
    np.testing.assert_allclose(second(ours), second(theirs), rtol=1e-13, atol=1e-14)


def test_derivatives_without_a_scatter():
    gradient_text = lambda rows, index: (
        jax.jit(jax.grad(lambda x: jnp.sum(jnp.sin(static_take(x, index)))))
        .lower(jnp.ones((rows, 3)))
        .as_text()
    )
    for name, index in INDICES.items():
        assert "scatter" not in gradient_text(7, index), name
    # many rows that are used more often than the table is wide are left to jax
    assert "scatter" in gradient_text(400, np.repeat(np.arange(5), 20))


def test_rows_used_often_are_summed_one_by_one():
    index = np.concatenate([np.zeros(30, int), [5, 39, 40], np.full(25, 39)])
    x = jax.random.normal(jax.random.key(0), (40, 3))
    weight = jax.random.normal(jax.random.key(1), (len(index), 3))
    ours = lambda x: jnp.sum(weight * static_take(x, index) ** 2)
    theirs = lambda x: jnp.sum(weight * jnp.concatenate([x, jnp.zeros((1, 3))])[index] ** 2)
    assert "scatter" not in jax.jit(jax.grad(ours)).lower(x).as_text()
    np.testing.assert_allclose(jax.grad(ours)(x), jax.grad(theirs)(x), rtol=1e-13, atol=1e-14)
    many = jnp.stack([x, 2 * x], 1)
    both = lambda f: jax.grad(lambda x: jnp.sum(jax.vmap(f, 1)(x)))(many)
    np.testing.assert_allclose(both(ours), both(theirs), rtol=1e-13, atol=1e-14)
