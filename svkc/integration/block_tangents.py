"""Tangents of the steps of a phase, computed in blocks of steps and groups of blocks.

The tangents are those at fixed times of the steps. Where increments of the stages were stored in
the run, the stages need not be computed again before they are differentiated. A phase has room for
`max_steps` steps. Unused groups, blocks and steps are skipped in both directions, and reverse mode
stores the arguments of each of them alone (`skippable`).
"""

import dataclasses
import math
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from svkc._jax.control_flow import unvmap_any
from svkc._jax.pytrees import tree_where
from svkc._jax.select import where
from svkc._jax.skippable import skippable
from svkc.integration.ode import FieldArgs, ODEState
from svkc.integration.runge_kutta import (
    end_of_step,
    increment_bytes,
    recorded_step,
    step_tangent,
    zero_increments,
)
from svkc.integration.solution import PhaseProblem, PhaseSolution, StepperOptions, StepRecord
from svkc.loops.constraint_rows import choose_rows

# At most this many steps of a run have records, and their increments take at most this many bytes
# for each element of a batch. The phases share both equally. Each phase records its first steps.
RECORDED_STEPS, RECORDS_BYTES = 1024, 1 << 23


def record_capacity(start: ODEState, options: StepperOptions) -> int:
    """Return the number of steps of a phase that are recorded, those of whole blocks."""
    steps, phases = options.checkpoint_interval, options.phases
    blocks = RECORDS_BYTES // max(1, phases * steps * increment_bytes(options.solver, start))
    return steps * min(blocks, -(-min(RECORDED_STEPS // phases, options.max_steps) // steps))


def with_rows_at(q, field_args: FieldArgs, near: Any = None) -> FieldArgs:
    """Return the arguments of the vector field with the rows of the loops for a step from q.

    near: as in `RowChoice` (None: as at the start of the phase).
    """
    choice = field_args.row_choice
    if choice is None:
        return field_args
    near = choice.near if near is None else near
    rows = choose_rows(field_args.chain, field_args.structure, q, near)
    return dataclasses.replace(field_args, row_choice=rows)


class _PhaseData(eqx.Module):
    """Data that all steps of a phase share.

    start_time: of the phase; the time at which unused steps are evaluated.
    unused_y: the state at which they are evaluated.
    save_index: index of the step that ends at each save time.
    accepted: number of steps.
    records: of the first steps. None: there are none.
    """

    problem: PhaseProblem
    solver: diffrax.AbstractSolver[Any]
    start_time: Float[Array, ""]
    unused_y: ODEState
    save_index: Int[Array, " times"]
    accepted: Int[Array, ""]
    records: StepRecord | None


class _Blocks(eqx.Module):
    """Blocks of consecutive steps.

    first: index of the first one.
    y: the state at its start; arbitrary but finite for an unused block.
    starts, ends: times of the steps. In unused rows both are the end of the phase.
    near: which steps were taken with reduced rows of the loops. None: see `StepperState.near`.
    """

    first: Int[Array, "*blocks"]
    y: ODEState
    starts: Float[Array, "*blocks steps"]
    ends: Float[Array, "*blocks steps"]
    near: Bool[Array, "*blocks steps"] | None


def _blocks(start: ODEState, step_grid, solution: PhaseSolution, interval: int) -> _Blocks:
    """Return all blocks of `interval` steps, [groups, blocks of a group].

    There are about as many groups as blocks in a group.
    """
    needed = solution.checkpoints.q.shape[0] + 1
    size = math.isqrt(needed - 1) + 1
    groups = -(-needed // size)
    count = groups * size
    first = interval * jnp.arange(count, dtype=jnp.int32)
    repeat = lambda x, n: jnp.broadcast_to(x[None], (n, *x.shape))
    rows = lambda s, c: jnp.concatenate([s[None], c, repeat(s, count - needed)])
    states = jax.tree.map(rows, start, solution.checkpoints)
    rest = count * interval + 1 - step_grid.shape[0]
    times = jnp.concatenate([step_grid, repeat(step_grid[-1], rest)])
    near = solution.step_near
    if near is not None:
        near = jnp.concatenate([near, jnp.zeros(rest, bool)]).reshape(count, interval)
    steps = lambda x: x.reshape(count, interval)
    blocks = _Blocks(
        first=first, y=states, starts=steps(times[:-1]), ends=steps(times[1:]), near=near
    )
    return jax.tree.map(lambda x: x.reshape(groups, size, *x.shape[1:]), blocks)


@eqx.filter_jit
@eqx.filter_checkpoint
def replay_tangents(
    start, problem, step_grid, save_index, *, solution: PhaseSolution, options: StepperOptions,
    with_increments: bool,
):  # fmt: skip
    """Return the tangents at the end, at the save times, at the checkpoints and of the increments.

    Each block of steps is differentiated from its checkpoint.

    start, problem: pairs of primal and tangent.
    step_grid: times of the start and of the ends of the steps. save_index: steps of the save times.
    with_increments: whether the tangents of the recorded increments are returned; if not, None.
    """
    (start, d_start), (problem, d_problem), interval = start, problem, options.checkpoint_interval
    phase = _PhaseData(
        problem=problem,
        solver=options.solver,
        start_time=step_grid[0],
        unused_y=_state_of_unused_steps(start, solution),
        save_index=save_index,
        accepted=solution.accepted,
        records=solution.records,
    )
    at_start = lambda d: where(_broadcast_mask(save_index == 0, d[None]), d[None], 0)
    d_recorded = None
    if with_increments and solution.records is not None:
        d_recorded = jax.tree.map(jnp.zeros_like, solution.records.increments)

    def group(carry, blocks):
        return _group_if_used(
            (carry, d_problem), blocks.first[0] < solution.accepted, blocks, phase
        )

    (d_end, d_ys, d_recorded), d_after = jax.lax.scan(
        group,
        (d_start, jax.tree.map(at_start, d_start), d_recorded),
        _blocks(start, step_grid, solution, interval),
    )
    count = solution.checkpoints.q.shape[0]
    written = jnp.arange(1, count + 1, dtype=jnp.int32) * interval <= solution.accepted
    d_checkpoints = jax.tree.map(lambda d: d.reshape(-1, *d.shape[2:])[:count], d_after)
    mask = lambda d: where(_broadcast_mask(written, d), d, 0)
    return d_end, d_ys, jax.tree.map(mask, d_checkpoints), d_recorded


def _state_of_unused_steps(start: ODEState, solution: PhaseSolution) -> ODEState:
    """Return the state at which unused steps of a phase are evaluated.

    In a batch, unused steps are computed beside used ones, with cotangents of zero. Zero times an
    infinite derivative is NaN, and the vector field may have an infinite derivative at the end of a
    phase. So this is the state at the start of the phase, where the first step is evaluated. If the
    phase has no steps, that may be the end of the run: then it is a state close to the start.
    """
    close = lambda y: y + jnp.finfo(y.dtype).eps ** 0.5
    return tree_where(solution.accepted > 0, start, jax.tree.map(close, start))


def _tangents_of_group(tangents, blocks: _Blocks, phase: _PhaseData):
    """Return the tangents after a group of blocks, and the tangents after each of its blocks.

    tangents: those before it, as in `_tangents_of_block`.
    """
    carry, d_problem = tangents

    def block(carry, block):
        carry = _block_if_used((carry, d_problem), block.first < phase.accepted, block, phase)
        return carry, carry[0]

    return jax.lax.scan(block, carry, blocks)


def _no_group(tangents, blocks: _Blocks, phase: _PhaseData):
    """Return the tangents unchanged, and zeros for those after each block."""
    carry, zeros = tangents[0], lambda d: jnp.zeros((*blocks.first.shape, *d.shape), d.dtype)
    return carry, jax.tree.map(zeros, carry[0])


def _tangents_of_block(tangents, block: _Blocks, phase: _PhaseData):
    """Return the tangents after a block: of the state, at the save times, and of the increments.

    tangents: those before it, and that of the problem.
    """
    (d_y, d_ys, d_recorded), d_problem = tangents
    first, interval, records = block.first, block.starts.shape[0], phase.records
    is_stored = jnp.zeros((), bool)
    if records is not None:
        assert records.increments is not None
        is_stored = first < _row_count(records.increments)
        rows = lambda x: jax.lax.dynamic_slice_in_dim(x, first, interval)
        records = jax.tree.map(rows, records)

    def step(carry, x):
        (y, d_y), (start, end, near, record) = carry, x
        used = end > start
        at, times = tree_where(
            used, (y, (start, end)), (phase.unused_y, (phase.start_time, phase.start_time))
        )
        choice = phase.problem.field_args.row_choice
        if choice is not None:
            near = where(used, near, choice.near)
        record = _record_of_step(at, (*times, near), record, is_stored, phase)
        d_y, d_increments = _step_if_used((d_y, d_problem), used, times, at, record, phase)
        move = lambda: end_of_step(phase.solver, (*times, record), phase.problem, at)
        after = jax.lax.cond(unvmap_any(used), move, lambda: y)
        return (tree_where(used, after, y), d_y), (d_y, d_increments)

    (_, d_after), (d_steps, d_increments) = jax.lax.scan(
        step, (block.y, d_y), (block.starts, block.ends, block.near, records)
    )
    last = jnp.minimum(first + interval, phase.accepted)
    in_block = (phase.save_index > first) & (phase.save_index <= last)
    step_index = jnp.clip(phase.save_index - first - 1, 0, interval - 1)
    save = lambda old, new: where(_broadcast_mask(in_block, old), new[step_index], old)
    d_written = None if d_recorded is None else _write(d_recorded, d_increments, first)
    return d_after, jax.tree.map(save, d_ys, d_steps), d_written


def _record_of_step(
    y: ODEState, step, record: StepRecord | None, is_stored, phase: _PhaseData
) -> StepRecord:
    """Return the record of a step from y. That of an unused step is arbitrary but finite.

    step: start, end, and whether it was taken with reduced rows.
    record: None if the phase has no records. is_stored: whether `record` was stored in the run.
    """
    (start, end, near), problem, solver = step, phase.problem, phase.solver

    def take_again():
        field_args = with_rows_at(y.q, problem.field_args, near)
        return recorded_step(solver, problem.field, (start, end), y, field_args)

    if record is None:
        record = StepRecord(zero_increments(solver, y), problem.field_args.row_choice)
    return jax.lax.cond(unvmap_any(end > start) & ~is_stored, take_again, lambda: record)


def _no_block(tangents, block: _Blocks, phase: _PhaseData):
    """Return the tangents unchanged."""
    return tangents[0]


def _tangent_of_step(tangents, times, y: ODEState, record: StepRecord, phase: _PhaseData):
    """Return the tangents of the state after a step and of its increments.

    tangents: of the state before it and of the problem.
    times: start and end.
    """
    (d_y, d_problem), (start, end) = tangents, times
    d_end, d_increments = step_tangent(
        phase.solver, (start, end, record), (phase.problem, d_problem), (y, d_y)
    )
    return tree_where(end > start, d_end, d_y), d_increments


def _no_step(tangents, times, y: ODEState, record: StepRecord, phase: _PhaseData):
    """Return the tangent of the state unchanged, and zeros for that of the increments."""
    return tangents[0], zero_increments(phase.solver, y)


_step_if_used = skippable("step_tangent", _tangent_of_step, _no_step)
_block_if_used = skippable("block_tangent", _tangents_of_block, _no_block)
_group_if_used = skippable("group_tangent", _tangents_of_group, _no_group)


def _broadcast_mask(mask, like):
    """Return a mask of rows with as many axes as `like`, an array of such rows."""
    return mask.reshape(-1, *(1,) * (like.ndim - 1))


def _row_count(increments: ODEState) -> int:
    """Return the number of steps whose increments are given."""
    return increments.q.shape[0]


def _write(recorded: ODEState, increments: ODEState | None, first) -> ODEState:
    """Write the increments of a block from row `first` on, if there is room for them."""
    assert increments is not None
    write = lambda x, y: jax.lax.dynamic_update_slice_in_dim(x, y, first, 0)
    fits = first + _row_count(increments) <= _row_count(recorded)
    return tree_where(fits, jax.tree.map(write, recorded, increments), recorded)
