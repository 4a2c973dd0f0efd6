"""Rows that the stepping loop writes in place: saved states, checkpoints and records of steps."""

import jax
import jax.numpy as jnp

from svkc._jax.control_flow import buffer_at_set
from svkc.integration.ode import ODEState
from svkc.integration.solution import PhaseProblem, StepAttempt, StepperState, StepRecord


def write_states(
    s: StepperState, attempt: StepAttempt, t, save_ts, accepted, interval: int
) -> tuple[ODEState, ODEState]:
    """Write the state after an attempt into the saved states and the checkpoints it belongs to.

    t, accepted: time and number of accepted steps after the attempt.
    interval: number of steps between checkpoints.
    """
    ys, checkpoints = s.ys, s.checkpoints
    if save_ts.shape[0]:
        i = jnp.minimum(jnp.sum(save_ts < t, dtype=jnp.int32), save_ts.shape[0] - 1)
        ys = write_row(ys, i, attempt.y, attempt.keep_step & (save_ts[i] == t))
    if checkpoints.q.shape[0]:
        is_checkpoint = attempt.keep_step & (accepted % interval == 0)
        checkpoints = write_row(checkpoints, accepted // interval - 1, attempt.y, is_checkpoint)
    return ys, checkpoints


def write_record(
    s: StepperState, attempt: StepAttempt, problem: PhaseProblem, capacity: int
) -> StepRecord | None:
    """Write the record of an attempt that is kept, if there is room for it."""
    if s.records is None:
        return None
    record = StepRecord(attempt.increments, problem.field_args.row_choice)
    return write_row(s.records, s.accepted, record, attempt.keep_step & (s.accepted < capacity))


def write_row(rows, i, row, pred):
    """Write a row at index i in place where `pred` holds."""
    # The index of a row that is not written may be out of bounds.
    i = jnp.where(pred, i, 0)
    return jax.tree.map(lambda x, b: buffer_at_set(b, i, x, pred=pred), row, rows)
