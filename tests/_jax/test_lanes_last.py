"""`vmap` with the lanes last against `jax.vmap`: primitives with a rule, primitives without one,
and `svkc.step` in all transformations."""

import jax
import jax.numpy as jnp
import models
import numpy as np
import pytest
from tolerances import ROUND_OFF

import svkc
from svkc._jax import lanes_last_rules
from svkc._jax.lanes_last import tile_size, with_lanes_last
from svkc.loops.constraint_rows import RowChoice
from svkc.loops.loop_force_projection import project_by_loop_forces

KEY = jax.random.key(3)


def example(x, y, which):
    """Return the result of calls, gathers, products of all kinds, loops, solves and selects.

    Gathers have shared and batched indices.
    """
    rows = x[np.array([2, 0, 1])] + x[which][None] + jnp.eye(3)[which][None]
    left = (
        jnp.einsum("ij,kj->ik", x, y)
        + jnp.einsum("bij,bjk->bik", x[:, None, :], y.T[:, :, None])[:, 0]
    )
    symmetric = x @ x.T + 3 * jnp.eye(3)
    solved = jax.lax.custom_linear_solve(
        lambda v: symmetric @ v, y[0], lambda _, v: jnp.linalg.solve(symmetric, v), symmetric=True
    )

    def step(carry, row):
        i, total, kept = carry
        return (i + 1, total + row, jnp.where(i == 1, row, kept)), jnp.sum(row) * i.astype(float)

    (count, total, kept), along = jax.lax.scan(
        step, (jnp.int32(0), jnp.zeros(3), jnp.ones(3)), x, reverse=True
    )
    more = (
        jax.nn.relu(x)
        + jnp.cumsum(y, 1)
        + jnp.clip(x, -0.5, which.astype(float))
        + jnp.linalg.cholesky(symmetric)
        + jax.lax.cond(which > 1, jnp.sin, jnp.cos, y)
    )
    parts = jnp.concatenate(
        [
            rows[0],
            jnp.max(left, 1),
            solved,
            jnp.stack([total, kept])[1],
            along,
            jnp.split(x, 3)[1][0],
            jnp.pad(x, 1)[1],
        ]
    )
    return (
        parts.at[which].add(1.0),
        (more[::-1], jnp.argmax(x, 0), jnp.any(x > y), count),
        jnp.float32(1.5),
    )


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 5, 32, 35])
def test_every_rule(count):
    x, y = jax.random.normal(KEY, (2, count, 3, 3))
    which = jnp.arange(count) % 3
    one = with_lanes_last(example)
    for axes in ((0, 0, 0), (0, None, None), (None, 0, 0), (0, 0, None)):
        args = [
            value if axis == 0 else value[0]
            for value, axis in zip((x, y, which), axes, strict=True)
        ]
        for expected, got in zip(
            jax.tree.leaves(jax.jit(jax.vmap(example, axes))(*args)),
            jax.tree.leaves(jax.jit(jax.vmap(one, axes))(*args)),
            strict=True,
        ):
            np.testing.assert_allclose(got, expected, rtol=1e-13, atol=1e-13)
            assert got.dtype == expected.dtype


@pytest.mark.parametrize(
    ("lanes", "dtype", "expected"),
    [
        (0, jnp.float64, 1), (5, jnp.float64, 5), (32, jnp.float64, 32), (33, jnp.float64, 24),
        (1024, jnp.float64, 32), (33, jnp.float32, 33), (65, jnp.float32, 48),
        (96, jnp.float32, 48), (1024, jnp.float32, 64), (64, jnp.int32, 32),
    ],
)  # fmt: skip
def test_tile_size(lanes, dtype, expected):
    """Tiles of a batch are equal, of 32 lanes at most in float64 and of 64 in float32."""
    assert tile_size(lanes, [jnp.zeros(lanes, dtype), jnp.zeros(3, jnp.int32)]) == expected
    if dtype == jnp.float32:
        with_float64 = [jnp.zeros(lanes, dtype), jnp.zeros(3)]
        assert tile_size(lanes, with_float64) == tile_size(lanes, [jnp.zeros(3)])


@pytest.mark.parametrize("count", [40, 64])
def test_several_tiles(count):
    """Lanes of several tiles, of which the last may be padded, are those of `jax.vmap`."""
    function = lambda x, y: (x @ y.T, jnp.sum(x, 0), y)
    x, y = jax.random.normal(KEY, (2, count, 3, 2))
    assert tile_size(count, [x, y]) < count
    expected = jax.vmap(function)(x, y)
    for got, value in zip(jax.vmap(with_lanes_last(function))(x, y), expected, strict=True):
        np.testing.assert_allclose(got, value, rtol=1e-13, atol=1e-13)


