"""Events after other events: a release some time after a catch."""

import jax
import jax.numpy as jnp
import models
import numpy as np
import pytest
from tolerances import DIFFERENCE, REFERENCE

import svkc

G = 9.81
BALL = """<mujoco><worldbody><body name="ball"><freejoint name="ball"/>
  <geom size="0.1" mass="2"/></body></worldbody></mujoco>"""


@pytest.fixture(scope="module")
def falling():
    """Return a free ball with a hook at the world's origin, and its state at the height of one."""
    hook = svkc.VirtualLink("hook", "world", "ball", real_pos=(0, 0, 0))
    chain = svkc.load(BALL, virtual_links=[hook])
    return chain, chain.state({"ball": [0, 0, 1, 1, 0, 0, 0]})


def height(chain):
    """Return a guard: the height of the ball (m)."""
    return lambda t, state, args: chain.joint(state, "ball").q[2]


@pytest.fixture(scope="module")
def caught_and_released(falling):
    """Return a compiled run, by the initial height (m) and the delay of the release (s)."""
    chain, state = falling

    @jax.jit
    def run(h, delay):
        catch = svkc.when(height(chain), connect="hook", direction=False)
        release = svkc.at(delay, cut="hook", after=catch)
        above = jnp.arange(chain.topology.nq_all) == chain.q_index("ball").start + 2
        start = svkc.State(jnp.where(above, h, state.q), state.v, state.structure)
        return svkc.simulate(chain, start, 1.2, events=[release, catch], rtol=1e-10)

    return run


def place_at_the_end(h, delay):
    """Return the closed form: the ball falls, is held for the delay, and falls again."""
    return -G / 2 * (1.2 - jnp.sqrt(2 * h / G) - delay) ** 2


@pytest.mark.slow
def test_a_release_after_a_catch(falling, caught_and_released):
    h, delay = jnp.asarray(1.0), jnp.asarray(0.4)
    traj = caught_and_released(h, delay)
    t = np.sqrt(2 / G)
    np.testing.assert_allclose(traj.events.time[:2], [t, t + 0.4], atol=REFERENCE)
    np.testing.assert_array_equal(traj.events.which[:2], [1, 0])
    # four for the guard, and four for what follows it
    assert traj.events.time.shape == (8,)
    end = height(falling[0])(0, traj.final, None)
    np.testing.assert_allclose(end, place_at_the_end(h, delay), atol=REFERENCE)


@pytest.mark.slow
def test_derivatives_by_height_and_delay(falling, caught_and_released):
    h, delay = jnp.asarray(1.0), jnp.asarray(0.4)
    place = lambda h, delay: height(falling[0])(0, caught_and_released(h, delay).final, None)
    expected = np.array(jax.grad(place_at_the_end, (0, 1))(h, delay))
    for jacobian in (jax.jacrev, jax.jacfwd):
        np.testing.assert_allclose(jacobian(place, (0, 1))(h, delay), expected, atol=DIFFERENCE)


@pytest.mark.slow
def test_a_chain_of_events_and_a_guard_that_waits(falling):
    """A guard with `after` is armed by that event; an event that repeats counts anew."""
    chain, state = falling
    first = svkc.at(0.1, connect="hook", here=True)
    second = svkc.at(0.2, cut="hook", after=first)
    third = svkc.at(0.0, connect="hook", here=True, after=second)
    low = lambda t, state, args: chain.joint(state, "ball").q[2] - 0.5
    stop = svkc.when(low, stop=True, after=third)
    ends = svkc.at(0.3, cut="hook", after=third)
    traj = svkc.simulate(chain, state, 2.0, events=[stop, third, second, first, ends])
    count = int(traj.events.count)
    np.testing.assert_array_equal(traj.events.which[:count], [3, 2, 1, 4, 0])
    assert traj.result == svkc.RESULTS.stopped
    z = 1 - G / 2 * 0.1**2
    drop = np.sqrt(2 * (z - 0.5) / G)
    np.testing.assert_allclose(
        traj.events.time[:count], [0.1, 0.3, 0.3, 0.6, 0.6 + drop], atol=REFERENCE
    )


@pytest.mark.slow
def test_tables_show_events_of_one_instant_at_the_end(falling):
    chain, state = falling
    grip = svkc.at(0.1, connect="hook", here=True)
    stop = svkc.at(0.0, cut="hook", stop=True, after=grip)
    traj = svkc.simulate(chain, state, 1.0, events=[grip, stop])
    assert int(traj.events.count) == 2
    assert not bool(chain.connected(traj.final, "hook"))
    assert "0, 1   -          -" in str(traj)


@pytest.mark.slow
def test_each_catch_is_followed_by_its_release(falling):
    """In lanes that start at different heights, each with several catches."""
    chain, state = falling
    low = lambda t, state, args: chain.joint(state, "ball").q[2] - args
    # caught whenever it falls below a level that the hook does not change: once for each release
    catch = svkc.when(low, connect="hook", direction=False, here=True)
    release = svkc.at(0.05, cut="hook", after=catch)
    again = svkc.at(0.1, connect="hook", here=True, after=release)
    last = svkc.at(0.07, cut="hook", after=again)

    def run(level):
        return svkc.simulate(
            chain, state, 1.0, events=[catch, release, again, last], args=level, max_events=4
        )

    levels = jnp.array([0.9, 0.6])
    traj = jax.jit(jax.vmap(run))(levels)
    start = np.sqrt(2 * (1 - np.asarray(levels)) / G)
    expected = start[:, None] + np.array([[0, 0.05, 0.15, 0.22]])
    np.testing.assert_allclose(traj.events.time, expected, atol=1e-8)


@pytest.mark.slow
def test_a_repeated_event_counts_anew():
    """A pendulum passes its lowest point again and again; a lock follows each passage."""
    chain = svkc.load(models.ARM)
    state = chain.state({"arm": 0.3})
    angle = lambda t, state, args: chain.joint(state, "arm").q
    passage = svkc.when(angle)
    mark = svkc.at(0.1, after=passage)
    traj = svkc.simulate(chain, state, 3.0, events=[passage, mark], max_events=6, throw=False)
    time, which = np.asarray(traj.events.time), np.asarray(traj.events.which)
    np.testing.assert_array_equal(which, [0, 1] * 3)
    np.testing.assert_allclose(time[1::2] - time[::2], 0.1, atol=1e-12)
