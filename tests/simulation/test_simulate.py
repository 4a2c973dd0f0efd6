"""`simulate`: the high bar, events, batches, step sizes, result codes."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import models
import numpy as np
import pytest
from tolerances import REFERENCE, ROUND_OFF

import svkc

PENDULUM = models.ARM.replace('gravity="0.3 -0.2 -9.81"', 'gravity="0 0 -10"')


@pytest.fixture(scope="module")
def pendulum():
    """Return a rod on a hinge, with a weld ("hook") that can connect the rod to the ground."""
    return svkc.load(PENDULUM, virtual_links=[svkc.VirtualLink("hook", "world", "arm", "weld")])


def high_bar_run(chain, state, right, left, again):
    events = (
        svkc.at(right, cut="right_hand_grip"),
        svkc.at(left, cut="left_hand_grip"),
        svkc.at(again, connect="left_hand_grip", here=True),
    )
    return svkc.simulate(
        chain, state, 1.0, ts=jnp.linspace(0, 1.0, 41), events=events, rtol=1e-10, atol=1e-12
    )


@pytest.fixture(scope="module")
def compiled():
    """Return the compiled high bar run for all tests of this file; it fails if traced twice."""
    return eqx.filter_jit(eqx.debug.assert_max_traces(high_bar_run, max_traces=1))


def test_high_bar(high_bar, compiled):
    """Freedoms, ranks, energy in each phase to 1e-8 and loop gaps at every save time, for two
    releases, and for two releases and a catch, with one trace."""
    chain, state = high_bar
    traj = compiled(chain, state, *jnp.array([0.5, 0.75, 10.0]))
    p = traj.phases
    assert p.joint_freedoms[:3].tolist() == [24, 23, 22]
    assert p.rank[:3].tolist() == [12, 6, 0]
    assert p.freedoms[:3].tolist() == [12, 17, 22]
    assert float(jnp.max(jnp.abs(p.energy_drift[:3] / p.energy[:3, 0]))) <= 1e-8
    assert float(traj.gaps.max()) <= REFERENCE
    np.testing.assert_array_equal(traj.events.time[:2], [0.5, 0.75])
    assert traj.events.which[:2].tolist() == [0, 1]
    # the saved poses satisfy the loop closure
    positions, _ = jax.vmap(lambda s: svkc.poses(chain, s))(traj.states)
    hand = positions[:20, chain.body_names.index("right_hand")]
    assert (
        float(jnp.abs(jnp.linalg.norm(hand - jnp.array([[0, -0.3, 2.6]]), axis=1) - 0.0681).max())
        < ROUND_OFF
    )
    recaught = compiled(chain, state, *jnp.array([0.3, 0.6, 0.8]))
    assert recaught.phases.joint_freedoms[:4].tolist() == [24, 23, 22, 23]
    assert float(recaught.events.energy_lost[2]) > 0
    assert float(recaught.gaps.max()) <= REFERENCE
    assert int(recaught.events.count) == 3


@pytest.mark.slow
def test_a_batch_of_different_runs_equals_single_runs(high_bar, compiled):
    """Batched runs with different release times and initial structures equal the single runs and
    are traced once."""
    chain, state = high_bar
    masks = [[True, True], [True, False], [False, False]]
    starts = [svkc.transition(chain, state, np.array(m)) for m in masks]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *starts)
    right, left, again = (
        jnp.array([0.2, 0.4, 10.0]),
        jnp.array([0.5, 0.1, 10.0]),
        jnp.array([0.7, 10.0, 0.5]),
    )
    batched = eqx.filter_jit(
        eqx.debug.assert_max_traces(
            eqx.filter_vmap(high_bar_run, in_axes=(None, 0, 0, 0, 0)), max_traces=1
        )
    )
    traj = batched(chain, stacked, right, left, again)
    for i, start in enumerate(starts):
        one = compiled(chain, start, right[i], left[i], again[i])
        np.testing.assert_allclose(traj.final.q[i], one.final.q, atol=1e-8)
        assert traj.events.which[i].tolist() == one.events.which.tolist()


class AngleGuard(eqx.Module):
    """A guard whose angle is data, so that runs with other angles share one program."""

    value: jax.Array

    def __call__(self, t, state, args):
        return state.q[0] - self.value


def angle_guard(value):
    return AngleGuard(jnp.asarray(float(value)))


# save times of runs without events, equal so that runs share one program
SAVE_TIMES = jnp.linspace(0, 1, 5)


def simulate_pendulum(pendulum, **kw):
    return svkc.simulate(pendulum, pendulum.state({"arm": 1.2}), 1.0, **kw)


@pytest.mark.slow
def test_the_earliest_of_two_guards_in_one_step_fires(pendulum):
    """Both guards cross within one fixed step of 0.2 s. In either order the earlier one fires, with
    the accuracy of a step of 0.2 s."""
    fine = simulate_pendulum(
        pendulum, events=[svkc.when(angle_guard(g), stop=True) for g in (0.7, 0.3)], dt=1e-3
    )
    for guards in ([0.7, 0.3], [0.3, 0.7]):
        traj = simulate_pendulum(
            pendulum, events=[svkc.when(angle_guard(g), stop=True) for g in guards], dt=0.2
        )
        assert int(traj.events.which[0]) == guards.index(0.7)
        assert abs(float(traj.events.time[0] - fine.events.time[0])) < 3e-5
        assert abs(float(traj.final.q[0]) - 0.7) < ROUND_OFF
        assert traj.result == svkc.RESULTS.stopped
        assert float(traj.states.q[-1, 0]) == pytest.approx(0.7)


@pytest.fixture(scope="module")
def caught(pendulum):
    """Return a run in which two guards cross at one instant; the event of the second connects."""
    events = [
        svkc.when(angle_guard(0.7)),
        svkc.when(lambda t, s, a: 0.7 - s.q[0], connect="hook", here=True),
    ]
    return simulate_pendulum(
        pendulum, events=events, ts=jnp.linspace(0, 1, 3), rtol=1e-9, atol=1e-11
    )


@pytest.mark.slow
def test_simultaneous_guards_make_one_change(caught):
    """Guards that cross at one instant fire together, in one change of structure."""
    traj = caught
    assert int(traj.events.count) == 2
    assert traj.events.which[:2].tolist() == [0, 1]
    assert float(traj.events.time[0]) == float(traj.events.time[1])
    assert abs(float(traj.final.q[0]) - 0.7) < REFERENCE
    assert float(jnp.abs(traj.final.v).max()) < ROUND_OFF
    assert float(traj.events.energy_lost[0]) > 0


@pytest.mark.slow
def test_event_time_has_the_accuracy_of_the_solver(pendulum):
    """The rod passes the vertical after a quarter period, which the arithmetic-geometric mean
    gives. A longer run ends with `max_events` at its capacity for events."""
    m, length, com = 1.0, 1.0, 0.5
    model = pendulum.model.model
    inertia = 1 / model.dof_invweight0[0]
    mass, com = float(model.body_mass[1]), float(-model.body_ipos[1, 2])
    a, g = 1.0, np.cos(0.6)
    while abs(a - g) > 1e-15:
        a, g = (a + g) / 2, np.sqrt(a * g)
    expected = np.pi / (2 * a) * np.sqrt(inertia / (mass * 10 * com)) * m * length
    traj = simulate_pendulum(
        pendulum, events=[svkc.when(angle_guard(0.0))], rtol=1e-11, atol=1e-13, max_events=2
    )
    assert abs(float(traj.events.time[0]) - expected) < 1e-10
    # the program of the run above, for a run with more events than its capacity
    many = svkc.simulate(
        pendulum,
        pendulum.state({"arm": 1.0}),
        9.0,
        events=[svkc.when(angle_guard(0.0))],
        max_events=2,
        throw=False,
    )
    assert many.result == svkc.RESULTS.max_events
    assert int(many.events.count) == 2
    assert 0 < float(many.t_final) < 9


@pytest.mark.slow
def test_directions_and_repeated_crossings(pendulum):
    """A guard without an action records every crossing, with a direction every second one. A guard
    that starts at zero has not crossed."""
    state = pendulum.state({"arm": 0.5})
    events = [
        svkc.when(angle_guard(0.0)),
        svkc.when(angle_guard(0.0), direction=True),
        svkc.when(angle_guard(0.5), direction=True),
    ]
    traj = svkc.simulate(pendulum, state, 3.0, events=events, rtol=1e-8, atol=1e-10)
    which = traj.events.which[: int(traj.events.count)].tolist()
    assert which.count(0) == 2 * which.count(1) or which.count(0) == 2 * which.count(1) + 1
    assert which.count(1) >= 1
    # at the top of the swing round-off decides whether the guard crosses again
    assert all(
        time > 1
        for time, i in zip(traj.events.time.tolist(), traj.events.which.tolist(), strict=True)
        if i == 2
    )


@pytest.mark.slow
def test_simultaneous_events_at_start_and_end(pendulum):
    """Timed events at t0 and t1, and a guard that crosses at t1."""
    state = pendulum.state({"arm": 0.5}, {"arm": 1.0})
    last = svkc.when(lambda t, s, args: t - 1.0, stop=True)
    events = [
        svkc.at(0.0, connect="hook", here=True),
        svkc.at(0.5, cut="hook"),
        svkc.at(1.0, connect="hook", here=True),
        last,
    ]
    traj = svkc.simulate(pendulum, state, 1.0, ts=jnp.array([0.0, 0.25, 0.5, 1.0]), events=events)
    assert traj.events.time[:4].tolist() == [0, 0.5, 1.0, 1.0]
    assert traj.events.which[:4].tolist() == [0, 1, 2, 3]
    assert traj.result == svkc.RESULTS.stopped
    assert traj.connected[:, 0].tolist() == [True, True, False, True]
    np.testing.assert_allclose(traj.states.q[:3, 0], 0.5, atol=ROUND_OFF)
    assert traj.final.structure.connected.tolist() == [True]
    assert float(traj.final.q[0]) < 0.5


@pytest.mark.slow
def test_fixed_and_adaptive_steps_are_consistent(pendulum):
    fixed = simulate_pendulum(pendulum, ts=SAVE_TIMES, dt=1e-3)
    adaptive = simulate_pendulum(pendulum, ts=SAVE_TIMES, rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose(fixed.states.q, adaptive.states.q, atol=REFERENCE)
    assert int(fixed.report().accepted) == 1000
    euler = simulate_pendulum(pendulum, ts=SAVE_TIMES, dt=1e-3, solver=diffrax.Euler())
    assert 1e-5 < float(jnp.abs(euler.states.q - adaptive.states.q).max()) < 1e-1


@pytest.mark.slow
def test_control_and_work(pendulum, capsys):
    """The work of a control explains the change of energy. A control that is NaN from some time on
    ends the run with `non_finite`."""

    def control(t, state, args):
        return args[0] * jnp.ones(1) * jnp.sin(5 * t) + 0 * jnp.log(args[1] - t)

    run = lambda *args: simulate_pendulum(
        pendulum,
        control=control,
        args=jnp.array(args),
        rtol=1e-10,
        atol=1e-12,
        progress_meter=diffrax.TextProgressMeter(),
        throw=False,
    )
    traj = run(3.0, 2.0)
    jax.effects_barrier()
    assert "100" in capsys.readouterr().out
    assert traj.result == svkc.RESULTS.successful
    assert abs(float(traj.phases.work[0])) > 1e-2
    assert abs(float(traj.phases.energy_drift[0])) < 1e-8
    assert run(3.0, 0.5).result == svkc.RESULTS.non_finite


def max_gap_after_two_seconds(stabilization) -> float:
    chain = models.four_bar()
    traj = svkc.simulate(
        chain,
        chain.state(v={"crank": 4.0}),
        2.0,
        ts=jnp.linspace(0, 2, 21),
        dt=0.01,
        stabilization=stabilization,
        throw=False,
    )
    return float(traj.gaps.max())


@pytest.mark.slow
@pytest.mark.parametrize(
    "stabilization", [svkc.stabilization.Projection(), svkc.stabilization.CoordinatePartitioning()]
)
def test_projection_removes_drift(stabilization):
    """Projection after steps, or in every evaluation, keeps a four-bar's loop gap at round-off."""
    assert max_gap_after_two_seconds(stabilization) < 1e-13


