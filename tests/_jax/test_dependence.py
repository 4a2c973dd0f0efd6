"""How outputs depend on inputs, by the expression of a function."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from svkc._jax.dependence import LINEAR, NONE, NONLINEAR, dependence
from svkc._jax.static_gather import static_take

MATRIX = np.arange(6.0).reshape(2, 3)

# function of x [3] and y [2], and its dependence on x0 x1 x2 y0 y1
CASES = {
    "matrix": (lambda x, y: MATRIX @ x, [[1, 1, 1, 0, 0]] * 2),
    "product": (lambda x, y: x[:2] * y, [[2, 0, 0, 2, 0], [0, 2, 0, 0, 2]]),
    "matrix of inputs": (lambda x, y: (x[:2, None] * MATRIX).T @ y, [[2, 2, 0, 2, 2]] * 3),
    "quotient": (lambda x, y: jnp.stack([x[0] / 2, 1 / y[0]]), [[1, 0, 0, 0, 0], [0, 0, 0, 2, 0]]),
    "gate": (lambda x, y: jnp.where(x[0] > 1e9, y, 0.0), [[2, 0, 0, 2, 0], [2, 0, 0, 0, 2]]),
    "kink": (lambda x, y: jnp.maximum(x[2] - 1e9, 0)[None], [[0, 0, 2, 0, 0]]),
    "zero": (lambda x, y: jnp.zeros(1) * x[:1], [[1, 0, 0, 0, 0]]),
    "sum": (lambda x, y: jnp.sum(x)[None] - y[:1], [[1, 1, 1, 1, 0]]),
    "set": (lambda x, y: y.at[np.array([1])].set(x[0]), [[0, 0, 0, 1, 0], [1, 0, 0, 0, 0]]),
    "indices": (lambda x, y: x[np.array([2, 0])], [[0, 0, 1, 0, 0], [1, 0, 0, 0, 0]]),
    "static": (lambda x, y: static_take(x, np.array([1, 3])), [[0, 1, 0, 0, 0], [0] * 5]),
    "split": (lambda x, y: jnp.split(x, [2])[1], [[0, 0, 1, 0, 0]]),
    "unpacked": (lambda x, y: jnp.stack(tuple(x))[1:2], [[0, 1, 0, 0, 0]]),
    "columns": (
        lambda x, y: jnp.stack(jnp.unstack(jnp.outer(x, MATRIX[0]), axis=1))[1, :2],
        [[1, 0, 0, 0, 0], [0, 1, 0, 0, 0]],
    ),
    "reversed": (lambda x, y: x[::-1].reshape(3, 1).T[0, :1], [[0, 0, 1, 0, 0]]),
    "whole": (lambda x, y: jnp.round(x[:1]).astype(int).astype(y.dtype) + y[:1], [[2, 0, 0, 1, 0]]),
    "call": (lambda x, y: jax.jit(jnp.multiply)(x[:1], y[:1]), [[2, 0, 0, 2, 0]]),
    "checkpoint": (
        lambda x, y: jax.checkpoint(lambda a: 2 * a)(y),
        [[0, 0, 0, 1, 0], [0] * 4 + [1]],
    ),
    "loop": (
        lambda x, y: jax.lax.fori_loop(0, 3, lambda i, a: a + 1, y),
        [[0, 0, 0, 2, 2]] * 2,
    ),
    "reduction": (
        lambda x, y: jax.lax.reduce(x, np.ones(()), jax.lax.mul, (0,))[None],
        [[2, 2, 2, 0, 0]],
    ),
    "custom": (lambda x, y: jax.nn.relu(x[:1]), [[2, 0, 0, 0, 0]]),
    "base 2": (lambda x, y: jnp.log2(x[1:2]), [[0, 2, 0, 0, 0]]),
    "constant": (lambda x, y: jnp.ones(2), [[0] * 5] * 2),
}


@pytest.mark.parametrize("case", CASES)
def test_dependence(case):
    function, expected = CASES[case]
    assert (NONE, LINEAR, NONLINEAR) == (0, 1, 2)
    result = dependence(function, jnp.zeros(3), jnp.zeros(2))
    np.testing.assert_array_equal(result, expected)


@pytest.mark.parametrize("seed", range(5))
def test_derivatives_outside_the_dependence_are_zero(seed):
    """Of a function of many primitives, at a random point."""

    def function(x, y):
        z = jnp.concatenate([jnp.sin(x) * y[0], jnp.outer(x, y).ravel()[1:4], jnp.cumsum(y)])
        z = jnp.linalg.solve(jnp.eye(8) + 0.1 * jnp.outer(jnp.ones(8), z), z)[:4]
        return jnp.concatenate([z, jax.scipy.special.erf(x), jnp.sort(y), x[1:] ** 3])

    random = np.random.default_rng(seed)
    at = random.normal(size=3), random.normal(size=2)
    kinds = dependence(function, *map(jnp.asarray, at))
    J = np.concatenate(jax.jacfwd(function, (0, 1))(*map(jnp.asarray, at)), 1)
    assert not np.any(J[kinds == NONE])
    assert (kinds[4:7, :3] == NONLINEAR * np.eye(3)).all()
