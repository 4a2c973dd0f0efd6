"""A run, phase after phase: a scan over solves of one smooth field each, with the change of
structure between them.

A phase ends at the next scheduled time or at the end of the first step in which a guard crosses
zero; the crossing is then located by steps of the solver back from there, so that its time and
state have the solver's own order and not that of an interpolation. Lanes of a batch
that are done go on with phases of no length.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from svkc._jax.eager import eager_jit
from svkc._jax.functions import call_with_comparable
from svkc._jax.primitive import ClosureConverted
from svkc._jax.pytrees import stop_gradient_tree
from svkc.integration.event_location import GuardValues, event_tolerance
from svkc.integration.ode import FieldArgs, ODEState
from svkc.model.chain import Chain, State
from svkc.simulation.apply_events import apply_events, reevaluated_guards
from svkc.simulation.certificate import certificate, evaluations_per_step
from svkc.simulation.options import Options, prepare_options
from svkc.simulation.phase import PhaseOutcome, RunState, solve_phase
from svkc.simulation.records import RESULTS, empty_events, empty_phase_records, write_phase_row
from svkc.simulation.trajectory import Trajectory
from svkc.transitions.plan import Plan


def simulate(
    chain: Chain, state: State, t1, *, t0=0.0, ts=None, events=(), control=None, args=None,
    dt=None, rtol=None, atol=None, solver=None, stepsize_controller=None, stabilization=None,
    dynamics=None, adjoint=None, max_events=None, max_steps=None, throw=True, progress_meter=None,
) -> Trajectory:  # fmt: skip
    """The motion from t0 to t1 (s), through every change of structure in `events` (`svkc.at`,
    `svkc.when`).

    ts: times to save, stepped to exactly; None: t0 and t1. A state saved at an event's time is the
    one after it; times past the end of a run that stopped early hold its last state.
    control(t, state, args): joint torques (N m, N) over every coordinate, or the tree's.
    dt: fixed steps (s). rtol, atol: adaptive steps, by default 1e-7 (float32: 1e-4) and a hundredth
    of rtol.
    solver, stepsize_controller, adjoint, progress_meter: diffrax objects, passed through; by
    default Dopri8 with rtol, Tsit5 with dt or in float32.
    stabilization: an object of `svkc.stabilization`, by default `Projection()`. dynamics: one of
    `svkc.dynamics`. Functions are compared by their code and by the values that they read:
    defaults, closures and globals. An equal function is not compiled again. Floating-point
    arrays among these values are data. Numbers and integer arrays are static, as are arrays that
    Python has to read. A function that reads other kinds of objects is compared by identity; if
    that compiles it again, a `UserWarning` names the argument.
    max_events: how many events may happen (default: each timed one, four times each guard);
    max_steps: in one phase.
    ValueError: a call that cannot be right. A run that goes wrong ends with a code in `result`,
    raised when throw=True.
    """
    options, save_at, plan = prepare_options(
        chain, state, t0, t1, ts=ts, events=events, control=control, dt=dt, rtol=rtol, atol=atol,
        solver=solver, stepsize_controller=stepsize_controller, stabilization=stabilization,
        dynamics=dynamics, adjoint=adjoint, max_events=max_events, max_steps=max_steps,
        progress_meter=progress_meter,
    )  # fmt: skip
    dtype = state.q.dtype
    inputs = chain, state, jnp.asarray(t0, dtype), jnp.asarray(t1, dtype), save_at
    run = lambda control, events: _run(
        *inputs, replace(plan, guards=events), replace(options, control=control), args
    )
    run = call_with_comparable(run, control=options.control, events=plan.guards)
    certified = _certify_eagerly if len(save_at) <= MAX_EAGER_STATES else _certify
    traj = certified(
        chain, run, save_at, inputs[3], options.gap_tolerance, evaluations_per_step(options.solver)
    )
    return _raise_on_failure(chain, traj) if throw else traj


def _raise_on_failure(chain: Chain, traj: Trajectory) -> Trajectory:
    """Return the trajectory. Raise RuntimeError, or an error at run time under jit, where the run
    went wrong."""
    good = RESULTS.successful, RESULTS.stopped
    if isinstance(traj.result._value, jax.core.Tracer):
        return traj.result.error_if(traj, (traj.result != good[0]) & (traj.result != good[1]))
    if np.all(np.isin(np.asarray(traj.result._value), [code._value for code in good])):
        return traj
    phase, loop = int(traj.phases.count), int(traj.report().loop)
    where = f"phase {phase}" if loop < 0 else f"phase {phase}, loop {chain.link_names[loop]!r}"
    raise RuntimeError(
        f"simulate stopped at t = {float(traj.t_final):.9g} s, in {where}: {RESULTS[traj.result]}"
    )


@eqx.filter_jit
def _run(chain: Chain, state: State, t0, t1, ts, plan: Plan, options: Options, args) -> RunState:
    plan, options = _closure_convert(chain, state, t0, plan, options, args)
    run = _initial_run_state(chain, state, t0, ts, plan, options)

    def phase(run: RunState, index):
        return _run_phase(chain, run, index, (t1, ts), plan=plan, options=options, args=args), None

    if options.max_events == 0:
        run, _ = phase(run, jnp.asarray(0))
    else:
        run, _ = jax.lax.scan(phase, run, jnp.arange(options.max_events + 1))
    return run


def _with_certificate(
    chain: Chain, run: RunState, ts, t1, gap_tolerance: float, stages: int
) -> Trajectory:
    """Return the run with its certificate. gap_tolerance: the largest gap of a closed loop; stages: of
    the field in one try of a step."""
    short = (run.t < t1) & (run.result == RESULTS.successful)
    result = RESULTS.where(short, RESULTS.max_events, run.result)
    phases, saved, lost = certificate(chain, run.records, run.count, run.saved, stages)
    worst = jnp.maximum(jnp.max(saved.gap), jnp.max(phases.gap))
    result = RESULTS.where(
        (result == RESULTS.successful) & (worst > gap_tolerance), RESULTS.loop_open, result
    )
    derivative = RESULTS.where(
        (lost < phases.start.shape[0]) & (lost <= run.invalid_from),
        RESULTS.rank_lost,
        run.derivative,
    )
    return Trajectory(
        ts=ts,
        states=run.saved,
        gaps=saved.gap,
        gap_rates=saved.gap_rate,
        events=run.events,
        phases=phases,
        final=run.state,
        t_final=run.t,
        result=result,
        derivative=derivative,
    )


# a program of its own, which an eager call compiles for compile time: it checks each state once
MAX_EAGER_STATES = 1000
_certify, _certify_eagerly = (
    eqx.filter_jit(_with_certificate),
    eager_jit(_with_certificate, eqx.filter_jit),
)


def _closure_convert(
    chain: Chain, state: State, t0, plan: Plan, options: Options, args
) -> tuple[Plan, Options]:
    """Control and guards with all that they close over as their leaves, so that it can be
    differentiated."""
    state = _with_lock_mask(chain, state, plan)
    guards = tuple(g.closure_convert(t0, state, args) for g in plan.guards)
    control = options.control
    control = None if control is None else ClosureConverted.from_function(control, t0, state, args)
    return replace(plan, guards=guards), replace(options, control=control)


def replace(node, **changed):
    return replace(node, **changed)


def _with_lock_mask(chain: Chain, state: State, plan: Plan) -> State:
    if not plan.has_locks or state.structure.locked is not None:
        return state
    return eqx.tree_at(
        lambda s: s.structure.locked,
        state,
        jnp.zeros(chain.dofs, bool),
        is_leaf=lambda x: x is None,
    )


def _initial_run_state(
    chain: Chain, state: State, t0, ts, plan: Plan, options: Options
) -> RunState:
    """Empty records, sized by capacity; unwritten entries show: inf, -1."""
    links, rows, dtype = len(chain.link_names), options.max_events, state.q.dtype
    state = _with_lock_mask(chain, state, plan)
    # an overload from the start is a crossing; guards that need no torques are evaluated at the
    # start of the phase
    initial = [g.initial_value for g in plan.guards]
    return RunState(
        t=t0,
        state=state,
        work=jnp.zeros((), dtype) if options.has_work else None,
        guard_values=jnp.asarray(initial, dtype) if plan.guards else None,
        stale=jnp.asarray(reevaluated_guards(plan)) if plan.guards else None,
        pending=jnp.ones(len(plan.timed), bool),
        events=empty_events(rows, links, dtype),
        records=empty_phase_records(rows + 1, state),
        count=jnp.asarray(0, jnp.int32),
        saved=jax.tree.map(lambda x: jnp.broadcast_to(x[None], (ts.shape[0], *x.shape)), state),
        result=RESULTS.successful,
        derivative=RESULTS.successful,
        invalid_from=jnp.asarray(rows + 1, jnp.int32),
    )  # fmt: skip


def _next_stop(run: RunState, t1, plan: Plan):
    """Return the time at which the next phase ends at the latest: that of the next event, or t1.

    Of two equal times the one taken is differentiated: the event's where it is t1, and t1 where the
    run is there already.
    """
    next_time = jnp.min(jnp.where(run.pending, plan.times, jnp.inf), initial=jnp.inf)
    stop = jnp.where(next_time <= t1, next_time, t1)
    return jnp.where((stop < run.t) | (run.result != RESULTS.successful), run.t, stop)


def _run_phase(
    chain: Chain, run: RunState, index, times, *, plan: Plan, options: Options, args
) -> RunState:
    """One solve, the events at its end, and the records of both. times: the end and the save
    times."""
    t1, ts = times
    run = _rearm_guards(chain, run, plan, options, args)
    active = (run.t < t1) | jnp.any(run.pending & (plan.times <= t1))
    active = active & (run.result == RESULTS.successful)
    stop = _next_stop(run, t1, plan)
    outcome = solve_phase(run, stop, ts, plan, options, FieldArgs(chain, run.state.structure, args))
    reached = active & (outcome.result == RESULTS.successful)
    timed = run.pending & (plan.times <= outcome.t + event_tolerance(outcome.t)) & reached
    fired = (
        jnp.zeros(len(plan.actions), bool)
        .at[np.array(plan.timed + plan.guarded, int)]
        .set(jnp.concatenate([timed, outcome.fired & reached]))
    )
    end_state = State(outcome.y.q, outcome.y.v, run.state.structure)
    saved = _write_saved_states(run, end_state, outcome, ts)
    row = (jnp.arange(run.records.start.shape[0]) == index) & active
    work = jnp.zeros_like(run.t) if run.work is None else outcome.y.work - run.work
    records = write_phase_row(
        run.records, row, (run.t, run.state), (outcome.t, end_state), work, outcome.solution
    )
    count = run.count + active.astype(jnp.int32)
    derivative, invalid_from = _check_derivative(run, outcome, active, timed, index)
    after, events, result = end_state, run.events, outcome.result
    if plan.actions:
        after, events, result = apply_events(chain, run, end_state, outcome, fired, plan)
    result = RESULTS.where(run.result == RESULTS.successful, result, run.result)
    # a guard that rests at zero after it fired keeps its value
    stale = (
        jnp.asarray(reevaluated_guards(plan)) & jnp.any(fired) & (outcome.guard_values != 0)
        if plan.guards
        else None
    )
    return RunState(
        t=outcome.t,
        state=after,
        work=outcome.y.work,
        guard_values=outcome.guard_values,
        stale=stale,
        pending=run.pending & ~timed,
        events=events,
        records=records,
        count=count,
        saved=saved,
        result=result,
        derivative=derivative,
        invalid_from=invalid_from,
    )


def _check_derivative(
    run: RunState, outcome: PhaseOutcome, active, timed: Bool[Array, " timed"], index
) -> tuple[RESULTS, Int[Array, ""]]:
    """Return the first reason why the run has no derivative, and the index of its phase. Ranks are
    checked after the run."""
    code = RESULTS.where(
        jnp.sum(outcome.fired) + jnp.sum(timed) > 1, RESULTS.together, outcome.derivative
    )
    first = (run.derivative == RESULTS.successful) & active & (code != RESULTS.successful)
    return RESULTS.where(first, code, run.derivative), jnp.where(
        first, index.astype(jnp.int32), run.invalid_from
    )


def _rearm_guards(chain: Chain, run: RunState, plan: Plan, options: Options, args) -> RunState:
    """Return the run with its stale guards re-evaluated at the start of a phase."""
    if not plan.guards or not reevaluated_guards(plan).any():
        return run
    scene = FieldArgs(chain, run.state.structure, args)
    now = stop_gradient_tree(GuardValues(plan, options.field))(
        *stop_gradient_tree((run.t, ODEState(run.state.q, run.state.v), scene))
    )
    return replace(run, guard_values=jnp.where(run.stale, now, run.guard_values))


def _write_saved_states(run: RunState, end_state: State, outcome: PhaseOutcome, ts) -> State:
    """The saved states with those of this phase written in: from its start to its end, both
    included; later ones hold its end."""
    here, later = ((ts >= run.t) & (ts <= outcome.t))[:, None], (ts > outcome.t)[:, None]
    q = jnp.where(here, outcome.ys.q, jnp.where(later, end_state.q[None], run.saved.q))
    v = jnp.where(here, outcome.ys.v, jnp.where(later, end_state.v[None], run.saved.v))

    def write(new, old):
        return jnp.where((ts >= run.t).reshape(-1, *(1,) * new.ndim), new[None], old)

    return State(q, v, jax.tree.map(write, end_state.structure, run.saved.structure))
