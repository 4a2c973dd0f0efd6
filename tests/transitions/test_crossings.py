"""Guards that cross zero several times within one step, and limits of the step size."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import models
import numpy as np
import pytest
from tolerances import DIFFERENCE

import svkc

GRAVITY, HEIGHT = 9.81, 1.0
# on the time of an event of a closed form: what the integration of constant acceleration leaves
TIME = 1e-10
# Guards of time as polynomials c[0] + c[1] t + ..., from their roots (s) and a factor. One step of
# each run below goes from 0.22 s, or from 0.9 s, to the end or by 0.9 s.
POLYNOMIALS = {
    "two crossings": np.polynomial.polynomial.polyfromroots([0.93, 1.03]),
    "two crossings from below": -np.polynomial.polynomial.polyfromroots([1.11, 1.1101]),
    "three crossings": np.polynomial.polynomial.polyfromroots([1.2, 1.3, 1.7]),
    "three crossings of one point": np.polynomial.polynomial.polyfromroots([1.4, 1.401, 1.402]),
    "four crossings": np.polynomial.polynomial.polyfromroots([1.0, 1.1, 1.3, 1.35]),
    "one crossing": np.array([-1.23, 1.0]),
    "grazing from above": np.polynomial.polynomial.polyfromroots([1.3, 1.3])
    + np.array([1e-6, 0, 0]),
    "grazing from below": -np.polynomial.polynomial.polyfromroots([1.17, 1.17])
    - np.array([1e-9, 0, 0]),
    "no root": np.array([1.0]),
}


@pytest.fixture(scope="module")
def ball():
    """Return a ball 1 m above a hand at the origin, which falls along z."""
    body = (
        f'<body name="ball" pos="0 0 {HEIGHT}"><joint name="z" type="slide" axis="0 0 1"/>'
        '<geom type="sphere" size="0.05"/></body>'
    )
    xml = models.MJCF.format(body).replace("0.3 -0.2 -9.81", f"0 0 -{GRAVITY}")
    hand = svkc.VirtualLink("hand", "world", "ball", "weld", real_pos=(0, 0, 0))
    return svkc.load(xml, virtual_links=[hand])


def catch_time(ball, height, speed, size, **options):
    """Return the time (s) at which a ball comes within `size` (m) of the hand, and the run."""
    state = ball.state()
    state = eqx.tree_at(lambda s: (s.q, s.v), state, (state.q.at[0].set(height - HEIGHT), speed))
    touch = svkc.when(svkc.touch(ball, "hand", size), direction=False, stop=True)
    traj = svkc.simulate(ball, state, 2.0, events=touch, throw=False, max_events=1, **options)
    return traj.t_final, traj


def fall_time(height, speed, size):
    """Return the time (s) of a fall from `height` to `size` (m) with a first velocity (m/s)."""
    return (speed + np.sqrt(speed**2 + 2 * GRAVITY * (height - size))) / GRAVITY


@pytest.mark.slow
def test_a_ball_is_caught_by_hands_smaller_than_a_step(ball):
    """Lanes of one program: sizes of the hand, velocities of the throw, tolerances. A ball that
    starts within the hand and never leaves it is not caught."""
    hand_radii, speeds, rtols = (
        (1.5, 0.9, 0.1, 0.01, 1e-3),
        (-20.0, -1.0, 0.0, 3.0),
        (1e-4, 1e-7, 1e-10),
    )
    lanes = jnp.array(
        [(*x,) for x in np.array(np.meshgrid(hand_radii, speeds, rtols)).reshape(3, -1).T]
    )
    run = lambda x: catch_time(ball, 1.0, x[1][None], x[0], rtol=x[2])
    time, traj = jax.jit(jax.vmap(run))(lanes)
    within = lanes[:, 0] > 1
    expected = np.where(within, 2.0, fall_time(1.0, lanes[:, 1], np.minimum(lanes[:, 0], 1.0)))
    # a ball at 1 m leaves a hand of 1.5 m downwards
    np.testing.assert_allclose(time, expected, rtol=0, atol=TIME)
    codes = np.where(within, svkc.RESULTS.successful._value, svkc.RESULTS.stopped._value)
    assert np.asarray(traj.result._value).tolist() == codes.tolist()


@pytest.mark.slow
def test_the_ball_is_caught_with_fixed_steps_and_other_solvers(ball):
    for options in (
        {"dt": 0.2},
        {"dt": 0.2, "solver": diffrax.Kvaerno5()},
        {"rtol": 1e-6, "solver": diffrax.Tsit5()},
    ):
        time, _ = eqx.filter_jit(catch_time)(ball, 1.0, jnp.zeros(1), 0.05, **options)
        np.testing.assert_allclose(time, fall_time(1.0, 0.0, 0.05), atol=TIME)
    # the Euler step of svkc: the time is that of the method's own steps, from either side
    euler = {"dt": 0.2, "solver": svkc.integrators.SymplecticEuler()}
    time, traj = eqx.filter_jit(catch_time)(ball, 1.0, jnp.zeros(1), 0.05, **euler)
    assert traj.result == svkc.RESULTS.stopped
    np.testing.assert_allclose(traj.final.q[0], 0.05 - HEIGHT, atol=1e-9)


@pytest.mark.slow
def test_a_caught_ball_hangs_in_the_hand(ball):
    events = svkc.when(svkc.touch(ball, "hand", 0.1), connect="hand", direction=False, here=True)
    traj = svkc.simulate(ball, ball.state(), 1.0, events=events)
    np.testing.assert_allclose(traj.events.time[0], fall_time(1.0, 0.0, 0.1), atol=TIME)
    np.testing.assert_allclose(traj.final.q[0], 0.1 - HEIGHT, atol=1e-9)
    np.testing.assert_allclose(traj.final.v[0], 0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("options", [{}, {"dt": 0.9}], ids=["adaptive", "fixed"])
def test_each_crossing_fires_in_its_direction(ball, options):
    """Three guards without action record rising, falling and all crossings, in lanes that differ
    in the number of crossings within a step."""
    coefficients = np.zeros((len(POLYNOMIALS), 5))
    for row, c in zip(coefficients, POLYNOMIALS.values(), strict=True):
        row[: len(c)] = c
    guard = lambda t, state, c: jnp.polyval(c[::-1], t)
    events = [svkc.when(guard, direction=d) for d in (True, False, None)]
    run = lambda c: (
        svkc.simulate(
            ball, ball.state(), 2.0, events=events, args=c, max_events=9, throw=False, **options
        ).events
    )
    records = jax.jit(jax.vmap(run))(jnp.asarray(coefficients))
    for i, (name, c) in enumerate(POLYNOMIALS.items()):
        roots = np.sort(np.roots(c[::-1]))
        roots = roots[np.isreal(roots)].real
        rises = np.polyval(np.polyder(c[::-1]), roots) > 0
        count = int(records.count[i])
        which, times = np.asarray(records.which[i])[:count], np.asarray(records.time[i])[:count]
        for index, expected in enumerate((roots[rises], roots[~rises], roots)):
            located = times[which == index]
            assert located.shape == expected.shape, (name, index, times, roots)
            np.testing.assert_allclose(located, expected, atol=1e-9, err_msg=name)


@pytest.mark.slow
def test_the_earliest_of_two_guards_fires(ball):
    """Both guards cross zero twice in one step; the second in the list crosses first."""
    first = svkc.when(lambda t, s, a: jnp.abs(t - a[0]) - 0.01, stop=True)
    second = svkc.when(lambda t, s, a: jnp.abs(t - a[1]) - 0.2, stop=True)
    run = lambda a: svkc.simulate(ball, ball.state(), 2.0, events=[second, first], args=a)
    traj = jax.jit(jax.vmap(run))(jnp.array([[0.7, 1.5], [1.5, 0.7], [1.2, 1.3]]))
    np.testing.assert_allclose(traj.t_final, [0.69, 0.5, 1.1], atol=TIME)
    assert traj.events.which[:, 0].tolist() == [1, 0, 0]


@pytest.mark.slow
@pytest.mark.parametrize("options", [{}, {"dt": 0.3}], ids=["adaptive", "fixed"])
def test_the_catch_is_differentiable_by_the_height(ball, options):
    time = lambda h: catch_time(ball, h, jnp.zeros(1), 0.1, **options)[0]
    expected = 1 / np.sqrt(2 * GRAVITY * 0.9)
    np.testing.assert_allclose(jax.jit(jax.grad(time))(1.0), expected, rtol=1e-9)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(time))(1.0), expected, rtol=1e-9)
    step = 1e-4
    difference = (time(1.0 + step) - time(1.0 - step)) / (2 * step)
    np.testing.assert_allclose(difference, expected, rtol=DIFFERENCE)


@pytest.mark.slow
def test_the_derivative_of_a_double_crossing_by_a_parameter(ball):
    """Forward mode, with a guard of time: no motion is differentiated."""
    guard = lambda t, state, a: (t - 1.2) ** 2 - a
    time = lambda a: (
        svkc.simulate(ball, ball.state(), 2.0, events=svkc.when(guard, stop=True), args=a).t_final
    )
    value, slope = jax.jit(lambda a: jax.jvp(time, (a,), (jnp.ones(()),)))(jnp.asarray(0.01))
    np.testing.assert_allclose(value, 1.1, atol=TIME)
    np.testing.assert_allclose(slope, -0.5 / 0.1, rtol=1e-9)


def oscillation(t, state, args):
    """Return a guard that is negative for 4 ms, 25 times in 2 s."""
    return jnp.cos(2 * jnp.pi * 12.5 * t) + 0.987


@pytest.mark.slow
@pytest.mark.parametrize(
    "options", [{"dt": 0.5}, pytest.param({}, marks=pytest.mark.slow)], ids=["fixed", "adaptive"]
)
def test_max_step_bounds_steps_while_the_guard_is_armed(ball, options):
    """A guard faster than the points in a step is located with `max_step`, which each lane may
    choose."""

    def run(limit):
        event = svkc.when(oscillation, direction=False, max_step=limit)
        return svkc.simulate(ball, ball.state(), 0.2, events=event, max_events=3, **options)

    traj = jax.jit(jax.vmap(run))(jnp.array([0.005, 0.02]))
    first = (np.pi - np.arccos(0.987)) / (2 * np.pi * 12.5)
    expected = [[first, first + 0.08, first + 0.16]] * 2
    np.testing.assert_allclose(traj.events.time, expected, rtol=0, atol=TIME)
    assert np.all(traj.phases.accepted.sum(1) >= np.array([40, 10]))


@pytest.mark.slow
def test_dtmax_bounds_adaptive_steps(ball):
    run = lambda limit: svkc.simulate(ball, ball.state(), 2.0, dtmax=limit).phases.accepted[0]
    counts = jax.jit(jax.vmap(run))(jnp.array([0.1, 1.9]))
    assert 20 <= int(counts[0]) <= 24
    assert int(counts[1]) < 8


def random_guard(rng: np.random.Generator) -> np.ndarray:
    """Return coefficients of a guard of time: a polynomial of degree 3 or 4 with its roots in
    [0, 2.5] s, half of the time two of them close, or a line plus a sine of up to 20 rad/s."""
    c = np.zeros(8)
    kind = rng.integers(3)
    if kind < 2:
        roots = rng.uniform(0, 2.5, 3 + kind)
        if rng.random() < 0.5:
            roots[1] = roots[0] + 10 ** rng.uniform(-3, -0.5)
        factor = rng.choice([-1, 1]) * 10 ** rng.uniform(-1, 1)
        c[: len(roots) + 1] = factor * np.polynomial.polynomial.polyfromroots(roots)
    else:
        c[:2] = rng.uniform(-1, 1, 2)
        c[5:] = rng.uniform(0.05, 1), rng.uniform(0.5, 20), rng.uniform(0, 2 * np.pi)
    return c


def random_guard_value(t, c, sin=np.sin):
    """Return the value of a guard with these coefficients."""
    polynomial = c[0] + t * (c[1] + t * (c[2] + t * (c[3] + t * c[4])))
    return polynomial + c[5] * sin(c[6] * t + c[7])


@pytest.mark.slow
def test_first_crossings_of_random_guards(ball):
    """The first crossings of 400 guards, against a grid of 1e5 points and bisection."""
    rng = np.random.default_rng(7)
    cases = np.array([random_guard(rng) for _ in range(400)])
    guard = lambda t, state, c: random_guard_value(t, c, jnp.sin)
    run = lambda c: (
        svkc.simulate(
            ball, ball.state(), 2.0, events=svkc.when(guard, stop=True), args=c, throw=False
        ).t_final
    )
    times = np.asarray(jax.jit(lambda cases: jax.lax.map(run, cases))(jnp.asarray(cases)))
    grid, wrong = np.linspace(0, 2, 100001), []
    for c, time in zip(cases, times, strict=True):
        values = random_guard_value(grid, c)
        crossings = np.nonzero(values[:-1] * values[1:] < 0)[0]
        expected = 2.0
        if len(crossings):
            low, high = grid[crossings[0]], grid[crossings[0] + 1]
            for _ in range(60):
                middle = (low + high) / 2
                same = random_guard_value(middle, c) * values[crossings[0]] > 0
                low, high = (middle, high) if same else (low, middle)
            expected = high
        if not abs(time - expected) < 1e-9:
            wrong.append((c, time, expected))
    # with values at the ends of steps alone 200 of them are wrong
    assert len(wrong) <= 1, wrong


@pytest.mark.slow
def test_a_guard_that_is_nan_where_its_root_is_sought_ends_the_run(ball):
    guard = lambda t, state, args: jnp.where(jnp.abs(t - 0.05) < 0.01, jnp.nan, t - 0.05)
    traj = svkc.simulate(
        ball, ball.state(), 0.2, dt=0.1, events=[svkc.when(guard, lock="z")], throw=False
    )
    assert traj.result == svkc.RESULTS.non_finite
    assert not bool(traj.final.structure.locked.any())
    assert float(traj.t_final) == 0
