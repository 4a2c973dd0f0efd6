"""A guard that starts a run, or a phase after an event, at zero to round-off: lanes in which the
guard is above, at and below zero by 1e-16 have the same events."""

import equinox as eqx
import jax.numpy as jnp
import models
import numpy as np
import pytest

import svkc

ROUND_OFFS = (0.0, 1e-16, -1e-16)
# indices of the events of all runs
HOLD, NO_CHANGE, EITHER, RISING, FALLING, CATCH, RELEASE = range(7)
SINE, MINUS_SINE, MOVED_UP, MOVED_DOWN, TURNED_AROUND = range(5)


def _value(t, state, args):
    """Return the value of the guard that `args` selects, by its index and an offset."""
    index, offset = args
    connected = state.structure.connected[0]
    sine = jnp.sin(2 * jnp.pi * t)
    turned_around = jnp.where(connected, jnp.sin(5 * jnp.pi * (t - 0.3)), 0.3 - t)
    moved = lambda x: jnp.where(connected, x, 5.0 - offset)
    values = [sine, -sine, moved(t - 0.3), moved(0.3 - t), turned_around]
    return offset + jnp.stack(values)[index]


def _catch(t, state, args):
    """Return the guard of the weld: above zero unless the guard turns around."""
    return jnp.where(args[0] == TURNED_AROUND, _value(t, state, args), 1.0)


@pytest.fixture(scope="module")
def events_of():
    """Return a function that returns indices and times of the events for one guard.

    The lanes of its runs differ by the offset of the guard, and have the same events.
    """
    text = f'<body name="a"><joint type="slide" axis="1 0 0"/>{models.BOX.format("1 1 1")}</body>'
    chain = svkc.load(
        models.MJCF.format(text).replace("0.3 -0.2 -9.81", "0 0 -10"),
        virtual_links=[svkc.VirtualLink("hook", "world", "a", "weld")],
    )

    @eqx.filter_jit
    @eqx.filter_vmap(in_axes=(None, 0, None, None))
    def run(index, offset, hold, no_change):
        events = [
            svkc.at(hold, connect="hook", here=True),
            svkc.at(no_change),
            *(svkc.when(_value, direction=d) for d in (None, True, False)),
            svkc.when(_catch, connect="hook", here=True, direction=False),
            svkc.when(_catch, cut="hook", direction=True),
        ]
        return svkc.simulate(
            chain, chain.state(), 1.2, events=events, args=(index, offset), dt=0.07, max_events=12,
            throw=False,
        )  # fmt: skip

    def events_of(index, offsets=ROUND_OFFS, *, hold=2.0, no_change=2.0):
        # arrays, so that all runs share one program
        traj = run(*map(jnp.asarray, (index, offsets, hold, no_change)))
        assert np.all(np.asarray(traj.result == svkc.RESULTS.successful))
        which, time = np.asarray(traj.events.which), np.asarray(traj.events.time)
        assert np.all(which == which[0])
        np.testing.assert_allclose(time, np.broadcast_to(time[0], time.shape), atol=1e-12)
        count = int(traj.events.count[0])
        return which[0, :count].tolist(), time[0, :count]

    return events_of


@pytest.mark.slow
def test_a_guard_at_zero_at_the_start_fires_when_it_crosses_zero_later(events_of):
    """The sine rises from zero at 0, falls through zero at 0.5 and rises through it at 1."""
    for index, first, second in ((SINE, FALLING, RISING), (MINUS_SINE, RISING, FALLING)):
        which, time = events_of(index)
        assert which == [EITHER, first, EITHER, second]
        np.testing.assert_allclose(time, [0.5, 0.5, 1, 1], atol=1e-12)


@pytest.mark.slow
def test_a_guard_that_an_event_puts_at_zero_has_not_crossed(events_of):
    """The event at 0.3 moves the guard from 5 to zero, from where it rises or falls."""
    for index in (MOVED_UP, MOVED_DOWN):
        assert events_of(index, hold=0.3)[0] == [HOLD]


@pytest.mark.slow
def test_a_guard_that_has_just_fired_does_not_fire_at_once(events_of):
    """The weld holds the box when the guard falls to zero, and the guard turns around. The guard
    that cuts the weld when it rises fires at the next rise through zero."""
    which, time = events_of(TURNED_AROUND)
    assert which == [EITHER, FALLING, CATCH, EITHER, FALLING, EITHER, RISING, RELEASE]
    np.testing.assert_allclose(time, [0.3] * 3 + [0.5] * 2 + [0.7] * 3, atol=1e-12)


@pytest.mark.slow
def test_a_crossing_at_the_time_of_another_event_is_not_lost(events_of):
    """The guard is within round-off of zero at the timed event, on its way through zero.

    The sine is 1.2e-16 there: with the last offsets the guard crosses zero before the timed event.
    """
    for offsets in (ROUND_OFFS, (-2e-16, -3e-16, -4e-16)):
        which, time = events_of(SINE, offsets, no_change=0.5)
        assert which == [NO_CHANGE, EITHER, FALLING, EITHER, RISING]
        np.testing.assert_allclose(time, [0.5] * 3 + [1.0] * 2, atol=1e-12)
