"""F5: what follows when the structure changes: the rank that a phase goes by, loops closed, and the velocity after the impact (paper, section V-C)."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from svkc.chain import Chain, Structure
from svkc.closure import scaled_jacobian, scales
from svkc.forward_dynamics import motion_and_multipliers, with_links
from svkc.inverse_dynamics import inertia_times
from svkc.kinematics import Kinematics, integrate, kinematics, normalize
from svkc.loops import active_dofs, ends, gap
from svkc.operation import operation
from svkc.projection import least_change
from svkc.selection import Selection, count_rank, held_part, rank_tolerance, select, without_weak

# turns of `newton_turns`: the search for the rank, Newton's method on the gaps, the impact
SEARCH, CLOSE, IMPACT, END = 0, 14, 16, 17


class Turns(eqx.Module):
    """What goes from turn to turn of `newton_turns`: the motion, the rank of the structure with its margin, and what has been found.

    `probe`: the configuration that the search looks at; `size`, `open`: |R_kk| and the largest gap at the given q and at a closed configuration nearby; `gap`:
    the largest before the first closing turn (rad, `chain.length`s); `wrench`: impulse of each loop at its joint, angular first; `lost`: energy (J).
    """

    q: Float[Array, " q"]
    v: Float[Array, " dofs"]
    rank: Int[Array, ""]
    margin: Float[Array, ""]
    probe: Float[Array, " q"]
    size: Float[Array, "2 steps"]
    open: Float[Array, "2"]
    gap: Float[Array, ""]
    wrench: Float[Array, "links 6"]
    lost: Float[Array, ""]

    @classmethod
    def start(cls, chain: Chain, structure: Structure, q, v, searches: bool) -> "Turns":
        """Before the first turn. searches: the rank is to be found; until then every row counts."""
        links, zero = len(chain.link_names), jnp.zeros((), q.dtype)
        steps = min(6 * links, chain.dofs)
        rank, margin = (jnp.asarray(steps, jnp.int32), zero) if searches else (structure.rank, structure.margin)
        none = jnp.zeros((2, steps), q.dtype), jnp.zeros(2, q.dtype), zero, jnp.zeros((links, 6), q.dtype), zero
        q = normalize(chain, q)
        return cls(q, v, rank, margin, q, *none)

    def searched(self, i, size, gap) -> "Turns":
        """Record what the probe shows at its first and at its last place, and decide the rank at the last one."""
        at_first, at_last = i == SEARCH, i == CLOSE - 1
        put = lambda rows, new: jnp.where(jnp.stack([at_first, at_last]).reshape(2, *(1,) * new.ndim), new[None], rows)
        found = dataclasses.replace(self, size=put(self.size, size), open=put(self.open, gap))
        rank, margin = found.decided()
        return dataclasses.replace(found, rank=jnp.where(at_last, rank, self.rank), margin=jnp.where(at_last, margin, self.margin))

    def decided(self) -> tuple[Int[Array, ""], Float[Array, ""]]:
        """Return the rank m, the larger one of the two places, and |R_mm| / |R_11| there. A place where Newton's method left a gap does not count."""
        size, eps = self.size, jnp.finfo(self.size.dtype)
        closed = self.open[1] < eps.eps**0.75
        rank = jnp.where(closed, jnp.maximum(count_rank(size[0]), count_rank(size[1])), count_rank(size[0]))
        last = jnp.arange(size.shape[1], dtype=jnp.int32) == rank - 1
        margin = jnp.sum(jnp.where(last, size, 0), 1) / jnp.maximum(size[:, 0], eps.tiny)
        return rank, jnp.where(closed, jnp.max(margin), margin[0])


