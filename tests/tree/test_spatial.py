"""Products of vectors and quaternions: values, and derivatives of first and second order."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from svkc.tree.spatial import (
    cross,
    inverse_positive,
    motion_cross,
    quat_matrix,
    quat_multiply,
    skew,
)


def quaternion_product(a, b):
    """Return the Hamilton product by its textbook formula."""
    (w, x), (m, y) = (a[0], a[1:]), (b[0], b[1:])
    return jnp.concatenate([(w * m - x @ y)[None], w * y + m * x + jnp.cross(x, y)])


def spatial_product(a, b):
    """Return Featherstone's (2.31)."""
    return jnp.concatenate(
        [jnp.cross(a[:3], b[:3]), jnp.cross(a[3:], b[:3]) + jnp.cross(a[:3], b[3:])]
    )


def rotation_matrix(q, _):
    """Return the vector part of x -> q x q*, column by column."""
    conjugate = q * jnp.asarray([1.0, -1, -1, -1])
    image = lambda x: quaternion_product(quaternion_product(q, jnp.append(0.0, x)), conjugate)
    return jnp.stack([image(x)[1:] for x in jnp.eye(3)], 1)


CASES = {
    "cross": (cross, jnp.cross, 3),
    "motion_cross": (motion_cross, spatial_product, 6),
    "quat_multiply": (quat_multiply, quaternion_product, 4),
    "quat_matrix": (lambda q, _: quat_matrix(q), rotation_matrix, 4),
    "skew": (lambda a, _: skew(a), lambda a, _: jnp.cross(a, jnp.eye(3)).T, 3),
}


@pytest.mark.parametrize("case", CASES)
def test_products(case):
    ours, expected, size = CASES[case]
    a, b = jax.random.normal(jax.random.key(0), (2, size))
    np.testing.assert_allclose(ours(a, b), expected(a, b), rtol=1e-13, atol=1e-14)
    for transform in (jax.jacfwd, jax.jacrev, jax.hessian):
        # by both factors, and by one alone, whose other tangent is zero
        for by in ((0, 1), 0, 1):
            got, value = (jax.jit(transform(f, by))(a, b) for f in (ours, expected))
            for x, y in zip(jax.tree.leaves(got), jax.tree.leaves(value), strict=True):
                np.testing.assert_allclose(x, y, rtol=1e-13, atol=1e-14)


def test_products_broadcast_leading_axes():
    a = jax.random.normal(jax.random.key(0), (1, 4))
    b = jax.random.normal(jax.random.key(1), (5, 4))
    expected = jax.vmap(lambda b: quat_multiply(a[0], b))(b)
    np.testing.assert_allclose(quat_multiply(a, b), expected, rtol=1e-13, atol=1e-14)
    loss = lambda product: lambda a, b: jnp.sum(jnp.sin(product(a, b)))
    rows = lambda a, b: jax.vmap(lambda b: quat_multiply(a[0], b))(b)
    got, value = (jax.grad(loss(f), (0, 1))(a, b) for f in (quat_multiply, rows))
    for x, y in zip(got, value, strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize("size", [1e-15, 1e-9, 1.0, 1e9, 1e15])
def test_inverses_of_small_and_large_inertias_in_float32(size):
    """The cubes of 1e-15 and 1e15 are zero and infinite in float32."""
    rng = np.random.default_rng(0)
    A = rng.normal(size=(4, 3, 3))
    D = size * (A @ np.swapaxes(A, 1, 2) + np.eye(3))
    inverse = inverse_positive(jnp.asarray(D, jnp.float32))
    products = np.asarray(inverse, float) @ D
    np.testing.assert_allclose(products, np.broadcast_to(np.eye(3), D.shape), atol=1e-5)
    # d(D^-1) = -D^-1 dD D^-1
    along = jnp.asarray(np.eye(3) * D, jnp.float32)
    slope = jax.jvp(inverse_positive, (jnp.asarray(D, jnp.float32),), (along,))[1]
    expected = -np.linalg.inv(D) @ (np.eye(3) * D) @ np.linalg.inv(D)
    np.testing.assert_allclose(slope * size, expected * size, atol=1e-5)
