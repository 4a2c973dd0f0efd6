"""Rows of the loop constraints for articulated bodies: reduced near singular configurations, and
independent ones of redundant loops."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import models
import numpy as np
import pytest
from tolerances import DIFFERENCE, ROUND_OFF

import svkc
from svkc.loops.constraint_rows import RowChoice, choose_rows, reduce_rows
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
            chain,
            state.structure,
            state.q,
            state.v,
            jnp.ones(4),
            dynamics=BODIES,
            choice=choose_rows(chain, state.structure, state.q, near),
        )
    )
    for reduced, plain in zip(accelerate(True), accelerate(False), strict=True):
        np.testing.assert_allclose(reduced, plain, rtol=ROUND_OFF, atol=ROUND_OFF)


def along_a_line(chain, state, v, rng):
    """Return a function of a number: velocity and acceleration with reduced rows along a line."""
    dq, dv, weight = (jnp.asarray(rng.normal(size=4)) for _ in range(3))

    def both(x):
        out = velocity_and_acceleration(
            chain, state.structure, state.q + x * dq, v + x * dv, jnp.ones(4), dynamics=BODIES,
            choice=RowChoice.of_first_step(chain, state.structure, jnp.asarray(True)),
        )  # fmt: skip
        return jnp.concatenate(out) @ jnp.tile(weight, 2)

    return both


@pytest.mark.slow
def test_derivatives_of_reduced_rows(four_bar):
    """Both modes agree with central differences, also where the rates do not fit the loops."""
    chain = four_bar[0]
    # not where two pivots are equal, as there the changed rates jump
    state = chain.state({"crank": 0.7}, {"crank": 4.0})
    rng = np.random.default_rng(1)
    v = state.v + 0.1 * rng.normal(size=4)
    both = along_a_line(chain, state, v, rng)
    forward, reverse = jax.jit(jax.jacfwd(both))(0.0), jax.jit(jax.jacrev(both))(0.0)
    h, value = 1e-5, jax.jit(both)
    difference = (value(h) - value(-h)) / (2 * h)
    np.testing.assert_allclose(forward, difference, rtol=DIFFERENCE)
    np.testing.assert_allclose(reverse, forward, rtol=ROUND_OFF)


@pytest.mark.slow
def test_second_derivative_of_reduced_rows(four_bar):
    """At rates that fit the loops it agrees with the central difference of the first one."""
    chain = four_bar[0]
    state = chain.state({"crank": 0.7}, {"crank": 4.0})
    both = along_a_line(chain, state, state.v, np.random.default_rng(1))
    h, first = 1e-5, jax.jit(jax.jacfwd(both))
    second = jax.jit(jax.jacfwd(jax.jacrev(both)))(0.0)
    np.testing.assert_allclose(second, (first(h) - first(-h)) / (2 * h), rtol=DIFFERENCE)


@pytest.mark.slow
def test_redundant_loops_keep_as_many_rows_as_their_rank():
    """Of two loops, one of which is wholly redundant, as many rows stay as there are constraints.

    Accelerations are those of composite bodies, which eliminate rows by pivots.
    """
    chain = models.parallelogram()
    state = chain.state({"leg0": 0.4}, {"leg0": 2.0})
    choice = choose_rows(chain, state.structure, state.q, jnp.asarray(False))
    virtual = chain.dofs - chain.nv
    assert int(jnp.sum(choice.kept)) == int(state.structure.rank) - virtual == 3
    of = functools.partial(
        velocity_and_acceleration, chain, state.structure, state.q, state.v, jnp.ones(chain.dofs)
    )
    composites = of(dynamics=svkc.dynamics.CompositeBodies())
    for few, every in zip(of(dynamics=BODIES, choice=choice), composites, strict=True):
        np.testing.assert_allclose(few, every, rtol=ROUND_OFF, atol=ROUND_OFF)
