"""Outcomes of a run, and the records that it writes: one row for each phase and for each event."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from svkc.integration.solution import PhaseSolution, Stats
from svkc.model.chain import State, Structure


class PhaseRecords(eqx.Module):
    """One row for each phase: its times, the motion at its two ends, its structure, and the counts
    of its steps.

    Unwritten rows hold the initial state, so that what is computed from them is finite.
    """

    start: Float[Array, "*phases"]
    stop: Float[Array, "*phases"]
    q: Float[Array, "*phases 2 q"]
    v: Float[Array, "*phases 2 dofs"]
    structure: Structure
    work: Float[Array, "*phases"]
    accepted: Int[Array, "*phases"]
    rejected: Int[Array, "*phases"]
    stats: Stats


class Events(eqx.Module):
    """What happened, in the order of time; rows past `count` are unused (time inf, which -1).

    `which`: the event's place in the list given; `impulse` (N s), `angular_impulse` (N m s): on
    each real link from its parent, at the joint, in world axes, for the links this event connected;
    `energy_lost` (J): of events at one instant, in the first one's row.
    """

    time: Float[Array, " events"]
    which: Int[Array, " events"]
    impulse: Float[Array, "events links 3"]
    angular_impulse: Float[Array, "events links 3"]
    energy_lost: Float[Array, " events"]
    count: Int[Array, ""]


def empty_events(rows: int, links: int, dtype) -> Events:
    """Return empty rows for events. Their times are inf, their indices -1."""
    impulse = jnp.zeros((rows, links, 3), dtype)
    return Events(
        time=jnp.full(rows, jnp.inf, dtype),
        which=jnp.full(rows, -1, jnp.int32),
        impulse=impulse,
        angular_impulse=impulse,
        energy_lost=jnp.zeros(rows, dtype),
        count=jnp.asarray(0, jnp.int32),
    )


def empty_phase_records(rows: int, state: State) -> PhaseRecords:
    """Return the records before the first phase."""
    dtype = state.q.dtype
    repeat = lambda tree, *axes: jax.tree.map(
        lambda x: jnp.broadcast_to(x, (*axes, *jnp.shape(x))), tree
    )
    return PhaseRecords(
        start=jnp.full(rows, jnp.inf, dtype),
        stop=jnp.full(rows, jnp.inf, dtype),
        q=repeat(state.q, rows, 2),
        v=repeat(state.v, rows, 2),
        structure=repeat(state.structure, rows),
        work=jnp.zeros(rows, dtype),
        accepted=jnp.zeros(rows, jnp.int32),
        rejected=jnp.zeros(rows, jnp.int32),
        stats=repeat(Stats.zeros(dtype, True), rows),
    )


def write_phase_row(
    records: PhaseRecords,
    row: Bool[Array, " phases"],
    began: tuple,
    ended: tuple,
    work,
    path: PhaseSolution,
) -> PhaseRecords:
    """Return the records with the row of one phase written. row: one-hot, or all False for no
    phase; began, ended: time and state."""
    (start, first), (stop, last) = began, ended
    new = PhaseRecords(
        start=start,
        stop=stop,
        q=jnp.stack([first.q, last.q]),
        v=jnp.stack([first.v, last.v]),
        structure=first.structure,
        work=work,
        accepted=path.accepted,
        rejected=path.rejected,
        stats=path.stats,
    )
    write = lambda old, new: jnp.where(
        row.reshape(-1, *(1,) * jnp.ndim(new)), jnp.asarray(new)[None], old
    )
    return jax.tree.map(write, records, new)


class RESULTS(eqx.Enumeration):
    """How a run ended, lane by lane."""

    successful = ""
    stopped = "An event asked the run to stop."
    max_events = (
        "More events than max_events: the state is that of the last event handled. Raise"
        " max_events, or look for chattering."
    )
    max_steps = "More steps than max_steps in one phase. Raise max_steps, or loosen rtol and atol."
    step_too_small = (
        "The step size fell to its lower bound: the problem is too stiff, or singular, for this"
        " solver and tolerance."
    )
    not_in_place = (
        "A link was to be connected at its declared placement, but its bodies were elsewhere. Use"
        " here, or a guard that waits."
    )
    loop_open = (
        "A loop is open by more than the tolerance. Use smaller steps, or projection; look at"
        " mobility and its margin there."
    )
    non_finite = "A number that is not finite appeared."
    grazing = (
        "A guard touched zero rather than crossed it: the time of its event has no derivative, and"
        " those given are not numbers."
    )
    jump = "A guard jumped over zero: the time of its event counts as fixed in derivatives."
    together = (
        "Events happened at one instant: derivatives are those of this order, and none where their"
        " times can change apart."
    )
    rank_lost = (
        "The loops lose rank at an end of a phase: derivatives across it are not to be relied on."
    )
    no_slot = (
        "A grip was to be made and every spare slot was taken: it was not made, everything else"
        " was. Load with more spare slots, or unbind."
    )


class Phases(eqx.Module):
    """The stretches between changes of structure; rows past `count` are unused.

    `energy`: mechanical energy (J) at start and end; `work`: done in between by control, limits and
    dampers (J); `margin`: the least |R_mm| / |R_11| of the phase (of its two ends where steps are
    not projected), how far the weakest row that counts is from being redundant; `swaps`: how often
    the choice of dependent coordinates changed from step to step (-1: not looked at); `loop`: the
    one that could not be closed (-1: none);
    `evaluations`: of the vector field, in steps alone; `error`: the estimated errors of the steps
    added up (root mean square over q and v; inf: the solver estimates none); `gap`: the largest of
    the loops' gaps (rad, m) at the ends of steps (of the phase, with a diffrax adjoint);
    `gap_rate`: of their rates (rad/s, m/s) at the phase's two ends, before the event that ends it;
    `free`: nothing holds the bodies to the ground; `momentum_drift`:
    then, the change of linear momentum (N s) that gravity does not explain and that of the angular
    momentum about the centre of mass (N m s).
    """

    start: Float[Array, " phases"]
    stop: Float[Array, " phases"]
    connected: Bool[Array, "phases links"]
    rank: Int[Array, " phases"]
    joint_freedoms: Int[Array, " phases"]
    energy: Float[Array, "phases 2"]
    work: Float[Array, " phases"]
    margin: Float[Array, " phases"]
    accepted: Int[Array, " phases"]
    rejected: Int[Array, " phases"]
    evaluations: Int[Array, " phases"]
    swaps: Int[Array, " phases"]
    loop: Int[Array, " phases"]
    error: Float[Array, " phases"]
    gap: Float[Array, "phases 2"]
    gap_rate: Float[Array, "phases 2"]
    free: Bool[Array, " phases"]
    momentum_drift: Float[Array, "phases 2"]
    count: Int[Array, ""]

    @property
    def freedoms(self) -> Int[Array, "... phases"]:
        """Mobility N_F = N_J - m (13)."""
        return self.joint_freedoms - self.rank

    @property
    def energy_drift(self) -> Float[Array, "... phases"]:
        """Energy gained that no work explains (J)."""
        return self.energy[..., 1] - self.energy[..., 0] - self.work
