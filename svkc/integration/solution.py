"""The problem, the options, the state of the stepping loop and the solution of one phase."""

from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from svkc._jax.select import where
from svkc.integration.dense_output import ProjectedInterpolation
from svkc.integration.event_location import ArmedGuards, EventInfo, EventSearch
from svkc.integration.ode import FieldArgs, ODEState
from svkc.integration.vector_field import VectorField
from svkc.loops.constraint import largest_gaps
from svkc.loops.constraint_rows import RowChoice
from svkc.loops.projection import ProjectionInfo
from svkc.model.annotations import DType
from svkc.model.chain import State

# result codes of a phase: these of svkc, and diffrax's own
NON_FINITE, LOOP_OPEN = -1, -2
SUCCESSFUL: Any = diffrax.RESULTS.successful._value
EVENT: Any = diffrax.RESULTS.event_occurred._value
MAX_STEPS: Any = diffrax.RESULTS.max_steps_reached._value


class PhaseProblem(eqx.Module):
    """Everything the motion of a phase depends on besides its start and its times.

    field: the vector field, with the arrays that control closes over as leaves.
    """

    field_args: FieldArgs
    field: VectorField


class StepperOptions(eqx.Module):
    """How steps are chosen. None of these fields is differentiated.

    armed_guards: guards that may end the phase. None: no event can.
    controller: step-size controller of diffrax.
    first_step: size of the first step (s). None: the controller chooses.
    max_step: the longest step that the armed guards allow (s). None: no guard limits steps.
    gap_tolerance: steps that leave a larger loop gap are rejected (rad, units of `chain.length`).
    max_steps: the most steps of a phase, accepted and rejected; event location is not counted.
    checkpoint_interval: one state in so many steps is stored.
    phases: number of phases of the run.
    record_capacity: records of so many first steps are stored.
    """

    solver: diffrax.AbstractSolver[Any]
    armed_guards: ArmedGuards | None
    controller: Any
    first_step: Any
    max_step: Float[Array, ""] | None
    progress_meter: diffrax.AbstractProgressMeter[Any]
    gap_tolerance: float = eqx.field(static=True)
    max_steps: int = eqx.field(static=True)
    checkpoint_interval: int = eqx.field(static=True)
    phases: int = eqx.field(static=True)
    record_capacity: int = eqx.field(static=True, default=0)


class Stats(eqx.Module):
    """Statistics of the steps of a phase.

    attempts: attempted steps, those of event location included. All other fields are of the steps
        that were kept.
    error: sum of their estimated errors, root mean square over q and v. inf: no estimates.
    margin: least |R_mm| / |R_11| of the loop Jacobian.
    swaps: changes of the dependent coordinates. -1: not counted.
    loop: index of a loop that could not be closed. -1: none.
    gap: largest gaps of the loops (rad, m).
    reduced_steps: steps taken with reduced rows of the loops. -1: not counted.
    """

    attempts: Int[Array, ""]
    error: Float[Array, ""]
    margin: Float[Array, ""]
    swaps: Int[Array, ""]
    loop: Int[Array, ""]
    gap: Float[Array, "2"]
    reduced_steps: Int[Array, ""]

    @classmethod
    def zeros(cls, dtype: DType, *, counts_swaps: bool, counts_reduced_steps: bool) -> "Stats":
        """Return the statistics before the first step."""
        zero = jnp.zeros((), jnp.int32)
        return cls(
            attempts=zero,
            error=jnp.zeros((), dtype),
            margin=jnp.ones((), dtype),
            swaps=zero if counts_swaps else zero - 1,
            loop=zero - 1,
            gap=jnp.zeros(2, dtype),
            reduced_steps=zero if counts_reduced_steps else zero - 1,
        )

    @classmethod
    def attempts_only(cls, dtype: DType, attempts: Int[Array, ""]) -> "Stats":
        """Return the statistics of a loop that counts its attempts alone."""
        unknown, one = jnp.asarray(-1, jnp.int32), jnp.ones((), dtype)
        return cls(
            attempts=attempts,
            error=jnp.inf * one,
            margin=one,
            swaps=unknown,
            loop=unknown,
            gap=jnp.zeros(2, dtype),
            reduced_steps=unknown,
        )


class StepRecord(eqx.Module):
    """What the derivative of a step needs from the step.

    increments: of an explicit Runge-Kutta step, size of the step times the vector field at each of
        its stages, without those of the error estimate alone. None: the solver has no such stages.
    row_choice: rows of the loops that the step uses. None: all.
    """

    increments: ODEState | None
    row_choice: RowChoice | None


