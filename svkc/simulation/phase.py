"""One phase: a solve of one smooth field, up to the next scheduled time or the first guard that
crosses zero."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from svkc._jax.pytrees import frozen
from svkc.integration.diffrax_adjoint import Settled
from svkc.integration.event_adjoint import arrived
from svkc.integration.event_location import Reading, Watched
from svkc.integration.integrate import march
from svkc.integration.integrators import Motion, Scene, finite
from svkc.integration.replay import Replay, integrated, staged
from svkc.integration.solution import (
    EVENT,
    MAX_STEPS,
    NON_FINITE,
    OPEN,
    SUCCESSFUL,
    How,
    Path,
    Tally,
    World,
)
from svkc.integration.vector_field import Field
from svkc.model.chain import State
from svkc.simulation.options import Options
from svkc.simulation.records import RESULTS, Events, Records
from svkc.transitions.events import Plan


class Run(eqx.Module):
    """The state that a phase hands to the next. `count`: phases so far; `stale`: guards whose
    values belong to another structure; `derivative`, `invalid_from`: why the run has no derivative,
    and the index of the first such phase."""

    t: Float[Array, ""]
    state: State
    work: Float[Array, ""] | None
    guards: Float[Array, " guards"] | None
    stale: Bool[Array, " guards"] | None
    pending: Bool[Array, " timed"]
    events: Events
    records: Records
    count: Int[Array, ""]
    saved: State
    result: RESULTS
    derivative: RESULTS
    invalid_from: Int[Array, ""]


class Solved(eqx.Module):
    """Where a phase ended: time, motion, the guards that fired there, which guard values go on, the
    solver's words, and whether it can be differentiated."""

    t: Float[Array, ""]
    motion: Motion
    fired: Bool[Array, " guards"]
    guards: Float[Array, " guards"] | None
    saved: Motion
    path: Path
    result: RESULTS
    derivative: RESULTS


def solve(run: Run, stop, ts, made: Plan, options: Options, scene: Scene) -> Solved:
    """From run.t to `stop`, or to the first guard that crosses zero."""
    guards = Reading(made, options.field) if made.guards else None
    watched = (
        None
        if guards is None
        else frozen(Watched(guards, run.guards, made.watched(scene.chain, scene.structure)))
    )
    start = Motion(run.state.q, run.state.v, run.work)
    # a save time within the phase, its ends included, moves by itself; what is saved of the others
    # counts in another phase
    begun, ended = frozen((run.t, jnp.maximum(stop, run.t)))
    at = jnp.where(ts < begun, begun, jnp.where(ts > ended, ended, ts))
    reading = options.field if guards is None else guards
    path, found, t, motion = _path(
        start, (run.t, stop, at), World(scene, options.field), watched, options, reading
    )
    result = _translate(path.result, path.end)
    if found is None:
        return Solved(
            t,
            motion,
            jnp.zeros(0, bool),
            None,
            path.saved,
            frozen(path),
            result,
            RESULTS.successful,
        )
    code = RESULTS.where(found.jumps, RESULTS.jump, RESULTS.successful)
    code = RESULTS.where(jnp.sum(found.fired) > 1, RESULTS.together, code)
    code = RESULTS.where(found.flat, RESULTS.grazing, code)
    return Solved(t, motion, found.fired, found.values, path.saved, frozen(path), result, code)


def _path(
    start: Motion,
    times,
    world: World,
    watched: Watched | None,
    options: Options,
    reading: Reading | Field,
):
    """The solve up to where it ends, the guard that ends it, and the time and motion there;
    differentiated by replay, or by the diffrax adjoint asked for."""
    ours, adjoint = isinstance(options.adjoint, Replay), options.adjoint
    every = (
        min(adjoint.every, options.max_steps) if isinstance(adjoint, Replay) else options.max_steps
    )
    meter = options.progress_meter if ours else diffrax.NoProgressMeter()
    solver, looked_for, (controller, first_step) = frozen(
        (staged(options.solver, "lax"), watched, options.steps())
    )
    how = How(
        solver, looked_for, controller, first_step, meter, options.gap, options.max_steps, every
    )
    if ours:
        path, t, motion = integrated(start, times, world, how, reading)
        return path, frozen(path.found), t, motion
    t0, stop, at = times
    found = None
    if watched is not None:
        # where a guard is zero first, found once before
        begin, fixed_times, still = frozen((start, times, world))
        first = march(begin, fixed_times, still, how)
        stop = jnp.where(first.found.hit, first.t, stop)
        at, found = jnp.where(at > stop, stop, at), first.found
    controller, first_step = options.steps(at)
    # as diffrax would set it, did it see through the wrapper
    kind = {diffrax.ForwardMode: "lax", diffrax.DirectAdjoint: "bounded"}.get(type(adjoint))
    solver = Settled(staged(options.solver, kind), options.field)
    saveat = diffrax.SaveAt(subs=[diffrax.SubSaveAt(t1=True), diffrax.SubSaveAt(ts=at)])
    sol = diffrax.diffeqsolve(
        diffrax.ODETerm(world.field), solver, t0, stop, first_step, start, world.scene,
        saveat=saveat, stepsize_controller=controller, adjoint=adjoint,
        max_steps=options.max_steps, throw=False, progress_meter=options.progress_meter,
    )  # fmt: skip
    (end, saved), t, result = sol.ys, sol.ts[0][0], sol.result._value
    result = jnp.where(result == diffrax.RESULTS.internal_error._value, NON_FINITE, result)
    if found is not None:
        result = jnp.where((result == SUCCESSFUL) & found.hit, EVENT, result)
    accepted, rejected = (
        jnp.asarray(sol.stats[name], jnp.int32)
        for name in ("num_accepted_steps", "num_rejected_steps")
    )
    # diffrax tells the number of tries alone
    unknown = jnp.asarray(-1, jnp.int32)
    tally = Tally(
        accepted + rejected,
        jnp.asarray(jnp.inf, t0.dtype),
        jnp.ones((), t0.dtype),
        unknown,
        unknown,
        jnp.zeros(2, t0.dtype),
    )
    path = Path(
        t,
        jax.tree.map(lambda x: x[0], end),
        saved,
        jnp.zeros(0, t0.dtype),
        saved,
        accepted,
        rejected,
        result,
        tally,
        found,
    )
    # the adjoint has seen to a scheduled end that moves
    return path, found, *arrived(path.t, path.end, jnp.zeros_like(t), world.scene, reading, found)


def _translate(result: Int[Array, ""], motion: Motion) -> RESULTS:
    """Diffrax's word for how a solve ended, as ours."""
    out = RESULTS.where(
        (result == SUCCESSFUL) | (result == EVENT), RESULTS.successful, RESULTS.step_too_small
    )
    out = RESULTS.where(result == MAX_STEPS, RESULTS.max_steps, out)
    out = RESULTS.where(result == OPEN, RESULTS.loop_open, out)
    return RESULTS.where(finite(motion) & (result != NON_FINITE), out, RESULTS.non_finite)