def newton_turns(chain: Chain, structure: Structure, q: Float[Array, " q"], v: Float[Array, " dofs"], first: int, last: int) -> Turns:
    """Take the turns `first` to `last` - 1 of a change of structure, in one loop over one body, so that they are compiled once.

    SEARCH to CLOSE: look at q, move to a place a few degrees away, close the loops there, look again: q itself may be singular. CLOSE to IMPACT: close the
    loops at q by the least change of scaled coordinates. IMPACT: project the velocity, orthogonally in the metric of the inertia, on what the structure
    allows, v+ = W (W^T M W)^-1 W^T M v-: the paper's (29)-(38), which holds where loops are redundant too.
    """
    row, column = scales(chain)
    # a fixed direction without pattern, left out where Newton's method does not come back onto the loops
    direction = np.sin(1.0 + 2.3 * np.arange(chain.dofs))
    away = jnp.where(active_dofs(chain, structure), 0.05 * direction * column, 0).astype(q.dtype)

    @functools.partial(jax.checkpoint, prevent_cse=False)
    def turn(i, now: Turns) -> Turns:
        at = now.q if first >= CLOSE else jnp.where(i < CLOSE, now.probe, now.q)
        kin = kinematics(chain, at)
        end = ends(chain, structure, kin, at)
        J, gaps = scaled_jacobian(chain, structure, kin, end), row * gap(structure, end).ravel()
        full = select(J, now.rank, None if structure.independent is None else structure.independent & (i == IMPACT))
        weak = held_part(q.dtype) * now.margin
        selection = without_weak(full, jnp.where(i == IMPACT, weak, jnp.maximum(rank_tolerance(q.dtype), weak)))
        step = -least_change(chain, structure, kin, selection, J, gaps[:, None])[:, 0]
        largest = jnp.max(jnp.abs(gaps))
        now = dataclasses.replace(now, gap=jnp.where(i == CLOSE, largest, now.gap))
        if last > IMPACT:
            hit = lambda: _impact(chain, structure, kin, selection, J, now.v)
            v, wrench, lost = jax.lax.cond(i == IMPACT, hit, lambda: (now.v, now.wrench, now.lost))
            step = jnp.where(i == IMPACT, 0, step)
            now = dataclasses.replace(now, v=v, wrench=wrench, lost=lost)
        if first >= CLOSE:
            return dataclasses.replace(now, q=integrate(chain, at, step))
        moved = integrate(chain, at, jnp.where(i == SEARCH, away, step))
        now = now.searched(i, full.size, largest)
        return dataclasses.replace(now, probe=jnp.where(i < CLOSE, moved, now.probe), q=jnp.where(i < CLOSE, now.q, moved))

    return jax.lax.fori_loop(first, last, turn, Turns.start(chain, structure, q, v, first < CLOSE))


def _impact(chain: Chain, structure: Structure, kin: Kinematics, selection: Selection, J, v):
    """Return the velocity after the impact, the impulse of each loop on its real link, and the energy lost."""
    row, column = scales(chain)
    before = jnp.where(active_dofs(chain, structure), v, 0)
    jump, mu = motion_and_multipliers(chain, structure, kin, selection, J, jnp.zeros_like(v), J @ (before / column))
    momentum = with_links(chain, inertia_times(chain, kin, jump[: chain.nv]), jump)
    # v- and v+ differ by a vector orthogonal to v+, so that the loss is a square and cannot be negative
    return before + jump, (row * (selection.Q.T @ mu)).reshape(-1, 6), jump @ momentum / 2


@jax.jit
def decide_rank(chain: Chain, structure: Structure, q: Float[Array, " q"]) -> Structure:
    """The structure with its rank m: the larger of those at q and at a closed configuration nearby, for q itself may be singular."""
    if not len(chain.topology.link_names):
        return structure
    frozen = jax.lax.stop_gradient((chain, structure, q))
    found = newton_turns(*frozen, jnp.zeros(chain.dofs, q.dtype), SEARCH, CLOSE)
    return eqx.tree_at(lambda s: (s.rank, s.margin), structure, (found.rank, found.margin))


class Joined(eqx.Module):
    """What `join` finds: rank and margin of the structure, the motion under it, and of the impact what `Turns` has."""

    rank: Int[Array, ""]
    margin: Float[Array, ""]
    q: Float[Array, " q"]
    v: Float[Array, " dofs"]
    wrench: Float[Array, "links 6"]
    lost: Float[Array, ""]
    gap: Float[Array, ""]


def _join(chain: Chain, structure: Structure, q, v) -> Joined:
    found = newton_turns(chain, structure, q, v, SEARCH, END)
    return Joined(found.rank, found.margin, found.q, found.v, found.wrench, found.lost, found.gap)


def _join_jvp(primals, tangents):
    """Return the tangent of the closing turns and the impact, for the rank that was found."""
    joined = join(*primals)
    chain, structure, q, v = primals
    ranked = eqx.tree_at(lambda s: (s.rank, s.margin), structure, (joined.rank, jax.lax.stop_gradient(joined.margin)))

    @eqx.filter_checkpoint
    def moved(chain, structure, q, v):
        found = newton_turns(chain, structure, q, v, CLOSE, END)
        return found.q, found.v, found.wrench, found.lost

    along = eqx.filter_jvp(moved, (chain, ranked, q, v), tangents)[1]
    return joined, Joined(None, None, *along, None)


# join(chain, structure, q, v) -> Joined: the loops closed, the rank found and the velocity after the impact, where something new holds
join = operation("join", _join, _join_jvp)
