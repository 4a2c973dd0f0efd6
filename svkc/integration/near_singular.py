"""Steps near singular configurations, which are taken again with reduced rows of the loops."""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Bool

from svkc.integration.solution import PhaseProblem, StepAttempt, StepperState
from svkc.loops.pivoting import has_redundant_rows, singularity_threshold


def redone_if_near(
    s: StepperState, attempt: StepAttempt, problem: PhaseProblem
) -> tuple[StepAttempt, Bool[Array, ""] | None, Bool[Array, ""]]:
    """Return the attempt, whether the next one has reduced rows, and whether this one is redone.

    An attempt that ends near a singular configuration, or that does not close the loops, is not
    kept: it is taken again with reduced rows. Rows are reduced until a step is kept that ends away
    from singular configurations, and throughout a phase whose loops are redundant.
    """
    if s.near is None:
        return attempt, None, jnp.zeros((), bool)
    assert attempt.projection_info is not None
    margin = attempt.projection_info.margin
    assert margin is not None
    structure = problem.field_args.structure
    # false for NaN
    away = margin > singularity_threshold(structure)
    away = away & ~has_redundant_rows(structure)
    redo = ~s.near & ~(away & attempt.closed)
    near = jnp.where(s.near, ~(attempt.keep_step & away), redo)
    keep_step = attempt.keep_step & ~redo
    return dataclasses.replace(attempt, keep_step=keep_step), near, redo
