"""Root finding: number of evaluations and accuracy for smooth functions, and for functions with
jumps, kinks and flat roots."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from svkc.integration.bracket import MAX_ITERATIONS, Bracket

# function, interval, root, largest number of evaluations (bisection takes 52 in float64)
SMOOTH = {
    "line": (lambda t: t - 0.1234, (0.0, 0.3), 0.1234, 4),
    "parabola": (lambda t: (t + 0.5) ** 2 - 0.36, (0.0, 0.3), 0.1, 9),
    "sine": (lambda t: jnp.sin(5 * t) - 0.7, (0.0, 0.3), math.asin(0.7) / 5, 10),
    "exponential": (lambda t: jnp.exp(30 * t) - math.exp(3), (0.0, 0.3), 0.1, 12),
    "far from t = 0": (lambda t: (t - 100.02) + (t - 100.02) ** 2, (100.0, 100.05), 100.02, 8),
    "fall from rest": (lambda t: 4.905 * t**2 - 0.02, (0.0, 0.1), math.sqrt(0.02 / 4.905), 12),
}
HARD = {
    "jump": (lambda t: jnp.where(t > 0.1234, 1.0, -1.0).astype(t.dtype), (0.0, 0.3), 0.1234, 60),
    "uneven jump": (
        lambda t: jnp.where(t > 0.1234, 1e-3, -1.0).astype(t.dtype),
        (0.0, 0.3),
        0.1234,
        60,
    ),
    "jump to infinity": (
        lambda t: jnp.where(t > 0.1234, jnp.inf, -1.0).astype(t.dtype),
        (0.0, 0.3),
        0.1234,
        60,
    ),
    "zero at the end": (lambda t: jnp.minimum(t - 0.3, 0.0) ** 3, (0.0, 0.3), 0.3, 60),
    "kink": (lambda t: (t - 0.1) * jnp.where(t > 0.1, 1.0, 1e3), (0.0, 0.3), 0.1, 80),
    "triple root": (lambda t: (t - 0.13) ** 3, (0.0, 0.3), 0.13, 80),
    "root of infinite rate": (lambda t: jnp.cbrt(t - 0.1), (0.0, 0.3), 0.1, 80),
    "steep": (lambda t: jnp.tanh(1e3 * (t - 0.1)), (0.0, 0.3), 0.1, 30),
}


def find_root(f, interval, dtype) -> Bracket:
    """Return the converged bracket about the root of f in an interval."""
    a, b = (jnp.asarray(x, dtype) for x in interval)
    start = Bracket.around(a, b, f(a), f(b))

    def iterate(bracket):
        c = bracket.next_point()
        return bracket.update(c, f(c))

    return jax.lax.while_loop(lambda bracket: bracket.not_converged(), iterate, start)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("name", [*SMOOTH, *HARD])
def test_a_root_is_located_to_round_off(name, dtype):
    """The bracket ends within its tolerance, a few units of round-off of the time, and holds the
    root. In float32 bisection takes 24 evaluations."""
    f, interval, root, most = (SMOOTH | HARD)[name]
    end = find_root(f, interval, dtype)
    eps = float(np.finfo(dtype).eps)
    a, b = float(end.a), float(end.b)
    assert float(end.fa) < 0 <= float(end.fb)
    assert b - a <= 3 * eps * max(interval[1], 1e-3)
    assert abs(b - root) <= 8 * eps * interval[1]
    assert int(end.count) <= min(most, 30 if dtype == np.float32 else MAX_ITERATIONS / 2)


def test_round_off_of_a_guard_costs_few_evaluations():
    """The bracket of a guard with round-off noise still converges, in at most six more steps."""
    noise = lambda t: 3e-16 * jnp.sin(1e17 * t)
    f, interval, root, most = SMOOTH["sine"]
    bracket = find_root(lambda t: f(t) + noise(t), interval, np.float64)
    assert abs(float(bracket.b) - root) < 1e-15
    assert int(bracket.count) <= most + 6
