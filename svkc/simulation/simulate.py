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
    options, save_at, made = prepare_options(
        chain, state, t0, t1, ts=ts, events=events, control=control, dt=dt, rtol=rtol, atol=atol,
        solver=solver, stepsize_controller=stepsize_controller, stabilization=stabilization,
        dynamics=dynamics, adjoint=adjoint, max_events=max_events, max_steps=max_steps,
        progress_meter=progress_meter,
    )  # fmt: skip
    dtype = state.q.dtype
    given = chain, state, jnp.asarray(t0, dtype), jnp.asarray(t1, dtype), save_at
    run = lambda control, events: _run(
        *given, _with(made, guards=events), _with(options, control=control), args
    )
    run = call_with_comparable(run, control=options.control, events=made.guards)
    certified = _certified_once if len(save_at) <= MAX_EAGER_STATES else _certified
    traj = certified(
        chain, run, save_at, given[3], options.gap_tolerance, evaluations_per_step(options.solver)
    )
    return _raised(chain, traj) if throw else traj


def _raised(chain: Chain, traj: Trajectory) -> Trajectory:
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
def _run(chain: Chain, state: State, t0, t1, ts, made: Plan, options: Options, args) -> RunState:
    made, options = _closure_convert(chain, state, t0, made, options, args)
    run = _start(chain, state, t0, ts, made, options)

    def phase(run: RunState, index):
        return _phase(chain, run, index, (t1, ts), made=made, options=options, args=args), None

    if options.max_events == 0:
        run, _ = phase(run, jnp.asarray(0))
    else:
        run, _ = jax.lax.scan(phase, run, jnp.arange(options.max_events + 1))
    return run


