"""The result of a run (`Trajectory`), and the numbers of its certificate (`Report`)."""

import dataclasses
import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from svkc._jax.eager import eager_jit
from svkc._jax.select import where
from svkc.model.annotations import Function, Names, Path, Scalar
from svkc.model.chain import Chain
from svkc.model.chain_names import ChainNames
from svkc.model.state import State
from svkc.model.tables import Block, Printed, is_readable, lane_index, number
from svkc.model.validation import scalar
from svkc.simulation.codes import DERIVATIVE, RESULTS
from svkc.simulation.non_finite import trace_non_finite
from svkc.simulation.option_checks import EventList
from svkc.simulation.records import Events, Phases
from svkc.simulation.report import ROUND_OFF_DRIFT, Report
from svkc.simulation.run_tables import (
    batch_event_table,
    event_table,
    extent,
    joint_table,
    phase_table,
)


class Trajectory(Printed):
    """The result of a run of `simulate`.

    ts: save times (s).
    states: states at the save times, with a leading time axis.
    gaps, gap_rates: largest loop gaps at the save times (rad, m), and their rates (rad/s, m/s).
    events: records of the events.
    phases: records of the phases.
    final, t_final: state and time at the end of the run.
    work: done from the start to each save time by control, by dampers and by joint limits (J). None
        in files of older versions.
    result: how the run ended.
    derivative: `svkc.types.DERIVATIVE.successful` if the run has derivatives; otherwise why not: a
        guard that grazed zero or jumped, simultaneous events, or a loss of rank.
    names: names of the chain's bodies, joints, links and coordinates; None in files of schema 5.
    """

    ts: Float[Array, " times"]
    states: State
    gaps: Float[Array, "times 2"]
    gap_rates: Float[Array, "times 2"]
    events: Events
    phases: Phases
    final: State
    t_final: Float[Array, ""]
    result: RESULTS
    derivative: DERIVATIVE
    work: Float[Array, "times 3"] | None = None
    names: ChainNames | None = eqx.field(static=True, default=None)

    def _blocks(self) -> list[Block]:
        report, events = self.report(), bool(np.any(self.events.count))
        if np.ndim(self.t_final):
            return [extent(self), *[batch_event_table(self)] * events, *report._blocks()]
        blocks = [extent(self), phase_table(self.phases, self.names)]
        if events:
            blocks.append(event_table(self))
        if self.names and np.size(self.ts):
            blocks.append(joint_table(self))
        if self.work is not None and np.any(self.work):
            control, dampers, limits = map(number, np.asarray(self.work)[-1])
            blocks.append(f"work (J): control {control}, dampers {dampers}, joint limits {limits}")
        return [*blocks, report.verdict()]

    def __repr__(self) -> str:
        return f"<{extent(self)}: {self.result}>" if is_readable(self) else super().__repr__()

    def __getitem__(self, lane: Any) -> "Trajectory":
        """Return one lane of a batch, or a smaller batch.

        lane: index, slice, array of indices or mask over the lanes; a tuple of these over several
            axes of lanes.

        Raises ValueError for a single run, IndexError if there is no such lane.
        """
        return jax.tree.map(lambda x: x[lane_index(lane, np.shape(self.t_final))], self)

    @property
    def connected(self) -> Bool[Array | np.ndarray, "... times links"]:
        """Which virtual links are connected at each save time."""
        return self.states.structure.connected

    def save(self, path: Path, chain: Chain | None = None, **options: Any) -> None:
        """Write the run, or a batch of runs, to one .npz file, with its certificate.

        The file is written atomically. `svkc.load_trajectory` returns an equal object.

        path: of the file.
        chain: stored as well if given, for `svkc.load_chain` and the command `svkc view`.
        options: further metadata of the run, such as rtol=1e-8; values that JSON lacks are stored
            as their `str`.

        Raises OSError if the file cannot be written.
        """
        # archive imports this module, so the import is deferred
        from svkc.simulation.archive import save

        save(self, path, chain, options)

    def plot(self, chain: Chain | None = None, *, joints: Names | None = None) -> Any:
        """Return a matplotlib figure of joint coordinates, energy, loop gaps and mobility over
        time, with events as vertical lines, as `svkc.plot` does.

        chain: adds the parts of the energy at the save times; optional.
        joints: names of joints and virtual links whose coordinates are shown; None: of the tree's.
        """
        from svkc.viz.render import plot

        return plot(self, chain, joints=joints)

    def trace_non_finite(
        self, chain: Chain, *, control: Function | None = None, events: EventList = (),
        args: Any = None, dt: Scalar | None = None, lane: Function | None = None, data: Any = None,
    ) -> str:  # fmt: skip
        """Return what was not finite first, if the run ended with `RESULTS.non_finite`.

        That is a parameter of the chain, the initial state, the control, a guard, the acceleration
        or the motion itself; "" for other results. The numbers are evaluated again at the last
        finite state and within a step after it, outside of compiled functions. Of a batch, each
        such lane has a line.

        chain, control, events, args, dt: arguments of the run, as `simulate` was given them.
        lane, data: as `svkc.rollout` was given them.
        """
        options = {"control": control, "events": events, "args": args, "dt": dt}
        return trace_non_finite(self, chain, lane, data, options)

    def report(self, halved: Scalar | None = None) -> "Report":
        """Return the certificate of the run, or of each run of a batch.

        halved: an error of the run as `svkc.accuracy.estimate_error` returns, to be shown in the
            report.
        """
        report = _report(self)
        if halved is None:
            return report
        return dataclasses.replace(report, halved=scalar("halved", halved))


