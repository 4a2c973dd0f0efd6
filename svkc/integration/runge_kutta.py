"""Single steps of a solver and their derivatives."""

import dataclasses
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from svkc._jax.one_kernel import one_kernel
from svkc.integration.ode import FieldArgs, ODEState
from svkc.integration.solution import PhaseProblem, StepRecord
from svkc.integration.vector_field import VectorField, project_state


def _without_last_stage(tableau: diffrax.ButcherTableau) -> diffrax.ButcherTableau:
    """Return an explicit tableau without its last stage, whose weights are zero."""
    assert tableau.b_sol[-1] == tableau.b_error[-1] == 0
    return diffrax.ButcherTableau(
        c=tableau.c[:-1],
        b_sol=tableau.b_sol[:-1],
        b_error=tableau.b_error[:-1],
        a_lower=tableau.a_lower[:-1],
    )


def with_scan_kind(
    solver: diffrax.AbstractSolver[Any], kind: str | None
) -> diffrax.AbstractSolver[Any]:
    """Return a Runge-Kutta solver whose loop over stages is of this kind; others as they are.

    For a solver that wraps another, the wrapped solver is changed.

    kind: "lax" for forward mode, "bounded" for both modes, None for diffrax's own choice.
    """
    if isinstance(solver, diffrax.AbstractWrappedSolver):
        inner = with_scan_kind(solver.solver, kind)
        return eqx.tree_at(lambda s: s.solver, solver, inner)
    if not isinstance(solver, diffrax.AbstractRungeKutta):
        return solver
    return eqx.tree_at(lambda s: s.scan_kind, solver, kind, is_leaf=lambda x: x is None)


class _Dopri8WithoutDenseOutput(diffrax.Dopri8):
    """Dopri8 without its fourteenth stage, which serves the dense output alone."""

    tableau: ClassVar[diffrax.ButcherTableau] = _without_last_stage(diffrax.Dopri8.tableau)
    interpolation_cls: ClassVar[Any] = diffrax.LocalLinearInterpolation


def without_dense_output(solver: diffrax.AbstractSolver[Any]) -> diffrax.AbstractSolver[Any]:
    """Return a solver with these steps and error estimates that evaluates no stage for its dense
    output alone.

    Only Dopri8 has such a stage, its last. It is also the first of the next step, but not after a
    projection, which changes the state.
    """
    if type(solver) is not diffrax.Dopri8:
        return solver
    return _Dopri8WithoutDenseOutput(scan_kind=solver.scan_kind)


def _explicit_tableau(solver: diffrax.AbstractSolver[Any]) -> diffrax.ButcherTableau | None:
    """Return the tableau of an explicit Runge-Kutta solver, None for any other solver."""
    # a solver that wraps one counts as explicit for diffrax, but has no tableau
    tableau = getattr(solver, "tableau", None)
    is_explicit = isinstance(solver, diffrax.AbstractERK)
    return tableau if is_explicit and isinstance(tableau, diffrax.ButcherTableau) else None


def _stage_count(tableau: diffrax.ButcherTableau) -> int:
    """Return the number of stages without those that serve the error estimate alone."""
    return int(np.max(np.flatnonzero(tableau.b_sol))) + 1


def increments_of_stages(solver: diffrax.AbstractSolver[Any], dense_info: Any) -> ODEState | None:
    """Return the increments of a `StepRecord`.

    dense_info: what the solver's step returned for the dense output.
    """
    tableau = _explicit_tableau(solver)
    if tableau is None:
        return None
    return jax.tree.map(lambda k: k[: _stage_count(tableau)], dense_info["k"])


def initial_records(
    solver: diffrax.AbstractSolver[Any], field_args: FieldArgs, start: ODEState, capacity: int
) -> StepRecord | None:
    """Return zero records, None without capacity or for a solver without increments."""
    increments = zero_increments(solver, start)
    if not capacity or increments is None:
        return None
    rows = lambda x: jnp.broadcast_to(x[None], (capacity, *x.shape))
    return StepRecord(*jax.tree.map(rows, (increments, field_args.row_choice)))


