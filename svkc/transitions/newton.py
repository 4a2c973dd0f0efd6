"""Newton's method on a structure: its rank, its loops closed, velocities that keep them, and the
velocity after an impact (paper, section V-C).

A caller lists the iterations that it needs. One loop over one body takes them all, so that
kinematics, loop Jacobian and pivots are compiled once.
"""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from svkc._jax.primitive import operation
from svkc.loops.constraint import LoopKinematics, loop_kinematics, scales
from svkc.loops.pivoting import (
    Selection,
    count_rank,
    held_part,
    rank_tolerance,
    select,
    without_weak,
)
from svkc.loops.projection import least_change
from svkc.model.chain import Chain, Structure, active_dofs
from svkc.transitions.impact import velocity_after_impact
from svkc.transitions.placement import joint_coordinates, with_coordinates
from svkc.tree.configuration import integrate, normalize

# kinds of iterations
READ = 0  # set the coordinates of virtual joints to what the poses of their bodies say
# a Newton step that closes the loops by the least change of scaled coordinates; held coordinates
# stay, or not
CLOSE_HELD, CLOSE = 1, 2
# look at q and move a copy of it a few degrees away; close its loops; decide the rank
PERTURB, RECLOSE, COUNT = 3, 4, 5
# project the velocity by its least change; held velocities stay, or not
VELOCITY_HELD, VELOCITY = 6, 7
IMPACT = 8  # project the velocity in the metric of the inertia

RANK = (PERTURB, *(RECLOSE,) * 12, COUNT)
CONNECT = (CLOSE, CLOSE, IMPACT)


class Schedule(eqx.Module):
    """The kinds of iterations to take, in order."""

    kinds: tuple[int, ...] = eqx.field(static=True)

    @property
    def unranked(self) -> int:
        """Return how many iterations come before the rank is known, in which every row counts."""
        return self.kinds.index(PERTURB) if PERTURB in self.kinds else 0


class Held(eqx.Module):
    """Coordinates and velocities that stay in held iterations, and links whose coordinates are
    read. None: there are none."""

    q: Bool[Array, " dofs"] | None = None
    v: Bool[Array, " dofs"] | None = None
    read: Bool[Array, " links"] | None = None


class Newton(eqx.Module):
    """The state of the iteration: the motion, the rank of the structure with its margin, and what
    has been found.

    `probe`: the copy of q in the search for the rank; `size`, `open`: |R_kk| of the loop Jacobian
    and how far each loop is open (rad, or `chain.length`s), at the start and at the end of the
    search; `left`: how far each loop is open in the last iteration; `wrench`: impulse of each loop
    on its real link from the parent, at the joint, angular first (N m s, N s); `lost`: energy lost
    (J).
    """

    q: Float[Array, " q"]
    v: Float[Array, " dofs"]
    rank: Int[Array, ""]
    margin: Float[Array, ""]
    probe: Float[Array, " q"]
    size: Float[Array, "2 steps"]
    open: Float[Array, "2 links"]
    left: Float[Array, " links"]
    wrench: Float[Array, "links 6"]
    lost: Float[Array, ""]

    @classmethod
    def init(cls, chain: Chain, structure: Structure, q, v) -> "Newton":
        """Return the state before the first iteration."""
        links, dtype, q = len(chain.link_names), q.dtype, normalize(chain, q)
        gaps, zero = jnp.zeros((2, links), dtype), jnp.zeros((), dtype)
        size = jnp.zeros((2, min(6 * links, chain.dofs)), dtype)
        return cls(
            q=q,
            v=v,
            rank=structure.rank,
            margin=structure.margin,
            probe=q,
            size=size,
            open=gaps,
            left=gaps[0],
            wrench=jnp.zeros((links, 6), dtype),
            lost=zero,
        )

    def searched(self, kind, size, gaps) -> "Newton":
        """Record both ends of the search for the rank, and decide the rank at its end."""
        places = jnp.stack([kind == PERTURB, kind == COUNT])[:, None]
        seen = dataclasses.replace(
            self,
            size=jnp.where(places, size[None], self.size),
            open=jnp.where(places, gaps[None], self.open),
        )
        rank, margin = seen.decided()
        return dataclasses.replace(
            seen,
            rank=jnp.where(kind == COUNT, rank, self.rank),
            margin=jnp.where(kind == COUNT, margin, self.margin),
        )

    def decided(self) -> tuple[Int[Array, ""], Float[Array, ""]]:
        """Return the larger rank m of both ends, and |R_mm| / |R_11| there. The second end does not
        count where its loops are open."""
        size, eps = self.size, jnp.finfo(self.size.dtype)
        closed = jnp.max(self.open[1]) < eps.eps**0.75
        rank = jnp.where(
            closed, jnp.maximum(count_rank(size[0]), count_rank(size[1])), count_rank(size[0])
        )
        last = jnp.arange(size.shape[1], dtype=jnp.int32) == rank - 1
        margin = jnp.sum(jnp.where(last, size, 0), 1) / jnp.maximum(size[:, 0], eps.tiny)
        return rank, jnp.where(closed, jnp.max(margin), margin[0])


