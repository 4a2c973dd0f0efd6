"""Conversion of motions to the unknowns of a transcription, and back."""

import jax
import jax.numpy as jnp
import numpy as np

from svkc.model.chain import Chain
from svkc.optimize.charts import chart_from_motion, motion_from_chart
from svkc.optimize.guesses import Guess, PhaseMotion
from svkc.optimize.loop_rows import gaps_at
from svkc.optimize.transcription import Transcription


def encode(
    transcription: Transcription, guess: Guess, chain: Chain, free: np.ndarray
) -> np.ndarray:
    """Return a guess as the vector of unknowns, in SI units and within bounds.

    free: numbers of the free args. chain: the chain for these.
    """
    table, nv = transcription.builder.table, transcription.model.layout.nv
    x, start, kept = np.zeros(table.count), 0.0, np.zeros(0, int)
    rows, has_state = transcription.model.rows.rows, transcription.model.controls.has_state
    for motion, at, reference in zip(guess.phases, transcription.indices, transcription.references):
        x[at.start_time], x[at.duration] = start, motion.duration
        start += float(motion.duration)
        coordinates, rates = _to_charts(transcription, reference, motion.q, motion.v)
        x[at.nodes[:, :nv]], x[at.nodes[:, nv : 2 * nv]] = coordinates, rates
        x[at.nodes[:, 2 * nv :]] = motion.states
        x[at.blocks[:, int(has_state) :]] = motion.blocks[:, int(has_state) :]
        x[at.vdot] = motion.vdot
        for index, values in ((at.forces, motion.forces), (at.impulse, motion.impulse)):
            x[index[index >= 0]] = np.asarray(values)[..., rows][index >= 0]
        # gaps of a link stay as they are where the link connects
        starts = (at.kept_gap >= 0) & ~np.isin(at.kept_gap, kept)
        if starts.any():
            x[at.kept_gap[starts]] = np.asarray(
                gaps_at(chain, jnp.asarray(motion.q[0]), transcription.model.rows)
            )[starts]
        kept = at.kept_gap
    x[transcription.builder.free_args] = free
    return _with_noise(transcription, guess, np.clip(x, table.lower, table.upper))


def _to_charts(transcription: Transcription, reference, q, v):
    """Return the coordinates and rates [n + 1 nv] of nodes in their charts, from q and v."""
    chain = transcription.builder.chain
    return jax.vmap(lambda *x: chart_from_motion(chain, *x))(
        *(jnp.asarray(x) for x in (reference, q, v))
    )


def _with_noise(transcription: Transcription, guess: Guess, x: np.ndarray) -> np.ndarray:
    """Return the unknowns moved at random by a fraction of the range between their bounds."""
    if not guess.noise:
        return x
    table = transcription.builder.table
    span = table.upper - table.lower
    span = np.where(np.isfinite(span), span, 0)
    random = np.random.default_rng(guess.key).uniform(-1, 1, len(x))
    return np.clip(x + guess.noise * span * random, table.lower, table.upper)


def decode(transcription: Transcription, x: np.ndarray) -> tuple[PhaseMotion, ...]:
    """Return the motion of each phase from the vector of unknowns x, in SI units."""
    chain, nv, rows = (
        transcription.builder.chain,
        transcription.model.layout.nv,
        transcription.model.rows.rows,
    )
    padded, links = np.append(x, 0.0), 6 * len(chain.link_names)
    motions = []
    specified = zip(transcription.phases, transcription.indices, transcription.references)
    for phase, at, reference in specified:
        coordinates = x[at.nodes[:, :nv]], x[at.nodes[:, nv : 2 * nv]]
        q, v = jax.vmap(lambda r, y, w: motion_from_chart(chain, r, y, w, w)[:2])(
            *(jnp.asarray(y) for y in (reference, *coordinates))
        )
        on_links = lambda index: _spread(padded[index], rows, links)
        motions.append(
            PhaseMotion(
                duration=float(x[at.duration]),
                q=np.asarray(q),
                v=np.asarray(v),
                states=x[at.nodes[:, 2 * nv :]],
                blocks=x[at.blocks],
                vdot=x[at.vdot],
                forces=on_links(at.forces),
                impulse=on_links(at.impulse),
                mesh=phase.node_fractions,
            )
        )
    return tuple(motions)


def _spread(values: np.ndarray, rows: np.ndarray, count: int) -> np.ndarray:
    """Return values of selected rows [... rows] as values of all rows [... count], with zeros."""
    out = np.zeros((*values.shape[:-1], count))
    out[..., rows] = values
    return out
