"""The steps of one phase: forward until its end, or until a guard has gone through zero; then, from
the same step's begin, to where it was zero.

One loop does both, so that a program holds the field, the solver's stages and the way back onto the
loops once. Nothing here is differentiated.
"""

import dataclasses

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from svkc._jax.control_flow import buffer_at_set, while_loop
from svkc._jax.pytrees import tree_where
from svkc.integration.event_location import Bracket, Search, found, watch
from svkc.integration.integrators import REST, Motion, finite, motion_norm
from svkc.integration.solution import (
    EVENT,
    MAX_STEPS,
    MOVED,
    NON_FINITE,
    OPEN,
    SUCCESSFUL,
    How,
    Path,
    Step,
    Tally,
    Tried,
    World,
    _counted,
)
from svkc.integration.stabilization import projects
from svkc.integration.vector_field import Seen, settle


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
    end = while_loop(
        going, lambda s: _step(s, times, world, how), begin, buffers=buffers, kind="lax"
    )
    how.progress_meter.close(end.meter)
    # of times that are equal the first one's row is written
    saved = (
        jax.tree.map(lambda x: x[jnp.searchsorted(at, at)], end.saved) if at.shape[0] else end.saved
    )
    short = jnp.where(end.t < stop, MAX_STEPS, SUCCESSFUL)
    fired = None if how.watched is None else found(end.search, end.guards, end.t)
    if fired is not None:
        short = jnp.where(fired.hit, EVENT, short)
    result = jnp.where(end.result == SUCCESSFUL, short, end.result)
    return Path(
        t=end.t,
        end=end.y,
        saved=saved,
        times=end.times,
        kept=end.kept,
        accepted=end.accepted,
        rejected=end.rejected,
        result=result.astype(jnp.int32),
        tally=end.tally,
        found=fired,
    )


def _begin(start: Motion, times, world: World, how: How) -> Step:
    t0, stop, at = times
    term, no, zero = diffrax.ODETerm(world.field), jnp.zeros((), bool), jnp.zeros((), jnp.int32)
    first, controller = how.controller.init(
        term,
        t0,
        stop,
        start,
        how.first_step,
        world.scene,
        func=how.solver.func,
        error_order=how.solver.error_order(term),
    )
    rows = lambda n: jax.tree.map(lambda x: jnp.broadcast_to(x[None], (n, *x.shape)), start)
    values, search, seen = None, None, Seen.first(world.field, world.scene, start.q)
    if how.watched is not None:
        values = how.watched.values
        search = Search(
            span=t0,
            side=jnp.zeros_like(values),
            size=values,
            bracket=Bracket.around(t0, t0, t0, t0),
            motion=start,
            values=values,
            ahead=values,
            on=no,
            narrow=no,
            done=no,
        )
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
    # a step begins with the rate where the one before was settled to, not with one remembered from
    # where it was before that
    fresh = True if projects(stabilization, world.scene) else s.jumped
    y, error, _, solver, solved = how.solver.step(
        term, s.t, t1, s.y, world.scene, s.solver, made_jump=fresh
    )
    raw, (y, seen) = y, settle(world.field, world.scene, y)
    if error is not None and world.field.pivotless:
        # without pivots nothing else shows that loops lose rank
        error = jax.tree.map(
            lambda e, new, old: jnp.maximum(jnp.abs(e), MOVED * jnp.abs(new - old)), error, y, raw
        )
    whole, order = finite(y), how.solver.error_order(term)
    why = jnp.where(whole, OPEN, NON_FINITE)
    if seen is not None:
        whole = whole & (jnp.max(seen.gap) <= how.gap)
    error = jax.tree.map(lambda x: jnp.where(whole & jnp.isfinite(x), x, jnp.inf), error)
    keep, t, ahead, jumped, controller, said = how.controller.adapt_step_size(
        s.t, t1, s.y, y, world.scene, error, error_order=order, controller_state=s.controller
    )
    keep, length = jnp.asarray(keep), ahead - t
    if isinstance(how.controller, diffrax.PIDController):
        # the length asked for before a step was much shortened, where that step says no more than
        # that it may grow as far as it ever may
        grown = keep & (length >= 0.99 * how.controller.factormax * (t1 - s.t))
        length = jnp.where(grown, jnp.maximum(length, s.length), length)
    failed = keep & (solved._value != SUCCESSFUL)
    result = jnp.where(failed, solved._value, said._value)
    # what is not finite, or open, is never kept: it ends the run where the step has to be of that
    # length, or when there is no shorter one
    result = jnp.where(~whole & (keep | (result != SUCCESSFUL)), why, result).astype(jnp.int32)
    estimate = jnp.asarray(jnp.inf, t.dtype) if error is None else motion_norm(error)
    return Tried(
        t=t,
        y=y,
        keep=keep & whole,
        length=length,
        jumped=jnp.asarray(jumped),
        solver=solver,
        controller=controller,
        result=result,
        error=estimate,
        seen=seen,
    )