def _among(kind, *kinds: int) -> Bool[Array, ""]:
    return functools.reduce(jnp.logical_or, [kind == k for k in kinds])


class _Iteration(eqx.Module):
    """One iteration of any kind among `kinds`; what no kind among them needs is not compiled.

    `away`: the change of q to a configuration nearby, from which the rank is searched for.
    """

    chain: Chain
    structure: Structure
    held: Held
    away: Float[Array, " dofs"]
    kinds: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, now: Newton, kind, ranked) -> Newton:
        """Return the state after one more iteration. ranked: whether only as many rows count as the
        rank of `now`."""
        chain, structure = self.chain, self.structure
        at = now.q
        if COUNT in self.kinds:
            at = jnp.where(_among(kind, RECLOSE, COUNT), now.probe, now.q)
        loops = loop_kinematics(chain, structure, at)
        J = self._without_held(loops.J, kind)
        full, selection = self._select(J, now, kind, ranked)
        of_v, residual = _among(kind, VELOCITY_HELD, VELOCITY), loops.gap
        if VELOCITY in self.kinds:
            residual = jnp.where(of_v, loops.J @ (now.v / scales(chain)[1]), residual)
        step = -least_change(chain, selection, J, residual[:, None])[:, 0]
        left = jnp.max(jnp.abs(loops.gap).reshape(-1, 6), 1)
        if COUNT in self.kinds:
            now = now.searched(kind, full.size, left)
        v, wrench, lost = now.v + jnp.where(of_v, step, 0), now.wrench, now.lost
        if IMPACT in self.kinds:
            v, wrench, lost = jax.lax.cond(
                kind == IMPACT,
                lambda: velocity_after_impact(chain, structure, loops, selection, now.v),
                lambda: (v, wrench, lost),
            )
        q, probe = self._moved(loops, at, kind, step), now.probe
        if COUNT in self.kinds:
            searching = _among(kind, *RANK)
            q, probe = jnp.where(searching, now.q, q), jnp.where(searching, q, probe)
        return dataclasses.replace(now, q=q, v=v, probe=probe, wrench=wrench, lost=lost, left=left)

    def _without_held(self, J, kind) -> Float[Array, "rows dofs"]:
        """Return J with the columns of coordinates zero that this iteration holds."""
        for which, mask in ((CLOSE_HELD, self.held.q), (VELOCITY_HELD, self.held.v)):
            if mask is not None and which in self.kinds:
                J = jnp.where(mask[None] & (kind == which), 0, J)
        return J

    def _select(self, J, now: Newton, kind, ranked) -> tuple[Selection, Selection]:
        """Return the pivots of J, and those among them that are large enough to divide by."""
        wanted, every, dtype = None, min(J.shape), J.dtype
        if self.structure.independent is not None and IMPACT in self.kinds:
            wanted = self.structure.independent & (kind == IMPACT)
        full = select(J, jnp.where(ranked, now.rank, every), wanted)
        weak = jnp.where(ranked, held_part(dtype) * now.margin, 0)
        # along weaker steps a gap is of second order, and dividing by them would only amplify
        # round-off
        least = jnp.where(kind == IMPACT, weak, jnp.maximum(rank_tolerance(dtype), weak))
        return full, without_weak(full, least)

    def _moved(self, loops: LoopKinematics, at, kind, step) -> Float[Array, " q"]:
        """Return the configuration after this iteration, moved from the one at which it was."""
        chain = self.chain
        closing = jnp.where(_among(kind, CLOSE_HELD, CLOSE, RECLOSE), step, 0)
        moved = integrate(chain, at, jnp.where(kind == PERTURB, self.away, closing))
        if READ not in self.kinds:
            return moved

        def read():
            coordinates = joint_coordinates(chain, self.structure, loops.kin, at)
            return with_coordinates(chain, self.held.read, coordinates, at)

        return jax.lax.cond(kind == READ, read, lambda: moved)