def zero_increments(solver: diffrax.AbstractSolver[Any], y: ODEState) -> ODEState | None:
    """Return the increments of a step without motion, None for a solver without increments."""
    tableau = _explicit_tableau(solver)
    return None if tableau is None else _zero_increments(tableau, y)


def _zero_increments(tableau: diffrax.ButcherTableau, y: ODEState) -> ODEState:
    """Return the increments of a step of an explicit Runge-Kutta method without motion."""
    return jax.tree.map(lambda y: jnp.zeros((_stage_count(tableau), *y.shape), y.dtype), y)


def increment_bytes(solver: diffrax.AbstractSolver[Any], start: ODEState) -> int:
    """Return the size of the increments of a step, zero for a solver without increments."""
    tableau = _explicit_tableau(solver)
    count = 0 if tableau is None else _stage_count(tableau)
    return count * sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(start))


def recorded_step(
    solver: diffrax.AbstractSolver[Any],
    field: VectorField,
    times,
    y: ODEState,
    field_args: FieldArgs,
) -> StepRecord:
    """Return the record of a step from y.

    times: start and end.
    """
    tableau, increments = _explicit_tableau(solver), None
    if tableau is not None:
        increments = _increments(tableau, field, times, y, field_args)
    return StepRecord(increments, field_args.row_choice)


@one_kernel
def end_of_step(
    solver: diffrax.AbstractSolver[Any],
    step: tuple[Array, Array, StepRecord],
    problem: PhaseProblem,
    y: ODEState,
) -> ODEState:
    """Return the end of a projected step from y.

    step: start, end and record.
    """
    (t0, t1, record), field = step, problem.field
    field_args = dataclasses.replace(problem.field_args, row_choice=record.row_choice)
    tableau = _explicit_tableau(solver)
    if tableau is None:
        end = _step_of_any_solver(solver, field, (t0, t1), y, field_args)
    else:
        assert record.increments is not None
        end = _add(y, _weights_of_end(tableau), record.increments)
    return project_state(field, field_args, end)[0]


def step_tangent(
    solver: diffrax.AbstractSolver[Any],
    step: tuple[Array, Array, StepRecord],
    problem: tuple[PhaseProblem, Any],
    start: tuple[ODEState, ODEState],
) -> tuple[ODEState, ODEState | None]:
    """Return the tangents of the end of a projected step and of its increments.

    Reverse mode stores the arguments of the torques and of the rates in each evaluation of the
    field, and those of the projection, and recomputes these functions.

    step: start, end and record.
    problem, start: pairs of primal and tangent.
    """
    (_, t1, record), tableau = step, _explicit_tableau(solver)
    if tableau is None:
        return _tangent_of_any_step(solver, step, problem, start), None
    assert record.increments is not None
    # outside the kernel: a kernel cannot hold products of matrices
    A = jnp.asarray(_stage_weights(tableau), t1.dtype)
    stages = jax.tree.map(
        lambda y, k: y[None] + jnp.tensordot(A, k, 1), start[0], record.increments
    )
    return _tangent_of_stages(solver, step, stages, problem, start)


@one_kernel
def _tangent_of_any_step(solver, step, problem, start) -> ODEState:
    """Return the tangent of the end of a projected step of a solver without increments.

    The arguments are those of `step_tangent`.
    """
    end = lambda y, p: end_of_step(solver, step, p, y)
    return eqx.filter_jvp(end, *((y, p) for y, p in zip(start, problem, strict=True)))[1]


