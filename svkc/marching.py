"""F6: the steps of one phase: forward until its end, or until a guard has gone through zero; then, from the same step's begin, to where it was zero.

One loop does both, so that a program holds the field, the solver's stages and the way back onto the loops once. Nothing here is differentiated.
"""

from typing import Any

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from svkc.events import Bracket
from svkc.location import FLAT, Found, Reading, event_tolerance
from svkc.stepping import REST, Field, Motion, Scene, projects, settle

SUCCESSFUL, EVENT, MAX_STEPS = diffrax.RESULTS.successful._value, diffrax.RESULTS.event_occurred._value, diffrax.RESULTS.max_steps_reached._value


class World(eqx.Module):
    """What the motion depends on besides its start: the scene, and the vector field with all that it closes over."""

    scene: Scene
    field: Field


class Watched(eqx.Module):
    """Guards, their values at the start of a phase, and which of them may end it."""

    guards: Reading
    values: Float[Array, " guards"]
    which: Bool[Array, " guards"]


class How(eqx.Module):
    """What finds the steps: nothing of it is differentiated."""

    solver: diffrax.AbstractSolver
    watched: Watched | None
    controller: Any
    first_step: Any
    progress_meter: diffrax.AbstractProgressMeter
    max_steps: int = eqx.field(static=True)
    every: int = eqx.field(static=True)


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
    found: Found | None = None


class Search(eqx.Module):
    """For the first zero in the step from the loop's t, over a span of time: guards that crossed it, by the side they are on then, and their sizes; the
    bracket and, at its right end, the motion and the guards; the guards just after that. on: begun; narrow: the bracket is to be made smaller yet."""

    span: Float[Array, ""]
    side: Float[Array, " guards"]
    size: Float[Array, " guards"]
    bracket: Bracket
    motion: Motion
    values: Float[Array, " guards"]
    ahead: Float[Array, " guards"]
    on: Bool[Array, ""]
    narrow: Bool[Array, ""]
    done: Bool[Array, ""]

    def asked(self) -> Float[Array, ""]:
        """The time to be looked at next."""
        b = self.bracket.b
        return jnp.where(self.narrow, self.bracket.inside(), b + event_tolerance(b))


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


def _choose(which, new, old):
    return jax.tree.map(lambda a, b: jnp.where(which, a, b), new, old)


def march(start: Motion, times, world: World, how: How) -> Path:
    """From times = (t0, stop, save times) to `stop`, or to where a guard was zero first."""
    _, stop, at = times

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
    found = None if how.watched is None else _found(end)
    if found is not None:
        short = jnp.where(found.hit, EVENT, short)
    result = jnp.where(end.result == SUCCESSFUL, short, end.result)
    return Path(end.t, end.y, saved, end.times, end.kept, end.accepted, end.rejected, result.astype(jnp.int32), found)


def _begin(start: Motion, times, world: World, how: How) -> Step:
    t0, stop, at = times
    term, no, zero = diffrax.ODETerm(world.field), jnp.zeros((), bool), jnp.zeros((), jnp.int32)
    first, controller = how.controller.init(term, t0, stop, start, how.first_step, world.scene, how.solver.func, how.solver.error_order(term))
    rows = lambda n: jax.tree.map(lambda x: jnp.broadcast_to(x[None], (n, *x.shape)), start)
    values, search = None, None
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
    y = settle(stabilization, world.scene, y)
    error, order = jax.tree.map(lambda x: jnp.where(jnp.isnan(x), jnp.inf, x), error), how.solver.error_order(term)
    keep, t, ahead, jumped, controller, said = how.controller.adapt_step_size(s.t, t1, s.y, y, world.scene, error, order, s.controller)
    keep, length = jnp.asarray(keep), ahead - t
    if isinstance(how.controller, diffrax.PIDController):
        # the length asked for before a step was much shortened, where that step says no more than that it may grow as far as it ever may
        grown = keep & (length >= 0.99 * how.controller.factormax * (t1 - s.t))
        length = jnp.where(grown, jnp.maximum(length, s.length), length)
    failed = keep & (solved._value != SUCCESSFUL)
    result = jnp.where(failed, solved._value, said._value).astype(jnp.int32)
    return Tried(t, y, keep, length, jnp.asarray(jumped), solver, controller, result)


