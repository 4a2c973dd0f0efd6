"""The scan over the phases of a run: its initial state and its body.

The body integrates one phase and applies the events at the end of the phase.
"""

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from svkc._jax.pytrees import stop_gradient_tree
from svkc._jax.select import where
from svkc.integration.event_location import GuardValues, event_tolerance
from svkc.integration.ode import ODEState, Times
from svkc.integration.vector_field import phase_field_args
from svkc.model.chain import Chain, State
from svkc.simulation.apply_events import apply_events, reevaluated_guards
from svkc.simulation.codes import DERIVATIVE, RESULTS
from svkc.simulation.options import Options
from svkc.simulation.phase import PhaseOutcome, RunState, solve_phase
from svkc.simulation.records import empty_events, empty_phase_records, write_phase_row
from svkc.simulation.traced_checks import initial_result
from svkc.transitions.event_schedule import EventSchedule, armed_guards
from svkc.transitions.plan import Plan, guard_round_off


def with_lock_mask(chain: Chain, state: State, plan: Plan) -> State:
    """Return the state with a mask of locked joints if an event locks or unlocks joints.

    The state then has one pytree structure throughout the run.
    """
    if not plan.has_locks or state.structure.locked is not None:
        return state
    return eqx.tree_at(
        lambda s: s.structure.locked,
        state,
        jnp.zeros(chain.dofs, bool),
        is_leaf=lambda x: x is None,
    )


def initial_run_state(
    chain: Chain, state: State, times: Times, plan: Plan, options: Options
) -> RunState:
    """Return the state of a run before its first phase, with empty records.

    times: start, end and save times.
    """
    t0, _, ts = times
    links, rows, dtype = len(chain.link_names), options.max_events, state.q.dtype
    state = with_lock_mask(chain, state, plan)
    # A link that is overloaded at the start breaks at once, by its guard's initial value. Guards
    # that need no torques are zero, on neither side, until the first phase re-evaluates them.
    initial = [g.initial_value if g.needs_torques else 0.0 for g in plan.guards]
    return RunState(
        t=t0,
        state=state,
        work=jnp.zeros(3, dtype) if options.has_work else None,
        guard_values=jnp.asarray(initial, dtype) if plan.guards else None,
        stale=jnp.asarray(reevaluated_guards(plan)) if plan.guards else None,
        schedule=EventSchedule.at_start(plan),
        first_step=options.first_step,
        unsaved=jnp.ones((), bool),
        events=empty_events(rows, links, dtype),
        records=empty_phase_records(rows + 1, state),
        count=jnp.asarray(0, jnp.int32),
        saved=jax.tree.map(lambda x: jnp.broadcast_to(x[None], (ts.shape[0], *x.shape)), state),
        saved_work=jnp.zeros((ts.shape[0], 3), dtype) if options.has_work else None,
        result=initial_result(chain, times, plan, options),
        derivative=DERIVATIVE.successful,
        invalid_from=jnp.asarray(rows + 1, jnp.int32),
    )  # fmt: skip


def _reevaluate_stale_guards(
    chain: Chain, run: RunState, plan: Plan, options: Options, args
) -> RunState:
    """Return the run with its stale guards re-evaluated at the start of a phase.

    A value within round-off of zero has an arbitrary sign. Such a guard keeps the value that
    `_guard_values_after` returned: usually zero, from which a guard cannot cross zero.
    """
    if not plan.guards or not reevaluated_guards(plan).any():
        return run
    field_args = phase_field_args(chain, run.state.structure, args, options.field)
    assert run.stale is not None
    assert run.guard_values is not None
    values = stop_gradient_tree(GuardValues(plan, options.field))(
        *stop_gradient_tree((run.t, ODEState(run.state.q, run.state.v), field_args))
    )
    at_zero = jnp.abs(values) < guard_round_off(values.dtype)
    values = where(at_zero, run.guard_values, values)
    return replace(run, guard_values=where(run.stale, values, run.guard_values))


def _guard_values_after(
    chain: Chain, run: RunState, outcome: PhaseOutcome, fired: Bool[Array, " events"], plan: Plan
):
    """Return the values of the guards after a phase, and which of them are stale.

    The value of a stale guard becomes zero, unless the guard may be about to cross zero. Such a
    guard is armed and within round-off of zero. If a guard ended the phase, it must also be on the
    side of zero on which it started the phase: on the other side it has just crossed zero, as a
    second guard does that has the same function as the guard that fired.
    """
    if not plan.guards:
        return None, None
    values, before = outcome.guard_values, run.guard_values
    assert values is not None
    assert before is not None
    # A guard that is exactly zero, as after its own event, remains zero without re-evaluation.
    stale = jnp.asarray(reevaluated_guards(plan)) & jnp.any(fired) & (values != 0)
    at_zero = jnp.abs(values) < guard_round_off(values.dtype)
    on_first_side = jnp.sign(values) == jnp.sign(before)
    may_cross = at_zero & (on_first_side | ~jnp.any(outcome.fired))
    may_cross = may_cross & armed_guards(chain, run.state.structure, plan, run.schedule)
    return where(stale & ~may_cross, 0, values), stale


def _first_step_after(run: RunState, outcome: PhaseOutcome) -> Float[Array, ""]:
    """Return the size of the first step after a phase (s).

    It is half of the size proposed at the end of the phase, as the change may shorten the steps. A
    phase without a step changes nothing.
    """
    proposed = outcome.solution.proposed_step
    if proposed is None:
        return run.first_step
    return where(outcome.solution.accepted > 0, proposed / 2, run.first_step)