@one_kernel
def _tangent_of_stages(solver, step, stages: ODEState, problem, start) -> tuple[ODEState, ODEState]:
    """Return `step_tangent` of an explicit Runge-Kutta step.

    stages: states at the stages. The other arguments are those of `step_tangent`.
    """
    (t0, t1, record), (y, d_y), (model, d_model) = step, start, problem
    tableau = _explicit_tableau(solver)
    assert tableau is not None
    with_rows = lambda p: dataclasses.replace(p.field_args, row_choice=record.row_choice)

    def stage(t, weights, d_increments, y_stage):
        rate = lambda y, p: p.field(t, y, with_rows(p))
        tangents = _add(d_y, weights, d_increments), d_model
        return eqx.filter_jvp(rate, (y_stage, model), tangents)[1]

    d_increments = _scan_stages(tableau, stage, (t0, t1), stages)
    b = _weights_of_end(tableau)
    ends = (_add(y, b, record.increments), model), (_add(d_y, b, d_increments), d_model)
    project = lambda y, p: project_state(p.field, with_rows(p), y)[0]
    projection_and_tangent = one_kernel(eqx.filter_checkpoint(eqx.filter_jvp))
    return projection_and_tangent(project, *ends)[1], d_increments


def _weights_of_end(tableau: diffrax.ButcherTableau):
    """Return the weights of the increments in the end of a step."""
    return tableau.b_sol[: _stage_count(tableau)]


def _step_of_any_solver(solver, field, times, y: ODEState, field_args: FieldArgs) -> ODEState:
    """Return the end of a step without projection.

    times: start and end.
    """
    solver, term = with_scan_kind(solver, "bounded"), diffrax.ODETerm(field)
    t0, t1 = times
    solver_state = solver.init(term, t0, t1, y, field_args)
    return solver.step(term, t0, t1, y, field_args, solver_state, made_jump=False)[0]


def _increments(
    tableau: diffrax.ButcherTableau, rate, times, y: ODEState, field_args: FieldArgs
) -> ODEState:
    """Return the increments of an explicit Runge-Kutta step.

    rate: vector field. times: start and end.
    """
    stage = lambda t, weights, increments, _: rate(t, _add(y, weights, increments), field_args)
    zeros = _zero_increments(tableau, y)
    return _scan_stages(tableau, stage, times, zeros)


def _scan_stages(tableau: diffrax.ButcherTableau, stage, times, xs: ODEState) -> ODEState:
    """Return h k_i of all stages i, by a scan, with h the size of the step.

    stage: (time, weights of earlier stages, increments of earlier stages, x of the stage) -> rate.
    times: start and end. xs: of all stages, in the shape of the increments.
    """
    t0, t1 = times
    count = _stage_count(tableau)

    @eqx.filter_checkpoint
    def body(increments, x):
        weights, fraction, one_hot, x_stage = x
        k = stage(t0 + fraction * (t1 - t0), weights, increments, x_stage)
        # a `where` here would store a mask of the shape of all increments in reverse mode
        write = lambda ks, k: (
            ks + jnp.expand_dims(one_hot, range(1, ks.ndim)) * ((t1 - t0) * k)[None]
        )
        return jax.tree.map(write, increments, k), None

    A, c, one_hot = _stage_weights(tableau), np.append(0.0, tableau.c)[:count], np.eye(count)
    constants = jax.tree.map(lambda x: jnp.asarray(x, t1.dtype), (A, c, one_hot))
    return jax.lax.scan(body, jax.tree.map(jnp.zeros_like, xs), (*constants, xs))[0]


def _stage_weights(tableau: diffrax.ButcherTableau):
    """Return the weights of earlier stages, [stages, stages]."""
    count = _stage_count(tableau)
    A = np.zeros((count, count))
    for i, row in enumerate(tableau.a_lower[: count - 1]):
        A[i + 1, : i + 1] = row
    return A


def _add(y: ODEState, weights, increments: ODEState) -> ODEState:
    """Return y plus the weighted sum of the increments of the stages."""
    weighted = lambda y, k: y + jnp.tensordot(jnp.asarray(weights, k.dtype), k, 1)
    return jax.tree.map(weighted, y, increments)