def _located(s: Step, world: World, how: How) -> tuple[Tried, Array, Search, Array]:
    """Take a try of a step and look at the guards there. Return it, the values of the guards, the
    search for the zero of one, and whether that search goes on or has just ended."""
    t1 = jnp.where(s.search.on, s.search.asked(), s.next)
    tried = _try(s, t1, world, how)
    guards, search = watch(
        s.search,
        s.guards,
        t0=s.t,
        t1=t1,
        y=tried.y,
        keep=tried.keep,
        scene=world.scene,
        watched=how.watched,
    )
    still = s.search.on | search.on
    blind = tried.keep & jnp.any(jnp.isnan(guards))
    t, y = tree_where(search.done, (search.bracket.b, search.motion), (tried.t, tried.y))
    tried = dataclasses.replace(
        tried,
        t=t,
        y=y,
        keep=(tried.keep & ~blind & ~still) | search.done,
        result=jnp.where(blind, NON_FINITE, tried.result),
    )
    return tried, guards, search, still


def _saved(s: Step, tried: Tried, t, at, accepted, every: int) -> tuple[Motion, Motion]:
    """Return the saved states and the kept ones, with the state after a try written in where it is
    one of them. t, accepted: the time and the number of steps after it."""
    saved, kept = s.saved, s.kept
    if at.shape[0]:
        place = jnp.minimum(jnp.sum(at < t, dtype=jnp.int32), at.shape[0] - 1)
        saved = _written(saved, place, tried.y, tried.keep & (at[place] == t))
    if kept.q.shape[0]:
        kept = _written(kept, accepted // every - 1, tried.y, tried.keep & (accepted % every == 0))
    return saved, kept


def _step(s: Step, times, world: World, how: How) -> Step:
    """One try: kept, or to be made shorter; or one more look at the step in which a guard went
    through zero."""
    t0, stop, at = times
    if s.seen is not None and s.seen.pivots is not None and world.field.dynamics.hold is not None:
        world = eqx.tree_at(
            lambda w: w.scene.pivots, world, s.seen.pivots, is_leaf=lambda x: x is None
        )
    if s.search is None:
        tried = _try(s, s.next, world, how)
        guards, search, still = None, None, jnp.zeros((), bool)
    else:
        tried, guards, search, still = _located(s, world, how)
    moved = lambda new, old: tree_where(tried.keep, new, old)
    # while a zero is looked for, nothing else goes on
    next_ = lambda new, old: tree_where(still, old, new)
    t, accepted = moved(tried.t, s.t), s.accepted + tried.keep.astype(jnp.int32)
    saved, kept = _saved(s, tried, t, at, accepted, how.every)
    result = next_(tried.result, s.result)
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
        result=result,
        tally=_counted(s, tried, result, world.scene),
        seen=moved(tried.seen, s.seen),
    )


def _written(rows, i, new, pred):
    """Rows of numbers with new ones at i."""
    # the index of a row that is not to be written may be anything
    i = jnp.where(pred, i, 0)
    return jax.tree.map(lambda x, b: buffer_at_set(b, i, x, pred=pred), new, rows)