def _iterate(
    chain: Chain, structure: Structure, q, v, held: Held, schedule: Schedule, *, unranked: int
) -> Newton:
    """Take the iterations of a schedule. unranked: how many of them take every row, whatever the
    rank of the structure."""
    kinds, active = schedule.kinds, active_dofs(chain, structure)
    # a fixed direction without pattern, as q itself may be singular
    away = 0.05 * np.sin(1.0 + 2.3 * np.arange(chain.dofs)) * scales(chain)[1]
    away = jnp.where(active, away, 0).astype(q.dtype)
    iteration = _Iteration(chain, structure, held=held, away=away, kinds=kinds)

    @functools.partial(jax.checkpoint, prevent_cse=False)
    def one(now: Newton, x) -> tuple[Newton, None]:
        return iteration(now, *x), None

    xs = jnp.asarray(np.array(kinds, np.int32)), jnp.asarray(np.arange(len(kinds)) >= unranked)
    return jax.lax.scan(one, Newton.init(chain, structure, q, jnp.where(active, v, 0)), xs)[0]


def _solve(chain: Chain, structure: Structure, q, v, held: Held, schedule: Schedule) -> Newton:
    # until the search has ended every row counts, in the search too
    unranked = schedule.unranked + len(RANK) if COUNT in schedule.kinds else 0
    return _iterate(chain, structure, q, v, held, schedule, unranked=unranked)


def _solve_jvp(primals, tangents):
    """Return the tangent of the iterations that move q or v, with the rank that was found; the
    search for the rank has no part in derivatives."""
    found = solve_structure(*primals)
    chain, structure, q, v, held, schedule = primals
    ranked = eqx.tree_at(
        lambda s: (s.rank, s.margin), structure, (found.rank, jax.lax.stop_gradient(found.margin))
    )
    moving = Schedule(tuple(kind for kind in schedule.kinds if kind not in RANK))

    @eqx.filter_checkpoint
    def moved(chain, structure, q, v):
        there = _iterate(chain, structure, q, v, held, moving, unranked=schedule.unranked)
        return there.q, there.v, there.wrench, there.lost

    along = eqx.filter_jvp(moved, (chain, ranked, q, v), tangents[:4])[1]
    none = jax.tree.map(lambda x: None, found)
    return found, eqx.tree_at(
        lambda t: (t.q, t.v, t.wrench, t.lost), none, along, is_leaf=lambda x: x is None
    )


# solve_structure(chain, structure, q, v, held, schedule) -> Newton: the state of the iteration
# after a schedule
solve_structure = operation("solve_structure", _solve, _solve_jvp)


@jax.jit
def decide_rank(chain: Chain, structure: Structure, q: Float[Array, " q"]) -> Structure:
    """Return the structure with its rank m: the larger one of those at q and at a closed
    configuration nearby, as q itself may be singular."""
    if not len(chain.topology.link_names):
        return structure
    frozen = jax.lax.stop_gradient((chain, structure, q))
    found = _solve(*frozen, jnp.zeros(chain.dofs, q.dtype), Held(), Schedule(RANK))
    return eqx.tree_at(lambda s: (s.rank, s.margin), structure, (found.rank, found.margin))
