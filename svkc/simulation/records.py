"""The records that a run writes: one row for each phase and one for each event."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from svkc._jax.select import where
from svkc.integration.solution import PhaseSolution, Stats
from svkc.model.annotations import DType
from svkc.model.chain import State, Structure


class PhaseRecords(eqx.Module):
    """Records of the phases of a run, one row for each phase.

    start, stop: times of the phase (s).
    q, v: at the start and at the end of the phase.
    work: done by control, joint limits and dampers (J).
    accepted, rejected: numbers of steps.

    Unwritten rows hold the initial state, so that values computed from them are finite.
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
    """The events of a run in the order of time, one row for each event.

    time: of the event (s).
    which: index of the event in the list that `simulate` was given.
    impulse, angular_impulse: what the parent exerts on the real link of each virtual link that the
        event connected, at the joint, in world axes (N s, N m s).
    energy_lost: kinetic energy lost in the impact (J). Events at one instant make one impact, whose
        loss is in the row of the first of them.
    count: number of events. Rows past `count` are empty: their time is inf, their index -1.
    """

    time: Float[Array, " events"]
    which: Int[Array, " events"]
    impulse: Float[Array, "events links 3"]
    angular_impulse: Float[Array, "events links 3"]
    energy_lost: Float[Array, " events"]
    count: Int[Array, ""]


def empty_events(rows: int, links: int, dtype: DType) -> Events:
    """Return records of events with empty rows: times inf, indices -1."""
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
    """Return records of phases with empty rows: times inf, the initial state."""
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
        stats=repeat(Stats.zeros(dtype, counts_swaps=True, counts_reduced_steps=True), rows),
    )


def write_phase_row(
    records: PhaseRecords,
    row: Bool[Array, " phases"],
    start: tuple[Float[Array, ""], State],
    end: tuple[Float[Array, ""], State],
    work: Float[Array, ""],
    solution: PhaseSolution,
) -> PhaseRecords:
    """Return the records with the row of one phase written.

    row: one-hot mask of the row; all False writes nothing.
    start, end: time and state at the two ends of the phase.
    """
    (t_start, first), (t_stop, last) = start, end
    new = PhaseRecords(
        start=t_start,
        stop=t_stop,
        q=jnp.stack([first.q, last.q]),
        v=jnp.stack([first.v, last.v]),
        structure=first.structure,
        work=work,
        accepted=solution.accepted,
        rejected=solution.rejected,
        stats=solution.stats,
    )
    write = lambda old, new: where(
        row.reshape(-1, *(1,) * jnp.ndim(new)), jnp.asarray(new)[None], old
    )
    return jax.tree.map(write, records, new)


class Phases(eqx.Module):
    """The phases of a run: the intervals of time between changes of structure, one row each.

    start, stop: times of the phase (s).
    connected: which virtual links are connected.
    rank: rank m of the loop Jacobian.
    joint_freedoms: number N_J of joint freedoms, those of connected virtual links included.
    energy: mechanical energy at the start and at the end (J).
    work: done by control, joint limits and dampers (J).
    margin: least |R_mm| / |R_11|, the distance from losing rank. Over all steps if they are
        projected in svkc's own loop, otherwise over the two ends of the phase.
    accepted, rejected: numbers of steps.
    evaluations: of the vector field in all attempts; with `Replay` event location is included.
    swaps: how often the choice of dependent coordinates changed between steps (-1: not recorded).
    loop: index of the loop that could not be closed (-1: none).
    error: sum of the estimated errors of the steps, root mean square over q and v (inf: the solver
        has no error estimate, or the adjoint is one of diffrax).
    gap: largest loop gaps at the ends of steps (rad, m); with a diffrax adjoint at the two ends of
        the phase.
    gap_rate: largest rates of the loop gaps at the two ends of the phase, before the event (rad/s,
        m/s).
    free: whether the bodies are free of the ground.
    momentum_drift: of a free phase, change of linear momentum that gravity does not explain (N s),
        and change of angular momentum about the centre of mass (N m s).
    count: number of phases. Rows past `count` are empty.
    kinetic_energy: largest kinetic energy at the two ends of the phase and at the save times within
        (J); None in files of older versions.
    reduced_steps: steps by articulated bodies with reduced rows of the loops, as near a singular
        configuration and at the start of phases with redundant loops (-1: not by articulated
        bodies); None in files of older versions.
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
    kinetic_energy: Float[Array, " phases"] | None = None
    reduced_steps: Int[Array, " phases"] | None = None

    @property
    def freedoms(self) -> Int[Array | np.ndarray, "... phases"]:
        """Mobility N_F = N_J - m (paper, (13))."""
        return self.joint_freedoms - self.rank

    @property
    def energy_drift(self) -> Float[Array | np.ndarray, "... phases"]:
        """Change of energy that the work does not explain (J)."""
        return self.energy[..., 1] - self.energy[..., 0] - self.work
