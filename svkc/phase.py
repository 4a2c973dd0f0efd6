"""F6: one phase: a diffrax solve of one smooth field, and where in its last step the first guard crossed zero."""

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from svkc.chain import Chain, State
from svkc.events import Plan, first_root
from svkc.guards import Sensor
from svkc.request import Options
from svkc.stepping import Field, Motion, Scene, Settled, Watch
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


class Solved(eqx.Module):
    """Where a phase ended: time, motion, the guards that fired there, which guard values go on, and the solver's words."""

    t: Float[Array, ""]
    motion: Motion
    fired: Bool[Array, " guards"]
    guards: Float[Array, " guards"] | None
    saved: Motion
    stats: tuple[Int[Array, ""], Int[Array, ""]]
    result: RESULTS


def event_tolerance(t: Float[Array, ""]) -> Float[Array, ""]:
    """Events this close (s) to the earliest happen together with it: sqrt(eps), 1.5e-8 in float64, relative from t = 1 s on."""
    return jnp.finfo(t.dtype).eps ** 0.5 * jnp.maximum(1, jnp.abs(t))


def guard_values(made: Plan, field: Field, t, y: Motion, scene: Scene) -> Float[Array, " guards"]:
    """What every guard says of this moment; those that measure the mechanism are told its torques."""
    state = State(y.q, y.v, scene.structure)
    tau = field.torques(t, y, scene)[0] if any(isinstance(g, Sensor) and g.loaded for g in made.guards) else jnp.zeros_like(y.v)
    values = [g.measure(scene.chain, state, tau) if isinstance(g, Sensor) else g(t, state, scene.args) for g in made.guards]
    return jnp.stack([jnp.asarray(x, y.q.dtype).reshape(()) for x in values])


def solve(chain: Chain, run: Run, stop, ts, made: Plan, options: Options, args) -> Solved:
    """Diffrax from run.t to `stop`, or to the first guard that crosses zero."""
    structure = run.state.structure
    watched = made.watched(chain, structure) if made.guards else None
    scene = Scene(chain, structure, args, watched)
    watch = None if run.guards is None else Watch(run.t, run.guards, run.guards)
    start = Motion(run.state.q, run.state.v, run.work, watch)
    field = options.field
    guards = (lambda t, y, scene: guard_values(made, field, t, y, scene)) if made.guards else None
    solver = Settled(options.solver, options.stabilization, guards)
    term = diffrax.ODETerm(field)
    at = jnp.clip(ts, run.t, jnp.maximum(stop, run.t))
    event = None
    if made.guards:

        def any_crossed(t, y, scene, **_):
            return jnp.any(made.crossed(y.watch.before, y.watch.after) & scene.watched)

        event = diffrax.Event(any_crossed)
    controller, dt0 = options.steps(run.t, t1=stop, ts=at)
    sol = diffrax.diffeqsolve(
        term, solver, run.t, stop, dt0, start, scene,
        saveat=diffrax.SaveAt(subs=[diffrax.SubSaveAt(t1=True), diffrax.SubSaveAt(ts=at)]),
        stepsize_controller=controller, adjoint=options.adjoint, event=event, max_steps=options.max_steps, throw=False,
        progress_meter=options.progress_meter,
    )  # fmt: skip
    (end, saved), t = sol.ys, sol.ts[0][0]
    motion = jax.tree.map(lambda x: x[0], end)
    stats = (sol.stats["num_accepted_steps"], sol.stats["num_rejected_steps"])
    result = _translate(sol.result, motion)
    if not made.guards:
        return Solved(t, motion, jnp.zeros(0, bool), None, saved, stats, result)
    hit = sol.result == diffrax.RESULTS.event_occurred
    t, motion, fired, values = _locate(hit, t, motion, term, solver, scene, made)
    return Solved(t, motion, fired, values, saved, stats, result)


