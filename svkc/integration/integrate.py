"""Integrate one phase; if a guard changes sign, locate the root by re-taking that step.

One loop takes the steps and locates the root, so that its program holds the vector field, the
stages of the solver and the projection once. Nothing in this module is differentiated.
"""

import dataclasses
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
from jaxtyping import Array

from svkc._jax.control_flow import while_loop
from svkc._jax.pytrees import tree_where
from svkc.integration.dense_output import ProjectedInterpolation, make_interpolation
from svkc.integration.event_location import EventSearch, event_info
from svkc.integration.guard_scan import locate_event
from svkc.integration.near_singular import redone_if_near, with_rows_of_projection
from svkc.integration.ode import ODEState, Times, is_finite, rms_norm
from svkc.integration.runge_kutta import increments_of_stages, initial_records
from svkc.integration.solution import (
    EVENT,
    LOOP_OPEN,
    MAX_STEPS,
    NON_FINITE,
    SUCCESSFUL,
    PhaseProblem,
    PhaseSolution,
    Stats,
    StepAttempt,
    StepperOptions,
    StepperState,
    update_stats,
)
from svkc.integration.stabilization import needs_projection
from svkc.integration.step_buffers import write_record, write_row, write_states
from svkc.integration.step_size import (
    clip_step,
    unclipped_step_size,
)
from svkc.integration.vector_field import initial_projection_info, project_state


def integrate_phase(
    start: ODEState, times: Times, problem: PhaseProblem, options: StepperOptions
) -> PhaseSolution:
    """Integrate one phase to its scheduled end, or to the first event.

    times: start, scheduled end and save times.
    """
    _, stop, save_ts = times
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
    ys = end.ys
    if save_ts.shape[0]:  # of equal save times, the loop writes the first row alone
        ys = jax.tree.map(lambda x: x[jnp.searchsorted(save_ts, save_ts)], ys)
    event, stopped = None, jnp.where(end.t < stop, MAX_STEPS, SUCCESSFUL)
    if options.armed_guards is not None:
        assert end.search is not None
        assert end.guard_values is not None
        event = event_info(end.search, end.guard_values, end.t)
        stopped = jnp.where(event.occurred, EVENT, stopped)
    result = jnp.where(end.result == SUCCESSFUL, stopped, end.result)
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


def _attempt_step(
    s: StepperState, t1, problem: PhaseProblem, options: StepperOptions
) -> StepAttempt:
    """Take one step of the solver to t1, project it, and let the controller judge its error."""
    field, field_args, controller = problem.field, problem.field_args, options.controller
    term = diffrax.ODETerm(field)
    # After a projection the FSAL derivative is stale: re-evaluate.
    stale = needs_projection(field.stabilization, field_args.chain) or s.made_jump
    y_solver, error, dense_info, solver_state, solver_result = options.solver.step(
        term, s.t, t1, s.y, field_args, s.solver_state, made_jump=stale
    )
    y, info = project_state(field, field_args, y_solver)
    failure = jnp.where(ok := is_finite(y), LOOP_OPEN, NON_FINITE)
    if info is not None:
        ok = ok & (jnp.max(info.gap) <= options.gap_tolerance)
    error = jax.tree.map(lambda x: jnp.where(ok & jnp.isfinite(x), x, jnp.inf), error)
    keep_step, t, proposed, made_jump, controller_state, controller_result = (
        controller.adapt_step_size(
            s.t,
            t1,
            s.y,
            y,
            field_args,
            error,
            error_order=options.solver.error_order(term),
            controller_state=s.controller_state,
        )
    )
    failed = jnp.asarray(keep_step) & (solver_result._value != SUCCESSFUL)
    result = jnp.where(failed, solver_result._value, controller_result._value)
    # A step that is not ok ends the phase if the controller keeps it or has no shorter one.
    result = jnp.where(~ok & (keep_step | (result != SUCCESSFUL)), failure, result)
    return StepAttempt(
        t=t,
        y=y,
        keep_step=keep_step & ok,
        closed=ok,
        step_size=unclipped_step_size(
            controller, keep_step, t1 - s.t, proposed=proposed - t, before=s.step_size
        ),
        made_jump=jnp.asarray(made_jump),
        solver_state=solver_state,
        controller_state=controller_state,
        result=result.astype(jnp.int32),
        error_norm=jnp.asarray(jnp.inf, t.dtype) if error is None else rms_norm(error),
        projection_info=info,
        interpolation=_interpolation((s.t, t1), dense_info, y, y_solver, options),
        increments=increments_of_stages(options.solver, dense_info),
    )


