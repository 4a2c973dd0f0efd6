"""F6: the motion of one phase as a function that is differentiated both ways, whatever solver and step control found it.

The run itself is never differentiated. Its steps are then gone through again, with their times held fixed, for what a change of start, times and
parameters does to each: forwards for a tangent, backwards for a cotangent. Kept of a run are the times of its steps and one state in `every`.
"""

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from svkc.location import Found, locate
from svkc.operation import operation
from svkc.stepping import Field, Motion, Scene, Settled, filled, step_alone

# blocks are passed over in groups where the run has no more steps
GROUP = 64


class Replay(eqx.Module):
    """The default `adjoint` of `svkc.simulate`: both modes, in any mixture with vmap and jit.

    every: one state in so many steps is kept, and the steps between are taken once more on the way back. Memory for a phase, in numbers:
    max_steps (1 + size / every), with size that of q and v together, and what one block of `every` steps needs.
    """

    every: int = eqx.field(static=True, default=16)


class World(eqx.Module):
    """What the motion depends on besides its start: the scene, and the vector field with all that it closes over."""

    scene: Scene
    field: Field


class How(eqx.Module):
    """What finds the steps: nothing of it is differentiated."""

    solver: diffrax.AbstractSolver
    guards: object
    controller: object
    first_step: object
    event: diffrax.Event | None
    progress_meter: diffrax.AbstractProgressMeter
    max_steps: int = eqx.field(static=True)
    every: int = eqx.field(static=True)


class Path(eqx.Module):
    """Where a solve ended, the states at the times asked for, the times of its steps (inf: not taken), and one state in `every`."""

    t: Float[Array, ""]
    end: Motion
    saved: Motion
    times: Float[Array, " steps"]
    kept: Motion
    accepted: Int[Array, ""]
    rejected: Int[Array, ""]
    result: Int[Array, ""]
    found: Found | None = None


def _integrated(start: Motion, times, world: World, how: How) -> Path:
    """Diffrax from times = (t0, stop, save times) to `stop`, or to where in its last step a guard was zero. In derivatives the end's time is fixed."""
    t0, stop, at = times
    inner = how.solver
    if isinstance(inner, diffrax.AbstractRungeKutta):
        inner = eqx.tree_at(lambda s: s.scan_kind, inner, "lax", is_leaf=lambda x: x is None)
    solver = Settled(inner, world.field.stabilization, how.guards)
    subs = [
        diffrax.SubSaveAt(t1=True),
        diffrax.SubSaveAt(ts=at, fn=lambda t, y, args: y.bare),
        diffrax.SubSaveAt(steps=1, fn=lambda t, y, args: None),
        diffrax.SubSaveAt(steps=how.every, fn=lambda t, y, args: y.bare),
    ]
    sol = diffrax.diffeqsolve(
        diffrax.ODETerm(world.field), solver, t0, stop, how.first_step, start, world.scene, saveat=diffrax.SaveAt(subs=subs),
        stepsize_controller=how.controller, adjoint=diffrax.ForwardMode(), event=how.event, max_steps=how.max_steps, throw=False,
        progress_meter=how.progress_meter,
    )  # fmt: skip
    end, saved, _, kept = sol.ys
    t, end, times, found = sol.ts[0][0], jax.tree.map(lambda x: x[0], end), sol.ts[2], None
    counts = [jnp.asarray(sol.stats[name], jnp.int32) for name in ("num_accepted_steps", "num_rejected_steps")]
    if how.guards is not None:
        hit = sol.result == diffrax.RESULTS.event_occurred
        t, end, found = locate(hit, t, end, inner, world.scene, how.guards)
        # the last step is gone through again only up to there
        times = times.at[counts[0] - 1].set(jnp.where(hit, t, times[counts[0] - 1]))
    return Path(t, end.bare, saved, times, kept, *counts, sol.result._value, found)


def _grid(t0, at, path: Path):
    """[steps + 1] times of the start and of every step, those that met a save time being that time; after the last step, its end; and for each save
    time the place in the grid of the state saved there."""
    recorded = jnp.concatenate([jax.lax.stop_gradient(t0)[None], path.times])
    place = jnp.searchsorted(recorded, jax.lax.stop_gradient(at)).astype(jnp.int32)
    met = recorded[jnp.minimum(place, recorded.shape[0] - 1)] == at
    last = recorded[path.accepted]
    recorded = jnp.where(jnp.isfinite(recorded), recorded, last)
    times = recorded.at[jnp.where(met & (place > 0), place, recorded.shape[0])].set(at, mode="drop")
    # past the last step time stands still
    times = jnp.where(jnp.arange(times.shape[0], dtype=jnp.int32) > path.accepted, times[path.accepted], times)
    return times.at[0].set(t0), place


def _block(y: Motion, times, world: World, solver) -> tuple[Motion, Motion]:
    """The steps of one block, from times[0] to times[1]: the state after it, and after each step."""

    def step(y, ends):
        y = step_alone(solver, world.field, *ends, y, world.scene)
        return y, y

    return jax.lax.scan(step, y, times)