@pytest.mark.slow
def test_baumgarte_bounds_drift():
    """Baumgarte's term keeps the gap below the 6e-6 of the run without stabilization."""
    assert 1e-13 < max_gap_after_two_seconds(svkc.stabilization.Baumgarte(30.0)) < 1e-6


@pytest.mark.slow
def test_drift_grows_without_stabilization():
    assert max_gap_after_two_seconds(svkc.stabilization.NoStabilization()) > 1e-6


@pytest.mark.slow
def test_result_codes_of_failed_runs(pendulum):
    """Codes `max_steps` and `not_in_place`; tests above cover `max_events` and `non_finite`."""
    state = pendulum.state({"arm": 1.0})
    short = svkc.simulate(pendulum, state, 1.0, dt=1e-3, max_steps=10, throw=False)
    assert short.result == svkc.RESULTS.max_steps
    with pytest.raises(RuntimeError, match="max_steps"):
        svkc.simulate(pendulum, state, 1.0, dt=1e-3, max_steps=10)
    away = svkc.simulate(pendulum, state, 1.0, events=[svkc.at(0.5, connect="hook")], throw=False)
    assert away.result == svkc.RESULTS.not_in_place


@pytest.mark.slow
def test_discontinuous_guards(pendulum):
    """The event of a guard that jumps in time is located at the jump. A guard that jumps by a
    change of structure has not crossed."""
    state = pendulum.state({"arm": 1.2})
    jumps = svkc.when(lambda t, s, a: jnp.where(t > 0.5, 1.0 + t, -1.0))
    later = svkc.when(lambda t, s, a: jnp.where(s.structure.connected[0], s.q[0] - 2.0, 1.0))
    traj = svkc.simulate(
        pendulum,
        state,
        1.0,
        events=[jumps, svkc.at(0.3, connect="hook", here=True), later],
        rtol=1e-8,
    )
    assert traj.events.which[: int(traj.events.count)].tolist() == [1, 0]
    assert traj.events.time[1] == pytest.approx(0.5, abs=1e-7)


