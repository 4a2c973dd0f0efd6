"""The motion of one phase as a function that is differentiated both ways, whatever solver and step
control found it.

The run itself is never differentiated. Its steps are gone through again, their times held fixed,
for what a change of start and parameters does to
each: forwards for a tangent, backwards for a cotangent. Kept of a run are the times of its steps
and one state in `every`. What a change of the start's time or of a save time does is the rate of
the motion there.
"""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc._jax.control_flow import unvmap_any
from svkc._jax.primitive import custom_primitive
from svkc._jax.pytrees import materialise_zeros, stop_gradient_tree
from svkc.integration.event_adjoint import end_of_phase_tangent, transport_tangent
from svkc.integration.integrate import integrate_phase
from svkc.integration.ode import FieldArgs, ODEState
from svkc.integration.solution import SUCCESSFUL, PhaseProblem, PhaseSolution, StepperOptions
from svkc.integration.vector_field import VectorField, project_state
from svkc.model.validation import integer

# blocks are passed over in groups where the run has no more steps
BLOCKS_PER_GROUP = 64


class Replay(eqx.Module):
    """The default `adjoint` of `svkc.simulate`: both modes, in any mixture with vmap and jit.

    every: one state in so many steps is kept, and the steps between are taken once more on the way
    back. Memory for a phase, in numbers:
    max_steps (1 + size / every), with size that of q and v together, and what one block of `every`
    steps needs.
    """

    every: int = eqx.field(static=True, default=16)

    def __check_init__(self):
        integer("every", self.every, 1)


def _step_grid(t0, at, path: PhaseSolution):
    """[steps + 1] times of the start and of every step, after the last its end again; and for each
    save time the place of its state among them."""
    times = jnp.concatenate([t0[None], path.step_ts])
    place = jnp.searchsorted(times, at).astype(jnp.int32)
    # past the last step time stands still
    return (
        jnp.where(
            jnp.arange(times.shape[0], dtype=jnp.int32) > path.accepted, times[path.accepted], times
        ),
        place,
    )


def _replay_block(y: ODEState, times, world: PhaseProblem, solver) -> tuple[ODEState, ODEState]:
    """The steps of one block, from times[0] to times[1]: the state after it, and after each
    step."""

    def step(y, ends):
        y = replay_step(solver, world.field, ends[0], ends[1], y, world.field_args)
        return y, y

    return jax.lax.scan(step, y, times)


def _stop_shift(path: PhaseSolution, stop) -> Float[Array, ""]:
    """Return zero, with the tangent of the scheduled end where that was reached."""
    return jnp.where(path.result == SUCCESSFUL, stop - path.t, 0)


def _integrate(start: ODEState, times, world: PhaseProblem, how: StepperOptions, guards):
    path = integrate_phase(start, times, world, how)
    return path, path.t, path.y


def _integrate_with_replay_jvp(primals, tangents):
    """Tangents at the times that the run has found, which stay, and what the changes of the times
    of its start, its end and of the save times add."""
    start, times, world, how, guards = primals
    d_start, d_times, d_world, _, d_guards = tangents
    path, t, end = integrate_with_replay(*primals)
    (t0, stop, at), (d_t0, d_stop, d_at) = times, d_times
    # of both ends by one program
    rates = jax.lax.map(
        lambda x: world.field(*x, world.field_args),
        (jnp.stack([t0, t]), jax.tree.map(lambda *x: jnp.stack(x), start, end)),
    )
    at_start, at_end = (jax.tree.map(lambda x, i=i: x[i], rates) for i in range(2))
    grid, place = _step_grid(*stop_gradient_tree((t0, at, path)))
    d_start = materialise_zeros(start, d_start)
    if d_t0 is not None:
        start, d_start = _at_fixed_start(start, d_start, at_start, (t0, d_t0), (world, d_world))
    d_end, d_saved, d_kept = _replay_tangents(
        (start, d_start), (world, d_world), grid, place, path=path, how=how
    )
    if d_at is not None:
        d_saved = jax.vmap(lambda y, dy, *times: _at_shifted_time(y, dy, times, (world, d_world)))(
            path.ys, d_saved, at, d_at
        )
    none = jax.tree.map(lambda x: None, path)
    moving = lambda p: (p.y, p.ys, p.checkpoints)
    d_path = eqx.tree_at(
        moving,
        none,
        (d_end, d_saved, d_kept),
        is_leaf=lambda x: x is None or isinstance(x, ODEState),
    )
    late = _stop_shift(path, stop)
    d_late = None if d_stop is None else jnp.where(path.result == SUCCESSFUL, d_stop, 0)
    arriving = (path.t, path.y, late, world.field_args, guards, stop_gradient_tree(path.event))
    return (path, t, end), (
        d_path,
        *end_of_phase_tangent(
            arriving, (None, d_end, d_late, d_world.field_args, d_guards, None), t, end, at_end
        ),
    )


