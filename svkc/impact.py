"""F5: Newton's method on a structure: its rank, its loops closed, velocities that keep them, and the velocity after an impact (paper, section V-C).

All of these are turns of one loop over one body: kinematics, loop Jacobian and pivots are compiled once, whichever of them a caller needs.
"""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from svkc.chain import Chain, Structure
from svkc.closure import scaled_jacobian, scales
from svkc.forward_dynamics import constraint_forces, solve_motion, with_links
from svkc.inverse_dynamics import inertia_times
from svkc.kinematics import Kinematics, integrate, kinematics, normalize
from svkc.loops import active_dofs, ends, gap, joint_coordinates, with_coordinates
from svkc.operation import operation
from svkc.projection import least_change
from svkc.selection import Selection, count_rank, held_part, rank_tolerance, select, without_weak

# what one turn does
READ = 0  # read the coordinates of virtual joints off from where the bodies are
CLOSE_HELD, CLOSE = 1, 2  # a Newton step that closes the loops by the least change of scaled coordinates, without or with those that are held
AWAY, BACK, LOOK = 3, 4, 5  # look at q and move a few degrees away; close the loops there; look again and decide the rank
AGREE_HELD, AGREE = 6, 7  # the least change of velocities that keeps the loops, without or with those that are held
IMPACT = 8  # the velocity after an impact

RANK = (AWAY, *(BACK,) * 12, LOOK)
JOIN = (CLOSE, CLOSE, IMPACT)


class Held(eqx.Module):
    """Coordinates and velocities that must not move in held turns, and the links whose coordinates are read off. None: there are none."""

    q: Bool[Array, " dofs"] | None = None
    v: Bool[Array, " dofs"] | None = None
    read: Bool[Array, " links"] | None = None


class Turns(eqx.Module):
    """What goes from turn to turn: the motion, the rank of the structure with its margin, and what has been found.

    `probe`: the configuration that the search for the rank looks at; `size`, `open`: |R_kk|, and how far each loop is open (rad, or `chain.length`s), where
    the search looks first and last; `left`: how far each loop is open in the last turn; `wrench`: impulse of each loop on its real link from the parent, at
    the joint, angular first; `lost`: energy (J).
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
    def start(cls, chain: Chain, structure: Structure, q, v, searches: bool) -> "Turns":
        """Return the motion before the first turn. searches: the rank is to be found, and until then every row counts."""
        links, dtype = len(chain.link_names), q.dtype
        steps, q = min(6 * links, chain.dofs), normalize(chain, q)
        rank, margin = (jnp.asarray(steps, jnp.int32), jnp.zeros((), dtype)) if searches else (structure.rank, structure.margin)
        gaps = jnp.zeros((2, links), dtype)
        return cls(q, v, rank, margin, q, jnp.zeros((2, steps), dtype), gaps, gaps[0], jnp.zeros((links, 6), dtype), jnp.zeros((), dtype))

    def looked(self, kind, size, gaps) -> "Turns":
        """Record what the search sees where it looks first and last, and decide the rank in the end."""
        places = jnp.stack([kind == AWAY, kind == LOOK])[:, None]
        seen = dataclasses.replace(self, size=jnp.where(places, size[None], self.size), open=jnp.where(places, gaps[None], self.open))
        rank, margin = seen.decided()
        return dataclasses.replace(seen, rank=jnp.where(kind == LOOK, rank, self.rank), margin=jnp.where(kind == LOOK, margin, self.margin))

    def decided(self) -> tuple[Int[Array, ""], Float[Array, ""]]:
        """Return the rank m, the larger one of the two places, and |R_mm| / |R_11| there. A place that Newton's method left open does not count."""
        size, eps = self.size, jnp.finfo(self.size.dtype)
        closed = jnp.max(self.open[1]) < eps.eps**0.75
        rank = jnp.where(closed, jnp.maximum(count_rank(size[0]), count_rank(size[1])), count_rank(size[0]))
        last = jnp.arange(size.shape[1], dtype=jnp.int32) == rank - 1
        margin = jnp.sum(jnp.where(last, size, 0), 1) / jnp.maximum(size[:, 0], eps.tiny)
        return rank, jnp.where(closed, jnp.max(margin), margin[0])


def _is(kind, *kinds: int) -> Bool[Array, ""]:
    return functools.reduce(jnp.logical_or, [kind == k for k in kinds])