class PhaseSolution(eqx.Module):
    """The solution of one phase.

    t, y: time and state at its end.
    ys: states at the save times.
    step_ts: times at the ends of the steps, inf in unused rows.
    step_near: which steps were taken with reduced rows of the loops. None: see
        `StepperState.near`.
    checkpoints: states after every `checkpoint_interval` steps.
    records: of the first `record_capacity` steps. None if that is zero.
    accepted, rejected: numbers of steps.
    result: result code, diffrax's or one of this module.
    event: the event at the end. None: there are no guards.
    proposed_step: size that the controller proposes for the next step (s). After an event it is the
        size of the interrupted step; without a step, that of the first one. None: not known.
    """

    t: Float[Array, ""]
    y: ODEState
    ys: ODEState
    step_ts: Float[Array, " steps"]
    step_near: Bool[Array, " steps"] | None
    checkpoints: ODEState
    accepted: Int[Array, ""]
    rejected: Int[Array, ""]
    result: Int[Array, ""]
    stats: Stats
    event: EventInfo | None = None
    records: StepRecord | None = None
    proposed_step: Float[Array, ""] | None = None


class StepperState(eqx.Module):
    """The state of the stepping loop.

    tnext: end of the next step, clipped at save times.
    step_size: size that the controller proposed, before clipping.
    guard_values: values of the guards at t.
    near: whether the next step is taken with reduced rows of the loops, as near a singular
        configuration. None: rows are never reduced.
    step_ts, step_near, checkpoints, records, ys: as in `PhaseSolution`, as buffers of the loop.
        None, as `progress_meter_state`, in the states of `step_attempt`.
    projection_info: that of the last projection. None: steps are not projected.
    """

    t: Float[Array, ""]
    y: ODEState
    tnext: Float[Array, ""]
    step_size: Float[Array, ""]
    made_jump: Bool[Array, ""]
    solver_state: Any
    controller_state: Any
    progress_meter_state: Any
    guard_values: Float[Array, " guards"] | None
    search: EventSearch | None
    near: Bool[Array, ""] | None
    step_ts: Any
    step_near: Any
    checkpoints: Any
    records: Any
    ys: Any
    accepted: Int[Array, ""]
    rejected: Int[Array, ""]
    result: Int[Array, ""]
    stats: Stats
    projection_info: ProjectionInfo | None


class StepAttempt(eqx.Module):
    """One attempted step.

    t: end of the step if it is kept, else its start.
    y: projected state at the end of the step.
    keep_step: whether the loop advances to (t, y).
    closed: whether y is finite and its loops are closed.
    step_size: size that the controller proposes for the next step.
    error_norm: root mean square of the estimated error over q and v. inf: no estimate.
    interpolation: dense output of the step. None: there are no guards.
    increments: as in `StepRecord`.
    """

    t: Float[Array, ""]
    y: ODEState
    keep_step: Bool[Array, ""]
    closed: Bool[Array, ""]
    step_size: Float[Array, ""]
    made_jump: Bool[Array, ""]
    solver_state: Any
    controller_state: Any
    result: Int[Array, ""]
    error_norm: Float[Array, ""]
    projection_info: ProjectionInfo | None
    interpolation: ProjectedInterpolation | None
    increments: ODEState | None


def update_stats(
    s: StepperState, attempt: StepAttempt, result: Int[Array, ""], field_args: FieldArgs
) -> Stats:
    """Return the statistics after one more attempt.

    result: result code of the loop after the attempt.
    """
    old, keep_step, info = s.stats, attempt.keep_step, attempt.projection_info
    margin, swaps, loop, gap = old.margin, old.swaps, old.loop, old.gap
    if info is not None and info.margin is not None:
        margin = where(keep_step, jnp.minimum(margin, info.margin), margin)
    if info is not None and info.pivots is not None:
        assert s.projection_info is not None
        dependent = s.projection_info.dependent
        # The first selection of a phase is not a swap.
        swapped = jnp.any(dependent) & jnp.any(dependent != info.dependent)
        swaps = swaps + (keep_step & swapped).astype(jnp.int32)
    if info is not None:
        widest = jnp.argmax(jnp.max(info.gap, 1)).astype(jnp.int32)
        loop = where(result == LOOP_OPEN, widest, loop)
    if len(field_args.chain.link_names):
        gap = where(keep_step, jnp.maximum(gap, _max_gaps(attempt, field_args)), gap)
    return Stats(
        attempts=old.attempts + 1,
        error=old.error + where(keep_step, attempt.error_norm, 0),
        margin=margin,
        swaps=swaps,
        loop=loop,
        gap=gap,
        reduced_steps=old.reduced_steps
        if s.near is None
        else old.reduced_steps + (keep_step & s.near).astype(jnp.int32),
    )


def _max_gaps(attempt: StepAttempt, field_args: FieldArgs) -> Float[Array, "2"]:
    """Return the largest gaps of the loops (rad, m) at the end of an attempt."""
    chain, y = field_args.chain, attempt.y
    if attempt.projection_info is None:
        return largest_gaps(chain, State(y.q, y.v, field_args.structure))[0]
    units = jnp.stack([jnp.ones_like(chain.length), chain.length])
    return jnp.max(attempt.projection_info.gap, 0) * units
