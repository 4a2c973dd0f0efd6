import jax
import jax.numpy as jnp
import numpy as np
import pytest

from svkc._jax.skippable import skippable

A = jnp.arange(9.0).reshape(3, 3) / 5
LANES = 4
X = jnp.linspace(0.2, 1.1, LANES * 3).reshape(LANES, 3)
USED = jnp.array([True, False, True, False])


def scaled(tangents, x):
    d_x, d_scale = tangents
    return (jnp.sin(x) * (A @ d_x) + d_scale * x**2, d_x * jnp.sum(x))


def unchanged(tangents, x):
    return tangents[0], jnp.zeros_like(x)


ours = skippable("test_scaled", scaled, unchanged)


def reference(tangents, used, x):
    pick = lambda a, b: jnp.where(used, a, b)
    return jax.tree.map(pick, scaled(tangents, x), unchanged(tangents, x))


def in_lanes(f):
    return lambda tangents, used, x: jax.vmap(f, ((0, None), None, 0))(tangents, used, x)


def loss(f):
    """A function of x and the tangents that is nonlinear in both."""

    def value(tangents, used, x):
        a, b = f(tangents, used, x)
        return jnp.sum(jnp.cos(a) * jnp.exp(b / 9))

    return value


DERIVATIVES = {
    "value": lambda f: f,
    "jvp": lambda f: lambda x: jax.jvp(f, (x,), (jax.tree.map(jnp.ones_like, x),)),
    "vjp": lambda f: lambda x: jax.vjp(f, x)[1](jnp.ones_like(f(x))),
    "forward over reverse": lambda f: jax.jacfwd(jax.jacrev(f)),
    "reverse over reverse": lambda f: jax.jacrev(jax.jacrev(f)),
    "reverse over forward": lambda f: jax.jacrev(jax.jacfwd(f)),
}


@pytest.mark.parametrize("derivative", list(DERIVATIVES))
@pytest.mark.parametrize("used", [True, pytest.param(False, marks=pytest.mark.slow)])
@pytest.mark.parametrize("compiled", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_derivatives(derivative, used, compiled):
    """The lanes share the second tangent, as they may share the masses of a chain."""
    batch = (X, jnp.asarray(0.7)), jnp.asarray(used), X + 1
    alone = jax.tree.map(lambda x: x[0] if x.ndim == 2 else x, batch)
    nested = (jnp.stack([X, X + 2]), jnp.asarray(0.3)), jnp.asarray(used), jnp.stack([X, X])
    for args, batched in (
        (alone, lambda f: f),
        (batch, in_lanes),
        (nested, lambda f: in_lanes(in_lanes(f))),
    ):

        def of(f, args=args, batched=batched):
            value = loss(batched(f))
            g = DERIVATIVES[derivative](lambda p: value((p[0], p[1]), args[1], p[2]))
            return (jax.jit(g) if compiled else g)((*args[0], args[2]))

        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12),
            of(ours),
            of(reference),
        )


@pytest.mark.parametrize(
    "derivative",
    [pytest.param(n, marks=pytest.mark.slow) if "over" in n else n for n in DERIVATIVES],
)
def test_derivatives_of_lanes_with_other_flags(derivative):
    f = skippable("test_masked", reference, lambda tangents, used, x: unchanged(tangents, x))

    def of(f):
        lanes = jax.vmap(f, ((0, None), 0, 0))
        return DERIVATIVES[derivative](lambda p: loss(lanes)((p[0], p[1]), USED, p[2]))

    ours = of(lambda tangents, used, x: f(tangents, used, used, x))((X, jnp.asarray(0.7), X + 1))
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12),
        ours,
        of(reference)((X, jnp.asarray(0.7), X + 1)),
    )


def test_cotangents_of_a_shared_tangent_are_summed_at_once():
    f = skippable("test_product", lambda W, x: W @ x, lambda W, x: W[0] * 0)
    lanes, W = 64, jnp.ones((128, 128))

    def value(W, xs):
        step = lambda total, x: (
            total + jnp.sum(jax.vmap(f, (None, None, 0))(W, x[0, 0] > 0, x)),
            None,
        )
        return jax.lax.scan(step, 0.0, xs)[0]

    gradient = jax.jit(jax.grad(value)).lower(W, jnp.ones((3, lanes, 128))).compile()
    assert gradient.memory_analysis().temp_size_in_bytes < 4 * W.nbytes  # with a copy a lane: 64


@pytest.mark.parametrize("used", [True, False])
def test_the_transpose_is_skipped(used):
    evaluations = []

    def counted(tangents, x):
        jax.debug.callback(lambda _: evaluations.append(1), x)
        return scaled(tangents, x)

    f = skippable("test_counted", counted, unchanged)
    used = jnp.asarray(used)
    gradient = jax.jit(jax.grad(lambda x: jnp.sum(f((x, jnp.ones(())), used, X[0])[0])))
    gradient(X[1])
    jax.effects_barrier()
    assert len(evaluations) == (2 if used else 0)  # in the value and in the transpose


def test_residuals_are_the_arguments():
    # a `lax.cond` in a scan stores values of the branch not taken for each iteration
    large = lambda tangents, x: (jnp.tanh(jnp.outer(x, x)).reshape(-1)[:3] * tangents[0], x * 0)
    f = skippable("test_large", large, unchanged)
    many = jnp.broadcast_to(X[0], (1000, 3))

    def stored(f):
        step = lambda used: lambda d, x: (f((d, jnp.ones(())), used, x)[0], None)
        run = lambda d, used: jnp.sum(jax.lax.scan(step(used), d, many)[0])
        gradient = jax.jit(jax.grad(run)).lower(X[0], jnp.asarray(False)).compile()
        return gradient.memory_analysis().temp_size_in_bytes

    cond = lambda tangents, used, x: jax.lax.cond(
        used, lambda: large(tangents, x), lambda: unchanged(tangents, x)
    )
    assert stored(f) < 1000 * 3 * 8 < stored(cond)