def _turns(chain: Chain, structure: Structure, q: Float[Array, " q"], v: Float[Array, " dofs"], held: Held, schedule: tuple[int, ...]) -> Turns:
    row, column = scales(chain)
    active, kinds = active_dofs(chain, structure), np.array(schedule, np.int32)
    # a fixed direction without pattern: q itself may be singular
    away = jnp.where(active, 0.05 * np.sin(1.0 + 2.3 * np.arange(chain.dofs)) * column, 0).astype(q.dtype)

    @functools.partial(jax.checkpoint, prevent_cse=False)
    def turn(now: Turns, kind: Int[Array, ""]) -> tuple[Turns, None]:
        at = jnp.where(_is(kind, BACK, LOOK), now.probe, now.q) if LOOK in schedule else now.q
        kin = kinematics(chain, at)
        end = ends(chain, structure, kin, at)
        J, gaps = scaled_jacobian(chain, structure, kin, end), row * gap(structure, end).ravel()
        still = jnp.zeros(chain.dofs, bool)
        for which, mask in ((CLOSE_HELD, held.q), (AGREE_HELD, held.v)):
            still = still if mask is None or which not in schedule else still | (mask & (kind == which))
        free = jnp.where(still[None], 0, J) if CLOSE_HELD in schedule or AGREE_HELD in schedule else J
        wanted = None if structure.independent is None or IMPACT not in schedule else structure.independent & (kind == IMPACT)
        full, weak = select(free, now.rank, wanted), held_part(q.dtype) * now.margin
        # along weaker steps a gap is of second order, and dividing by them would only amplify round-off
        selection = without_weak(full, jnp.where(kind == IMPACT, weak, jnp.maximum(rank_tolerance(q.dtype), weak)))
        of_v = _is(kind, AGREE_HELD, AGREE)
        apart = jnp.where(of_v, J @ (now.v / column), gaps) if AGREE in schedule else gaps
        step = -least_change(chain, structure, kin, selection, free, apart[:, None])[:, 0]
        open_ = jnp.max(jnp.abs(gaps).reshape(-1, 6), 1)
        if LOOK in schedule:
            now = now.looked(kind, full.size, open_)
        new = now.v + jnp.where(of_v, step, 0), now.wrench, now.lost
        if IMPACT in schedule:
            new = jax.lax.cond(kind == IMPACT, lambda: _impact(chain, structure, kin, selection, J, now.v), lambda: new)
        moved = integrate(chain, at, jnp.where(kind == AWAY, away, jnp.where(_is(kind, CLOSE_HELD, CLOSE, BACK), step, 0)))
        if READ in schedule:
            read = lambda: with_coordinates(chain, held.read, joint_coordinates(chain, structure, kin, at), at)
            moved = jax.lax.cond(kind == READ, read, lambda: moved)
        if LOOK in schedule:
            probing = _is(kind, AWAY, BACK, LOOK)
            now, moved = dataclasses.replace(now, probe=jnp.where(probing, moved, now.probe)), jnp.where(probing, now.q, moved)
        return dataclasses.replace(now, q=moved, v=new[0], wrench=new[1], lost=new[2], left=open_), None

    return jax.lax.scan(turn, Turns.start(chain, structure, q, jnp.where(active, v, 0), LOOK in schedule), jnp.asarray(kinds))[0]


def _impact(chain: Chain, structure: Structure, kin: Kinematics, selection: Selection, J, v):
    """Return v+ = W (W^T M W)^-1 W^T M v-, the impulse of each loop on its real link, and the energy lost: the paper's (29)-(38), said shortly.

    It is the projection, orthogonal in the metric of the inertia, on what the structure allows, and holds where loops are redundant too.
    """
    jump = solve_motion(chain, structure, kin, selection, J, jnp.zeros_like(v), J @ (v / scales(chain)[1]))
    impulse = with_links(chain, inertia_times(chain, kin, jump[: chain.nv]), jump)
    # v- and v+ differ by a vector orthogonal to v+, so that the loss is a square and cannot be negative
    return v + jump, -constraint_forces(chain, selection, J, impulse), jump @ impulse / 2


class Schedule(eqx.Module):
    """The turns to take, in order."""

    kinds: tuple[int, ...] = eqx.field(static=True)


def _newton_jvp(primals, tangents):
    """Return the tangent of the turns that move something, for the rank that was found."""
    found = newton_turns(*primals)
    chain, structure, q, v, held, schedule = primals
    ranked = eqx.tree_at(lambda s: (s.rank, s.margin), structure, (found.rank, jax.lax.stop_gradient(found.margin)))
    moving = tuple(kind for kind in schedule.kinds if kind not in RANK)

    @eqx.filter_checkpoint
    def moved(chain, structure, q, v):
        there = _turns(chain, structure, q, v, held, moving)
        return there.q, there.v, there.wrench, there.lost

    along = eqx.filter_jvp(moved, (chain, ranked, q, v), tangents[:4])[1]
    none = jax.tree.map(lambda x: None, found)
    return found, eqx.tree_at(lambda t: (t.q, t.v, t.wrench, t.lost), none, along, is_leaf=lambda x: x is None)


# newton_turns(chain, structure, q, v, held, schedule) -> Turns. What the search for the rank looks at has no part in derivatives.
newton_turns = operation("newton_turns", lambda *args: _turns(*args[:5], args[5].kinds), _newton_jvp)


@jax.jit
def decide_rank(chain: Chain, structure: Structure, q: Float[Array, " q"]) -> Structure:
    """The structure with its rank m: the larger of those at q and at a closed configuration nearby, for q itself may be singular."""
    if not len(chain.topology.link_names):
        return structure
    frozen = jax.lax.stop_gradient((chain, structure, q))
    found = _turns(*frozen, jnp.zeros(chain.dofs, q.dtype), Held(), RANK)
    return eqx.tree_at(lambda s: (s.rank, s.margin), structure, (found.rank, found.margin))
