"""One phase: the integration of one smooth vector field up to the next scheduled time, or to the
first guard that crosses zero. Changes of structure happen between phases."""

import dataclasses

import diffrax
import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from svkc._jax.pytrees import stop_gradient_tree
from svkc._jax.select import where
from svkc.integration.diffrax_adjoint import integrate_with_diffrax
from svkc.integration.event_adjoint import end_of_phase
from svkc.integration.event_location import ArmedGuards, GuardValues
from svkc.integration.integrate import integrate_phase
from svkc.integration.ode import FieldArgs, ODEState, is_finite
from svkc.integration.replay import Replay, integrate_with_replay
from svkc.integration.runge_kutta import with_scan_kind, without_dense_output
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
from svkc.simulation.codes import DERIVATIVE, RESULTS
from svkc.simulation.options import Options
from svkc.simulation.records import Events, PhaseRecords
from svkc.transitions.event_schedule import EventSchedule, armed_guards
from svkc.transitions.plan import Plan


class RunState(eqx.Module):
    """The state of a run between two phases.

    work: done so far by control, by dampers and by joint limits (J).
    guard_values: at the end of the last phase.
    stale: which guard values are re-evaluated at the start of the next phase.
    schedule: when the timed events happen, and which events have happened.
    first_step: size of the first step of the next phase with a PID controller and `Replay` (s).
    unsaved: whether a phase still has to save the state: at the start, and after an event.
    count: number of phases so far.
    saved, saved_work: states and work at the save times.
    derivative, invalid_from: why the run has no derivative, and the index of the first phase for
        which this is so.
    """

    t: Float[Array, ""]
    state: State
    work: Float[Array, "3"] | None
    guard_values: Float[Array, " guards"] | None
    stale: Bool[Array, " guards"] | None
    schedule: EventSchedule
    first_step: Float[Array, ""]
    unsaved: Bool[Array, ""]
    events: Events
    records: PhaseRecords
    count: Int[Array, ""]
    saved: State
    saved_work: Float[Array, "times 3"] | None
    result: RESULTS
    derivative: DERIVATIVE
    invalid_from: Int[Array, ""]


class PhaseOutcome(eqx.Module):
    """The end of a phase.

    y: the ODE state at the end.
    fired: which guards ended the phase.
    guard_values: at the end.
    ys: ODE states at the save times.
    solution: of the solver, without derivatives.
    derivative: why the phase has no derivative.
    """

    t: Float[Array, ""]
    y: ODEState
    fired: Bool[Array, " guards"]
    guard_values: Float[Array, " guards"] | None
    ys: ODEState
    solution: PhaseSolution
    result: RESULTS
    derivative: DERIVATIVE


def solve_phase(
    run: RunState,
    stop: Float[Array, ""],
    ts: Float[Array, " times"],
    plan: Plan,
    options: Options,
    field_args: FieldArgs,
) -> PhaseOutcome:
    """Integrate one phase from run.t to `stop`, or to the first guard that crosses zero.

    ts: save times of the run; states are saved at those within the phase.
    """
    guards = GuardValues(plan, options.field) if plan.guards else None
    armed = None
    if guards is not None:
        mask = armed_guards(field_args.chain, field_args.structure, plan, run.schedule)
        assert run.guard_values is not None
        armed = stop_gradient_tree(ArmedGuards(guards, run.guard_values, mask))
    y0 = ODEState(run.state.q, run.state.v, run.work)
    # Save times outside the phase are clipped to its ends. Only save times within the phase, ends
    # included, have derivatives here; the states saved at the others are those of other phases.
    t_start, t_stop = stop_gradient_tree((run.t, jnp.maximum(stop, run.t)))
    clipped_ts = where(ts < t_start, t_start, where(ts > t_stop, t_stop, ts))
    solution, event, t, y = _integrate(
        y0,
        (run.t, stop, clipped_ts),
        PhaseProblem(field_args, options.field),
        armed,
        options,
        stepper_options=_stepper_options(run, options, armed),
        guards=options.field if guards is None else guards,
    )
    outcome = PhaseOutcome(
        t=t,
        y=y,
        fired=jnp.zeros(0, bool),
        guard_values=None,
        ys=solution.ys,
        solution=stop_gradient_tree(solution),
        result=_as_result(solution.result, solution.y),
        derivative=DERIVATIVE.successful,
    )
    if event is None:
        return outcome
    code = DERIVATIVE.where(event.jumps, DERIVATIVE.jump, DERIVATIVE.successful)
    code = DERIVATIVE.where(jnp.sum(event.fired) > 1, DERIVATIVE.together, code)
    code = DERIVATIVE.where(event.grazing, DERIVATIVE.grazing, code)
    return dataclasses.replace(
        outcome, fired=event.fired, guard_values=event.values, derivative=code
    )