def _translate(result, motion: Motion) -> RESULTS:
    """Diffrax's word for how a solve ended, as ours."""
    out = RESULTS.where(result == diffrax.RESULTS.successful, RESULTS.successful, RESULTS.step_too_small)
    out = RESULTS.where(result == diffrax.RESULTS.event_occurred, RESULTS.successful, out)
    out = RESULTS.where(result == diffrax.RESULTS.max_steps_reached, RESULTS.max_steps, out)
    finite = jnp.all(jnp.isfinite(motion.q)) & jnp.all(jnp.isfinite(motion.v))
    return RESULTS.where(finite, out, RESULTS.non_finite)


def _locate(hit, t_end, end: Motion, term, solver, scene: Scene, made: Plan):
    """Time and motion of the earliest crossing in the last step, the guards that fired, and the guard values to go on with.

    Steps of the solver back from the end of the step; the root is found without derivatives and then corrected once by Newton's formula
    with everything differentiable, which makes dt/dp = -(dg/dp) / (dg/dt) exact. A guard that jumps over zero happens where it jumps, uncorrected.
    A guard that fired is armed again once it has left zero.
    """
    crossed = made.crossed(end.watch.before, end.watch.after) & scene.watched & hit
    side = jnp.where(crossed, jnp.where(end.watch.after >= end.watch.before, 1, -1), 0).astype(t_end.dtype)

    # an inner loop that can be differentiated both ways, outside of diffrax's adjoints
    if isinstance(solver.solver, diffrax.AbstractRungeKutta):
        solver = eqx.tree_at(lambda s: s.solver.scan_kind, solver, "bounded", is_leaf=lambda x: x is None)

    def back(t, t_end, end, scene, begun):
        return solver.step(term, t_end, t, end, scene, begun, False)[0]

    def found():
        begun = solver.init(term, t_end, t_end, end, scene)
        frozen = jax.lax.stop_gradient((t_end, end, scene, begun))

        def passed(values):
            return jnp.where(crossed, side * values, -jnp.inf)

        def ahead(t):
            return jnp.max(passed(solver.guards(t, back(t, *frozen), frozen[2])))

        at_start, at_end = jnp.max(passed(end.watch.before)), jnp.max(passed(end.watch.after))
        root = jax.lax.stop_gradient(first_root(ahead, end.watch.start, at_start, frozen[0], at_end))
        y = back(root, t_end, end, scene, begun)
        rate = jax.lax.stop_gradient(term.vf(root, y, scene))
        along = (jnp.ones_like(root), rate)
        values, slopes = jax.jvp(lambda t, y: solver.guards(t, y, scene), (root, y), along)
        slopes = jax.lax.stop_gradient(slopes)
        first = jnp.argmax(passed(values))
        fired = crossed & (passed(values) + side * slopes * event_tolerance(root) >= 0)
        fired = fired | (jnp.arange(side.shape[0]) == first)
        correction = values[first] / jnp.where(slopes[first] == 0, 1, slopes[first])
        # time does not run back behind the step
        correction = jnp.where(jnp.abs(correction) <= event_tolerance(root), jnp.minimum(correction, root - end.watch.start), 0)
        y = jax.tree.map(lambda y, r: y - r * correction, y, rate)
        # zero: not armed, until it has left zero
        after = jnp.where(fired, 0, jax.lax.stop_gradient(values))
        return root - correction, y.q, y.v, y.work, fired, after

    def missed():
        return t_end, end.q, end.v, end.work, jnp.zeros_like(crossed), end.watch.after

    t, q, v, work, fired, after = jax.lax.cond(eqxi.unvmap_any(hit), found, missed)
    pick = lambda a, b: jnp.where(hit, a, b)
    t, q, v, after = pick(t, t_end), pick(q, end.q), pick(v, end.v), pick(after, end.watch.after)
    work = None if work is None else pick(work, end.work)
    return t, Motion(q, v, work), fired & hit, after
