"""F6: one phase: a solve of one smooth field, up to the next scheduled time or the first guard that crosses zero."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from svkc.chain import State
from svkc.events import Plan
from svkc.location import Crossing, Found, Reading, arrived, locate
from svkc.replay import How, Path, Replay, World, integrated
from svkc.request import Options
from svkc.stepping import Motion, Scene, Settled, Watch, frozen, staged, step_alone
from svkc.trajectory import RESULTS, Events, Phases


class Run(eqx.Module):
    """What goes from phase to phase."""

    t: Float[Array, ""]
    state: State
    work: Float[Array, ""] | None
    guards: Float[Array, " guards"] | None
    pending: Bool[Array, " timed"]
    events: Events
    phases: Phases
    saved: State
    result: RESULTS
    derivative: RESULTS


class Solved(eqx.Module):
    """Where a phase ended: time, motion, the guards that fired there, which guard values go on, the solver's words, and whether it can be differentiated."""

    t: Float[Array, ""]
    motion: Motion
    fired: Bool[Array, " guards"]
    guards: Float[Array, " guards"] | None
    saved: Motion
    stats: tuple[Int[Array, ""], Int[Array, ""]]
    result: RESULTS
    derivative: RESULTS


def solve(run: Run, stop, ts, made: Plan, options: Options, scene: Scene) -> Solved:
    """Diffrax from run.t to `stop`, or to the first guard that crosses zero."""
    scene = eqx.tree_at(lambda s: s.watched, scene, made.watched(scene.chain, scene.structure) if made.guards else None, is_leaf=lambda x: x is None)
    guards = Reading(made, options.field) if made.guards else None
    still = Motion(run.state.q, run.state.v, run.work)
    watch = None if guards is None else frozen(Watch(run.t, still, run.guards, run.guards))
    start = eqx.tree_at(lambda y: y.watch, still, watch, is_leaf=lambda x: x is None)
    # a save time within the phase, its ends included, moves by itself; what is saved of the others counts in another phase
    begun, ended = frozen((run.t, jnp.maximum(stop, run.t)))
    at = jnp.where(ts < begun, begun, jnp.where(ts > ended, ended, ts))
    path, found = _path(start, (run.t, stop, at), World(scene, options.field), guards, options)
    stats, result = (path.accepted, path.rejected), _translate(path.result, path.end)
    # a scheduled end goes on to move with its time, where a diffrax adjoint has not seen to that
    late = jnp.where(path.result == diffrax.RESULTS.successful._value, stop - path.t, 0)
    t, motion = arrived(path.t, path.end, late, scene, options.field if guards is None else guards, found)
    if found is None:
        return Solved(t, motion, jnp.zeros(0, bool), None, path.saved, stats, result, RESULTS.successful)
    code = RESULTS.where(found.jumps, RESULTS.jump, RESULTS.successful)
    code = RESULTS.where(jnp.sum(found.fired) > 1, RESULTS.together, code)
    code = RESULTS.where(found.flat, RESULTS.grazing, code)
    return Solved(t, motion, found.fired, found.values, path.saved, stats, result, code)


def _path(start: Motion, times, world: World, guards: Reading | None, options: Options) -> tuple[Path, Found | None]:
    """The solve up to where it ends, differentiated at fixed times by replay, or by the diffrax adjoint that the user asked for."""
    t0, stop, at = times
    event = None if guards is None else diffrax.Event(Crossing(frozen(guards.made)))
    controller, first = options.steps(t0, t1=stop, ts=at)
    if isinstance(options.adjoint, Replay):
        every = min(options.adjoint.every, options.max_steps)
        how = How(*frozen((options.solver, guards, controller, first)), event, options.progress_meter, options.max_steps, every)
        path = integrated(start, times, world, how)
        return path, frozen(path.found)
    # as diffrax would set it, did it see through the wrapper
    kind = {diffrax.ForwardMode: "lax", diffrax.DirectAdjoint: "bounded"}.get(type(options.adjoint))
    solver = Settled(staged(options.solver, kind), options.stabilization, guards)
    saveat = diffrax.SaveAt(subs=[diffrax.SubSaveAt(t1=True), diffrax.SubSaveAt(ts=at)])
    sol = diffrax.diffeqsolve(
        diffrax.ODETerm(world.field), solver, t0, stop, first, start, world.scene, saveat=saveat, stepsize_controller=controller,
        adjoint=options.adjoint, event=event, max_steps=options.max_steps, throw=False, progress_meter=options.progress_meter,
    )  # fmt: skip
    (end, saved), t, found = sol.ys, sol.ts[0][0], None
    end = jax.tree.map(lambda x: x[0], end)
    if guards is not None:
        hit = sol.result == diffrax.RESULTS.event_occurred
        root, _, found = frozen(locate(*frozen((hit, t, end, options.solver, world.scene, guards))))
        at_root = step_alone(options.solver, world.field, end.watch.start, root, end.watch.begin, world.scene)
        t, end = jax.tree.map(lambda a, b: jnp.where(hit, a, b), (root, at_root), (t, end.bare))
    counts = (jnp.asarray(sol.stats[name], jnp.int32) for name in ("num_accepted_steps", "num_rejected_steps"))
    return Path(t, end, saved, jnp.zeros(0, t0.dtype), saved, *counts, sol.result._value, found), found


def _translate(result: Int[Array, ""], motion: Motion) -> RESULTS:
    """Diffrax's word for how a solve ended, as ours."""
    said = lambda word: result == word._value
    out = RESULTS.where(said(diffrax.RESULTS.successful) | said(diffrax.RESULTS.event_occurred), RESULTS.successful, RESULTS.step_too_small)
    out = RESULTS.where(said(diffrax.RESULTS.max_steps_reached), RESULTS.max_steps, out)
    finite = jnp.all(jnp.isfinite(motion.q)) & jnp.all(jnp.isfinite(motion.v))
    return RESULTS.where(finite, out, RESULTS.non_finite)
