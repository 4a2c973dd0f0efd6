"""Row reduction of the loop constraints, which articulated bodies use near singular configurations
and where loops are redundant."""

import dataclasses

import jax
import jax.numpy as jnp
import models
import numpy as np
import pytest
from tolerances import DIFFERENCE, ROUND_OFF

import svkc
from svkc.loops.constraint_rows import reduce_rows
from svkc.loops.forward_dynamics import velocity_and_acceleration

BODIES = svkc.dynamics.ArticulatedBodies()


@pytest.fixture(scope="module")
def four_bar():
    chain = models.four_bar()
    return chain, chain.state(v={"crank": 4.0})


def test_rows_are_reduced_to_the_rank(four_bar):
    """Six rows of rank four become four rows that are the identity at their pivots."""
    rng = np.random.default_rng(0)
    B = jnp.asarray(rng.normal(size=(6, 4)) @ rng.normal(size=(4, 9)))
    A, T, pivots = reduce_rows(B, four_bar[1].structure, jnp.asarray(4))
    kept = np.any(np.asarray(pivots) > 0, 1)
    assert kept.sum() == 4
    np.testing.assert_allclose(A, T @ B, atol=ROUND_OFF)
    np.testing.assert_allclose((A @ pivots.T)[kept][:, kept], np.eye(4), atol=ROUND_OFF)
    np.testing.assert_array_equal(np.asarray(A)[~kept], 0)
    # the reduced rows have the range of the rows
    np.testing.assert_allclose((B @ pivots[kept].T) @ A[kept], B, atol=ROUND_OFF)


def test_weak_rows_are_dropped(four_bar):
    """Of two rows that differ by 1e-6 one is dropped in a phase whose margin is 0.3."""
    B = jnp.array([[1.0, 2.0, 3.0], [1.0, 2.0, 3.0 + 1e-6]])
    pivots = reduce_rows(B, four_bar[1].structure, jnp.asarray(2))[2]
    assert int(jnp.sum(pivots)) == 1
    fine = dataclasses.replace(four_bar[1].structure, margin=jnp.asarray(1e-6))
    assert int(jnp.sum(reduce_rows(B, fine, jnp.asarray(2))[2])) == 2


def test_accelerations_do_not_depend_on_the_reduction(four_bar):
    chain, state = four_bar
    accelerate = jax.jit(
        lambda near: velocity_and_acceleration(
            chain, state.structure, state.q, state.v, jnp.ones(4), dynamics=BODIES, near=near
        )
    )
    for reduced, plain in zip(accelerate(True), accelerate(False), strict=True):
        np.testing.assert_allclose(reduced, plain, rtol=ROUND_OFF, atol=ROUND_OFF)


def test_derivatives_of_reduced_rows(four_bar):
    """Both modes agree with central differences, also where the rates do not fit the loops."""
    chain = four_bar[0]
    # not where two pivots are equal, as there the changed rates jump
    state = chain.state({"crank": 0.7}, {"crank": 4.0})
    rng = np.random.default_rng(1)
    v = state.v + 0.1 * rng.normal(size=4)
    dq, dv, weight = (jnp.asarray(rng.normal(size=4)) for _ in range(3))

    def both(x):
        out = velocity_and_acceleration(
            chain, state.structure, state.q + x * dq, v + x * dv, jnp.ones(4), dynamics=BODIES,
            near=jnp.asarray(True),
        )  # fmt: skip
        return jnp.concatenate(out) @ jnp.tile(weight, 2)

    forward, reverse = jax.jit(jax.jacfwd(both))(0.0), jax.jit(jax.jacrev(both))(0.0)
    h, value = 1e-5, jax.jit(both)
    difference = (value(h) - value(-h)) / (2 * h)
    np.testing.assert_allclose(forward, difference, rtol=DIFFERENCE)
    np.testing.assert_allclose(reverse, forward, rtol=ROUND_OFF)