def _with_certificate(
    chain: Chain, run: RunState, ts, t1, most: float, evaluations: int
) -> Trajectory:
    """Return the run with its certificate. most: the largest gap of a closed loop; evaluations: of
    the field in one try of a step."""
    short = (run.t < t1) & (run.result == RESULTS.successful)
    result = RESULTS.where(short, RESULTS.max_events, run.result)
    phases, saved, lost = certificate(chain, run.records, run.count, run.saved, evaluations)
    worst = jnp.maximum(jnp.max(saved.gap), jnp.max(phases.gap))
    result = RESULTS.where(
        (result == RESULTS.successful) & (worst > most), RESULTS.loop_open, result
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
_certified, _certified_once = (
    eqx.filter_jit(_with_certificate),
    eager_jit(_with_certificate, eqx.filter_jit),
)


def _closure_convert(
    chain: Chain, state: State, t0, made: Plan, options: Options, args
) -> tuple[Plan, Options]:
    """Control and guards with all that they close over as their leaves, so that it can be
    differentiated."""
    state = _lockable(chain, state, made)
    guards = tuple(g.closure_convert(t0, state, args) for g in made.guards)
    control = options.control
    control = None if control is None else ClosureConverted.from_function(control, t0, state, args)
    return _with(made, guards=guards), _with(options, control=control)


def _with(node, **changed):
    return dataclasses.replace(node, **changed)


def _lockable(chain: Chain, state: State, made: Plan) -> State:
    if not made.has_locks or state.structure.locked is not None:
        return state
    return eqx.tree_at(
        lambda s: s.structure.locked,
        state,
        jnp.zeros(chain.dofs, bool),
        is_leaf=lambda x: x is None,
    )


def _start(chain: Chain, state: State, t0, ts, made: Plan, options: Options) -> RunState:
    """Empty records, sized by capacity; unwritten entries show: inf, -1."""
    links, rows, dtype = len(chain.link_names), options.max_events, state.q.dtype
    state = _lockable(chain, state, made)
    # an overload from the start is a crossing; guards that need no torques are evaluated at the
    # start of the phase
    initial = [g.initial_value for g in made.guards]
    return RunState(
        t=t0,
        state=state,
        work=jnp.zeros((), dtype) if options.has_work else None,
        guards=jnp.asarray(initial, dtype) if made.guards else None,
        stale=jnp.asarray(reevaluated_guards(made)) if made.guards else None,
        pending=jnp.ones(len(made.timed), bool),
        events=empty_events(rows, links, dtype),
        records=empty_phase_records(rows + 1, state),
        count=jnp.asarray(0, jnp.int32),
        saved=jax.tree.map(lambda x: jnp.broadcast_to(x[None], (ts.shape[0], *x.shape)), state),
        result=RESULTS.successful,
        derivative=RESULTS.successful,
        invalid_from=jnp.asarray(rows + 1, jnp.int32),
    )  # fmt: skip


def _next_stop(run: RunState, t1, made: Plan):
    """Return the time at which the next phase ends at the latest: that of the next event, or t1.

    Of two equal times the one taken is differentiated: the event's where it is t1, and t1 where the
    run is there already.
    """
    next_time = jnp.min(jnp.where(run.pending, made.times, jnp.inf), initial=jnp.inf)
    stop = jnp.where(next_time <= t1, next_time, t1)
    return jnp.where((stop < run.t) | (run.result != RESULTS.successful), run.t, stop)


def _phase(
    chain: Chain, run: RunState, index, times, *, made: Plan, options: Options, args
) -> RunState:
    """One solve, the events at its end, and the records of both. times: the end and the save
    times."""
    t1, ts = times
    run = _with_guards(chain, run, made, options, args)
    going = (run.t < t1) | jnp.any(run.pending & (made.times <= t1))
    going = going & (run.result == RESULTS.successful)
    stop = _next_stop(run, t1, made)
    solved = solve_phase(run, stop, ts, made, options, FieldArgs(chain, run.state.structure, args))
    reached = going & (solved.result == RESULTS.successful)
    timed = run.pending & (made.times <= solved.t + event_tolerance(solved.t)) & reached
    fired = (
        jnp.zeros(len(made.actions), bool)
        .at[np.array(made.timed + made.guarded, int)]
        .set(jnp.concatenate([timed, solved.fired & reached]))
    )
    ended = State(solved.motion.q, solved.motion.v, run.state.structure)
    saved = _save(run, ended, solved, ts)
    row = (jnp.arange(run.records.start.shape[0]) == index) & going
    work = jnp.zeros_like(run.t) if run.work is None else solved.motion.work - run.work
    records = write_phase_row(
        run.records, row, (run.t, run.state), (solved.t, ended), work, solved.path
    )
    count = run.count + going.astype(jnp.int32)
    derivative, invalid_from = _derivative(run, solved, going, timed, index)
    after, events, result = ended, run.events, solved.result
    if made.actions:
        after, events, result = apply_events(chain, run, ended, solved, fired, made)
    result = RESULTS.where(run.result == RESULTS.successful, result, run.result)
    # a guard that rests at zero after it fired keeps its value
    stale = (
        jnp.asarray(reevaluated_guards(made)) & jnp.any(fired) & (solved.guards != 0)
        if made.guards
        else None
    )
    return RunState(
        t=solved.t,
        state=after,
        work=solved.motion.work,
        guards=solved.guards,
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


def _derivative(
    run: RunState, solved: PhaseOutcome, going, timed: Bool[Array, " timed"], index
) -> tuple[RESULTS, Int[Array, ""]]:
    """Return the first reason why the run has no derivative, and the index of its phase. Ranks are
    checked after the run."""
    code = RESULTS.where(
        jnp.sum(solved.fired) + jnp.sum(timed) > 1, RESULTS.together, solved.derivative
    )
    first = (run.derivative == RESULTS.successful) & going & (code != RESULTS.successful)
    return RESULTS.where(first, code, run.derivative), jnp.where(
        first, index.astype(jnp.int32), run.invalid_from
    )


def _with_guards(chain: Chain, run: RunState, made: Plan, options: Options, args) -> RunState:
    """Return the run with its stale guards re-evaluated at the start of a phase."""
    if not made.guards or not reevaluated_guards(made).any():
        return run
    scene = FieldArgs(chain, run.state.structure, args)
    now = stop_gradient_tree(GuardValues(made, options.field))(
        *stop_gradient_tree((run.t, ODEState(run.state.q, run.state.v), scene))
    )
    return dataclasses.replace(run, guards=jnp.where(run.stale, now, run.guards))


def _save(run: RunState, ended: State, solved: PhaseOutcome, ts) -> State:
    """The saved states with those of this phase written in: from its start to its end, both
    included; later ones hold its end."""
    here, later = ((ts >= run.t) & (ts <= solved.t))[:, None], (ts > solved.t)[:, None]
    q = jnp.where(here, solved.saved.q, jnp.where(later, ended.q[None], run.saved.q))
    v = jnp.where(here, solved.saved.v, jnp.where(later, ended.v[None], run.saved.v))

    def write(new, old):
        return jnp.where((ts >= run.t).reshape(-1, *(1,) * new.ndim), new[None], old)

    return State(q, v, jax.tree.map(write, ended.structure, run.saved.structure))