def _next_stop(run: RunState, t1):
    """Return the scheduled end of the next phase: the time of the next timed event, or t1.

    If the time of an event equals t1, derivatives are by the time of the event, not by t1. A run
    that has ended keeps its time, so that its phases have zero length.
    """
    next_time = run.schedule.next_time()
    stop = where(next_time <= t1, next_time, t1)
    return where((stop < run.t) | (run.result != RESULTS.successful), run.t, stop)


def has_next_phase(run: RunState, t1) -> Bool[Array, ""]:
    """Return whether the run has another phase.

    The run has neither failed nor stopped, and it is before its end or a timed event is due.
    """
    unfinished = (run.t < t1) | jnp.any(run.schedule.due(t1))
    return unfinished & (run.result == RESULTS.successful)


def needs_phase(run: RunState, t1) -> Bool[Array, ""]:
    """Return whether `run_phase` changes the records, the saved states or their derivatives.

    In a run of no length a phase of zero length gives the saved states their derivatives by t1 and
    the save times. After an event at the end of a run, such a phase saves the state.
    """
    return has_next_phase(run, t1) | run.unsaved


def run_phase(
    chain: Chain, run: RunState, index: Any, times: Any, *, plan: Plan, options: Options, args: Any
) -> RunState:  # fmt: skip
    """Integrate one phase, apply the events at its end, and write the records of both.

    index: index of the phase.
    times: end of the run, and the save times.
    """
    t1, ts = times
    active = has_next_phase(run, t1)
    run = _reevaluate_stale_guards(chain, run, plan, options, args)
    stop = _next_stop(run, t1)
    field_args = phase_field_args(chain, run.state.structure, args, options.field)
    outcome = solve_phase(run, stop, ts, plan, options, field_args)
    timed, fired = _fired_events(run, outcome, active, t1, plan)
    end_state = State(outcome.y.q, outcome.y.v, run.state.structure)
    saved, saved_work = _write_saved_states(run, end_state, outcome, ts)
    row = (jnp.arange(run.records.start.shape[0]) == index) & active
    work = jnp.zeros_like(run.t)
    if run.work is not None and outcome.y.work is not None:
        work = jnp.sum(outcome.y.work - run.work)
    records = write_phase_row(
        run.records, row, (run.t, run.state), (outcome.t, end_state), work, outcome.solution
    )
    derivative, invalid_from = _check_derivative(run, outcome, active, timed, index)
    after, events, result = end_state, run.events, outcome.result
    if plan.actions:
        after, events, result = apply_events(
            chain, run, end_state, outcome, fired, plan, gap_tolerance=options.gap_tolerance
        )
    result = RESULTS.where(run.result == RESULTS.successful, result, run.result)
    guard_values, stale = _guard_values_after(chain, run, outcome, fired, plan)
    return RunState(
        t=outcome.t,
        state=after,
        work=outcome.y.work,
        guard_values=guard_values,
        stale=stale,
        schedule=run.schedule.advance(plan, outcome.t, fired, timed),
        first_step=_first_step_after(run, outcome),
        unsaved=jnp.any(fired),
        events=events,
        records=records,
        count=run.count + active.astype(jnp.int32),
        saved=saved,
        saved_work=saved_work,
        result=result,
        derivative=derivative,
        invalid_from=invalid_from,
    )


def _fired_events(run: RunState, outcome: PhaseOutcome, active, t1, plan: Plan):
    """Return the mask of the timed events, and that of all events, that fired after a phase.

    Events after t1 by more than round-off do not happen.
    """
    reached = active & (outcome.result == RESULTS.successful)
    latest = t1 + 8 * jnp.finfo(t1.dtype).eps * jnp.maximum(1, jnp.abs(t1))
    due_until = jnp.minimum(outcome.t + event_tolerance(outcome.t), latest)
    timed = run.schedule.due(due_until) & reached
    indices = np.array(plan.timed + plan.guarded, int)
    fired = jnp.concatenate([timed, outcome.fired & reached])
    return timed, jnp.zeros(len(plan.actions), bool).at[indices].set(fired)


def _check_derivative(
    run: RunState, outcome: PhaseOutcome, active, timed: Bool[Array, " timed"], index
) -> tuple[DERIVATIVE, Int[Array, ""]]:
    """Return the run's first `DERIVATIVE` other than successful, and the index of its phase.

    The rank of the loops is not checked here, but by the certificate after the run.

    active: whether the run had not ended before this phase.
    timed: mask of the timed events that fired.
    """
    code = DERIVATIVE.where(
        jnp.sum(outcome.fired) + jnp.sum(timed) > 1, DERIVATIVE.together, outcome.derivative
    )
    first = (run.derivative == DERIVATIVE.successful) & active & (code != DERIVATIVE.successful)
    return DERIVATIVE.where(first, code, run.derivative), where(
        first, index.astype(jnp.int32), run.invalid_from
    )


def _write_saved_states(
    run: RunState, end_state: State, outcome: PhaseOutcome, ts
) -> tuple[State, Float[Array, "times 3"] | None]:
    """Return the saved states, and the saved work, with those of a phase written.

    They are at the save times from its start to its end, both included. Rows of later save times
    hold the state and the work at its end until a later phase overwrites them.
    """
    within, later = ((ts >= run.t) & (ts <= outcome.t))[:, None], (ts > outcome.t)[:, None]
    rows = lambda at_saves, at_end, old: where(within, at_saves, where(later, at_end[None], old))
    q = rows(outcome.ys.q, end_state.q, run.saved.q)
    v = rows(outcome.ys.v, end_state.v, run.saved.v)
    work = None
    if run.saved_work is not None:
        work = rows(outcome.ys.work, outcome.y.work, run.saved_work)

    def write(new, old):
        return where((ts >= run.t).reshape(-1, *(1,) * new.ndim), new[None], old)

    return State(q, v, jax.tree.map(write, end_state.structure, run.saved.structure)), work
