"""F6: the steps of one phase: forward until its end, or until a guard has gone through zero; then, from the same step's begin, to where it was zero.

One loop does both, so that a program holds the field, the solver's stages and the way back onto the loops once. Nothing here is differentiated.
"""

import dataclasses
from typing import Any

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from svkc.integration.event_adjoint import Found
from svkc.integration.event_location import Search, Watched, found, watch
from svkc.integration.vector_field import REST, Field, Motion, Scene, Seen, chosen, finite, motion_norm, projects, settle
from svkc.loops.coordinates import largest_gaps
from svkc.model.chain import State
from svkc.transitions.events import Bracket

NON_FINITE, OPEN = -1, -2
# by articulated bodies a step may be moved, as it is put back onto the loops, by 1 / MOVED of what it may err by
MOVED = 1e-3
SUCCESSFUL, EVENT, MAX_STEPS = diffrax.RESULTS.successful._value, diffrax.RESULTS.event_occurred._value, diffrax.RESULTS.max_steps_reached._value


class World(eqx.Module):
    """What the motion depends on besides its start: the scene, and the vector field with all that it closes over."""

    scene: Scene
    field: Field


class How(eqx.Module):
    """What finds the steps: nothing of it is differentiated."""

    solver: diffrax.AbstractSolver
    watched: Watched | None
    controller: Any
    first_step: Any
    progress_meter: diffrax.AbstractProgressMeter
    gap: float = eqx.field(static=True)
    max_steps: int = eqx.field(static=True)
    every: int = eqx.field(static=True)


class Tally(eqx.Module):
    """What a run has cost and shown: tries, and of the steps that were kept the sum of their estimated errors (root mean square over q and v; inf: the
    solver gives none), the least |R_mm| / |R_11| of the loops, how often the dependent coordinates changed (-1: not looked at), the loop that could
    not be closed (-1: none), and the largest of the loops' gaps (rad, m)."""

    tries: Int[Array, ""]
    error: Float[Array, ""]
    margin: Float[Array, ""]
    swaps: Int[Array, ""]
    loop: Int[Array, ""]
    gap: Float[Array, "2"]

    @classmethod
    def none(cls, dtype, looked: bool) -> "Tally":
        """Before the first step."""
        zero = jnp.zeros((), jnp.int32)
        return cls(zero, jnp.zeros((), dtype), jnp.ones((), dtype), zero if looked else zero - 1, zero - 1, jnp.zeros(2, dtype))


class Path(eqx.Module):
    """Where a solve ended, the states at the times asked for, the times of its steps (inf: not taken), one state in `every`, diffrax's result code."""

    t: Float[Array, ""]
    end: Motion
    saved: Motion
    times: Float[Array, " steps"]
    kept: Motion
    accepted: Int[Array, ""]
    rejected: Int[Array, ""]
    result: Int[Array, ""]
    tally: Tally
    found: Found | None = None


class Step(eqx.Module):
    """What goes from step to step. length: what the controller asks for, before a time to be met shortens it; times, kept, saved: as in `Path`, but
    buffers within the loop."""

    t: Float[Array, ""]
    y: Motion
    next: Float[Array, ""]
    length: Float[Array, ""]
    jumped: Bool[Array, ""]
    solver: Any
    controller: Any
    meter: Any
    guards: Float[Array, " guards"] | None
    search: Search | None
    times: Any
    kept: Any
    saved: Any
    accepted: Int[Array, ""]
    rejected: Int[Array, ""]
    result: Int[Array, ""]
    tally: Tally
    seen: Seen | None


class Tried(eqx.Module):
    """What a try has led to."""

    t: Float[Array, ""]
    y: Motion
    keep: Bool[Array, ""]
    length: Float[Array, ""]
    jumped: Bool[Array, ""]
    solver: Any
    controller: Any
    result: Int[Array, ""]
    error: Float[Array, ""]
    seen: Seen | None


def march(start: Motion, times, world: World, how: How) -> Path:
    """From times = (t0, stop, save times) to `stop`, or to where a guard was zero first."""
    _, stop, at = times
    world = World(world.scene, dataclasses.replace(world.field, differentiated=False))

    def going(s: Step):
        more = (s.t < stop) & (s.accepted + s.rejected < how.max_steps)
        if s.search is not None:
            more = (more | s.search.on) & ~s.search.done
        return more & (s.result == SUCCESSFUL)

    begin, buffers = _begin(start, times, world, how), lambda s: (s.times, s.kept, s.saved)
    end = eqxi.while_loop(going, lambda s: _step(s, times, world, how), begin, buffers=buffers, kind="lax")
    how.progress_meter.close(end.meter)
    # of times that are equal the first one's row is written
    saved = jax.tree.map(lambda x: x[jnp.searchsorted(at, at)], end.saved) if at.shape[0] else end.saved
    short = jnp.where(end.t < stop, MAX_STEPS, SUCCESSFUL)
    fired = None if how.watched is None else found(end.search, end.guards, end.t)
    if fired is not None:
        short = jnp.where(fired.hit, EVENT, short)
    result = jnp.where(end.result == SUCCESSFUL, short, end.result)
    return Path(end.t, end.y, saved, end.times, end.kept, end.accepted, end.rejected, result.astype(jnp.int32), end.tally, fired)


