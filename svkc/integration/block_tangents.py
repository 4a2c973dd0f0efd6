"""Tangents of the steps of a phase, computed in blocks of steps.

The tangents are those at fixed times of the steps. Where increments of the stages were stored in
the run, the stages need not be computed again before they are differentiated.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from svkc._jax.control_flow import unvmap_any
from svkc._jax.primitive import custom_primitive, undefined_primals
from svkc._jax.pytrees import tree_where
from svkc._jax.select import where
from svkc.integration.ode import FieldArgs, ODEState
from svkc.integration.runge_kutta import increment_bytes, recorded_step, step_and_tangent
from svkc.integration.solution import PhaseProblem, PhaseSolution, StepperOptions, StepRecord
from svkc.loops.constraint_rows import choose_rows

# Unused blocks are skipped in groups of at most this size; unused groups are skipped in groups of
# as many.
GROUP_SIZE = 16
# Number of steps at the start of a phase whose records are stored, and limit of the memory of their
# increments for each element of a batch. The number is rounded up to whole groups of blocks.
RECORDED_STEPS, RECORDS_BYTES = 512, 1 << 23


def _group_size(options: StepperOptions) -> int:
    """Return the number of blocks in a group."""
    return min(GROUP_SIZE, -(-options.max_steps // options.checkpoint_interval))


def record_capacity(start: ODEState, options: StepperOptions) -> int:
    """Return the number of steps that are recorded, those of whole groups."""
    steps = options.checkpoint_interval * _group_size(options)
    groups = RECORDS_BYTES // max(1, steps * increment_bytes(options.solver, start))
    return steps * min(groups, -(-min(RECORDED_STEPS, options.max_steps) // steps))


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


def _blocks(start: ODEState, step_grid, solution: PhaseSolution, options: StepperOptions):
    """Return the blocks of `checkpoint_interval` steps, [groups of groups, groups, blocks].

    For each block: its index, whether any of its steps was taken, the state at its start, and the
    starts and ends of its steps and which of them were taken with reduced rows.
    """
    interval, size = options.checkpoint_interval, _group_size(options)
    count = solution.checkpoints.q.shape[0] + 1
    groups = min(GROUP_SIZE, -(-count // size))
    shape = (-(-count // (size * groups)), groups, size)
    count = math.prod(shape)
    padding = count - solution.checkpoints.q.shape[0] - 1
    index = jnp.arange(count, dtype=jnp.int32)
    used = index * interval < solution.accepted
    states = jax.tree.map(
        lambda s, c: jnp.concatenate([s[None], c, jnp.broadcast_to(s[None], (padding, *s.shape))]),
        start,
        solution.checkpoints,
    )
    # Unused blocks get a finite state.
    states = jax.tree.map(
        lambda s, c: where(used.reshape(-1, *(1,) * s.ndim), c, s[None]), start, states
    )
    rest = count * interval + 1 - step_grid.shape[0]
    times = jnp.concatenate([step_grid, jnp.broadcast_to(step_grid[-1:], (rest,))])
    rows = lambda x: x.reshape(-1, interval)
    near = solution.step_near
    if near is not None:
        near = rows(jnp.concatenate([near, jnp.zeros(rest, bool)]))
    blocks = index, used, states, (rows(times[:-1]), rows(times[1:]), near)
    return jax.tree.map(lambda x: x.reshape(*shape, *x.shape[1:]), blocks)


@eqx.filter_jit
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
    (start, d_start), interval = start, options.checkpoint_interval
    count = solution.checkpoints.q.shape[0]

    def block(carry, x):
        d_y, d_ys, d_recorded = carry
        (i, used, y, steps), records = x

        def differentiate():
            first = i * interval
            d_after, (d_steps, d_increments) = _block_tangent(
                (d_y, problem[1]), (y, steps, records), problem[0], options.solver
            )
            last = jnp.minimum(first + interval, solution.accepted)
            in_block = used & (save_index > first) & (save_index <= last)
            step_index = jnp.clip(save_index - first - 1, 0, interval - 1)
            save = lambda old, new: where(_broadcast_mask(in_block, old), new[step_index], old)
            d_written = None if d_recorded is None else _write(d_recorded, d_increments, first)
            return tree_where(used, d_after, d_y), jax.tree.map(save, d_ys, d_steps), d_written

        carry = jax.lax.cond(unvmap_any(used), differentiate, lambda: carry)
        return carry, carry[0]

    def group(carry, x):
        return jax.lax.scan(block, carry, (x, _records_of_blocks(solution.records, x[0], interval)))

    many_groups = lambda carry, x: jax.lax.scan(_skipped_if_unused(group), carry, x)
    at_start = lambda d: where(_broadcast_mask(save_index == 0, d[None]), d[None], 0)
    d_recorded = None
    if with_increments and solution.records is not None:
        d_recorded = jax.tree.map(jnp.zeros_like, solution.records.increments)
    carry = d_start, jax.tree.map(at_start, d_start), d_recorded
    (d_end, d_ys, d_recorded), d_after = jax.lax.scan(
        _skipped_if_unused(many_groups), carry, _blocks(start, step_grid, solution, options)
    )
    written = jnp.arange(1, count + 1, dtype=jnp.int32) * interval <= solution.accepted
    d_checkpoints = jax.tree.map(lambda d: d.reshape(-1, *d.shape[3:])[:count], d_after)
    mask = lambda d: where(_broadcast_mask(written, d), d, 0)
    return d_end, d_ys, jax.tree.map(mask, d_checkpoints), d_recorded


def _skipped_if_unused(scan: Callable) -> Callable:
    """Return `scan` of blocks, (carry, blocks) -> (carry, tangents after each block), or no change
    and zeros if none of the blocks is used.

    Reverse mode stores the arguments and recomputes the rest. The outer checkpoint keeps constants
    from being stored for each group, the inner one keeps what a branch computes from being stored.
    """

    @jax.checkpoint
    def scan_or_skip(carry, blocks):
        used = blocks[1]
        zeros = lambda d: jnp.zeros((*used.shape, *d.shape), d.dtype)
        skip = lambda carry, _: (carry, jax.tree.map(zeros, carry[0]))
        return jax.lax.cond(unvmap_any(jnp.any(used)), jax.checkpoint(scan), skip, carry, blocks)

    return scan_or_skip


def _records_of_blocks(records: StepRecord | None, index, interval: int):
    """Return the records of a group of blocks, and for each block whether it has records.

    index: of the blocks.
    """
    if records is None:
        return None
    assert records.increments is not None
    steps, capacity = index.shape[0] * interval, _row_count(records.increments)
    first = index[0] * interval
    rows = lambda x: jax.lax.dynamic_slice_in_dim(x, first, steps).reshape(
        -1, interval, *x.shape[1:]
    )
    return jax.tree.map(rows, records), jnp.broadcast_to(first < capacity, index.shape)


def _tangents_of_block(tangents, block, problem: PhaseProblem, solver):
    """Return the tangents after a block of steps, after each of its steps, and of its increments.

    tangents: of the state at its start and of the problem.
    block: state at its start, starts and ends of its steps and which of them have reduced rows,
    and as from `_records_of_blocks`.
    """
    (d_y, d_problem), (y, steps, stored) = tangents, block
    records, is_stored = (None, False) if stored is None else stored

    def step(carry, x):
        (start, stop, near), record = x

        def take_again(y):
            field_args = with_rows_at(y.q, problem.field_args, near)
            return recorded_step(solver, problem.field, (start, stop), y, field_args)

        if record is None:
            record = take_again(carry[0])
        else:
            stored = record
            record = jax.lax.cond(is_stored, lambda y: stored, take_again, carry[0])
        *end, d_increments = step_and_tangent(
            solver, (start, stop, record), (problem, d_problem), carry
        )
        # rows past the end of the phase hold no step
        end = tree_where(stop > start, tuple(end), carry)
        return end, (end[1], d_increments)

    (_, d_end), d_steps = jax.lax.scan(step, (y, d_y), (steps, records))
    return d_end, d_steps


def _block_tangent_jvp(primals, tangents):
    # without the primitive, which would compute the value a second time
    return eqx.filter_jvp(eqx.filter_checkpoint(_tangents_of_block), primals, tangents)


def _block_tangent_transpose(inputs, cotangents):
    tangents, *rest = inputs
    shapes, known = undefined_primals(tangents)
    linear = lambda unknown: _tangents_of_block(eqx.combine(unknown, known), *rest)
    (cotangents,) = jax.linear_transpose(linear, shapes)(cotangents)
    return cotangents, *jax.tree.map(lambda _: None, tuple(rest))


# JAX traces the steps of a block once for a gradient. Without the primitive, JAX would transform
# their equations again for every scan, condition and checkpoint around them.
_block_tangent = custom_primitive(
    "block_tangent",
    eqx.filter_checkpoint(_tangents_of_block),
    _block_tangent_jvp,
    _block_tangent_transpose,
    inlined_by_vmap=True,
)


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