@functools.partial(eager_jit, jit=eqx.filter_jit)
def _report(traj: Trajectory) -> "Report":
    """Return the certificate of a trajectory; of a batch if its arrays have leading axes."""
    p = traj.phases
    largest = lambda x: jnp.max(where(jnp.isfinite(x), x, 0), -2)
    largest_of = lambda at_save_times, at_ends: jnp.maximum(
        largest(at_save_times), largest(at_ends)
    )
    gaps, rates, momentum = (
        largest_of(traj.gaps, p.gap),
        largest_of(traj.gap_rates, p.gap_rate),
        largest(p.momentum_drift),
    )
    written = jnp.isfinite(p.start)
    return Report(
        gap=gaps[..., 1],
        angular_gap=gaps[..., 0],
        gap_rate=rates[..., 1],
        angular_gap_rate=rates[..., 0],
        energy_drift=jnp.sum(where(written, p.energy_drift, 0), -1),
        energy_lost=jnp.sum(traj.events.energy_lost, -1),
        momentum_drift=momentum[..., 0],
        angular_momentum_drift=momentum[..., 1],
        free=jnp.any(p.free, -1),
        error=jnp.sum(p.error, -1),
        margin=jnp.min(p.margin, -1),
        swaps=_sum_of_counts(p.swaps),
        reduced_steps=_sum_of_counts(jnp.full_like(p.swaps, -1))
        if p.reduced_steps is None
        else _sum_of_counts(p.reduced_steps),
        accepted=jnp.sum(p.accepted, -1),
        rejected=jnp.sum(p.rejected, -1),
        evaluations=jnp.sum(p.evaluations, -1),
        drift_share=_drift_share(p),
        error_share=_error_share(traj),
        loop=jnp.max(p.loop, -1),
        phases=p.count,
        t_final=traj.t_final,
        result=traj.result,
        derivative=traj.derivative,
        names=traj.names,
    )


def _sum_of_counts(counts: Int[Array, "*lanes phases"]) -> Int[Array, "*lanes"]:
    """Return the sum over phases, and -1 where a phase was not counted."""
    return where(jnp.any(counts < 0, -1), -1, jnp.sum(counts, -1))


def _drift_share(p: Phases) -> Float[Array, "..."]:
    """Return the energy drifts of all phases, added without sign, by the largest kinetic energy.

    Drift within round-off of the energy counts as zero. NaN if no kinetic energy is recorded.
    """
    drift = jnp.sum(where(jnp.isfinite(p.start), jnp.abs(p.energy_drift), 0), -1)
    if p.kinetic_energy is None:
        return drift * jnp.nan
    round_off = ROUND_OFF_DRIFT * jnp.finfo(drift.dtype).eps * jnp.max(jnp.abs(p.energy), (-2, -1))
    kinetic = jnp.max(p.kinetic_energy, -1)
    share = drift / where(kinetic > 0, kinetic, 1)
    return where(drift <= round_off, 0, where(kinetic > 0, share, drift * jnp.inf))


def _error_share(traj: Trajectory) -> Float[Array, "..."]:
    """Return the summed errors of the steps by the largest root mean square of q and v at the save
    times, or by one (rad, m, rad/s, m/s) if that is larger."""
    states = jnp.concatenate([traj.states.q, traj.states.v], -1)
    size = jnp.max(jnp.sqrt(jnp.mean(states**2, -1)), -1)
    return jnp.sum(traj.phases.error, -1) / jnp.maximum(size, 1)