def _at_fixed_start(
    y: ODEState, dy: ODEState, rate: ODEState, time, world
) -> tuple[ODEState, ODEState]:
    """Return the start of a run and its tangent, as of a start at a time that stays: one that comes
    later has less time to move. rate: of the motion there; time, world: with their tangents."""
    t0, d_t0 = time
    delay = jax.lax.stop_gradient(t0) - t0
    dy = jax.tree.map(lambda d, r: d - r * d_t0, dy, rate)
    dy = _transport(y, dy, rate, (t0, delay), world)
    return jax.tree.map(lambda y, r: y + delay * r, y, rate), dy


def _at_shifted_time(y: ODEState, dy: ODEState, time, world) -> ODEState:
    """Return the tangent of a state saved at a time that changes, from that at a time that stays.
    time, world: with their tangents."""
    t, dt = time
    rate = world[0].field(t, y, world[0].field_args)
    dy = _transport(y, dy, rate, (t, t - jax.lax.stop_gradient(t)), world)
    return jax.tree.map(lambda d, r: d + r * dt, dy, rate)


def _transport(y: ODEState, dy: ODEState, rate: ODEState, time, world) -> ODEState:
    """Return dy carried along for a time that is zero but may itself change. time: t and that
    delay; world: with its tangent."""
    (t, delay), (world, d_world) = time, world
    changes = dy, d_world.field_args, d_world.field
    return transport_tangent(
        changes, rate, delay=delay, t=t, at=y, scene=world.field_args, field=world.field
    )