@pytest.mark.slow
def test_step_equals_a_step_of_simulate():
    """`svkc.step` equals a step of `simulate` with its solver and stabilization. It is of first
    order and bounds loop gaps, also in a batch with different structures."""
    chain = models.four_bar()
    state, dt = chain.state(v={"crank": 3.0}), 1e-3
    alone = svkc.step(chain, state, jnp.zeros(chain.nv), dt)
    options = {
        "solver": svkc.integrators.SymplecticEuler(),
        "stabilization": svkc.stabilization.Baumgarte(0.5 / dt),
    }
    run = svkc.simulate(chain, state, dt, dt=dt, **options).final
    np.testing.assert_allclose(alone.q, run.q, atol=1e-14)
    np.testing.assert_allclose(alone.v, run.v, atol=1e-11)
    other = svkc.cut(chain, state, "pin")
    lanes = jax.tree.map(lambda *x: jnp.stack(x), state, state, other, other)
    walk = lambda s, n: jax.lax.fori_loop(
        0, n, lambda _, s: svkc.step(chain, s, jnp.zeros(chain.nv), 0.5 / n.astype(float)), s
    )
    ends = jax.jit(jax.vmap(walk))(lanes, jnp.array([500, 1000, 500, 1000]))
    # loop gaps are of second order
    gaps = [
        float(
            jnp.abs(svkc.loop_gaps(chain, jax.tree.map(lambda x, lane=lane: x[lane], ends))).max()
        )
        for lane in (0, 1)
    ]
    assert 1.8 < np.log2(gaps[0] / gaps[1]) < 2.2
    assert gaps[1] < 1e-4
    for i, start in ((0, state), (2, other)):
        exact = svkc.simulate(chain, start, 0.5, rtol=1e-9).final.q
        coarse, fine = (float(jnp.abs(ends.q[lane] - exact).max()) for lane in (i, i + 1))
        assert 0.8 < np.log2(coarse / fine) < 1.2