def test_zero_lanes_and_integers():
    """Integer sums and products keep their dtype; a batch of zero lanes gives empty arrays."""
    counted = lambda x: (jnp.sum(x, dtype=jnp.int32), x @ x, jnp.stack([x, x]))
    one = with_lanes_last(counted)
    for count in (0, 4):
        x = jnp.ones((count, 11), jnp.int32)
        for expected, got in zip(jax.vmap(counted)(x), jax.vmap(one)(x), strict=True):
            np.testing.assert_array_equal(got, expected)
            assert got.dtype == expected.dtype


@pytest.fixture
def by_vmap(monkeypatch):
    """Return a list of the primitives without a rule, which go through `jax.vmap`."""
    names = []
    apply_vmap = lanes_last_rules._apply_vmap
    monkeypatch.setattr(
        lanes_last_rules,
        "_apply_vmap",
        lambda primitive, *rest: (names.append(primitive.name), apply_vmap(primitive, *rest))[1],
    )
    return names


def test_every_primitive_of_a_step_has_a_rule(by_vmap):
    for chain in (models.four_bar(), svkc.load(models.random_tree(8, 1))):
        states = jax.tree.map(lambda x: jnp.stack([x, x]), chain.state())
        step = lambda s, chain=chain: svkc.step(chain, s, jnp.zeros(chain.nv), 1e-3)
        jax.jit(jax.vmap(step)).lower(states)
    assert not by_vmap


def test_every_primitive_of_a_projection_has_a_rule(by_vmap):
    """Conditionals have a rule only if lanes share the predicate. So lanes share the number of
    iterations, and the margin of the rank is computed in the last iteration only."""
    chain = models.four_bar()
    states = jax.tree.map(lambda x: jnp.stack([x, x]), chain.state())

    def project(s):
        choice = RowChoice.of_first_step(chain, s.structure, jnp.zeros((), bool))
        return project_by_loop_forces(
            chain, s.structure, s.q, s.v, choice, iterations=2, differentiated=False
        )

    jax.jit(jax.vmap(project)).lower(states)
    assert not by_vmap


@pytest.mark.slow
def test_a_step_in_every_transformation():
    """Nested batches, derivatives of batches and batches of derivatives equal single calls."""
    chain = models.four_bar()
    state = chain.state()
    tau = jax.random.normal(KEY, (2, 3, chain.nv))
    v = lambda tau: svkc.step(chain, state, tau, 1e-2).v
    alone = jnp.stack([jnp.stack([v(one) for one in some]) for some in tau])
    np.testing.assert_allclose(jax.vmap(jax.vmap(v))(tau), alone, rtol=ROUND_OFF, atol=ROUND_OFF)
    slopes = jnp.stack([jax.jacrev(v)(one) for one in tau[0]])
    np.testing.assert_allclose(
        jax.vmap(jax.jacrev(v))(tau[0]), slopes, rtol=ROUND_OFF, atol=ROUND_OFF
    )
    np.testing.assert_allclose(
        jax.jacfwd(jax.vmap(v))(tau[0])[np.arange(3), :, np.arange(3)],
        slopes,
        rtol=ROUND_OFF,
        atol=ROUND_OFF,
    )
    each = jax.grad(lambda tau: jnp.sum(jax.vmap(v)(tau) ** 2))(tau[0])
    np.testing.assert_allclose(
        each, 2 * jnp.einsum("nji,nj->ni", slopes, alone[0]), rtol=ROUND_OFF, atol=ROUND_OFF
    )
    assert svkc.check_grad(lambda tau: jnp.sum(v(tau) ** 2), tau[0, 0]).error < 1e-8


@pytest.mark.slow
def test_runs_by_articulated_bodies():
    """A batch of different runs, with accelerations and projection evaluated lanes last, equals the
    single runs."""
    chain = models.four_bar()
    start = chain.state(v={"crank": 4.0})

    # 1e-12: after its first, very short steps a run's error estimate is round-off alone, and the
    # lengths that follow hang on it: a batch and
    # a single run take steps a few percent different, and agree as far as either is accurate
    def run(time, speed):
        state = svkc.State(start.q, speed * start.v, start.structure)
        events = [svkc.at(time, cut=chain.link_names[0])]
        traj = svkc.simulate(
            chain,
            state,
            0.3,
            events=events,
            dynamics=svkc.dynamics.ArticulatedBodies(),
            rtol=1e-12,
        )
        return traj.final.q, traj.final.v, traj.phases.energy_drift, jnp.max(jnp.abs(traj.gaps))

    times, speeds = jnp.array([0.05, 0.1, 0.25, 0.5]), jnp.array([1.0, -0.7, 0.3, 1.2])
    *batch, gap = jax.jit(jax.vmap(run))(times, speeds)
    single = [run(*lane) for lane in zip(times, speeds, strict=True)]
    for got, expected in zip(
        batch, map(jnp.stack, zip(*(lane[:-1] for lane in single), strict=True)), strict=True
    ):
        np.testing.assert_allclose(got, expected, rtol=0, atol=ROUND_OFF)
    assert float(jnp.max(gap)) < ROUND_OFF
