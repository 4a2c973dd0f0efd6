"""The problem, the options, the state and the solution of the integration of one phase."""

from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from svkc.integration.event_location import ArmedGuards, EventInfo, EventSearch
from svkc.integration.ode import FieldArgs, ODEState
from svkc.integration.vector_field import ProjectionInfo, VectorField
from svkc.loops.constraint import largest_gaps
from svkc.model.chain import State

NON_FINITE, LOOP_OPEN = -1, -2
# by articulated bodies a step may be moved, as it is put back onto the loops, by 1 / MOVED of what
# it may err by
PROJECTION_ERROR_WEIGHT = 1e-3
SUCCESSFUL, EVENT, MAX_STEPS = (
    diffrax.RESULTS.successful._value,
    diffrax.RESULTS.event_occurred._value,
    diffrax.RESULTS.max_steps_reached._value,
)


class PhaseProblem(eqx.Module):
    """What the motion depends on besides its start: the scene, and the vector field with all that
    it closes over."""

    field_args: FieldArgs
    field: VectorField


class StepperOptions(eqx.Module):
    """What finds the steps: nothing of it is differentiated."""

    solver: diffrax.AbstractSolver
    armed_guards: ArmedGuards | None
    controller: Any
    first_step: Any
    progress_meter: diffrax.AbstractProgressMeter
    gap_tolerance: float = eqx.field(static=True)
    max_steps: int = eqx.field(static=True)
    checkpoint_interval: int = eqx.field(static=True)


class Stats(eqx.Module):
    """What a run has cost and shown: tries, and of the steps that were kept the sum of their
    estimated errors (root mean square over q and v; inf: the solver gives none), the least |R_mm| /
    |R_11| of the loops, how often the dependent coordinates changed (-1: not looked at), the loop
    that could not be closed (-1: none), and the largest of the loops' gaps (rad, m)."""

    attempts: Int[Array, ""]
    error: Float[Array, ""]
    margin: Float[Array, ""]
    swaps: Int[Array, ""]
    loop: Int[Array, ""]
    gap: Float[Array, "2"]

    @classmethod
    def zeros(cls, dtype, looked: bool) -> "Tally":
        """Before the first step."""
        zero = jnp.zeros((), jnp.int32)
        return cls(
            attempts=zero,
            error=jnp.zeros((), dtype),
            margin=jnp.ones((), dtype),
            swaps=zero if looked else zero - 1,
            loop=zero - 1,
            gap=jnp.zeros(2, dtype),
        )

    @classmethod
    def attempts_only(cls, dtype, tries: Int[Array, ""]) -> "Tally":
        """Return the tally of a loop that counts tries alone."""
        no, one = jnp.asarray(-1, jnp.int32), jnp.ones((), dtype)
        gap = jnp.zeros(2, dtype)
        return cls(attempts=tries, error=jnp.inf * one, margin=one, swaps=no, loop=no, gap=gap)


class PhaseSolution(eqx.Module):
    """Where a solve ended, the states at the times asked for, the times of its steps (inf: not
    taken), one state in `every`, diffrax's result code."""

    t: Float[Array, ""]
    y: ODEState
    ys: ODEState
    step_ts: Float[Array, " steps"]
    checkpoints: ODEState
    accepted: Int[Array, ""]
    rejected: Int[Array, ""]
    result: Int[Array, ""]
    stats: Stats
    event: EventInfo | None = None


class StepperState(eqx.Module):
    """What goes from step to step. length: what the controller asks for, before a time to be met
    shortens it; times, kept, saved: as in `Path`, but buffers within the loop."""

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
    step_ts: Any
    checkpoints: Any
    ys: Any
    accepted: Int[Array, ""]
    rejected: Int[Array, ""]
    result: Int[Array, ""]
    stats: Stats
    projection_info: ProjectionInfo | None


class StepAttempt(eqx.Module):
    """What a try has led to."""

    t: Float[Array, ""]
    y: ODEState
    keep_step: Bool[Array, ""]
    step_size: Float[Array, ""]
    made_jump: Bool[Array, ""]
    solver_state: Any
    controller_state: Any
    result: Int[Array, ""]
    error_norm: Float[Array, ""]
    projection_info: ProjectionInfo | None


def update_stats(
    s: StepperState, tried: StepAttempt, result: Int[Array, ""], scene: FieldArgs
) -> Stats:
    """With one more try. result: how the run stands after it."""
    old, kept = s.stats, tried.keep_step
    margin, swaps, gap = old.margin, old.swaps, old.gap
    if tried.projection_info is not None and tried.projection_info.pivots is not None:
        margin = jnp.where(kept, jnp.minimum(margin, tried.projection_info.margin), margin)
        # the first choice of a phase is no change
        swapped = jnp.any(s.projection_info.dependent) & jnp.any(
            s.projection_info.dependent != tried.projection_info.dependent
        )
        swaps = swaps + (kept & swapped).astype(jnp.int32)
    loop = old.loop
    if tried.projection_info is not None:
        widest = jnp.argmax(jnp.max(tried.projection_info.gap, 1)).astype(jnp.int32)
        loop = jnp.where(result == LOOP_OPEN, widest, loop)
    if len(scene.chain.link_names):
        gap = jnp.where(kept, jnp.maximum(gap, _max_gaps(tried, scene)), gap)
    error = old.error + jnp.where(kept, tried.error, 0)
    return Stats(
        attempts=old.attempts + 1, error=error, margin=margin, swaps=swaps, loop=loop, gap=gap
    )


def _max_gaps(tried: StepAttempt, scene: FieldArgs) -> Float[Array, "2"]:
    """The largest of the loops' gaps (rad, m) at the end of a try."""
    if tried.projection_info is None:
        return largest_gaps(scene.chain, State(tried.y.q, tried.y.v, scene.structure))[0]
    return jnp.max(tried.projection_info.gap, 0) * jnp.stack(
        [jnp.ones_like(scene.chain.length), scene.chain.length]
    )