@pytest.mark.parametrize(
    ("dtype", "rtol", "atol"),
    [
        pytest.param("float64", 1e-11, 1e-13, marks=pytest.mark.slow),
        pytest.param("float64", 1e-4, 1e-6, marks=pytest.mark.slow),
        pytest.param("float32", 1e-5, 8 * 2.0**-23, marks=pytest.mark.slow),
    ],
)
def test_default_absolute_tolerance(pendulum, dtype, rtol, atol):
    """The default of atol is a hundredth of rtol, but at least eight times round-off."""
    chain, start = jax.tree.map(
        lambda x: x.astype(dtype) if eqx.is_inexact_array(x) else x,
        (pendulum, pendulum.state({"arm": 0.3})),
    )
    ts = SAVE_TIMES.astype(dtype)
    alone, both = (
        svkc.simulate(chain, start, 1.0, ts=ts, rtol=rtol),
        svkc.simulate(chain, start, 1.0, ts=ts, rtol=rtol, atol=atol),
    )
    # a hundredth of rtol may differ from atol in its last digit
    np.testing.assert_allclose(alone.final.q, both.final.q, atol=ROUND_OFF)
    assert int(alone.report().accepted) == int(both.report().accepted)


@pytest.mark.slow
def test_step_size_below_the_lower_bound(pendulum):
    """A step size below the controller's bound ends the run with a code, a finite state, and an
    error with throw=True."""
    controller = diffrax.PIDController(rtol=1e-12, atol=1e-14, dtmin=0.02, force_dtmin=False)
    traj = simulate_pendulum(
        pendulum, stepsize_controller=controller, solver=diffrax.Tsit5(), throw=False
    )
    assert traj.result == svkc.RESULTS.step_too_small
    assert float(traj.t_final) < 1.0
    assert np.isfinite(traj.final.q).all()
    with pytest.raises(RuntimeError, match="lower bound"):
        simulate_pendulum(pendulum, stepsize_controller=controller, solver=diffrax.Tsit5())


