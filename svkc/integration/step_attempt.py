"""One attempted step, its acceptance, and the state of the stepping loop after it.

Nothing in this module is differentiated.
"""

import dataclasses
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from svkc._jax.one_kernel import one_kernel
from svkc._jax.pytrees import tree_where
from svkc._jax.select import where
from svkc.integration.dense_output import ProjectedInterpolation, make_interpolation
from svkc.integration.guard_scan import locate_event
from svkc.integration.near_singular import redone_if_near, with_rows_of_projection
from svkc.integration.ode import ODEState, Times, is_finite, rms_norm
from svkc.integration.runge_kutta import increments_of_stages
from svkc.integration.solution import (
    LOOP_OPEN,
    NON_FINITE,
    SUCCESSFUL,
    PhaseProblem,
    StepAttempt,
    StepperOptions,
    StepperState,
    update_stats,
)
from svkc.integration.stabilization import needs_projection
from svkc.integration.step_size import clip_step, unclipped_step_size
from svkc.integration.vector_field import project_state


@one_kernel
def attempt_and_advance(
    s: StepperState, times: Times, problem: PhaseProblem, options: StepperOptions
) -> tuple[StepperState, ODEState | None]:
    """Attempt one step, and advance if it is kept. While a root is located, the step is one more
    evaluation of the guards.

    Return the state of the loop after the attempt, and the increments of its `StepRecord` if steps
    are recorded. Neither `s` nor the result has buffers, which a kernel would copy.
    """
    problem = with_rows_of_projection(s, problem)
    t1 = s.tnext if s.search is None else s.search.end_of_attempt(s.tnext)
    attempt, near, redo = redone_if_near(s, _attempt_step(s, t1, problem, options), problem)
    guard_values, search, hold = None, None, jnp.zeros((), bool)
    if s.search is not None:
        attempt, guard_values, search, hold = locate_event(s, attempt, t1, problem, options)
        is_new = search.is_new & ~redo
        search = dataclasses.replace(tree_where(redo, s.search, search), is_new=is_new)
    after = _state_after(s, attempt, hold | redo, times, options)
    rejected = (~attempt.keep_step & ~hold) | redo
    if search is not None:
        rejected = rejected | jnp.isfinite(search.retry_time)
        guard_values = tree_where(attempt.keep_step, guard_values, s.guard_values)
    after = dataclasses.replace(
        after,
        guard_values=guard_values,
        search=search,
        near=near,
        rejected=s.rejected + rejected.astype(jnp.int32),
        stats=update_stats(s, attempt, after.result, problem.field_args),
    )
    return after, attempt.increments if options.record_capacity else None


def _state_after(
    s: StepperState,
    attempt: StepAttempt,
    hold: Bool[Array, ""],
    times: Times,
    options: StepperOptions,
) -> StepperState:
    """Return the state of the loop after an attempt, except for guards, counts and statistics.

    hold: whether the size of the next step and the controller are unchanged, because a root is
        located, or a step is divided or redone.
    """
    if_advancing = lambda new, old: tree_where(attempt.keep_step, new, old)
    unless_held = lambda new, old: tree_where(hold, old, new)
    t = if_advancing(attempt.t, s.t)
    return dataclasses.replace(
        s,
        # These change when a step is kept.
        t=t,
        accepted=s.accepted + attempt.keep_step.astype(jnp.int32),
        y=if_advancing(attempt.y, s.y),
        made_jump=if_advancing(attempt.made_jump, s.made_jump),
        solver_state=if_advancing(attempt.solver_state, s.solver_state),
        projection_info=if_advancing(attempt.projection_info, s.projection_info),
        # These are unchanged while a root is located, or a step is divided or redone.
        tnext=unless_held(clip_step(t, t + attempt.step_size, times, options.max_step), s.tnext),
        step_size=unless_held(attempt.step_size, s.step_size),
        controller_state=unless_held(attempt.controller_state, s.controller_state),
        result=unless_held(attempt.result, s.result),
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
    failure = where(ok := is_finite(y), LOOP_OPEN, NON_FINITE)
    if info is not None:
        ok = ok & (jnp.max(info.gap) <= options.gap_tolerance)
    error = jax.tree.map(lambda x: where(ok & jnp.isfinite(x), x, jnp.inf), error)
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
    result = where(failed, solver_result._value, controller_result._value)
    # A step that is not ok ends the phase if the controller keeps it or has no shorter one.
    result = where(~ok & (keep_step | (result != SUCCESSFUL)), failure, result)
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
