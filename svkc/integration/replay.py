"""Integrate one phase with derivatives in both modes, for fixed or adaptive steps.

The stepping loop is never differentiated. Its steps are replayed at fixed times, to find what a
change of the start and of the parameters does to each step: forwards for a tangent, backwards for a
cotangent. The stepping loop stores the times of the steps and a checkpoint of the state after every
`checkpoint_interval` steps. Where the time of the start or a save time changes, the vector field
there gives the derivative.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from svkc._jax.control_flow import unvmap_any
from svkc._jax.primitive import custom_primitive
from svkc._jax.pytrees import materialise_zeros, stop_gradient_tree, tree_where
from svkc.integration.event_adjoint import end_of_phase_tangent, transport_tangent
from svkc.integration.integrate import integrate_phase
from svkc.integration.ode import FieldArgs, ODEState
from svkc.integration.runge_kutta import replay_step
from svkc.integration.solution import SUCCESSFUL, PhaseProblem, PhaseSolution, StepperOptions
from svkc.loops.constraint_rows import choose_rows
from svkc.model.validation import integer

# Blocks of steps are skipped in groups of this size past the end of a run.
BLOCKS_PER_GROUP = 64


class Replay(eqx.Module):
    """The default `adjoint` of `svkc.simulate`: replay the steps of a run to differentiate it.

    Forward and reverse mode work in any combination with `vmap` and `jit`. The times of the steps
    are fixed in derivatives; the times of events, of the start, of the end and of saved states are
    not.

    The memory for a phase is max_steps (1 + n / every) numbers, where n counts the entries of q and
    v, plus the residuals of one block of `every` steps.

    every: number of steps between checkpoints. Reverse mode repeats the steps between two
        checkpoints.

    Raises ValueError if `every` is not an integer of at least 1.
    """

    every: int = eqx.field(static=True, default=16)

    def __check_init__(self) -> None:
        integer("every", self.every, 1)


def _step_grid(t0, save_ts, solution: PhaseSolution):
    """Return the times of the step ends, and for each save time the index of its step end.

    The times, [steps + 1], start with t0 and repeat the end of the phase in unused rows.
    """
    times = jnp.concatenate([t0[None], solution.step_ts])
    save_index = jnp.searchsorted(times, save_ts).astype(jnp.int32)
    unused = jnp.arange(times.shape[0], dtype=jnp.int32) > solution.accepted
    return jnp.where(unused, times[solution.accepted], times), save_index


def _replay_block(y: ODEState, steps, problem: PhaseProblem, solver) -> tuple[ODEState, ODEState]:
    """Return the state after one block of steps, and the states after each of its steps.

    steps: starts and ends of the steps, and which are taken with reduced rows.
    """

    def replay(y, step):
        start, stop, near = step
        field_args = _at(y.q, problem.field_args, near)
        y = replay_step(solver, problem.field, start, stop, y, field_args)
        return y, y

    return jax.lax.scan(replay, y, steps)


def _at(q, field_args: FieldArgs, near: Any = None) -> FieldArgs:
    """Return the arguments of the vector field with the rows of the loops for a step from q.

    near: as in `RowChoice` (None: as at the start of the phase).
    """
    choice = field_args.row_choice
    if choice is None:
        return field_args
    near = choice.near if near is None else near
    rows = choose_rows(field_args.chain, field_args.structure, q, near)
    return dataclasses.replace(field_args, row_choice=rows)


def _integrate(start: ODEState, times, problem: PhaseProblem, options: StepperOptions, guards):
    """Integrate one phase. Return its `PhaseSolution`, and the time and the state at its end.

    In derivatives the time of `PhaseSolution.y` is fixed. The second and third result have the
    derivative of the end's time as well (`event_adjoint`).

    times: start, scheduled end and save times.
    guards: the `GuardValues`, or the `VectorField` if there are no guards.
    """
    solution = integrate_phase(start, times, problem, options)
    return solution, solution.t, solution.y


def _integrate_with_replay_jvp(primals, tangents):
    """Return the tangents at the fixed times of the steps, plus those of changing times."""
    start, times, problem, options, guards = primals
    d_start, d_times, d_problem, _, d_guards = tangents
    solution, t, y = integrate_with_replay(*primals)
    (t0, stop, save_ts), (d_t0, d_stop, d_save_ts) = times, d_times
    # One program evaluates the field at both ends.
    rates = jax.lax.map(
        lambda x: problem.field(*x, _at(x[1].q, problem.field_args)),
        (jnp.stack([t0, t]), jax.tree.map(lambda *x: jnp.stack(x), start, y)),
    )
    rate_start, rate_end = (jax.tree.map(lambda x, i=i: x[i], rates) for i in range(2))
    grid = _step_grid(*stop_gradient_tree((t0, save_ts, solution)))
    d_start = materialise_zeros(start, d_start)
    if d_t0 is not None:
        start, d_start = _at_fixed_start(
            start, d_start, rate_start, (t0, d_t0), (problem, d_problem)
        )
    d_y, d_ys, d_checkpoints = _replay_tangents(
        (start, d_start), (problem, d_problem), *grid, solution=solution, options=options
    )
    if d_save_ts is not None:
        d_ys = jax.vmap(lambda y, dy, *t: _at_shifted_time(y, dy, t, (problem, d_problem)))(
            solution.ys, d_ys, save_ts, d_save_ts
        )
    d_solution = eqx.tree_at(
        lambda s: (s.y, s.ys, s.checkpoints),
        jax.tree.map(lambda x: None, solution),
        (d_y, d_ys, d_checkpoints),
        is_leaf=lambda x: x is None or isinstance(x, ODEState),
    )
    at_scheduled_end = solution.result == SUCCESSFUL
    stop_shift = jnp.where(at_scheduled_end, stop - solution.t, 0)
    d_stop_shift = None if d_stop is None else jnp.where(at_scheduled_end, d_stop, 0)
    event = stop_gradient_tree(solution.event)
    d_end = end_of_phase_tangent(
        (solution.t, solution.y, stop_shift, problem.field_args, guards, event),
        (None, d_y, d_stop_shift, d_problem.field_args, d_guards, None),
        (t, y),
        rate_end,
    )
    return (solution, t, y), (d_solution, *d_end)


def _at_fixed_start(
    y: ODEState, dy: ODEState, rate: ODEState, time, problem
) -> tuple[ODEState, ODEState]:
    """Return the start state and its tangent as if the time of the start were fixed.

    A later start leaves less time to move: `rate * d_t0` is subtracted from the tangent.

    rate: derivative of the state by time at the start.
    time, problem: pairs of primal and tangent.
    """
    t0, d_t0 = time
    duration = jax.lax.stop_gradient(t0) - t0
    dy = jax.tree.map(lambda d, r: d - r * d_t0, dy, rate)
    dy = _transport(y, dy, rate, (t0, duration), problem)
    return jax.tree.map(lambda y, r: y + duration * r, y, rate), dy


def _at_shifted_time(y: ODEState, dy: ODEState, time, problem) -> ODEState:
    """Return the tangent of a state saved at a changing time, given the tangent at a fixed time.

    time, problem: pairs of primal and tangent.
    """
    t, dt = time
    rate = problem[0].field(t, y, problem[0].field_args)
    dy = _transport(y, dy, rate, (t, t - jax.lax.stop_gradient(t)), problem)
    return jax.tree.map(lambda d, r: d + r * dt, dy, rate)


def _transport(y: ODEState, dy: ODEState, rate: ODEState, time, problem) -> ODEState:
    """Return `transport_tangent` of dy.

    time: t and the duration of the transport.
    problem: pair of primal and tangent.
    """
    (t, duration), (problem, d_problem) = time, problem
    return transport_tangent(
        (dy, d_problem.field_args, d_problem.field),
        rate,
        duration=duration,
        t=t,
        y=y,
        field_args=problem.field_args,
        field=problem.field,
    )


def _blocks(start: ODEState, step_grid, solution: PhaseSolution, interval: int):
    """Return the blocks of `interval` steps, padded to whole groups.

    For each block: its index, whether any of its steps was taken, the state at its start, and the
    starts and ends of its steps and which of them were taken with reduced rows.
    """
    groups = -(-(solution.checkpoints.q.shape[0] + 1) // BLOCKS_PER_GROUP)
    count = groups * BLOCKS_PER_GROUP
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
        lambda s, c: jnp.where(used.reshape(-1, *(1,) * s.ndim), c, s[None]), start, states
    )
    rest = count * interval + 1 - step_grid.shape[0]
    times = jnp.concatenate([step_grid, jnp.broadcast_to(step_grid[-1:], (rest,))])
    rows = lambda x: x.reshape(-1, interval)
    near = solution.step_near
    if near is not None:
        near = rows(jnp.concatenate([near, jnp.zeros(rest, bool)]))
    return index, used, states, (rows(times[:-1]), rows(times[1:]), near)


@eqx.filter_jit
def _replay_tangents(
    start, problem, step_grid, save_index, *, solution: PhaseSolution, options: StepperOptions
):
    """Return the tangents at the end, at the save times and at the checkpoints.

    The blocks of steps are replayed in order, each from its checkpoint.

    start, problem: pairs of primal and tangent.
    step_grid, save_index: as from `_step_grid`.
    """
    (start, d_start), interval = start, options.checkpoint_interval
    count = solution.checkpoints.q.shape[0]
    index, *rest = _blocks(start, step_grid, solution, interval)

    def block(carry, x):
        d_y, d_ys = carry
        i, used, y, steps = x

        def replay():
            d_after, d_steps = _block_tangent(d_y, y, steps, problem, options.solver)
            last = jnp.minimum((i + 1) * interval, solution.accepted)
            in_block = (save_index > i * interval) & (save_index <= last)
            step_index = jnp.clip(save_index - i * interval - 1, 0, interval - 1)
            save = lambda old, new: jnp.where(
                _broadcast_mask(in_block, old) & used, new[step_index], old
            )
            return tree_where(used, d_after, d_y), jax.tree.map(save, d_ys, d_steps)

        carry = jax.lax.cond(unvmap_any(used), replay, lambda: (d_y, d_ys))
        return carry, carry[0]

    @jax.checkpoint
    def group(carry, x):
        def replay(carry):
            return jax.lax.scan(block, carry, x)

        def skip(carry):
            zeros = lambda d: jnp.zeros((BLOCKS_PER_GROUP, *d.shape), d.dtype)
            return carry, jax.tree.map(zeros, carry[0])

        return jax.lax.cond(unvmap_any(jnp.any(x[1])), replay, skip, carry)

    at_start = lambda d: jnp.where(_broadcast_mask(save_index == 0, d[None]), d[None], 0)
    groups = jax.tree.map(lambda x: x.reshape(-1, BLOCKS_PER_GROUP, *x.shape[1:]), (index, *rest))
    carry = d_start, jax.tree.map(at_start, d_start)
    (d_end, d_ys), d_after = jax.lax.scan(group, carry, groups)
    written = (index[:count] + 1) * interval <= solution.accepted
    d_checkpoints = jax.tree.map(lambda d: d.reshape(-1, *d.shape[2:])[:count], d_after)
    mask = lambda d: jnp.where(_broadcast_mask(written, d), d, 0)
    return d_end, d_ys, jax.tree.map(mask, d_checkpoints)


@eqx.filter_checkpoint
def _block_tangent(d_y: ODEState, y: ODEState, steps, problem, solver):
    """Return the tangents after a block of steps and after each of its steps."""
    problem, d_problem = problem
    replay = lambda y, problem: _replay_block(y, steps, problem, solver)
    return eqx.filter_jvp(replay, (y, problem), (d_y, d_problem))[1]


def _broadcast_mask(mask, like):
    """Return a mask of rows with as many axes as `like`, an array of such rows."""
    return mask.reshape(-1, *(1,) * (like.ndim - 1))


integrate_with_replay: Callable[..., Any] = custom_primitive(
    "integrate_with_replay", _integrate, _integrate_with_replay_jvp
)
