"""Chains and states are plain pytrees: optimisers, root finders and serialisation of other
libraries accept them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import models
import numpy as np
import optax
import optimistix
import pytest
from tolerances import REFERENCE

import svkc

ROD = models.bar("rod", models.Y, "0 0 -1")


def assert_equal_leaves(one, two):
    """Assert that two pytrees have equal structure and bit-identical leaves."""
    assert jax.tree.structure(one) == jax.tree.structure(two)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
        assert (a.dtype, a.shape) == (b.dtype, b.shape)
        assert np.asarray(a).tobytes() == np.asarray(b).tobytes()


def differentiable_part(thing, where):
    """Partition a pytree into one leaf and the rest."""
    return eqx.partition(thing, eqx.tree_at(where, jax.tree.map(lambda _: False, thing), True))


@pytest.fixture(scope="module")
def four_bar():
    chain = models.four_bar()
    return chain, chain.state(), chain.state({"crank": 0.3}, {"crank": 1.0})


def test_optax_optimises_a_leaf_of_a_chain(four_bar):
    """An optimiser fits centres of mass to a given energy; all other leaves stay bit-identical."""
    chain, _, state = four_bar
    free, rest = differentiable_part(chain, lambda c: c.com)
    loss = lambda free: (svkc.potential_energy(eqx.combine(free, rest), state) - 1.0) ** 2
    adam = optax.adam(0.01)

    @jax.jit
    def advance(free, memory):
        change, memory = adam.update(jax.grad(loss)(free), memory)
        return optax.apply_updates(free, change), memory

    first, memory = float(loss(free)), adam.init(free)
    # (adam itself raises a float to a whole number)
    with jax.numpy_dtype_promotion("standard"):
        for _ in range(300):
            free, memory = advance(free, memory)
    assert first > 10
    assert float(loss(free)) < 1e-3 * first
    moved = eqx.combine(free, rest)
    assert not np.array_equal(moved.com, chain.com)
    assert_equal_leaves(eqx.tree_at(lambda c: c.com, moved, chain.com), chain)


def test_optax_optimises_a_state(four_bar):
    """All floating-point leaves of a state are parameters."""
    chain, _, state = four_bar
    free, rest = eqx.partition(state, eqx.is_inexact_array)
    loss = lambda free: svkc.kinetic_energy(chain, eqx.combine(free, rest)) - 0.1 * jnp.sum(free.v)
    sgd = optax.sgd(0.01)
    change, _ = jax.jit(sgd.update)(jax.grad(loss)(free), sgd.init(free))
    after = eqx.combine(optax.apply_updates(free, change), rest)
    assert isinstance(after, svkc.State)
    assert loss(eqx.filter(after, eqx.is_inexact_array)) < loss(free)


@pytest.mark.slow
def test_optimistix_finds_a_launch_velocity():
    """Root finding through a run, over a State: the velocity with which a hanging rod is level at
    0.4 s."""
    chain = svkc.load(models.MJCF.format(ROD))
    free, rest = differentiable_part(
        eqx.tree_at(lambda s: s.v, chain.state(), jnp.array([6.0])), lambda s: s.v
    )
    level = lambda free, args: (
        svkc.simulate(chain, eqx.combine(free, rest), 0.4, dt=0.02, throw=False).final.q
        - jnp.pi / 2
    )
    solution = optimistix.root_find(level, optimistix.Newton(rtol=1e-10, atol=1e-10), free)
    assert isinstance(solution.value, svkc.State)
    np.testing.assert_allclose(level(solution.value, None), 0, atol=REFERENCE)
    assert 1 < float(solution.value.v[0]) < 20


@pytest.mark.slow
def test_optimistix_finds_the_equilibrium():
    """The minimum of the potential energy over a State is an equilibrium."""
    chain = svkc.load(
        models.MJCF.format(
            models.bar(
                "upper",
                models.Y,
                "0 0 -1",
                inside=models.bar("lower", models.Y, "0 0 -1", "0 0 -1"),
            )
        )
    )
    free, rest = differentiable_part(chain.state({"upper": 0.5, "lower": -0.8}), lambda s: s.q)
    energy = lambda free, args: svkc.potential_energy(chain, eqx.combine(free, rest))
    solution = optimistix.minimise(energy, optimistix.BFGS(rtol=1e-10, atol=1e-10), free)
    resting = eqx.combine(solution.value, rest)
    np.testing.assert_allclose(svkc.forward_dynamics(chain, resting, jnp.zeros(2)), 0, atol=1e-5)
    assert energy(solution.value, None) < energy(free, None)


@pytest.mark.slow
def test_optimistix_finds_masses(four_bar):
    """Least squares over a Chain: masses that explain measured torques."""
    chain, _, state = four_bar
    torques = lambda chain: svkc.inverse_dynamics(chain, state, jnp.arange(1.0, 1.0 + chain.nv))
    measured = torques(eqx.tree_at(lambda c: c.mass, chain, 1.3 * chain.mass))
    free, rest = differentiable_part(chain, lambda c: c.mass)
    misses = lambda free, args: torques(eqx.combine(free, rest)) - measured
    solution = optimistix.least_squares(
        misses, optimistix.LevenbergMarquardt(rtol=1e-10, atol=1e-10), free
    )
    assert isinstance(solution.value, svkc.Chain)
    np.testing.assert_allclose(torques(eqx.combine(solution.value, rest)), measured, rtol=1e-6)


def test_equinox_writes_and_reads_bit_for_bit(four_bar, tmp_path):
    chain, _, state = four_bar
    path = tmp_path / "both.eqx"
    eqx.tree_serialise_leaves(path, (chain, state))
    blank = jax.tree.map(jnp.zeros_like, (chain, state))
    again = eqx.tree_deserialise_leaves(path, blank)
    assert_equal_leaves(again, (chain, state))
    assert_equal_leaves(svkc.mobility(*again), svkc.mobility(chain, state))


def test_leaves_rebuild_an_equal_object(four_bar):
    """Flatten, pass through jit and scan, and unflatten."""
    chain, rest, state = four_bar
    for thing in (chain, state):
        leaves, tree = jax.tree.flatten(thing)
        assert all(isinstance(x, jax.Array) for x in leaves)
        assert_equal_leaves(jax.tree.unflatten(tree, leaves), thing)
        assert_equal_leaves(jax.jit(lambda x: x)(thing), thing)
    both = jax.tree.map(lambda *x: jnp.stack(x), rest, state)
    assert_equal_leaves(
        jax.tree.map(lambda x: x[1], jax.lax.scan(lambda _, s: (None, s), None, both)[1]), state
    )