@pytest.mark.slow
def test_states_after_the_last_event_are_saved(pendulum):
    """At and after the time of an event at the end of a run, or of one that ends it, the saved
    state is the one after the event: alone, in a batch beside a longer run, and in derivatives by
    the time of the event."""
    ts, start = jnp.array([0.0, 0.2, 0.3, 0.5]), pendulum.state({"arm": 0.5}, {"arm": 1.0})

    def run(stop_time, last=0.5):
        events = [
            svkc.at(stop_time, connect="hook", here=True, stop=True),
            svkc.at(last, connect="hook", here=True),
        ]
        return svkc.simulate(pendulum, start, 0.5, ts=ts, events=events, rtol=1e-9)

    stopped, ended = run(0.3), run(9.0)
    for traj, first in ((stopped, 2), (ended, 3)):
        np.testing.assert_array_equal(traj.states.v[first:], 0)
        np.testing.assert_array_equal(
            traj.states.q[first:], traj.final.q[None].repeat(4 - first, 0)
        )
        assert traj.connected[:, 0].tolist() == [False] * first + [True] * (4 - first)
    lanes = jax.vmap(run)(jnp.array([0.3, 9.0]))
    for traj, lane in ((stopped, 0), (ended, 1)):
        np.testing.assert_allclose(lanes.states.q[lane], traj.states.q, atol=ROUND_OFF)
        np.testing.assert_allclose(lanes.states.v[lane], traj.states.v, atol=ROUND_OFF)
    saved, final = jax.jacrev(lambda time: (run(time).states.q[-1], run(time).final.q))(0.3)
    np.testing.assert_allclose(saved, final, rtol=1e-9)
    assert abs(float(final[0])) > 0.1


@pytest.mark.slow
def test_a_run_of_no_length_has_derivatives_by_its_end(pendulum):
    """Phases after the end of a run are skipped, but not the first one."""
    start = pendulum.state({"arm": 0.4}, {"arm": 0.3})

    def saved(t1):
        events = svkc.at(5.0, stop=True)
        traj = svkc.simulate(pendulum, start, t1, dt=0.1, max_steps=16, events=events, max_events=3)
        return traj.states.q[-1, 0]

    q, rate = jax.value_and_grad(saved)(0.0)
    np.testing.assert_allclose([q, rate], [0.4, 0.3], rtol=1e-12)


