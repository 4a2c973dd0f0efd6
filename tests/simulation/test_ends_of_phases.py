"""Where phases end: failed searches for events, events at the end, and derivatives there."""

import diffrax
import jax
import jax.numpy as jnp
import models
import numpy as np
import pytest
from tolerances import DIFFERENCE, REFERENCE, ROUND_OFF

import svkc


@pytest.fixture(scope="module")
def pendulum():
    return svkc.load(models.ARM)


@pytest.mark.slow
@pytest.mark.parametrize("adjoint", [None, diffrax.RecursiveCheckpointAdjoint()])
def test_a_failed_search_for_an_event_ends_the_run(pendulum, adjoint):
    """By every adjoint: too few steps, and a guard that is NaN."""
    state = pendulum.state({"arm": 0.3})

    def run(guard, **options):
        event = svkc.when(guard, stop=True, max_step=options.pop("max_step", None))
        return svkc.simulate(
            pendulum, state, 1.0, events=event, max_events=1, adjoint=adjoint, throw=False,
            **options,
        )  # fmt: skip

    short = run(lambda t, s, a: t - 0.3, max_step=1e-3, max_steps=100)
    assert short.result == svkc.RESULTS.max_steps
    assert float(short.t_final) == pytest.approx(0.1)
    nan = run(lambda t, s, a: jnp.where(t < 0.1, -1.0, jnp.nan))
    assert nan.result == svkc.RESULTS.non_finite
    assert 0 <= float(nan.t_final) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("dtype", "start", "bound"), [("float64", 1e4, 1e-6), ("float32", 100.0, 2e-3)]
)
def test_derivatives_at_an_event_do_not_depend_on_the_time_of_the_start(dtype, start, bound):
    """By energy conservation v^2 - v0^2 at an angle is constant, so that dv/dv0 = v0 / v.

    The search for the event evaluates guards past it, sqrt(eps) t later. The stages of that step
    are not those of the step to the event.
    """
    with jax.enable_x64(dtype == "float64"):
        chain = svkc.load(models.ARM)
        state = chain.state({"arm": 1.5})

        def end(v0, t0):
            start = svkc.State(state.q, state.v + v0, state.structure)
            stop = svkc.when(lambda t, s, args: s.q[0] - 0.2, stop=True)
            run = svkc.simulate(chain, start, t0 + 2.0, t0=t0, events=stop, max_events=1)
            return run.final.v[0]

        v0 = jnp.asarray(-0.5, dtype)
        v, slope = jax.jit(jax.value_and_grad(end))(v0, jnp.asarray(start, dtype))
        assert abs(float(slope - v0 / v)) < bound


@pytest.mark.slow
def test_events_after_the_end_do_not_happen(pendulum):
    """An event 1e-8 s after t1 does not happen. One that is later by round-off alone does."""
    state = pendulum.state({"arm": 0.3})
    run = jax.jit(
        lambda end, time: svkc.simulate(
            pendulum, state, end, dt=0.01, max_steps=200, events=svkc.at(time, lock="arm")
        )
    )
    for end, time, count in ((1.0, 1.0 + 1e-8, 0), (1.0, 1.0, 1), (0.3, 0.1 + 0.2, 1)):
        traj = run(end, time)
        assert int(traj.events.count) == count
        assert bool(traj.final.structure.locked[0]) == bool(count)
    # an event at an infinite time does not happen, traced or not
    assert int(run(0.3, np.inf).events.count) == 0
    never = svkc.at(np.inf, lock="arm")
    assert int(svkc.simulate(pendulum, state, 0.1, dt=0.01, events=never).events.count) == 0


@pytest.mark.slow
def test_open_loops_are_reported_where_an_event_ends_the_run():
    chain = models.four_bar()
    state = chain.state({"crank": 0.4}, {"crank": 4.0})
    traj = svkc.simulate(
        chain, state, 1.0, dt=0.02, events=svkc.at(1.0, stop=True), throw=False,
        stabilization=svkc.stabilization.NoStabilization(),
    )  # fmt: skip
    assert float(traj.report().gap) > 1e-5
    assert traj.result == svkc.RESULTS.loop_open