def _stepper_options(run: RunState, options: Options, armed: ArmedGuards | None) -> StepperOptions:
    """Return the options of the stepping loop, which is never differentiated."""
    adjoint = options.adjoint
    replays = isinstance(adjoint, Replay)
    # guards alone need the dense output
    solver = options.solver if armed is not None else without_dense_output(options.solver)
    controller, first_step = options.step_size_control()
    if isinstance(controller, diffrax.PIDController):
        first_step = run.first_step
    solver, armed_guards, controller, first_step = stop_gradient_tree(
        (with_scan_kind(solver, "lax"), armed, controller, first_step)
    )
    max_step = None
    if armed_guards is not None and armed_guards.evaluate.plan.max_steps is not None:
        limits = armed_guards.evaluate.plan.max_steps
        max_step = jnp.min(where(armed_guards.armed, limits, jnp.inf))
    return StepperOptions(
        solver=solver,
        armed_guards=armed_guards,
        controller=controller,
        first_step=first_step,
        max_step=max_step,
        progress_meter=options.progress_meter if replays else diffrax.NoProgressMeter(),
        gap_tolerance=options.gap_tolerance,
        max_steps=options.max_steps,
        checkpoint_interval=(
            adjoint.checkpoint_interval(options.max_steps) if replays else options.max_steps
        ),
        phases=options.max_events + 1,
    )


def _integrate(
    y0: ODEState,
    times,
    problem: PhaseProblem,
    armed: ArmedGuards | None,
    options: Options,
    *,
    stepper_options: StepperOptions,
    guards: GuardValues | VectorField,
):
    """Return the solution of a phase, the event that ended it, and the time and ODE state at its
    end.

    Derivatives are those of the replayed steps, or those of the diffrax adjoint of the options.

    times: start and latest end of the phase, and the save times.
    guards: the guards, or the vector field where there are no guards.
    """
    adjoint = options.adjoint
    if isinstance(adjoint, Replay):
        solution, t, y = integrate_with_replay(y0, times, problem, stepper_options, guards)
        return solution, stop_gradient_tree(solution.event), t, y
    t0, stop, ts = times
    event, located, failed = None, None, None
    if armed is not None:
        # the event is located first, without derivatives; the differentiated solve ends at its time
        constants = stop_gradient_tree((y0, times, problem))
        located = integrate_phase(constants[0], constants[1], constants[2], stepper_options)
        assert located.event is not None
        failed = (located.result != SUCCESSFUL) & (located.result != EVENT)
        stop = where(located.event.occurred | failed, located.t, stop)
        ts, event = where(ts > stop, stop, ts), located.event
    controller, first_step = options.step_size_control(ts)
    stepper_options = dataclasses.replace(
        stepper_options,
        solver=options.solver,
        controller=controller,
        first_step=first_step,
        progress_meter=options.progress_meter,
    )
    solution = integrate_with_diffrax(y0, (t0, stop, ts), problem, stepper_options, adjoint, event)
    if located is not None:
        result = where(failed, located.result, solution.result)
        solution = dataclasses.replace(solution, result=result)
    # the adjoint differentiates by a scheduled end, so the end is not shifted again here
    stop_shift = jnp.zeros_like(solution.t)
    t, y = end_of_phase(solution.t, solution.y, stop_shift, problem.field_args, guards, event)
    return solution, event, t, y


def _as_result(result: Int[Array, ""], y: ODEState) -> RESULTS:
    """Return the result code of a solve as one of `RESULTS`."""
    out = RESULTS.where(
        (result == SUCCESSFUL) | (result == EVENT), RESULTS.successful, RESULTS.step_too_small
    )
    out = RESULTS.where(result == MAX_STEPS, RESULTS.max_steps, out)
    out = RESULTS.where(result == LOOP_OPEN, RESULTS.loop_open, out)
    return RESULTS.where(is_finite(y) & (result != NON_FINITE), out, RESULTS.non_finite)