def _step(s: Step, times, world: World, how: How) -> Step:
    """One try: kept, or to be made shorter; or one more look at the step in which a guard went through zero."""
    t0, stop, at = times
    if s.search is None:
        tried = _try(s, s.next, world, how)
        guards, search, still = None, None, jnp.zeros((), bool)
    else:
        t1 = jnp.where(s.search.on, s.search.asked(), s.next)
        tried = _try(s, t1, world, how)
        guards, search = _watch(s, t1, tried, world.scene, how.watched)
        still = s.search.on | search.on
        landed = _choose(search.done, (search.bracket.b, search.motion), (tried.t, tried.y))
        tried = eqx.tree_at(lambda x: (x.t, x.y, x.keep), tried, (*landed, (tried.keep & ~still) | search.done))
    moved = lambda new, old: _choose(tried.keep, new, old)
    # while a zero is looked for, nothing else goes on
    next_ = lambda new, old: _choose(still, old, new)
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
    )


def _written(rows, i, new, pred):
    """Rows of numbers with new ones at i."""
    # the index of a row that is not to be written may be anything
    i = jnp.where(pred, i, 0)
    return jax.tree.map(lambda x, b: eqxi.buffer_at_set(b, i, x, pred=pred), new, rows)


def _watch(s: Step, t1, tried: Tried, scene: Scene, watched: Watched) -> tuple[Float[Array, " guards"], Search]:
    """The guards after a try, and the search for their first zero: begun, narrowed, or done once they are known just after it."""
    old = s.search
    values = watched.guards(t1, tried.y, scene)
    # a guard at zero is not armed before it has left it by more than round-off
    values = jnp.where((s.guards == 0) & (jnp.abs(values) < jnp.finfo(values.dtype).eps ** 0.75), 0, values)
    crossed = watched.guards.made.crossed(s.guards, values) & watched.which & tried.keep & ~old.on
    begun = jnp.any(crossed)
    side = jnp.where(begun, jnp.where(crossed, jnp.where(values >= s.guards, 1, -1), 0).astype(values.dtype), old.side)
    # the largest of the guards that crossed: positive where one has
    passed = lambda values: jnp.max(jnp.where(side != 0, side * values, -jnp.inf))
    bracket = _choose(old.narrow, old.bracket.narrowed(t1, passed(values)), old.bracket)
    bracket = _choose(begun, Bracket.around(s.t, t1, passed(s.guards), passed(values)), bracket)
    at_right = begun | (old.narrow & (passed(values) >= 0))
    done = old.on & ~old.narrow
    on = begun | (old.on & ~done)
    search = Search(
        span=jnp.where(begun, t1 - s.t, old.span),
        side=side,
        size=jnp.where(begun, jnp.maximum(jnp.abs(s.guards), jnp.abs(values)), old.size),
        bracket=bracket,
        motion=_choose(at_right, tried.y, old.motion),
        values=jnp.where(at_right, values, old.values),
        ahead=jnp.where(done, values, old.ahead),
        on=on,
        narrow=on & bracket.wide(),
        done=done,
    )
    return jnp.where(done, search.values, values), search


def _found(end: Step) -> Found:
    """Which guards fired, where the loop has looked for that."""
    search = end.search
    crossed, passed = search.side != 0, search.side * search.values
    first = jnp.argmax(jnp.where(crossed, passed, -jnp.inf)).astype(jnp.int32)
    fired = (crossed & (search.side * search.ahead >= 0)) | (jnp.arange(crossed.shape[0], dtype=jnp.int32) == first)
    value, grown, large = jnp.abs(passed[first]), jnp.abs(search.ahead - search.values)[first], FLAT * search.size[first]
    jumps = search.done & (value > grown) & (value > large)
    flat = search.done & ~jumps & (grown / event_tolerance(end.t) * search.span < large)
    fired = fired & search.done
    # zero: not armed, until it has left zero
    return Found(fired, jnp.where(fired, 0, end.guards), first, search.done, jumps, flat)