def _begin(start: Motion, times, world: World, how: How) -> Step:
    t0, stop, at = times
    term, no, zero = diffrax.ODETerm(world.field), jnp.zeros((), bool), jnp.zeros((), jnp.int32)
    first, controller = how.controller.init(term, t0, stop, start, how.first_step, world.scene, how.solver.func, how.solver.error_order(term))
    rows = lambda n: jax.tree.map(lambda x: jnp.broadcast_to(x[None], (n, *x.shape)), start)
    values, search, seen = None, None, Seen.first(world.field, world.scene, start.q)
    if how.watched is not None:
        values = how.watched.values
        search = Search(t0, jnp.zeros_like(values), values, Bracket.around(t0, t0, t0, t0), start, values, values, no, no, no)
    return Step(
        t=t0,
        y=start,
        next=_met(t0, first, times),
        length=first - t0,
        jumped=no,
        solver=how.solver.init(term, t0, first, start, world.scene),
        controller=controller,
        meter=how.progress_meter.init(),
        guards=values,
        search=search,
        times=jnp.full(how.max_steps, jnp.inf, t0.dtype),
        kept=rows(how.max_steps // how.every),
        saved=rows(at.shape[0]),
        accepted=zero,
        rejected=zero,
        result=jnp.asarray(SUCCESSFUL, jnp.int32),
        tally=Tally.none(t0.dtype, seen is not None and seen.pivots is not None),
        seen=seen,
    )


def _met(t, proposed, times) -> Float[Array, ""]:
    """The end of a step from t: as proposed, or the next time to be met."""
    _, stop, at = times
    limit = jnp.minimum(stop, jnp.min(jnp.where(at > t, at, jnp.inf), initial=jnp.inf))
    return jnp.where(t + (proposed - t) * (1 + REST) >= limit, limit, proposed)


def _try(s: Step, t1, world: World, how: How) -> Tried:
    """A step of the solver to t1, settled, and what the controller says of it."""
    term, stabilization = diffrax.ODETerm(world.field), world.field.stabilization
    # a step begins with the rate where the one before was settled to, not with one remembered from where it was before that
    fresh = True if projects(stabilization, world.scene) else s.jumped
    y, error, _, solver, solved = how.solver.step(term, s.t, t1, s.y, world.scene, s.solver, fresh)
    raw, (y, seen) = y, settle(world.field, world.scene, y)
    if error is not None and world.field.pivotless:
        # without pivots nothing else shows that loops lose rank
        error = jax.tree.map(lambda e, new, old: jnp.maximum(jnp.abs(e), MOVED * jnp.abs(new - old)), error, y, raw)
    whole, order = finite(y), how.solver.error_order(term)
    why = jnp.where(whole, OPEN, NON_FINITE)
    if seen is not None:
        whole = whole & (jnp.max(seen.gap) <= how.gap)
    error = jax.tree.map(lambda x: jnp.where(whole & jnp.isfinite(x), x, jnp.inf), error)
    keep, t, ahead, jumped, controller, said = how.controller.adapt_step_size(s.t, t1, s.y, y, world.scene, error, order, s.controller)
    keep, length = jnp.asarray(keep), ahead - t
    if isinstance(how.controller, diffrax.PIDController):
        # the length asked for before a step was much shortened, where that step says no more than that it may grow as far as it ever may
        grown = keep & (length >= 0.99 * how.controller.factormax * (t1 - s.t))
        length = jnp.where(grown, jnp.maximum(length, s.length), length)
    failed = keep & (solved._value != SUCCESSFUL)
    result = jnp.where(failed, solved._value, said._value)
    # what is not finite, or open, is never kept: it ends the run where the step has to be of that length, or when there is no shorter one
    result = jnp.where(~whole & (keep | (result != SUCCESSFUL)), why, result).astype(jnp.int32)
    estimate = jnp.asarray(jnp.inf, t.dtype) if error is None else motion_norm(error)
    return Tried(t, y, keep & whole, length, jnp.asarray(jumped), solver, controller, result, estimate, seen)


def _step(s: Step, times, world: World, how: How) -> Step:
    """One try: kept, or to be made shorter; or one more look at the step in which a guard went through zero."""
    t0, stop, at = times
    if s.seen is not None and s.seen.pivots is not None and world.field.dynamics.hold is not None:
        world = eqx.tree_at(lambda w: w.scene.pivots, world, s.seen.pivots, is_leaf=lambda x: x is None)
    if s.search is None:
        tried = _try(s, s.next, world, how)
        guards, search, still = None, None, jnp.zeros((), bool)
    else:
        t1 = jnp.where(s.search.on, s.search.asked(), s.next)
        tried = _try(s, t1, world, how)
        guards, search = watch(s.search, s.guards, s.t, t1, tried.y, tried.keep, world.scene, how.watched)
        still = s.search.on | search.on
        blind = tried.keep & jnp.any(jnp.isnan(guards))
        tried = eqx.tree_at(lambda x: (x.keep, x.result), tried, (tried.keep & ~blind, jnp.where(blind, NON_FINITE, tried.result)))
        landed = chosen(search.done, (search.bracket.b, search.motion), (tried.t, tried.y))
        tried = eqx.tree_at(lambda x: (x.t, x.y, x.keep), tried, (*landed, (tried.keep & ~still) | search.done))
    moved = lambda new, old: chosen(tried.keep, new, old)
    # while a zero is looked for, nothing else goes on
    next_ = lambda new, old: chosen(still, old, new)
    t, accepted = moved(tried.t, s.t), s.accepted + tried.keep.astype(jnp.int32)
    saved, kept = s.saved, s.kept
    if at.shape[0]:
        place = jnp.minimum(jnp.sum(at < t, dtype=jnp.int32), at.shape[0] - 1)
        saved = _written(saved, place, tried.y, tried.keep & (at[place] == t))
    if kept.q.shape[0]:
        kept = _written(kept, accepted // how.every - 1, tried.y, tried.keep & (accepted % how.every == 0))
    return Step(
        t=t,
        y=moved(tried.y, s.y),
        next=next_(_met(t, t + tried.length, times), s.next),
        length=next_(tried.length, s.length),
        jumped=moved(tried.jumped, s.jumped),
        solver=moved(tried.solver, s.solver),
        controller=next_(tried.controller, s.controller),
        meter=how.progress_meter.step(s.meter, (t - t0) / jnp.where(stop > t0, stop - t0, 1)),
        guards=None if guards is None else moved(guards, s.guards),
        search=search,
        times=_written(s.times, s.accepted, t, tried.keep),
        kept=kept,
        saved=saved,
        accepted=accepted,
        rejected=s.rejected + (~tried.keep & ~still).astype(jnp.int32),
        result=next_(tried.result, s.result),
        tally=_counted(s, tried, next_(tried.result, s.result), world.scene),
        seen=moved(tried.seen, s.seen),
    )


def _counted(s: Step, tried: Tried, result: Int[Array, ""], scene: Scene) -> Tally:
    """With one more try. result: how the run stands after it."""
    old, kept = s.tally, tried.keep
    margin, swaps, gap = old.margin, old.swaps, old.gap
    if tried.seen is not None and tried.seen.pivots is not None:
        margin = jnp.where(kept, jnp.minimum(margin, tried.seen.margin), margin)
        # the first choice of a phase is no change
        swapped = jnp.any(s.seen.dependent) & jnp.any(s.seen.dependent != tried.seen.dependent)
        swaps = swaps + (kept & swapped).astype(jnp.int32)
    loop = old.loop if tried.seen is None else jnp.where(result == OPEN, jnp.argmax(jnp.max(tried.seen.gap, 1)).astype(jnp.int32), old.loop)
    if len(scene.chain.link_names):
        gap = jnp.where(kept, jnp.maximum(gap, _open(tried, scene)), gap)
    return Tally(old.tries + 1, old.error + jnp.where(kept, tried.error, 0), margin, swaps, loop, gap)


def _open(tried: Tried, scene: Scene) -> Float[Array, "2"]:
    """The largest of the loops' gaps (rad, m) at the end of a try."""
    if tried.seen is None:
        return largest_gaps(scene.chain, State(tried.y.q, tried.y.v, scene.structure))[0]
    return jnp.max(tried.seen.gap, 0) * jnp.stack([jnp.ones_like(scene.chain.length), scene.chain.length])


def _written(rows, i, new, pred):
    """Rows of numbers with new ones at i."""
    # the index of a row that is not to be written may be anything
    i = jnp.where(pred, i, 0)
    return jax.tree.map(lambda x, b: eqxi.buffer_at_set(b, i, x, pred=pred), new, rows)
