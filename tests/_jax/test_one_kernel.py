"""Functions compiled to one kernel: same values and derivatives, and what a kernel cannot hold.

From jax 0.11 on the functions are unchanged: values and derivatives hold, and no call is marked.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from svkc._jax.one_kernel import HAS_ONE_KERNEL, one_kernel


def chain_of_operations(x, A):
    """Return a value by gathers, a product with a matrix, a loop and a branch."""
    y = A @ jnp.sin(x[jnp.argmax(x) * 0 + jnp.arange(len(x)) // 2])
    y = jax.lax.fori_loop(0, 3, lambda i, y: y + jnp.tanh(A @ y) / (i + 1.0), y)
    return jax.lax.cond(y[0] > 0, lambda: jnp.outer(y, x), lambda: jnp.outer(x, y) + A)


X, A = jnp.asarray([0.3, -0.2, 0.9, 0.4]), jnp.asarray(np.arange(16.0).reshape(4, 4) / 10)

NO_KERNEL = {
    "sort": lambda x, A: jnp.sort(x) + A[0],
    "scatter": lambda x, A: A.at[jnp.argsort(x), 0].add(x),
    "matrices": lambda x, A: (A * x[None]) @ A,
    "LAPACK": lambda x, A: jnp.linalg.cholesky(A @ A.T + jnp.eye(4)) @ x,
    "random bits": lambda x, A: x + jax.random.normal(jax.random.key(0, impl="rbg"), (4,)),
    "callback": lambda x, A: jax.pure_callback(np.sin, x, x) + A[0],
}


def kernels(function, *args) -> int:
    """Return the number of calls in a compiled program that are one kernel."""
    text = jax.jit(function).lower(*args).as_text()
    return text.count('xla_cpu_small_call = "true"')


def test_a_program_is_one_kernel():
    assert kernels(one_kernel(chain_of_operations), X, A) == HAS_ONE_KERNEL
    compiled = jax.jit(one_kernel(chain_of_operations)).lower(X, A).compile()
    if HAS_ONE_KERNEL:
        main = compiled.as_text().split("ENTRY")[1]
        assert main.count("xla_cpu_small_call") == 1
        assert main.count("fusion(") == main.count("while(") == main.count("dot(") == 0
    expected = jax.jit(chain_of_operations)(X, A)
    np.testing.assert_allclose(compiled(X, A), expected, rtol=1e-14)


@pytest.mark.parametrize("transform", [jax.jacfwd, jax.jacrev, jax.hessian])
@pytest.mark.parametrize("checkpoint", [False, True])
def test_derivatives(transform, checkpoint):
    function = jax.checkpoint(chain_of_operations) if checkpoint else chain_of_operations
    derivative, expected = transform(one_kernel(function), (0, 1)), transform(function, (0, 1))
    for got, value in zip(
        jax.tree.leaves(jax.jit(derivative)(X, A)), jax.tree.leaves(jax.jit(expected)(X, A))
    ):
        np.testing.assert_allclose(got, value, rtol=1e-12, atol=1e-13)


def test_the_gradient_of_a_checkpointed_function_is_one_kernel():
    smooth = lambda x, A: jnp.sum(jnp.sin(A @ jnp.sin(x)) ** 2)
    gradient = jax.grad(one_kernel(jax.checkpoint(smooth)), (0, 1))
    compiled = jax.jit(gradient).lower(X, A).compile()
    main = compiled.as_text().split("ENTRY")[1]
    if HAS_ONE_KERNEL:  # nothing of the forward pass is left
        assert main.count("xla_cpu_small_call") == 1
    for got, value in zip(compiled(X, A), jax.grad(smooth, (0, 1))(X, A)):
        np.testing.assert_allclose(got, value, rtol=1e-12)


@pytest.mark.parametrize("case", NO_KERNEL)
def test_operations_of_the_runtime_are_compiled_as_usual(case):
    function = NO_KERNEL[case]
    assert kernels(one_kernel(function), X, A) == 0
    np.testing.assert_array_equal(jax.jit(one_kernel(function))(X, A), jax.jit(function)(X, A))


def test_batches_are_compiled_as_usual():
    batch = jnp.stack([X, X + 1])
    function = jax.vmap(one_kernel(chain_of_operations), (0, None))
    assert kernels(function, batch, A) == 0
    expected = jax.jit(jax.vmap(chain_of_operations, (0, None)))(batch, A)
    np.testing.assert_allclose(jax.jit(function)(batch, A), expected, rtol=1e-14)


@pytest.mark.parametrize("batched_first", [True, False])
def test_batches_with_an_output_that_is_the_same_for_all_lanes(batched_first):
    def plain(x, A):
        outputs = jnp.sin(x) * 2, A @ A[0]
        return outputs if batched_first else outputs[::-1]

    batch = jnp.stack([X, X + 1])
    both = lambda f: jax.vmap(f, (0, None), (0, None) if batched_first else (None, 0))
    assert kernels(both(one_kernel(plain)), batch, A) == 0
    for got, value in zip(jax.jit(both(one_kernel(plain)))(batch, A), both(plain)(batch, A)):
        np.testing.assert_allclose(got, value, rtol=1e-14)
    loss = lambda f: lambda x: jnp.sum(both(f)(x, A)[0] ** 2) + jnp.sum(both(f)(x, A)[1])
    got, expected = jax.jit(jax.grad(loss(one_kernel(plain))))(batch), jax.grad(loss(plain))(batch)
    np.testing.assert_allclose(got, expected, rtol=1e-13)


@pytest.mark.parametrize("fits", [True, False])
def test_kernels_within_a_kernel(fits):
    """The inner ones remain kernels where the outer function cannot be one."""
    plain = lambda x: jnp.sin(x) + jnp.flip(x)
    inner, last = one_kernel(plain), jnp.cumsum if fits else jnp.sort
    outer = one_kernel(lambda x: last(inner(x)) * inner(2 * x)[0])
    compiled = jax.jit(outer).lower(X).compile()
    assert kernels(outer, X) == (2 + fits) * HAS_ONE_KERNEL
    if HAS_ONE_KERNEL:
        assert compiled.as_text().split("ENTRY")[1].count("xla_cpu_small_call") == (
            1 if fits else 2
        )
    np.testing.assert_allclose(compiled(X), last(plain(X)) * plain(2 * X)[0], rtol=1e-14)


AT_ONE_INDEX = {
    "rows in a loop": lambda x, A, i: jax.lax.fori_loop(
        0, 3, lambda k, A: A.at[i + k].set(jnp.sin(x) * k), A
    ),
    "column": lambda x, A, i: A.at[:, i].set(x),
    "entry added": lambda x, A, i: A.at[i, 2].add(x[0]),
    "row multiplied": lambda x, A, i: A.at[i].multiply(x),
    "largest": lambda x, A, i: A.at[i].max(x),
    "booleans": lambda x, A, i: jnp.where((A > 0).at[i].set(False), A, x[None]),
    "transpose of a row": lambda x, A, i: jax.grad(lambda A: jnp.sum(A[i] * x))(A),
}


@pytest.mark.parametrize("case", AT_ONE_INDEX)
def test_writing_at_one_traced_index(case):
    """XLA replaces a scatter at one index by the update of a slice."""
    function = AT_ONE_INDEX[case]
    assert kernels(one_kernel(function), X, A, 1) == HAS_ONE_KERNEL
    for i in (0, 1, 3, 7):  # out of bounds at last
        got = jax.jit(one_kernel(function))(X, A, i)
        np.testing.assert_array_equal(got, jax.jit(function)(X, A, i))


def test_arguments_that_are_not_used():
    """XLA aborts if such an argument is a parameter of the function that is compiled."""

    @one_kernel
    def function(x, unused, empty, by_zero, label):
        zero = (0 * jnp.round(by_zero).astype(int)).astype(x.dtype)
        return {"x": jnp.sin(x) + zero, "same": x, "constant": jnp.ones(2)}, label, empty

    arguments = X, A, jnp.zeros((0, 3)), X
    result, label, empty = eqx.filter_jit(function)(*arguments, "label")
    assert label == "label"
    assert empty.shape == (0, 3)
    np.testing.assert_allclose(result["x"], np.sin(X), rtol=1e-15)
    np.testing.assert_array_equal(result["same"], X)
    np.testing.assert_array_equal(result["constant"], np.ones(2))


def test_arguments_that_become_constants():
    """XLA moves constants into loops and calls, so that parameters are no longer used."""
    function = one_kernel(lambda x, a, b: (jnp.sin(x) * a, b + 1))

    def run(x):
        a, b = jnp.full(4, 2.0), jnp.arange(3)
        scan = lambda x, _: (function(x, a, b)[0], function(a, a, b)[1])
        x, counts = jax.lax.scan(scan, x, length=3)
        return x, counts, one_kernel(lambda x: jnp.ones(2))(x), function(a, a, b)

    x, counts, ones, (last, _) = jax.jit(run)(X)
    expected = X
    for _ in range(3):
        expected = 2 * jnp.sin(expected)
    np.testing.assert_allclose(x, expected, rtol=1e-14)
    np.testing.assert_array_equal(counts, np.tile(np.arange(3) + 1, (3, 1)))
    np.testing.assert_array_equal(ones, np.ones(2))
    np.testing.assert_allclose(last, np.full(4, 2 * np.sin(2.0)), rtol=1e-14)


def test_loops_of_kernels():
    body = one_kernel(lambda carry, A: jnp.tanh(A @ carry))
    run = lambda x, A: jax.lax.scan(lambda x, _: (body(x, A), x), x, length=5)
    plain = lambda x, A: jax.lax.scan(lambda x, _: (jnp.tanh(A @ x), x), x, length=5)
    assert kernels(run, X, A) == HAS_ONE_KERNEL
    for got, value in zip(jax.jit(run)(X, A), jax.jit(plain)(X, A)):
        np.testing.assert_allclose(got, value, rtol=1e-14)
    loss = lambda f: jax.jit(jax.grad(lambda x: jnp.sum(f(x, A)[1] ** 2)))(X)
    np.testing.assert_allclose(loss(run), loss(plain), rtol=1e-13)


def test_other_platforms_do_not_see_the_attribute():
    text = jax.export.export(jax.jit(one_kernel(chain_of_operations)), platforms=["cuda"])(X, A)
    assert "xla_cpu_small_call" not in text.mlir_module()
