"""Choose the pivots or the rows of the loops for a step, and repeat steps with reduced rows."""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Bool

from svkc._jax.select import where
from svkc.integration.solution import PhaseProblem, StepAttempt, StepperState
from svkc.loops.pivoting import singularity_threshold


def with_rows_of_projection(s: StepperState, problem: PhaseProblem) -> PhaseProblem:
    """Return the problem with the pivots, or the rows of the loops, of the last projection."""
    info = s.projection_info
    if info is None:
        return problem
    changes = {}
    if info.pivots is not None and problem.field.dynamics.hold is not None:
        changes["pivots"] = info.pivots
    if s.near is not None:
        changes["row_choice"] = info.row_choice(s.near)
    field_args = dataclasses.replace(problem.field_args, **changes)
    return dataclasses.replace(problem, field_args=field_args)


def redone_if_near(
    s: StepperState, attempt: StepAttempt, problem: PhaseProblem
) -> tuple[StepAttempt, Bool[Array, ""] | None, Bool[Array, ""]]:
    """Return the attempt, whether the next one has reduced rows, and whether this one is redone.

    An attempt without reduced rows is repeated with reduced rows if it ends near a singular
    configuration or does not close the loops. Later steps use reduced rows until an accepted step
    ends away from singular configurations.
    """
    if s.near is None:
        return attempt, None, jnp.zeros((), bool)
    assert attempt.projection_info is not None
    margin = attempt.projection_info.margin
    assert margin is not None
    structure = problem.field_args.structure
    # false for NaN
    away = margin > singularity_threshold(structure)
    redo = ~s.near & ~(away & attempt.closed)
    near = where(s.near, ~(attempt.keep_step & away), redo)
    keep_step = attempt.keep_step & ~redo
    return dataclasses.replace(attempt, keep_step=keep_step), near, redo