def _interpolation(
    step: tuple[Array, Array],
    dense_info: Any,
    y: ODEState,
    y_solver: ODEState,
    options: StepperOptions,
) -> ProjectedInterpolation | None:
    """Return the dense output of a step, None where there are no guards.

    step: its start and end.
    dense_info: what the solver's step returned for the dense output.
    y, y_solver: the end of the step with and without projection.
    """
    if options.armed_guards is None:
        return None
    shift = jax.tree.map(lambda a, b: a - b, y, y_solver)
    cls = options.solver.interpolation_cls
    return make_interpolation(cls, t0=step[0], t1=step[1], inner=dense_info, shift=shift)


def _body_fun(
    s: StepperState, times, problem: PhaseProblem, options: StepperOptions
) -> StepperState:
    """Attempt one step and advance if it is kept; or evaluate the guards once to locate a root."""
    (t0, stop, save_ts), info = times, s.projection_info
    problem = with_rows_of_projection(s, problem)
    t1 = s.tnext if s.search is None else s.search.end_of_attempt(s.tnext)
    attempt, near, redo = redone_if_near(s, _attempt_step(s, t1, problem, options), problem)
    guard_values, search, hold = None, None, jnp.zeros((), bool)
    if s.search is not None:
        attempt, guard_values, search, hold = locate_event(s, attempt, t1, problem, options)
        search = tree_where(redo, s.search, search)
    rejected = (~attempt.keep_step & ~hold) | redo
    hold = hold | redo
    if search is not None:
        rejected = rejected | jnp.isfinite(search.retry_time)
    if_advancing = lambda new, old: tree_where(attempt.keep_step, new, old)
    unless_held = lambda new, old: tree_where(hold, old, new)
    t, accepted = if_advancing(attempt.t, s.t), s.accepted + attempt.keep_step.astype(jnp.int32)
    ys, checkpoints = write_states(s, attempt, t, save_ts, accepted, options.checkpoint_interval)
    result = unless_held(attempt.result, s.result)
    progress = (t - t0) / jnp.where(stop > t0, stop - t0, 1)
    return StepperState(
        # These move when the loop advances.
        t=t,
        y=if_advancing(attempt.y, s.y),
        made_jump=if_advancing(attempt.made_jump, s.made_jump),
        solver_state=if_advancing(attempt.solver_state, s.solver_state),
        guard_values=None if guard_values is None else if_advancing(guard_values, s.guard_values),
        projection_info=if_advancing(attempt.projection_info, info),
        # These stand still while a root is located or a step is divided.
        tnext=unless_held(clip_step(t, t + attempt.step_size, times, options.max_step), s.tnext),
        step_size=unless_held(attempt.step_size, s.step_size),
        controller_state=unless_held(attempt.controller_state, s.controller_state),
        result=result,
        # These are updated by every attempt.
        progress_meter_state=options.progress_meter.step(s.progress_meter_state, progress),
        search=search,
        near=near,
        step_ts=write_row(s.step_ts, s.accepted, t, attempt.keep_step),
        step_near=write_row(s.step_near, s.accepted, s.near, attempt.keep_step),
        checkpoints=checkpoints,
        records=write_record(s, attempt, problem, options.record_capacity),
        ys=ys,
        accepted=accepted,
        rejected=s.rejected + rejected.astype(jnp.int32),
        stats=update_stats(s, attempt, result, problem.field_args),
    )
