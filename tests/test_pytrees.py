"""Chains and states are plain pytrees: optimisers, root finders, files and training states of others take them as they are."""

import equinox as eqx
import jax
import jax.numpy as jnp
import models
import numpy as np
import optax
import optimistix
import pytest

import svkc

ROD = models.bar("rod", models.Y, "0 0 -1")


def same(one, two):
    """Bit for bit, and of one kind."""
    assert jax.tree.structure(one) == jax.tree.structure(two)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
        assert (a.dtype, a.shape) == (b.dtype, b.shape)
        assert np.asarray(a).tobytes() == np.asarray(b).tobytes()


@pytest.fixture(scope="module")
def four_bar():
    chain = models.four_bar()
    return chain, chain.state(), chain.state({"crank": 0.3}, {"crank": 1.0})


def test_optax_moves_a_leaf_of_a_chain(four_bar):
    """The floats of a chain are an optimiser's parameters: centres of mass that give the energy asked for; the rest stays bit for bit."""
    chain, _, state = four_bar
    free, rest = eqx.partition(chain, jax.tree.map(lambda x: x is chain.com, chain))
    loss = lambda free: (svkc.potential_energy(eqx.combine(free, rest), state) - 1.0) ** 2
    adam = optax.adam(0.01)

    @jax.jit
    def advance(free, memory):
        change, memory = adam.update(jax.grad(loss)(free), memory)
        return optax.apply_updates(free, change), memory

    first, memory = float(loss(free)), adam.init(free)
    # optax counts in whole numbers among floats
    with jax.numpy_dtype_promotion("standard"):
        for _ in range(300):
            free, memory = advance(free, memory)
    assert first > 10
    assert float(loss(free)) < 1e-3 * first
    moved = eqx.combine(free, rest)
    assert not np.array_equal(moved.com, chain.com)
    same(eqx.tree_at(lambda c: c.com, moved, chain.com), chain)


def test_optax_moves_a_state(four_bar):
    """A whole state as parameters, whole numbers and masks aside."""
    chain, _, state = four_bar
    free, rest = eqx.partition(state, eqx.is_inexact_array)
    loss = lambda free: svkc.kinetic_energy(chain, eqx.combine(free, rest)) - 0.1 * jnp.sum(free.v)
    sgd = optax.sgd(0.01)
    change, _ = jax.jit(sgd.update)(jax.grad(loss)(free), sgd.init(free))
    after = eqx.combine(optax.apply_updates(free, change), rest)
    assert isinstance(after, svkc.State)
    assert loss(eqx.filter(after, eqx.is_inexact_array)) < loss(free)


def test_optimistix_finds_the_speed_of_a_swing():
    """A root, through a whole run: the speed with which a hanging rod is level after 0.4 s."""
    chain = svkc.load(models.MJCF.replace("0.3 -0.2", "0 0").format(ROD))
    hanging = chain.state()

    def rate(speed, args):
        """What lacks to a quarter turn at 0.4 s."""
        start = eqx.tree_at(lambda s: s.v, hanging, speed)
        return svkc.simulate(chain, start, 0.4, dt=0.02, throw=False).final.q - jnp.pi / 2

    found = optimistix.root_find(rate, optimistix.Newton(rtol=1e-9, atol=1e-9), jnp.array([6.0]))
    traj = svkc.simulate(chain, eqx.tree_at(lambda s: s.v, hanging, found.value), 0.4, dt=0.02)
    assert abs(float(traj.final.q[0]) - np.pi / 2) < 1e-8


def test_optimistix_finds_where_a_loop_rests(four_bar):
    """Least squares over a State: a place at which no acceleration is left, the loop closed; whole numbers and masks aside."""
    chain, state, _ = four_bar
    free, rest = eqx.partition(state, jax.tree.map(lambda x: x is state.q, state))

    def misses(free, args):
        s = eqx.combine(free, rest)
        return svkc.forward_dynamics(chain, s, jnp.zeros(chain.nv)), svkc.loop_gaps(chain, s)

    found = optimistix.least_squares(misses, optimistix.LevenbergMarquardt(rtol=1e-10, atol=1e-10), free, max_steps=500)
    left = jnp.concatenate([jnp.ravel(x) for x in jax.tree.leaves(misses(found.value, None))])
    assert float(jnp.abs(left).max()) < 1e-6
    assert not np.allclose(found.value.q, state.q)


def test_equinox_writes_and_reads_bit_for_bit(four_bar, tmp_path):
    chain, _, state = four_bar
    path = tmp_path / "both.eqx"
    eqx.tree_serialise_leaves(path, (chain, state))
    blank = jax.tree.map(jnp.zeros_like, (chain, state))
    again = eqx.tree_deserialise_leaves(path, blank)
    same(again, (chain, state))
    same(svkc.mobility(*again), svkc.mobility(chain, state))


def test_leaves_alone_make_the_same_thing_again(four_bar):
    """As libraries do that know nothing of svkc: flattened, moved through jit and scan, and put together."""
    chain, rest, state = four_bar
    for thing in (chain, state):
        leaves, tree = jax.tree.flatten(thing)
        assert all(isinstance(x, jax.Array) for x in leaves)
        same(jax.tree.unflatten(tree, leaves), thing)
        same(jax.jit(lambda x: x)(thing), thing)
    both = jax.tree.map(lambda *x: jnp.stack(x), rest, state)
    same(jax.tree.map(lambda x: x[1], jax.lax.scan(lambda _, s: (None, s), None, both)[1]), state)