@pytest.mark.slow
def test_a_guard_that_is_not_armed_may_be_nan(pendulum):
    """A guard may be defined only after the event that arms it."""
    first = svkc.at(0.4)
    log = svkc.when(lambda t, s, args: jnp.log(t - 0.4) + 2, stop=True, after=first)
    run = lambda end: svkc.simulate(
        pendulum, pendulum.state({"arm": 0.3}), end, events=[first, log], throw=False
    )
    early = run(0.3)
    assert early.result == svkc.RESULTS.successful
    assert float(early.t_final) == 0.3
    stopped = run(1.0)
    assert stopped.result == svkc.RESULTS.stopped
    np.testing.assert_allclose(stopped.t_final, 0.4 + np.exp(-2.0), atol=REFERENCE)
    # the guard that ended a run is named, and not another one
    nan = svkc.when(lambda t, s, args: jnp.where(t < 0.1, 1.0, jnp.nan), stop=True)
    with pytest.raises(RuntimeError, match=r"the guard of events\[2\]"):
        svkc.simulate(pendulum, pendulum.state(), 0.3, dt=0.05, events=[first, log, nan])

    def end(x):
        start = pendulum.state({"arm": x})
        return svkc.simulate(pendulum, start, 0.3, dt=0.05, events=[first, log, nan]).final.q[0]

    with pytest.raises(RuntimeError, match=r"the guard of events\[2\]"):
        jax.jvp(end, (0.1,), (1.0,))


@pytest.mark.slow
def test_jumps_of_a_control(pendulum):
    """A controller with `jump_ts` saves the state at a jump, and has derivatives by diffrax."""
    state, ts = pendulum.state({"arm": 0.3}), jnp.array([0.0, 0.25, 0.5, 0.75, 1.0])
    hold = lambda t, s, args: jnp.where(t < 0.5, args[0], args[1])[None]
    controller = diffrax.ClipStepSizeController(
        diffrax.PIDController(1e-10, 1e-12), jump_ts=jnp.array([0.5, 1.0])
    )

    def run(args, **options):
        return svkc.simulate(pendulum, state, 1.0, ts=ts, control=hold, args=args, **options)

    args = jnp.array([0.5, -0.5])
    jumps, plain = run(args, stepsize_controller=controller), run(args, rtol=1e-11)
    assert float(jumps.t_final) == 1.0
    np.testing.assert_allclose(jumps.states.q, plain.states.q, atol=1e-8)
    end = lambda args: run(args, stepsize_controller=controller).final.q[0]
    assert svkc.check_grad(end, args, "reverse").error < DIFFERENCE


@pytest.mark.slow
def test_solvers_that_wrap_another(pendulum):
    state = pendulum.state({"arm": 0.3})
    half = svkc.simulate(
        pendulum, state, 0.5, rtol=1e-9, solver=diffrax.HalfSolver(diffrax.Tsit5())
    )
    plain = svkc.simulate(pendulum, state, 0.5, rtol=1e-11)
    np.testing.assert_allclose(half.final.q, plain.final.q, atol=1e-8)
    attempts = int(half.report().accepted + half.report().rejected)
    assert int(half.report().evaluations) == 21 * attempts
    end = lambda x: svkc.simulate(
        pendulum, pendulum.state({"arm": x}), 0.5, rtol=1e-9,
        solver=diffrax.HalfSolver(diffrax.Tsit5()),
    ).final.q[0]  # fmt: skip
    assert svkc.check_grad(end, jnp.asarray(0.3), "reverse").error < DIFFERENCE


@pytest.mark.slow
def test_a_locked_free_body_is_not_free():
    chain = svkc.load(models.MJCF.format(models.bar("base", 'type="free"', "0 0 1")))
    held = svkc.lock(chain, chain.state(), "base")
    traj = svkc.simulate(chain, held, 0.1)
    assert traj.phases.free.tolist() == [False]
    assert float(traj.report().momentum_drift) == 0
    np.testing.assert_allclose(traj.final.v, 0, atol=ROUND_OFF)
