"""Random runs with many events, several of them at one instant, checked in numpy.

The structure at every save time is that of a Python set to which the events are applied; loops are
closed there, and the energy, from `references/rigid_bodies.py`, and the losses in the records add
up. A run that is split into two, or whose events are in another order, is the same run. A lane with
a defect leaves the others of its batch as they are, bit for bit.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import mechanisms
import models
import numpy as np
import pytest
from references import rigid_bodies

import svkc

pytestmark = pytest.mark.slow

LANES, TIMED, BY_TIME, BY_HEIGHT = 8, 8, 8, 9
GRID = np.round(np.arange(0, 0.45, 0.05), 10)


@functools.cache
def scene():
    """Return two free boxes with a cuttable limb, a weld and a spare slot, and its structure."""
    chain = models.box_with_a_limb()
    return chain, chain.state().structure


def program(order):
    """Return a batched run of ten events, given in this order."""

    @jax.jit
    @jax.vmap
    def run(chain, q, v, structure, times, args, t0, t1):
        at, grip = svkc.at, svkc.Grip("world", "b", joint="ball", real_pos=(0.1, 0.2, 0.3))
        events = [
            at(times[0], connect="weld", here=True),
            at(times[1], cut="weld"),
            at(times[2], cut="limb"),
            at(times[3], connect="limb", here=True),
            at(times[4], bind=grip),
            at(times[5], unbind="spare_0"),
            at(times[6], lock="b"),
            at(times[7], unlock="b"),
            svkc.when(lambda t, state, args: t - args[0], cut="weld"),
            svkc.when(
                lambda t, state, args: state.q[2] - args[1],
                connect="weld", here=True, direction=True,
            ),
        ]  # fmt: skip
        ts = t0 + (t1 - t0) * jnp.linspace(0, 1, 5)
        return svkc.simulate(
            chain, svkc.State(q, v, structure), t1, t0=t0, ts=ts,
            events=[events[i] for i in order], args=args, dt=0.02, max_events=14, throw=False,
        )  # fmt: skip

    return run


@functools.cache
def in_order():
    return program(range(10))


def random_lane(seed):
    """Return the arguments of one random run; an event with an infinite time does not happen."""
    rng, (chain, structure) = np.random.default_rng(seed), scene()
    chain = mechanisms.randomized(chain, rng, planar=False)
    chain, q = mechanisms.closed(chain, mechanisms.random_q(chain, rng, 0.3))
    placed, locked = chain.structure, jnp.zeros(chain.dofs, bool)
    structure = eqx.tree_at(
        lambda s: (s.pos, s.quat, s.locked), structure, (placed.pos, placed.quat, locked),
        is_leaf=lambda x: x is None,
    )  # fmt: skip
    bodies = rigid_bodies.Bodies(rigid_bodies.batched(chain))
    v = bodies.motions(rigid_bodies.batched(structure), q[None])[0][0] @ rng.normal(size=chain.dofs)
    times = np.where(rng.random(TIMED) < 0.35, np.inf, rng.choice(GRID, TIMED))
    if rng.random() < 0.5:
        times = np.where(np.isfinite(times), np.minimum(times, rng.choice(GRID)), times)
    height = q[2] + rng.choice([0.0, -0.02, 0.03, 0.2])
    args = np.array([rng.choice([0.0, 0.033, 0.133, 0.277, 0.41]), height])
    return chain, q, 2 * v, structure, times, args, 0.0, float(rng.choice([0.2, 0.25, 0.37, 0.4]))


def structures(times, recorded):
    """Return (time, connected links, whether the box is locked) after each instant with events."""
    connected, locked, out = {"limb"}, False, []
    for time in sorted({t for t, _ in recorded}):
        fired = {i for t, i in recorded if t == time}
        cut = {"weld"} if fired & {1, BY_TIME} else set()
        cut |= {"limb"} if 2 in fired else set()
        connected = connected - ({"spare_0"} if 5 in fired else set())
        connected |= {"weld"} if fired & {0, BY_HEIGHT} else set()
        connected |= {name for i, name in ((3, "limb"), (4, "spare_0")) if i in fired}
        connected, locked = connected - cut, (locked or 6 in fired) and 7 not in fired
        out.append((time, connected, locked))
    return out


def at_time(history, time, before=False):
    """Return the last entry of `structures` at a time, or before it."""
    past = [x for x in history if x[0] < time or (x[0] == time and not before)]
    return past[-1][1:] if past else ({"limb"}, False)


def check_run(lane, traj):
    """Check the records and saved states of one run."""
    chain, q, v, structure, times, args, _t0, t1 = lane
    assert traj.result._value == svkc.RESULTS.successful._value
    count, bodies = int(traj.events.count), rigid_bodies.Bodies(rigid_bodies.batched(chain))
    recorded = list(zip(traj.events.time[:count], traj.events.which[:count], strict=True))
    history = structures(times, recorded)
    timed = sorted((t, i) for t, i in recorded if i < TIMED)
    assert timed == sorted((t, i) for i, t in enumerate(times) if t <= t1)
    assert recorded == sorted(recorded, key=lambda x: x[0])
    # a guard that is zero at the start has not crossed zero
    crosses = 0 < args[0] <= t1 and "weld" in at_time(history, args[0], before=True)[0]
    assert np.allclose([t for t, i in recorded if i == BY_TIME], [args[0]] if crosses else [])
    for t in (t for t, i in recorded if i == BY_HEIGHT):
        assert "weld" not in at_time(history, t, before=True)[0]
    s = rigid_bodies.batched(structure)
    kinetic = bodies.kinetic_energy(q[None], v[None])
    energy = kinetic + bodies.potential_energy(s, q[None])
    assert (traj.events.energy_lost > -1e-12).all()
    for i, t in enumerate(traj.ts):
        s = jax.tree.map(lambda x, i=i: x[i][None], traj.states.structure)
        connected, locked = at_time(history, t)
        assert {chain.link_names[k] for k in np.flatnonzero(s.connected)} == connected
        assert s.locked.any() == locked
        q_i, v_i = traj.states.q[i][None], traj.states.v[i][None]
        gap, J = bodies.loops(s, q_i)
        assert np.abs(gap).max() < 1e-8
        assert np.abs(J @ v_i[:, None, :, None]).max() < 1e-7
        assert not (v_i * s.locked).any()
        now = bodies.kinetic_energy(q_i, v_i) + bodies.potential_energy(s, q_i)
        lost = sum(traj.events.energy_lost[k] for k, x in enumerate(recorded) if x[0] <= t)
        assert abs(now + lost - energy) < 1e-5 * (1 + abs(energy) + kinetic)


def batches(count):
    """Return the lanes and the stacked arguments of some batches."""
    for first in mechanisms.seeds(count):
        lanes = [random_lane(LANES * first + k) for k in range(LANES)]
        yield lanes, jax.tree.map(lambda *x: jnp.stack([jnp.asarray(y) for y in x]), *lanes)


def test_structure_and_energy_of_runs():
    for lanes, arguments in batches(3):
        trajs = jax.tree.map(np.asarray, in_order()(*arguments))
        for k, lane in enumerate(lanes):
            check_run(lane, jax.tree.map(lambda x, k=k: x[k], trajs))


def test_a_run_in_two_parts():
    """Events at the time of the split belong to the first part."""
    for _, arguments in batches(2):
        times, args, _, t1 = arguments[4:]
        unsplit = in_order()(*arguments)
        middle = jnp.asarray(np.resize([0.1, 0.15, 0.17], LANES))
        first = in_order()(*arguments[:-1], middle)
        end, rest = first.final, jnp.where(times <= middle[:, None], jnp.inf, times)
        second = in_order()(*(arguments[0], end.q, end.v, end.structure, rest, args, middle, t1))
        np.testing.assert_array_equal(
            first.events.count + second.events.count, unsplit.events.count
        )
        same = second.final.structure.connected == unsplit.final.structure.connected
        assert np.asarray(same).all()
        # steps of other sizes, each with an error of the order of 1e-9
        np.testing.assert_allclose(second.final.q, unsplit.final.q, atol=1e-6)


def test_the_order_of_the_list_does_not_matter():
    run = program(range(9, -1, -1))
    for _, arguments in batches(2):
        for x, y in zip(
            jax.tree.leaves(in_order()(*arguments).states),
            jax.tree.leaves(run(*arguments).states),
            strict=True,
        ):
            np.testing.assert_array_equal(x, y)


DEFECTS = {
    "q": (1, lambda x: x.at[2, 3].set(jnp.nan)),
    "v": (2, lambda x: x.at[2, 3].set(jnp.nan)),
    "time": (4, lambda x: x.at[2, 3].set(jnp.nan)),
    "guard": (5, lambda x: x.at[2].set(jnp.nan)),
    "end": (7, lambda x: x.at[2].set(jnp.nan)),
    "infinite end": (7, lambda x: x.at[2].set(jnp.inf)),
    "reversed": (7, lambda x: x.at[2].set(-1.0)),
    "mass": (0, lambda c: eqx.tree_at(lambda c: c.mass, c, c.mass.at[2].multiply(-1))),
    "geometry": (0, lambda c: eqx.tree_at(lambda c: c.pos, c, c.pos.at[2].set(jnp.nan))),
}


def test_a_poisoned_lane_leaves_the_others_bit_for_bit():
    for _, arguments in batches(1):
        clean = in_order()(*arguments)
        for name, (index, spoil) in DEFECTS.items():
            spoiled = [*arguments[:index], spoil(arguments[index]), *arguments[index + 1 :]]
            traj = in_order()(*spoiled)
            assert int(traj.result._value[2]) != svkc.RESULTS.successful._value, name
            for x, y in zip(jax.tree.leaves(clean), jax.tree.leaves(traj), strict=True):
                others = np.arange(LANES) != 2
                np.testing.assert_array_equal(np.asarray(x)[others], np.asarray(y)[others])
