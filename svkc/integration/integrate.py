"""The steps of one phase: forward until its end, or until a guard has gone through zero; then, from
the same step's begin, to where it was zero.

One loop does both, so that a program holds the field, the solver's stages and the way back onto the
loops once. Nothing here is differentiated.
"""

import dataclasses

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from svkc._jax.control_flow import buffer_at_set, while_loop
from svkc._jax.pytrees import tree_where
from svkc.integration.event_location import Bracket, EventSearch, event_info, update_search
from svkc.integration.ode import ODEState, is_finite, rms_norm
from svkc.integration.solution import (
    EVENT,
    LOOP_OPEN,
    MAX_STEPS,
    NON_FINITE,
    PROJECTION_ERROR_WEIGHT,
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
from svkc.integration.step_size import MAX_STRETCH
from svkc.integration.vector_field import ProjectionInfo, project_state


def integrate_phase(
    start: ODEState, times, world: PhaseProblem, how: StepperOptions
) -> PhaseSolution:
    """From times = (t0, stop, save times) to `stop`, or to where a guard was zero first."""
    _, stop, at = times
    world = PhaseProblem(world.field_args, dataclasses.replace(world.field, differentiated=False))

    def going(s: StepperState):
        more = (s.t < stop) & (s.accepted + s.rejected < how.max_steps)
        if s.search is not None:
            more = (more | s.search.active) & ~s.search.done
        return more & (s.result == SUCCESSFUL)

    begin, buffers = (
        _init_stepper(start, times, world, how),
        lambda s: (s.step_ts, s.checkpoints, s.ys),
    )
    end = while_loop(
        going, lambda s: _body_fun(s, times, world, how), begin, buffers=buffers, kind="lax"
    )
    how.progress_meter.close(end.progress_meter_state)
    # of times that are equal the first one's row is written
    saved = jax.tree.map(lambda x: x[jnp.searchsorted(at, at)], end.ys) if at.shape[0] else end.ys
    short = jnp.where(end.t < stop, MAX_STEPS, SUCCESSFUL)
    fired = None if how.armed_guards is None else event_info(end.search, end.guard_values, end.t)
    if fired is not None:
        short = jnp.where(fired.occurred, EVENT, short)
    result = jnp.where(end.result == SUCCESSFUL, short, end.result)
    return PhaseSolution(
        t=end.t,
        y=end.y,
        ys=saved,
        step_ts=end.step_ts,
        checkpoints=end.checkpoints,
        accepted=end.accepted,
        rejected=end.rejected,
        result=result.astype(jnp.int32),
        stats=end.stats,
        event=fired,
    )


def _init_stepper(start: ODEState, times, world: PhaseProblem, how: StepperOptions) -> StepperState:
    t0, stop, at = times
    term, no, zero = diffrax.ODETerm(world.field), jnp.zeros((), bool), jnp.zeros((), jnp.int32)
    first, controller = how.controller.init(
        term,
        t0,
        stop,
        start,
        how.first_step,
        world.field_args,
        func=how.solver.func,
        error_order=how.solver.error_order(term),
    )
    rows = lambda n: jax.tree.map(lambda x: jnp.broadcast_to(x[None], (n, *x.shape)), start)
    values, search, seen = (
        None,
        None,
        ProjectionInfo.initial(world.field, world.field_args, start.q),
    )
    if how.armed_guards is not None:
        values = how.armed_guards.initial_values
        search = EventSearch(
            step_size=t0,
            sides=jnp.zeros_like(values),
            magnitudes=values,
            bracket=Bracket.around(t0, t0, t0, t0),
            y=start,
            values=values,
            values_after=values,
            active=no,
            narrowing=no,
            done=no,
        )
    return StepperState(
        t=t0,
        y=start,
        tnext=_clip_to_save_time(t0, first, times),
        step_size=first - t0,
        made_jump=no,
        solver_state=how.solver.init(term, t0, first, start, world.field_args),
        controller_state=controller,
        progress_meter_state=how.progress_meter.init(),
        guard_values=values,
        search=search,
        step_ts=jnp.full(how.max_steps, jnp.inf, t0.dtype),
        checkpoints=rows(how.max_steps // how.checkpoint_interval),
        ys=rows(at.shape[0]),
        accepted=zero,
        rejected=zero,
        result=jnp.asarray(SUCCESSFUL, jnp.int32),
        stats=Stats.zeros(t0.dtype, seen is not None and seen.pivots is not None),
        projection_info=seen,
    )


def _clip_to_save_time(t, proposed, times) -> Float[Array, ""]:
    """The end of a step from t: as proposed, or the next time to be met."""
    _, stop, at = times
    limit = jnp.minimum(stop, jnp.min(jnp.where(at > t, at, jnp.inf), initial=jnp.inf))
    return jnp.where(t + (proposed - t) * (1 + MAX_STRETCH) >= limit, limit, proposed)


def _attempt_step(s: StepperState, t1, world: PhaseProblem, how: StepperOptions) -> StepAttempt:
    """A step of the solver to t1, settled, and what the controller says of it."""
    term, stabilization = diffrax.ODETerm(world.field), world.field.stabilization
    # a step begins with the rate where the one before was settled to, not with one remembered from
    # where it was before that
    fresh = True if needs_projection(stabilization, world.field_args) else s.made_jump
    y, error, _, solver, solved = how.solver.step(
        term, s.t, t1, s.y, world.field_args, s.solver, made_jump=fresh
    )
    raw, (y, seen) = y, project_state(world.field, world.field_args, y)
    if error is not None and world.field.projects_by_loop_forces:
        # without pivots nothing else shows that loops lose rank
        error = jax.tree.map(
            lambda e, new, old: jnp.maximum(
                jnp.abs(e), PROJECTION_ERROR_WEIGHT * jnp.abs(new - old)
            ),
            error,
            y,
            raw,
        )
    whole, order = is_finite(y), how.solver.error_order(term)
    why = jnp.where(whole, LOOP_OPEN, NON_FINITE)
    if seen is not None:
        whole = whole & (jnp.max(seen.gap) <= how.gap)
    error = jax.tree.map(lambda x: jnp.where(whole & jnp.isfinite(x), x, jnp.inf), error)
    keep, t, ahead, jumped, controller, said = how.controller.adapt_step_size(
        s.t, t1, s.y, y, world.field_args, error, error_order=order, controller_state=s.controller
    )
    keep, length = jnp.asarray(keep), ahead - t
    if isinstance(how.controller, diffrax.PIDController):
        # the length asked for before a step was much shortened, where that step says no more than
        # that it may grow as far as it ever may
        grown = keep & (length >= 0.99 * how.controller.factormax * (t1 - s.t))
        length = jnp.where(grown, jnp.maximum(length, s.step_size), length)
    failed = keep & (solved._value != SUCCESSFUL)
    result = jnp.where(failed, solved._value, said._value)
    # what is not finite, or open, is never kept: it ends the run where the step has to be of that
    # length, or when there is no shorter one
    result = jnp.where(~whole & (keep | (result != SUCCESSFUL)), why, result).astype(jnp.int32)
    estimate = jnp.asarray(jnp.inf, t.dtype) if error is None else rms_norm(error)
    return StepAttempt(
        t=t,
        y=y,
        keep_step=keep & whole,
        step_size=length,
        made_jump=jnp.asarray(jumped),
        solver_state=solver,
        controller_state=controller,
        result=result,
        error_norm=estimate,
        projection_info=seen,
    )


def _attempt_and_locate(
    s: StepperState, world: PhaseProblem, how: StepperOptions
) -> tuple[StepAttempt, Array, EventSearch, Array]:
    """Take a try of a step and look at the guards there. Return it, the values of the guards, the
    search for the zero of one, and whether that search goes on or has just ended."""
    t1 = jnp.where(s.search.active, s.search.next_time(), s.tnext)
    tried = _attempt_step(s, t1, world, how)
    guards, search = update_search(
        s.search,
        s.guard_values,
        t0=s.t,
        t1=t1,
        y=tried.y,
        keep=tried.keep_step,
        scene=world.field_args,
        watched=how.armed_guards,
    )
    still = s.search.active | search.active
    blind = tried.keep_step & jnp.any(jnp.isnan(guards))
    t, y = tree_where(search.done, (search.bracket.b, search.y), (tried.t, tried.y))
    tried = dataclasses.replace(
        tried,
        t=t,
        y=y,
        keep_step=(tried.keep_step & ~blind & ~still) | search.done,
        result=jnp.where(blind, NON_FINITE, tried.result),
    )
    return tried, guards, search, still


def _write_states(
    s: StepperState, tried: StepAttempt, t, at, accepted, every: int
) -> tuple[ODEState, ODEState]:
    """Return the saved states and the kept ones, with the state after a try written in where it is
    one of them. t, accepted: the time and the number of steps after it."""
    saved, kept = s.ys, s.checkpoints
    if at.shape[0]:
        place = jnp.minimum(jnp.sum(at < t, dtype=jnp.int32), at.shape[0] - 1)
        saved = _write_row(saved, place, tried.y, tried.keep_step & (at[place] == t))
    if kept.q.shape[0]:
        kept = _write_row(
            kept, accepted // every - 1, tried.y, tried.keep_step & (accepted % every == 0)
        )
    return saved, kept


def _body_fun(s: StepperState, times, world: PhaseProblem, how: StepperOptions) -> StepperState:
    """One try: kept, or to be made shorter; or one more look at the step in which a guard went
    through zero."""
    t0, stop, at = times
    if (
        s.projection_info is not None
        and s.projection_info.pivots is not None
        and world.field.dynamics.hold is not None
    ):
        world = eqx.tree_at(
            lambda w: w.field_args.pivots,
            world,
            s.projection_info.pivots,
            is_leaf=lambda x: x is None,
        )
    if s.search is None:
        tried = _attempt_step(s, s.tnext, world, how)
        guards, search, still = None, None, jnp.zeros((), bool)
    else:
        tried, guards, search, still = _attempt_and_locate(s, world, how)
    moved = lambda new, old: tree_where(tried.keep_step, new, old)
    # while a zero is looked for, nothing else goes on
    next_ = lambda new, old: tree_where(still, old, new)
    t, accepted = moved(tried.t, s.t), s.accepted + tried.keep_step.astype(jnp.int32)
    saved, kept = _write_states(s, tried, t, at, accepted, how.checkpoint_interval)
    result = next_(tried.result, s.result)
    return StepperState(
        t=t,
        y=moved(tried.y, s.y),
        tnext=next_(_clip_to_save_time(t, t + tried.step_size, times), s.tnext),
        step_size=next_(tried.step_size, s.step_size),
        made_jump=moved(tried.made_jump, s.made_jump),
        solver_state=moved(tried.solver, s.solver),
        controller_state=next_(tried.controller, s.controller),
        progress_meter_state=how.progress_meter.step(
            s.progress_meter_state, (t - t0) / jnp.where(stop > t0, stop - t0, 1)
        ),
        guard_values=None if guards is None else moved(guards, s.guard_values),
        search=search,
        step_ts=_write_row(s.step_ts, s.accepted, t, tried.keep_step),
        checkpoints=kept,
        ys=saved,
        accepted=accepted,
        rejected=s.rejected + (~tried.keep_step & ~still).astype(jnp.int32),
        result=result,
        stats=update_stats(s, tried, result, world.field_args),
        projection_info=moved(tried.projection_info, s.projection_info),
    )


def _write_row(rows, i, new, pred):
    """Rows of numbers with new ones at i."""
    # the index of a row that is not to be written may be anything
    i = jnp.where(pred, i, 0)
    return jax.tree.map(lambda x, b: buffer_at_set(b, i, x, pred=pred), new, rows)