@pytest.mark.slow
def test_progress_meters_in_a_batch_with_events(pendulum):
    """JAX refuses effects in a conditional under `vmap`: phases are skipped with `Replay` only."""

    def end(angle):
        return svkc.simulate(
            pendulum, pendulum.state({"arm": angle}), 0.2, dt=0.1, max_steps=8,
            events=svkc.at(0.1, lock="arm"), adjoint=diffrax.RecursiveCheckpointAdjoint(),
            progress_meter=diffrax.TextProgressMeter(),
        ).final.q[0]  # fmt: skip

    ends = jax.vmap(end)(jnp.array([0.1, 0.2]))
    np.testing.assert_allclose(ends, [end(0.1), end(0.2)], atol=ROUND_OFF)


@pytest.mark.slow
@pytest.mark.parametrize(
    "adjoint", [diffrax.RecursiveCheckpointAdjoint(), svkc.integrators.Replay(every=3)]
)
def test_gradients_of_lanes_of_different_length(pendulum, adjoint):
    def saved(angle, t1):
        return svkc.simulate(
            pendulum, pendulum.state({"arm": angle}), t1, dt=0.1, max_steps=16, adjoint=adjoint
        ).states.q[-1, 0]

    ends = jnp.array([0.35, 1.0])
    gradients = jax.vmap(jax.grad(saved), (None, 0))(0.4, ends)
    alone = [jax.grad(saved)(0.4, t1) for t1 in ends]
    np.testing.assert_allclose(gradients, alone, atol=ROUND_OFF)


@pytest.mark.slow
def test_lanes_that_end_where_the_field_has_no_finite_derivative():
    """Unused steps of a lane, computed beside those of another lane, do not make its gradient NaN.

    The first lane ends at x = 0, where the derivative of the force is infinite. The second one
    takes a further step in this phase, and has another phase after the cut. The force is too small
    to change the motion.
    """
    body = f'<body name="a"><joint name="a" type="slide" axis="1 0 0"/>{models.BOX}</body>'
    text = models.MJCF.format(body.format("0.1 0.1 0.1")).replace("0.3 -0.2 -9.81", "0 0 0")
    hook = svkc.VirtualLink("hook", "world", "a", "weld")
    chain = svkc.load(text, virtual_links=[hook])

    def end(x, stop_time):
        events = [svkc.at(stop_time, stop=True), svkc.at(1.5, cut="hook")]
        force = lambda t, state, args: 1e-40 * jnp.sqrt(jnp.abs(state.q[:1]))
        start = chain.state({"a": x}, {"a": -1.0})
        return svkc.simulate(
            chain, start, 3.0, dt=0.5, solver=diffrax.Midpoint(), control=force, events=events
        ).final.q[0]  # fmt: skip

    x, times = jnp.array([1.0, 4.0]), jnp.array([1.0, 3.0])
    ends, gradients = jax.vmap(jax.value_and_grad(end))(x, times)
    np.testing.assert_array_equal(ends, [0, 1])
    np.testing.assert_array_equal(gradients, 1)
    tangents = jax.vmap(lambda x, t: jax.jvp(lambda x: end(x, t), (x,), (jnp.ones(()),))[1])
    np.testing.assert_array_equal(tangents(x, times), 1)


@pytest.mark.slow
def test_steps_keep_their_size_across_events(pendulum):
    """Each phase starts with half of the size proposed before it, so that phases shorter than the
    steps take one step each. The first phase starts with a thousandth of the run."""
    times = np.linspace(0, 2, 21)[1:-1]
    events = [svkc.at(time, cut="hook") for time in times]  # not connected: nothing changes
    state = pendulum.state({"arm": 0.3})
    traj = svkc.simulate(pendulum, state, 2.0, events=events, rtol=1e-4)
    accepted = np.asarray(traj.phases.accepted)
    assert accepted.shape == (20,)
    assert accepted[0] == 3  # of 2, 20 and 78 ms
    assert accepted[2:].tolist() == [1] * 18
    assert int(traj.phases.rejected.sum()) == 0
    reference = svkc.simulate(pendulum, state, 2.0, rtol=1e-10)
    np.testing.assert_allclose(traj.final.q, reference.final.q, atol=1e-4)
