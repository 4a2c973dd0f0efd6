"""Integrate one phase with derivatives in both modes, for fixed or adaptive steps.

The stepping loop is never differentiated. Its steps are differentiated at fixed times, one after
the other (`block_tangents`): in order for a tangent, in reverse order for a cotangent. The stepping
loop stores the times of the steps, a checkpoint of the state after every `checkpoint_interval`
steps, and the stages of the first steps. Where the time of the start or a save time changes, the
vector field there gives the derivative.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp

from svkc._jax.primitive import custom_primitive
from svkc._jax.pytrees import materialise_zeros, stop_gradient_tree
from svkc._jax.select import where
from svkc.integration.block_tangents import record_capacity, replay_tangents, with_rows_at
from svkc.integration.event_adjoint import end_of_phase_tangent, transport_tangent
from svkc.integration.integrate import integrate_phase
from svkc.integration.ode import ODEState
from svkc.integration.solution import (
    SUCCESSFUL,
    PhaseProblem,
    PhaseSolution,
    StepperOptions,
)
from svkc.model.validation import integer


class Replay(eqx.Module):
    """The default `adjoint` of `svkc.simulate`: replay the steps of a run to differentiate it.

    Forward and reverse mode work in any combination with `vmap` and `jit`. The times of the steps
    are fixed in derivatives; the times of events, of the start, of the end and of saved states are
    not.

    Of explicit Runge-Kutta solvers the stages of up to 1024 steps of a run are kept, in at most
    8 MiB. The phases share this equally, and each keeps the stages of its first steps. Stages of
    later steps are computed again in derivatives. The memory for a phase is max_steps (1 + n /
    every) numbers, where n counts the entries of q and v, plus its stages, plus those of one block
    of `every` steps.

    every: number of steps between checkpoints. None: 16, or 64 if `max_steps` is at least 4096.

    Raises ValueError if `every` is not an integer of at least 1.
    """

    every: int | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        if self.every is not None:
            integer("every", self.every, 1)

    def checkpoint_interval(self, max_steps: int) -> int:
        """Return the number of steps between checkpoints in phases of at most `max_steps` steps."""
        every = self.every
        if every is None:
            every = 64 if max_steps >= 4096 else 16
        return min(every, max_steps)


def _step_grid(t0, save_ts, solution: PhaseSolution):
    """Return the times of the step ends, and for each save time the index of its step end.

    The times, [steps + 1], start with t0 and repeat the end of the phase in unused rows.
    """
    times = jnp.concatenate([t0[None], solution.step_ts])
    save_index = jnp.searchsorted(times, save_ts).astype(jnp.int32)
    unused = jnp.arange(times.shape[0], dtype=jnp.int32) > solution.accepted
    return where(unused, times[solution.accepted], times), save_index


def _integrate(start: ODEState, times, problem: PhaseProblem, options: StepperOptions, guards):
    """Integrate one phase. Return its `PhaseSolution`, and the time and the state at its end.

    In derivatives the time of `PhaseSolution.y` is fixed. The second and third result have the
    derivative of the end's time as well (`event_adjoint`).

    times: start, scheduled end and save times.
    guards: the `GuardValues`, or the `VectorField` if there are no guards.
    """
    solution = integrate_phase(start, times, problem, options)
    return solution, solution.t, solution.y


def _integrate_jvp(primals, tangents, *, with_records: bool):
    """Return the tangents at the fixed times of the steps, plus those of changing times.

    The run that is differentiated stores the records of its steps.

    with_records: whether the solution and its tangents have the records.
    """
    start, times, problem, options, guards = primals
    _check_solver(options.solver)
    d_start, d_times, d_problem, _, d_guards = tangents
    options = dataclasses.replace(options, record_capacity=record_capacity(start, options))
    solution, t, y = _integrate_with_records(start, times, problem, options, guards)
    (t0, stop, save_ts), (d_t0, d_stop, d_save_ts) = times, d_times
    # One program evaluates the field at both ends.
    rates = jax.lax.map(
        lambda x: problem.field(*x, with_rows_at(x[1].q, problem.field_args)),
        (jnp.stack([t0, t]), jax.tree.map(lambda *x: jnp.stack(x), start, y)),
    )
    rate_start, rate_end = (jax.tree.map(lambda x, i=i: x[i], rates) for i in range(2))
    grid = _step_grid(*stop_gradient_tree((t0, save_ts, solution)))
    d_start = materialise_zeros(start, d_start)
    if d_t0 is not None:
        start, d_start = _at_fixed_start(
            start, d_start, rate_start, (t0, d_t0), (problem, d_problem)
        )
    d_y, d_ys, d_checkpoints, d_increments = replay_tangents(
        (start, d_start), (problem, d_problem), *grid, solution=solution, options=options,
        with_increments=with_records,
    )  # fmt: skip
    if d_save_ts is not None:
        d_ys = jax.vmap(lambda y, dy, *t: _at_shifted_time(y, dy, t, (problem, d_problem)))(
            solution.ys, d_ys, save_ts, d_save_ts
        )
    if not with_records:
        solution = dataclasses.replace(solution, records=None)
    d_solution = _solution_tangent(solution, (d_y, d_ys, d_checkpoints), d_increments)
    at_scheduled_end = solution.result == SUCCESSFUL
    stop_shift = where(at_scheduled_end, stop - solution.t, 0)
    d_stop_shift = None if d_stop is None else where(at_scheduled_end, d_stop, 0)
    event = stop_gradient_tree(solution.event)
    d_end = end_of_phase_tangent(
        (solution.t, solution.y, stop_shift, problem.field_args, guards, event),
        (None, d_y, d_stop_shift, d_problem.field_args, d_guards, None),
        (t, y),
        rate_end,
    )
    return (solution, t, y), (d_solution, *d_end)


def _check_solver(solver: diffrax.AbstractSolver[Any]) -> None:
    """Raise ValueError for a solver whose steps depend on values that it keeps from step to step.

    A step is differentiated by the state at its start alone.
    """
    while isinstance(solver, diffrax.AbstractWrappedSolver):
        solver = solver.solver
    if isinstance(solver, diffrax.LeapfrogMidpoint | diffrax.ReversibleHeun):
        raise ValueError(
            f"adjoint: svkc.integrators.Replay cannot differentiate {type(solver).__name__}, whose"
            " steps depend on earlier ones; give a diffrax adjoint, such as"
            " diffrax.RecursiveCheckpointAdjoint()"
        )


def _solution_tangent(solution: PhaseSolution, d_states, d_increments) -> PhaseSolution:
    """Return the tangent of a solution, with None where there is none.

    d_states: tangents of `y`, `ys` and `checkpoints`. d_increments: of the records, if any.
    """
    parts, d_parts = lambda s: (s.y, s.ys, s.checkpoints), d_states
    if solution.records is not None:
        parts = lambda s: (s.y, s.ys, s.checkpoints, s.records.increments)
        d_parts = (*d_states, d_increments)
    return eqx.tree_at(
        parts,
        jax.tree.map(lambda x: None, solution),
        d_parts,
        is_leaf=lambda x: x is None or isinstance(x, ODEState),
    )


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


integrate_with_replay: Callable[..., Any] = custom_primitive(
    "integrate_with_replay", _integrate, functools.partial(_integrate_jvp, with_records=False)
)
_integrate_with_records: Callable[..., Any] = custom_primitive(
    "integrate_with_records", _integrate, functools.partial(_integrate_jvp, with_records=True)
)
