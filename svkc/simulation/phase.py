"""One phase: the integration of one smooth vector field up to the next scheduled time, or to the
first guard that crosses zero."""

import dataclasses

import diffrax
import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from svkc._jax.pytrees import stop_gradient_tree
from svkc.integration.diffrax_adjoint import integrate_with_diffrax
from svkc.integration.event_adjoint import end_of_phase
from svkc.integration.event_location import ArmedGuards, GuardValues
from svkc.integration.integrate import integrate_phase
from svkc.integration.ode import FieldArgs, ODEState, is_finite
from svkc.integration.replay import Replay, integrate_with_replay
from svkc.integration.runge_kutta import with_scan_kind
from svkc.integration.solution import (
    EVENT,
    LOOP_OPEN,
    MAX_STEPS,
    NON_FINITE,
    SUCCESSFUL,
    PhaseProblem,
    PhaseSolution,
    StepperOptions,
)
from svkc.integration.vector_field import VectorField
from svkc.model.chain import State
from svkc.simulation.options import Options
from svkc.simulation.records import RESULTS, Events, PhaseRecords
from svkc.transitions.plan import Plan


class RunState(eqx.Module):
    """The state that a phase hands to the next. `count`: phases so far; `stale`: guards whose
    values belong to another structure; `derivative`, `invalid_from`: why the run has no derivative,
    and the index of the first such phase."""

    t: Float[Array, ""]
    state: State
    work: Float[Array, ""] | None
    guards: Float[Array, " guards"] | None
    stale: Bool[Array, " guards"] | None
    pending: Bool[Array, " timed"]
    events: Events
    records: PhaseRecords
    count: Int[Array, ""]
    saved: State
    result: RESULTS
    derivative: RESULTS
    invalid_from: Int[Array, ""]


class PhaseOutcome(eqx.Module):
    """Where a phase ended: time, motion, the guards that fired there, which guard values go on, the
    solver's words, and whether it can be differentiated."""

    t: Float[Array, ""]
    motion: ODEState
    fired: Bool[Array, " guards"]
    guards: Float[Array, " guards"] | None
    saved: ODEState
    path: PhaseSolution
    result: RESULTS
    derivative: RESULTS


def solve_phase(
    run: RunState, stop, ts, made: Plan, options: Options, scene: FieldArgs
) -> PhaseOutcome:
    """From run.t to `stop`, or to the first guard that crosses zero."""
    guards = GuardValues(made, options.field) if made.guards else None
    watched = (
        None
        if guards is None
        else stop_gradient_tree(
            ArmedGuards(guards, run.guards, made.armed(scene.chain, scene.structure))
        )
    )
    start = ODEState(run.state.q, run.state.v, run.work)
    # a save time within the phase, its ends included, moves by itself; what is saved of the others
    # counts in another phase
    begun, ended = stop_gradient_tree((run.t, jnp.maximum(stop, run.t)))
    at = jnp.where(ts < begun, begun, jnp.where(ts > ended, ended, ts))
    reading = options.field if guards is None else guards
    path, found, t, motion = _path(
        start, (run.t, stop, at), PhaseProblem(scene, options.field), watched, options, reading
    )
    result = _translate(path.result, path.y)
    solved = PhaseOutcome(
        t=t,
        motion=motion,
        fired=jnp.zeros(0, bool),
        guards=None,
        saved=path.ys,
        path=stop_gradient_tree(path),
        result=result,
        derivative=RESULTS.successful,
    )
    if found is None:
        return solved
    code = RESULTS.where(found.jumps, RESULTS.jump, RESULTS.successful)
    code = RESULTS.where(jnp.sum(found.fired) > 1, RESULTS.together, code)
    code = RESULTS.where(found.grazing, RESULTS.grazing, code)
    return dataclasses.replace(solved, fired=found.fired, guards=found.values, derivative=code)


def _path(
    start: ODEState,
    times,
    world: PhaseProblem,
    watched: ArmedGuards | None,
    options: Options,
    reading: GuardValues | VectorField,
):
    """Return the path up to its end, the guard that ends it, and the time and motion there.

    The derivative is that of the replayed steps, or that of the diffrax adjoint asked for.
    """
    adjoint, replayed = options.adjoint, isinstance(options.adjoint, Replay)
    solver, looked_for, (controller, first_step) = stop_gradient_tree(
        (with_scan_kind(options.solver, "lax"), watched, options.step_size_control())
    )
    how = StepperOptions(
        solver=solver,
        armed_guards=looked_for,
        controller=controller,
        first_step=first_step,
        progress_meter=options.progress_meter if replayed else diffrax.NoProgressMeter(),
        gap_tolerance=options.gap_tolerance,
        max_steps=options.max_steps,
        checkpoint_interval=min(adjoint.every, options.max_steps)
        if replayed
        else options.max_steps,
    )
    if replayed:
        path, t, motion = integrate_with_replay(start, times, world, how, reading)
        return path, stop_gradient_tree(path.event), t, motion
    t0, stop, at = times
    found = None
    if watched is not None:
        # an event is located once, before the differentiated solve, which then ends at its time
        begin, fixed_times, still = stop_gradient_tree((start, times, world))
        first = integrate_phase(begin, fixed_times, still, how)
        stop = jnp.where(first.event.occurred, first.t, stop)
        at, found = jnp.where(at > stop, stop, at), first.event
    controller, first_step = options.step_size_control(at)
    how = dataclasses.replace(
        how,
        solver=options.solver,
        controller=controller,
        first_step=first_step,
        progress_meter=options.progress_meter,
    )
    path = integrate_with_diffrax(start, (t0, stop, at), world, how, adjoint, found)
    # the adjoint has seen to a scheduled end that moves
    late = jnp.zeros_like(path.t)
    return path, found, *end_of_phase(path.t, path.y, late, world.field_args, reading, found)


def _translate(result: Int[Array, ""], motion: ODEState) -> RESULTS:
    """Diffrax's word for how a solve ended, as ours."""
    out = RESULTS.where(
        (result == SUCCESSFUL) | (result == EVENT), RESULTS.successful, RESULTS.step_too_small
    )
    out = RESULTS.where(result == MAX_STEPS, RESULTS.max_steps, out)
    out = RESULTS.where(result == LOOP_OPEN, RESULTS.loop_open, out)
    return RESULTS.where(is_finite(motion) & (result != NON_FINITE), out, RESULTS.non_finite)