def _integrated_jvp(primals, tangents):
    start, times, world, how = primals
    d_start, d_times, d_world, _ = tangents
    path = integrated(start, times, world, how)
    (t0, _, at), (d_t0, _, d_at) = times, d_times
    grid, place = _grid(t0, at, path)
    d_grid = _zeros(grid) if d_t0 is None and d_at is None else eqx.filter_jvp(lambda t0, at: _grid(t0, at, path)[0], (t0, at), (d_t0, d_at))[1]
    d_start = filled(start.bare, d_start.bare)
    d_end, d_saved, d_kept = _through(start.bare, d_start, grid, d_grid, place, world, d_world, path, how)
    if d_at is not None:
        # a state saved at the start moves with its own time, at the rate of the motion there
        rate = world.field(t0, start.bare, world.scene)
        delay = jnp.where(place == 0, d_at - filled(t0, d_t0), 0)
        d_saved = jax.tree.map(lambda d, r: d + delay.reshape(-1, *(1,) * r.ndim) * r[None], d_saved, rate)
    none = jax.tree.map(lambda x: None, path)
    moving = lambda p: (p.t, p.end, p.saved, p.kept)
    return path, eqx.tree_at(moving, none, (d_grid[path.accepted], d_end, d_saved, d_kept), is_leaf=lambda x: x is None or isinstance(x, Motion))


def _zeros(x):
    return jax.tree.map(jnp.zeros_like, x)


@eqx.filter_jit
def _through(start: Motion, d_start: Motion, grid, d_grid, place, world: World, d_world, path: Path, how: How):
    """The tangents at the end, at the save times and at the kept states: block after block of steps, each from its kept state."""
    every, count = how.every, path.kept.q.shape[0] + 1
    groups = -(-count // GROUP)
    pad = groups * GROUP - count
    index = jnp.arange(groups * GROUP, dtype=jnp.int32)

    def ends(x):
        x = jnp.concatenate([x, jnp.broadcast_to(x[-1:], (groups * GROUP * every + 1 - x.shape[0],))])
        return x[:-1].reshape(-1, every), x[1:].reshape(-1, every)

    going = index * every < path.accepted
    kept = jax.tree.map(lambda s, k: jnp.concatenate([s[None], k, jnp.broadcast_to(s[None], (pad, *s.shape))]), start, path.kept)
    # blocks that were not begun get numbers that are finite
    kept = jax.tree.map(lambda s, k: jnp.where(going.reshape(-1, *(1,) * s.ndim), k, s[None]), start, kept)

    @eqx.filter_checkpoint
    def block(d_y, y, times, d_times):
        _, (d_y, d_every) = eqx.filter_jvp(lambda y, times, world: _block(y, times, world, how.solver), (y, times, world), (d_y, d_times, d_world))
        return d_y, d_every

    def one(carry, x):
        d_y, d_saved = carry
        i, going, y, times, d_times = x

        def taken():
            after, d_every = block(d_y, y, times, d_times)
            here = (place > i * every) & (place <= jnp.minimum((i + 1) * every, path.accepted))
            local = jnp.clip(place - i * every - 1, 0, every - 1)
            spread = lambda old, new: jnp.where(here.reshape(-1, *(1,) * (old.ndim - 1)) & going, new[local], old)
            return jax.tree.map(lambda new, old: jnp.where(going, new, old), after, d_y), jax.tree.map(spread, d_saved, d_every)

        carry = jax.lax.cond(eqxi.unvmap_any(going), taken, lambda: (d_y, d_saved))
        return carry, carry[0]

    @jax.checkpoint
    def group(carry, x):
        def some(carry):
            return jax.lax.scan(one, carry, x)

        def none(carry):
            return carry, jax.tree.map(lambda d: jnp.zeros((GROUP, *d.shape), d.dtype), carry[0])

        return jax.lax.cond(eqxi.unvmap_any(jnp.any(x[1])), some, none, carry)

    d_saved = jax.tree.map(lambda d: jnp.where((place == 0).reshape(-1, *(1,) * d.ndim), d[None], 0), d_start)
    xs = jax.tree.map(lambda x: x.reshape(groups, GROUP, *x.shape[1:]), (index, going, kept, ends(grid), ends(d_grid)))
    (d_end, d_saved), after = jax.lax.scan(group, (d_start, d_saved), xs)
    written = (index[: count - 1] + 1) * every <= path.accepted
    flat = jax.tree.map(lambda d: d.reshape(-1, *d.shape[2:])[: count - 1], after)
    d_kept = jax.tree.map(lambda d: jnp.where(written.reshape(-1, *(1,) * (d.ndim - 1)), d, 0), flat)
    return d_end, d_saved, d_kept


# integrated(start, times, world, how) -> Path
integrated = operation("integrated", _integrated, _integrated_jvp)
