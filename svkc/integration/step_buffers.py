"""Rows that the stepping loop writes in place: saved states, checkpoints and records of steps."""

import jax
import jax.numpy as jnp

from svkc._jax.control_flow import buffer_at_set
from svkc._jax.select import where
from svkc.integration.ode import ODEState
from svkc.integration.solution import StepperState, StepRecord


def write_states(
    s: StepperState, after: StepperState, save_ts, interval: int
) -> tuple[ODEState, ODEState]:
    """Write the state after a kept attempt into the saved states and checkpoints it belongs to.

    s, after: states of the loop before and after the attempt.
    interval: number of steps between checkpoints.
    """
    ys, checkpoints, kept = s.ys, s.checkpoints, after.accepted > s.accepted
    if save_ts.shape[0]:
        i = jnp.minimum(jnp.sum(save_ts < after.t, dtype=jnp.int32), save_ts.shape[0] - 1)
        ys = write_row(ys, i, after.y, kept & (save_ts[i] == after.t))
    if checkpoints.q.shape[0]:
        is_checkpoint = kept & (after.accepted % interval == 0)
        checkpoints = write_row(checkpoints, after.accepted // interval - 1, after.y, is_checkpoint)
    return ys, checkpoints


def write_record(s: StepperState, record: StepRecord, pred, capacity: int) -> StepRecord | None:
    """Write the record of the next kept step where `pred` holds, if there is room for it."""
    if s.records is None:
        return None
    return write_row(s.records, s.accepted, record, pred & (s.accepted < capacity))


def write_row(rows, i, row, pred):
    """Write a row at index i in place where `pred` holds."""
    # The index of a row that is not written may be out of bounds.
    i = where(pred, i, 0)
    return jax.tree.map(lambda x, b: buffer_at_set(b, i, x, pred=pred), row, rows)
