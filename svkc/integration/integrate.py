"""Integrate one phase; if a guard changes sign, locate the root by re-taking that step.

One loop takes the steps and locates the root, so that its program holds the vector field, the
stages of the solver and the projection once. Nothing in this module is differentiated.
"""

import dataclasses

import diffrax
import jax
import jax.numpy as jnp

from svkc._jax.control_flow import while_loop
from svkc._jax.select import where
from svkc.integration.event_location import EventSearch, event_info
from svkc.integration.near_singular import with_rows_of_projection
from svkc.integration.ode import ODEState, Times
from svkc.integration.runge_kutta import initial_records
from svkc.integration.solution import (
    EVENT,
    MAX_STEPS,
    SUCCESSFUL,
    PhaseProblem,
    PhaseSolution,
    Stats,
    StepperOptions,
    StepperState,
    StepRecord,
)
from svkc.integration.step_attempt import attempt_and_advance
from svkc.integration.step_buffers import write_record, write_row, write_states
from svkc.integration.step_size import clip_step
from svkc.integration.vector_field import initial_projection_info


def integrate_phase(
    start: ODEState, times: Times, problem: PhaseProblem, options: StepperOptions
) -> PhaseSolution:
    """Integrate one phase to its scheduled end, or to the first event.

    times: start, scheduled end and save times.
    """
    stop = times[1]
    problem = PhaseProblem(
        problem.field_args, dataclasses.replace(problem.field, differentiated=False)
    )

    def cond_fun(s: StepperState):
        unfinished = (s.t < stop) & (s.accepted + s.rejected < options.max_steps)
        if s.search is not None:
            unfinished = (unfinished | s.search.active) & ~s.search.done
        return unfinished & (s.result == SUCCESSFUL)

    end = while_loop(
        cond_fun,
        lambda s: _body_fun(s, times, problem, options),
        _init_stepper(start, times, problem, options),
        buffers=lambda s: (s.step_ts, s.step_near, s.checkpoints, s.records, s.ys),
        kind="lax",
    )
    options.progress_meter.close(end.progress_meter_state)
    return _solution(end, times, options)


def _solution(end: StepperState, times: Times, options: StepperOptions) -> PhaseSolution:
    """Return the solution of a phase from the state of the stepping loop at its end."""
    (_, stop, save_ts), ys = times, end.ys
    if save_ts.shape[0]:  # of equal save times, the loop writes the first row alone
        ys = jax.tree.map(lambda x: x[jnp.searchsorted(save_ts, save_ts)], ys)
    event, stopped = None, where(end.t < stop, MAX_STEPS, SUCCESSFUL)
    if options.armed_guards is not None:
        assert end.search is not None
        assert end.guard_values is not None
        event = event_info(end.search, end.guard_values, end.t)
        stopped = where(event.occurred, EVENT, stopped)
    result = where(end.result == SUCCESSFUL, stopped, end.result)
    return PhaseSolution(
        t=end.t,
        y=end.y,
        ys=ys,
        step_ts=end.step_ts,
        step_near=end.step_near,
        checkpoints=end.checkpoints,
        records=end.records,
        accepted=end.accepted,
        rejected=end.rejected,
        result=result.astype(jnp.int32),
        stats=end.stats,
        event=event,
        proposed_step=end.step_size,
    )


def _init_stepper(
    start: ODEState, times, problem: PhaseProblem, options: StepperOptions
) -> StepperState:
    """Return the state of the stepping loop before the first step."""
    (t0, stop, save_ts), field, field_args = times, problem.field, problem.field_args
    term, zero = diffrax.ODETerm(field), jnp.zeros((), jnp.int32)
    t1, controller_state = options.controller.init(
        term,
        t0,
        stop,
        start,
        options.first_step,
        field_args,
        func=options.solver.func,
        error_order=options.solver.error_order(term),
    )
    rows = lambda n: jax.tree.map(lambda x: jnp.broadcast_to(x[None], (n, *x.shape)), start)
    info = initial_projection_info(field, field_args, start.q)
    near = None if field_args.row_choice is None else field_args.row_choice.near
    guard_values, search = None, None
    if options.armed_guards is not None:
        guard_values = options.armed_guards.initial_values
        search = EventSearch.inactive(t0, start, guard_values)
    return StepperState(
        t=t0,
        y=start,
        tnext=clip_step(t0, t1, times, options.max_step),
        step_size=t1 - t0,
        made_jump=jnp.zeros((), bool),
        solver_state=options.solver.init(term, t0, t1, start, field_args),
        controller_state=controller_state,
        progress_meter_state=options.progress_meter.init(),
        guard_values=guard_values,
        search=search,
        near=near,
        step_ts=jnp.full(options.max_steps, jnp.inf, t0.dtype),
        step_near=None if near is None else jnp.zeros(options.max_steps, bool),
        checkpoints=rows(options.max_steps // options.checkpoint_interval),
        records=initial_records(options.solver, field_args, start, options.record_capacity),
        ys=rows(save_ts.shape[0]),
        accepted=zero,
        rejected=zero,
        result=jnp.asarray(SUCCESSFUL, jnp.int32),
        stats=Stats.zeros(
            t0.dtype,
            counts_swaps=info is not None and info.pivots is not None,
            counts_reduced_steps=near is not None,
        ),
        projection_info=info,
    )


def _body_fun(
    s: StepperState, times, problem: PhaseProblem, options: StepperOptions
) -> StepperState:
    """Attempt one step, and write the buffers and the progress meter."""
    before = _without_buffers(s)
    after, increments = attempt_and_advance(before, times, problem, options)
    (t0, stop, save_ts), kept = times, after.accepted > s.accepted
    ys, checkpoints = write_states(s, after, save_ts, options.checkpoint_interval)
    progress = (after.t - t0) / where(stop > t0, stop - t0, 1)
    # again, so that the kernel of the attempt need not return the rows
    row_choice = with_rows_of_projection(before, problem).field_args.row_choice
    record, to_record = StepRecord(increments, row_choice), kept
    if after.search is not None:
        # The last attempt of a search ends after the event. The step to the event was attempted
        # before it, and its record is kept.
        to_record = (kept & ~after.search.done) | after.search.is_new
    return dataclasses.replace(
        after,
        progress_meter_state=options.progress_meter.step(s.progress_meter_state, progress),
        step_ts=write_row(s.step_ts, s.accepted, after.t, kept),
        step_near=write_row(s.step_near, s.accepted, s.near, kept),
        checkpoints=checkpoints,
        records=write_record(s, record, to_record, options.record_capacity),
        ys=ys,
    )


def _without_buffers(s: StepperState) -> StepperState:
    """Return the state of the loop without what `_body_fun` itself updates.

    These are the buffers, which are written in place, and the state of the progress meter.
    """
    without = ("step_ts", "step_near", "checkpoints", "records", "ys", "progress_meter_state")
    return dataclasses.replace(s, **dict.fromkeys(without))
