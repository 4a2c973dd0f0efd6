"""The result of a run (`Trajectory`), and its certificate (`Report`)."""

import dataclasses
import functools
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from svkc._jax.eager import eager_jit
from svkc._jax.pytrees import is_concrete
from svkc.model.annotations import Path, Scalar
from svkc.model.chain import Chain, State
from svkc.model.validation import scalar
from svkc.simulation.codes import DERIVATIVE, RESULTS
from svkc.simulation.records import Events, Phases


class Trajectory(eqx.Module):
    """The result of a run of `simulate`.

    ts: save times (s).
    states: states at the save times, with a leading time axis.
    gaps, gap_rates: largest loop gaps at the save times (rad, m), and their rates (rad/s, m/s).
    events: records of the events.
    phases: records of the phases.
    final, t_final: state and time at the end of the run.
    result: how the run ended.
    derivative: `svkc.types.DERIVATIVE.successful` if the run has derivatives; otherwise why not: a
        guard that grazed zero or jumped, simultaneous events, or a loss of rank.
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

    @property
    def connected(self) -> Bool[Array, "... times links"]:
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

    def plot(self, chain: Chain | None = None) -> Any:
        """Return a matplotlib figure of joint coordinates, loop gaps, energy and mobility over
        time, with events as vertical lines.

        chain: adds joint names, and kinetic and potential energy at the save times; optional.
        """
        from svkc.viz.render import plot

        return plot(self, chain)

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
    largest = lambda x: jnp.max(jnp.where(jnp.isfinite(x), x, 0), -2)
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
        energy_drift=jnp.sum(jnp.where(written, p.energy_drift, 0), -1),
        energy_lost=jnp.sum(traj.events.energy_lost, -1),
        momentum_drift=momentum[..., 0],
        angular_momentum_drift=momentum[..., 1],
        free=jnp.any(p.free, -1),
        error=jnp.sum(p.error, -1),
        margin=jnp.min(p.margin, -1),
        swaps=jnp.where(jnp.any(p.swaps < 0, -1), -1, jnp.sum(p.swaps, -1)),
        accepted=jnp.sum(p.accepted, -1),
        rejected=jnp.sum(p.rejected, -1),
        evaluations=jnp.sum(p.evaluations, -1),
        loop=jnp.max(p.loop, -1),
        phases=p.count,
        t_final=traj.t_final,
        result=traj.result,
        derivative=traj.derivative,
    )


class Report(eqx.Module):
    """The certificate of a run: how far the numbers of the run can be relied on.

    gap, angular_gap: largest loop gaps at the ends of steps and at save times (m, rad).
    gap_rate, angular_gap_rate: largest rates of the loop gaps at the save times and at the ends of
        phases (m/s, rad/s).
    energy_drift: change of energy that neither work nor impacts explain (J).
    energy_lost: energy lost in impacts (J).
    momentum_drift, angular_momentum_drift: over phases in which the bodies are free of the ground,
        largest change of linear momentum that gravity does not explain (N s), and of angular
        momentum about the centre of mass (N m s).
    free: whether there is such a phase.
    error: sum of the estimated errors of all steps (inf: none from this solver or adjoint).
    margin: least rank margin |R_mm| / |R_11|.
    swaps: how often the choice of dependent coordinates changed (-1: not recorded).
    accepted, rejected: numbers of steps.
    evaluations: of the vector field in steps.
    loop: index of the loop that could not be closed (-1: none).
    phases: number of phases.
    t_final: end of the run (s).
    result, derivative: of the trajectory.
    halved: result of `svkc.accuracy.estimate_error` (a finer run), if `report` was given it.
    """

    gap: Float[Array, ""]
    angular_gap: Float[Array, ""]
    gap_rate: Float[Array, ""]
    angular_gap_rate: Float[Array, ""]
    energy_drift: Float[Array, ""]
    energy_lost: Float[Array, ""]
    momentum_drift: Float[Array, ""]
    angular_momentum_drift: Float[Array, ""]
    free: Bool[Array, ""]
    error: Float[Array, ""]
    margin: Float[Array, ""]
    swaps: Int[Array, ""]
    accepted: Int[Array, ""]
    rejected: Int[Array, ""]
    evaluations: Int[Array, ""]
    loop: Int[Array, ""]
    phases: Int[Array, ""]
    t_final: Float[Array, ""]
    result: RESULTS
    derivative: DERIVATIVE
    halved: Any = None

    def __str__(self) -> str:
        if not is_concrete(self.gap) or self.gap.ndim:
            return repr(self)
        balance = (
            f"{float(self.momentum_drift):.2e} N s, {float(self.angular_momentum_drift):.2e} N m s"
            if self.free
            else "held to the ground throughout"
        )
        error = (
            f"{float(self.error):.2e}"
            if jnp.isfinite(self.error)
            else "not estimated by this solver"
        )
        swaps = (
            f"{int(self.swaps)} changes of the dependent coordinates"
            if self.swaps >= 0
            else "changes of the dependent coordinates not recorded"
        )
        if self.halved is not None:
            error += f"; by a finer run {float(self.halved):.2e} rad, m"
        lines = [
            (
                f"largest loop gap        {float(self.gap):.2e} m, {float(self.angular_gap):.2e}"
                f" rad; rate {float(self.gap_rate):.2e} m/s, {float(self.angular_gap_rate):.2e}"
                " rad/s"
            ),
            (
                f"energy                  drift {float(self.energy_drift):.2e} J, lost in impacts"
                f" {float(self.energy_lost):.4g} J"
            ),
            f"momentum where free     {balance}",
            f"errors of steps, summed {error}",
            f"rank margin             {float(self.margin):.2e}; {swaps}",
            (
                f"work                    {int(self.accepted)} steps, {int(self.rejected)}"
                f" rejected, {int(self.evaluations)} evaluations, {int(self.phases)} phases"
            ),
            (
                f"ended                   at {float(self.t_final):.9g} s:"
                f" {RESULTS[self.result] or 'successful'}"
            ),
        ]
        if self.loop >= 0:
            lines.append(f"could not be closed     loop {int(self.loop)}, counted from 0")
        if self.derivative != DERIVATIVE.successful:
            lines.append(f"derivatives             {DERIVATIVE[self.derivative]}")
        return "\n".join(lines)
