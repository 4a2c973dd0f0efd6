"""The kinds of iterations of `newton.py`, a schedule of them, and the state that they change.

A caller lists the kinds of iterations in a `Schedule`.
"""

import dataclasses
import functools
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from svkc._jax.select import where
from svkc.loops.pivoting import count_rank
from svkc.model.chain import Chain, Structure
from svkc.tree.configuration import normalize

# kinds of iterations
CLOSE = 2  # a Newton step that closes the loops by the least change of scaled coordinates
# the search for the rank
PERTURB = 3  # record the pivots at q, and perturb a copy of q (the probe) by a few degrees
CLOSE_PERTURBED = 4  # a Newton step that closes the loops of the probe
DECIDE_RANK = 5  # record the pivots at the probe, and decide the rank
IMPACT = 8  # project the velocity in the metric of the mass matrix

RANK_SEARCH = (PERTURB, *(CLOSE_PERTURBED,) * 12, DECIDE_RANK)
CONNECTION = (CLOSE, CLOSE, IMPACT)


def is_any_of(kind: Int[Array, ""], *kinds: int) -> Bool[Array, ""]:
    """Return whether a traced kind is one of these kinds."""
    return functools.reduce(jnp.logical_or, [kind == k for k in kinds])


class Schedule(eqx.Module):
    """The kinds of iterations to take, in order."""

    kinds: tuple[int, ...] = eqx.field(static=True)

    @property
    def all_row_steps(self) -> int:
        """Return the number of iterations before the search for the rank; they use all rows."""
        return self.kinds.index(PERTURB) if PERTURB in self.kinds else 0


class NewtonState(eqx.Module):
    """The state of the iteration.

    rank, margin: rank m of the loop Jacobian, and |R_mm| / |R_11|.
    probe: the perturbed copy of q in the search for the rank.
    probe_step: largest scaled change of the probe in the last iteration if that was a Newton step
        on the probe, else inf.
    search_diag_R: |R_kk| of the loop Jacobian at q and at the probe when the search ends.
    search_gaps: largest gap of each loop at these two (rad, or in `chain.length`s).
    residual_gaps: largest gap of each loop at the last evaluation of the loops.
    spatial_impulse: impulse of each loop on its real link from the parent, at the joint, angular
        part first (N m s, N s).
    energy_lost: kinetic energy lost in the impact (J).
    """

    q: Float[Array, " q"]
    v: Float[Array, " dofs"]
    rank: Int[Array, ""]
    margin: Float[Array, ""]
    probe: Float[Array, " q"]
    probe_step: Float[Array, ""]
    search_diag_R: Float[Array, "2 steps"]
    search_gaps: Float[Array, "2 links"]
    residual_gaps: Float[Array, " links"]
    spatial_impulse: Float[Array, "links 6"]
    energy_lost: Float[Array, ""]

    @classmethod
    def init(
        cls, chain: Chain, structure: Structure, q: Float[Array, " q"], v: Float[Array, " dofs"]
    ) -> "NewtonState":
        """Return the state before the first iteration."""
        links, dtype, q = len(chain.link_names), q.dtype, normalize(chain, q)
        gaps, zero = jnp.zeros((2, links), dtype), jnp.zeros((), dtype)
        diag_R = jnp.zeros((2, min(6 * links, chain.dofs)), dtype)
        return cls(
            q=q,
            v=v,
            rank=structure.rank,
            margin=structure.margin,
            probe=q,
            probe_step=jnp.full((), jnp.inf, dtype),
            search_diag_R=diag_R,
            search_gaps=gaps,
            residual_gaps=gaps[0],
            spatial_impulse=jnp.zeros((links, 6), dtype),
            energy_lost=zero,
        )

    def record_rank_search(self, kind: Any, diag_R: Any, gaps: Any) -> "NewtonState":
        """Return the state with the pivots and gaps of this iteration recorded if the iteration
        starts or ends the search for the rank, and with the rank if it ends the search."""
        rows = jnp.stack([kind == PERTURB, kind == DECIDE_RANK])[:, None]
        recorded = dataclasses.replace(
            self,
            search_diag_R=where(rows, diag_R[None], self.search_diag_R),
            search_gaps=where(rows, gaps[None], self.search_gaps),
        )
        rank, margin = recorded.rank_and_margin()
        return dataclasses.replace(
            recorded,
            rank=where(kind == DECIDE_RANK, rank, self.rank),
            margin=where(kind == DECIDE_RANK, margin, self.margin),
        )

    def rank_and_margin(self) -> tuple[Int[Array, ""], Float[Array, ""]]:
        """Return the larger rank m of those at q and at the probe, and the larger |R_mm| / |R_11|.

        The probe is left out if its loops are open.
        """
        diag_R, eps = self.search_diag_R, jnp.finfo(self.search_diag_R.dtype)
        closed = jnp.max(self.search_gaps[1]) < eps.eps**0.75
        rank = where(
            closed, jnp.maximum(count_rank(diag_R[0]), count_rank(diag_R[1])), count_rank(diag_R[0])
        )
        last = jnp.arange(diag_R.shape[1], dtype=jnp.int32) == rank - 1
        margin = jnp.sum(where(last, diag_R, 0), 1) / jnp.maximum(diag_R[:, 0], eps.tiny)
        return rank, where(closed, jnp.max(margin), margin[0])
