"""The structure of each phase, and which rows of its links are independent constraints."""

import functools
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc._jax.eager import eager_jit
from svkc.loops.pivoting import rank_tolerance
from svkc.model.chain import Chain
from svkc.model.names import connection_mask, link_index
from svkc.optimize.loop_rows import LinkRows, gaps_at, rates_at
from svkc.optimize.phases import Phase
from svkc.optimize.points import PhaseStructure, full_configuration
from svkc.transitions.newton import decide_rank


def candidate_rows(chain: Chain, links: np.ndarray) -> np.ndarray:
    """Return the indices of the rows of links that the joint constrains.

    links: mask of the virtual links. A joint with two free rotations keeps its third rotation row.
    """
    free = np.array(chain.topology.link_freedoms, bool).reshape(-1, 6)
    return np.flatnonzero((~free & np.asarray(links, bool)[:, None]).ravel())


@functools.partial(eager_jit, jit=eqx.filter_jit)
def gaps_and_jacobian(
    chain: Chain, q: Float[Array, " nq"], table: LinkRows
) -> tuple[Float[Array, " rows"], Float[Array, "rows nv"]]:
    """Return the gaps (rad, m) of links' rows, and the rows' derivatives by velocities."""
    rates = lambda v: rates_at(chain, q, v, table)
    return gaps_at(chain, q, table), jax.jacfwd(rates)(jnp.zeros(chain.nv, q.dtype))


def independent_rows(
    chain: Chain, q: Sequence[np.ndarray], preferred: np.ndarray, candidates: np.ndarray
) -> np.ndarray:
    """Return linearly independent rows among candidate rows of links.

    Rows in `preferred` are chosen before others. At each step the row with the largest remainder is
    chosen. Ranks may differ between configurations: the result is of the one with most rows.

    q: configurations [nq] of the tree.
    """
    if not len(candidates):
        return candidates
    table = LinkRows.of(chain, candidates)
    scale = np.where(candidates % 6 < 3, 1.0, 1 / float(chain.length))
    best = np.zeros(0, int)
    for pose in q:
        J = np.asarray(gaps_and_jacobian(chain, jnp.asarray(pose), table)[1]) * scale[:, None]
        rows = _pivoted_rows(J, np.isin(candidates, preferred))
        best = candidates[rows] if len(rows) > len(best) else best
    return np.sort(best)


def _pivoted_rows(J: np.ndarray, preferred: np.ndarray) -> list[int]:
    """Return indices of independent rows of J by Gram-Schmidt orthogonalization with pivoting.

    preferred: mask of the rows that are chosen before others.
    """
    rest, rows, largest = J.copy(), [], np.max(np.linalg.norm(J, axis=1), initial=1e-300)
    for group in (preferred, ~preferred):
        while True:
            norms = np.where(group, np.linalg.norm(rest, axis=1), 0)
            k = int(np.argmax(norms))
            if norms[k] <= rank_tolerance(J.dtype) * largest:
                break
            rows.append(k)
            direction = rest[k] / norms[k]
            rest = rest - np.outer(rest @ direction, direction)
    return rows


def links_here(chain: Chain, phases: Sequence[Phase]) -> list[np.ndarray]:
    """Return for each phase the mask of links that were connected where the bodies were."""
    of = lambda names: np.isin(chain.link_names, names)
    out, old = [], np.asarray(chain.structure.connected)
    here = np.zeros(len(old), bool)
    for phase in phases:
        if isinstance(phase.here, bool):
            of_phase = np.full(len(old), phase.here)
        else:
            of_phase, old = of(phase.here), old & bool(out)
        here = of(phase.connected) & np.where(old, here, of_phase)
        out.append(here)
        old = of(phase.connected)
    return out


def phase_structures(
    chain: Chain, phases: Sequence[Phase], poses: Sequence[Sequence[np.ndarray]]
) -> tuple[np.ndarray, list[PhaseStructure]]:
    """Return the rows of links that are constraints in some phase, and each phase's structure.

    poses: of each phase, configurations [nq] at which its rows are chosen; its rank is that of the
        first.
    Raises ValueError if a phase connects a spare slot.
    """
    none = np.zeros(len(chain.link_names), bool)
    masks = [np.asarray(connection_mask(chain.topology, p.connected, none)) for p in phases]
    own, before = [], np.zeros(0, int)
    for mask, q in zip(masks, poses):
        candidates = candidate_rows(chain, mask)
        before = independent_rows(chain, q, before, candidates)
        own.append(before)
    rows = np.unique(np.concatenate([np.zeros(0, int), *own]))
    structures = []
    here = links_here(chain, phases)
    for i, (phase, mask) in enumerate(zip(phases, masks)):
        active = np.isin(rows, own[i])
        old = masks[i - 1][rows // 6] if i else np.zeros(len(rows), bool)
        structure = eqx.tree_at(lambda s: s.connected, chain.structure, jnp.asarray(mask))
        if len(mask):
            q = full_configuration(chain, jnp.asarray(poses[i][0]))
            structure = decide_rank(chain, structure, q)
        structures.append(
            PhaseStructure(
                structure, active=active, new=active & ~old, here=active & here[i][rows // 6]
            )
        )
        _check_spare(chain, phase)
    return rows, structures


def _check_spare(chain: Chain, phase: Phase) -> None:
    """Raise ValueError if a phase connects a spare slot, which has no bodies."""
    for name in phase.connected:
        if chain.topology.link_spare[link_index(chain.topology, name)]:
            raise ValueError(
                f"phase {phase.name!r}: {name!r} is a spare slot; load the chain with the virtual"
                " link between its bodies"
            )