def _blocks(start: ODEState, grid, path: PhaseSolution, every: int):
    """For every block of steps, in whole groups: its place, whether it was begun, the state it
    begins from, the times of its steps' begins and ends."""
    groups = -(-(path.checkpoints.q.shape[0] + 1) // BLOCKS_PER_GROUP)
    pad = groups * BLOCKS_PER_GROUP - path.checkpoints.q.shape[0] - 1
    index = jnp.arange(groups * BLOCKS_PER_GROUP, dtype=jnp.int32)
    going = index * every < path.accepted
    kept = jax.tree.map(
        lambda s, k: jnp.concatenate([s[None], k, jnp.broadcast_to(s[None], (pad, *s.shape))]),
        start,
        path.checkpoints,
    )
    # blocks that were not begun get numbers that are finite
    kept = jax.tree.map(
        lambda s, k: jnp.where(going.reshape(-1, *(1,) * s.ndim), k, s[None]), start, kept
    )
    times = jnp.concatenate(
        [
            grid,
            jnp.broadcast_to(grid[-1:], (groups * BLOCKS_PER_GROUP * every + 1 - grid.shape[0],)),
        ]
    )
    return index, going, kept, (times[:-1].reshape(-1, every), times[1:].reshape(-1, every))


@eqx.filter_jit
def _replay_tangents(start, world, grid, place, *, path: PhaseSolution, how: StepperOptions):
    """Return the tangents at the end, at the save times and at the kept states: block after block
    of steps, each from its kept state. start, world: with their tangents."""
    (start, d_start), every, blocks = start, how.checkpoint_interval, path.checkpoints.q.shape[0]
    index, *rest = _blocks(start, grid, path, every)

    def one(carry, x):
        d_y, d_saved = carry
        i, going, y, times = x

        def taken():
            after, d_every = _block_tangent(d_y, y, times, world, how.solver)
            here = (place > i * every) & (place <= jnp.minimum((i + 1) * every, path.accepted))
            local = jnp.clip(place - i * every - 1, 0, every - 1)
            spread = lambda old, new: jnp.where(_broadcast_mask(here, old) & going, new[local], old)
            return _where(going, after, d_y), jax.tree.map(spread, d_saved, d_every)

        carry = jax.lax.cond(unvmap_any(going), taken, lambda: (d_y, d_saved))
        return carry, carry[0]

    @jax.checkpoint
    def group(carry, x):
        def some(carry):
            return jax.lax.scan(one, carry, x)

        def none(carry):
            return carry, jax.tree.map(
                lambda d: jnp.zeros((BLOCKS_PER_GROUP, *d.shape), d.dtype), carry[0]
            )

        return jax.lax.cond(unvmap_any(jnp.any(x[1])), some, none, carry)

    d_saved = jax.tree.map(
        lambda d: jnp.where(_broadcast_mask(place == 0, d[None]), d[None], 0), d_start
    )
    xs = jax.tree.map(lambda x: x.reshape(-1, BLOCKS_PER_GROUP, *x.shape[1:]), (index, *rest))
    (d_end, d_saved), after = jax.lax.scan(group, (d_start, d_saved), xs)
    written = (index[:blocks] + 1) * every <= path.accepted
    flat = jax.tree.map(lambda d: d.reshape(-1, *d.shape[2:])[:blocks], after)
    return (
        d_end,
        d_saved,
        jax.tree.map(lambda d: jnp.where(_broadcast_mask(written, d), d, 0), flat),
    )


@eqx.filter_checkpoint
def _block_tangent(d_y: ODEState, y: ODEState, times, world, solver):
    """Return the tangents after a block of steps and after each of its steps."""
    world, d_world = world
    step = lambda y, world: _replay_block(y, times, world, solver)
    return eqx.filter_jvp(step, (y, world), (d_y, d_world))[1]


def _broadcast_mask(mask, like):
    """Return a mask of rows with the axes of an array of such rows."""
    return mask.reshape(-1, *(1,) * (like.ndim - 1))


def _where(pred, new, old):
    return jax.tree.map(lambda new, old: jnp.where(pred, new, old), new, old)


# integrated(start, times, world, how, guards or field) -> Path, t, Motion: where the run went, with
# the time of its end fixed in derivatives; and its end, whose time is a guard's zero or the
# scheduled one
integrate_with_replay = custom_primitive("integrated", _integrate, _integrate_with_replay_jvp)


def with_scan_kind(solver: diffrax.AbstractSolver, kind: str | None) -> diffrax.AbstractSolver:
    """The solver with its loop over stages made for what is to be differentiated: "lax" forwards,
    "bounded" both ways, None diffrax's own choice."""
    if not isinstance(solver, diffrax.AbstractRungeKutta):
        return solver
    return eqx.tree_at(lambda s: s.scan_kind, solver, kind, is_leaf=lambda x: x is None)


def replay_step(
    solver: diffrax.AbstractSolver, field: VectorField, t0, t1, y: ODEState, scene: FieldArgs
) -> ODEState:
    """One settled step of a solver that remembers nothing of the step before, to be differentiated:
    of each evaluation of the field, and of each turn of the loop that settles the step, only the
    arguments are kept on the way back."""
    rate = eqx.filter_checkpoint(field)
    if isinstance(solver, diffrax.AbstractERK) and isinstance(
        solver.tableau, diffrax.ButcherTableau
    ):
        raw = _explicit_step(solver.tableau, rate, t0, t1, y, scene)
    else:
        solver = with_scan_kind(solver, "bounded")
        term = diffrax.ODETerm(rate)
        begun = solver.init(term, t0, t1, y, scene)
        raw = solver.step(term, t0, t1, y, scene, begun, made_jump=False)[0]
    return project_state(field, scene, raw)[0]


def _explicit_step(
    tableau: diffrax.ButcherTableau, rate, t0, t1, y: ODEState, scene: FieldArgs
) -> ODEState:
    """An explicit Runge-Kutta step as a loop over its stages, without those that only estimate the
    error."""
    used = int(np.max(np.flatnonzero(tableau.b_sol))) + 1
    A = np.zeros((used, used))
    for i, row in enumerate(tableau.a_lower[: used - 1]):
        A[i + 1, : i + 1] = row
    c, dtype = np.append(0.0, tableau.c)[:used], t1.dtype
    add = lambda weights, rates: jax.tree.map(
        lambda y, k: y + (t1 - t0) * jnp.tensordot(weights, k, 1), y, rates
    )

    def stage(rates, x):
        weights, part, here = x
        k = rate(t0 + part * (t1 - t0), add(weights, rates), scene)
        put = lambda ks, k: jnp.where(here.reshape(-1, *(1,) * k.ndim), k[None], ks)
        return jax.tree.map(put, rates, k), None

    none = jax.tree.map(lambda y: jnp.zeros((used, *y.shape), y.dtype), y)
    stages = (jnp.asarray(A, dtype), jnp.asarray(c, dtype), np.eye(used, dtype=bool))
    rates, _ = jax.lax.scan(stage, none, stages)
    return add(jnp.asarray(tableau.b_sol[:used], dtype), rates)
