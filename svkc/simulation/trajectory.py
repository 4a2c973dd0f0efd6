"""The result of a run, and its report."""

import dataclasses
import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from svkc._jax.eager import eager_jit
from svkc.model.chain import State
from svkc.model.validation import scalar
from svkc.simulation.records import RESULTS, Events, Phases


class Trajectory(eqx.Module):
    """A run: `states` at `ts` (leading time axis), the loop gaps (rad, m) and their rates (rad/s,
    m/s) there, events, phases, the final state and how it ended.

    `derivative`: successful where the run has derivatives, else why not: a guard that grazed or
    jumped, events that could change order, rank lost.
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
    derivative: RESULTS

    @property
    def connected(self) -> Bool[Array, "... times links"]:
        """Which virtual links hold at each time."""
        return self.states.structure.connected

    def save(self, path, chain=None, **options) -> None:
        """Writes the run to one .npz, whole or not at all, with its certificate;
        `svkc.load_trajectory` gives back an equal object.

        chain: its model and floats are kept too, for `svkc.load_chain` and the command `svkc view`.
        options: what else is to be told of the run, such as rtol=1e-8; numbers and text as they
        are, other things as they print.
        """
        # a verb the contract puts on the noun; its room is one floor up
        from svkc.simulation.archive import save

        save(self, path, chain, options)

    def plot(self, chain=None):
        """A matplotlib figure of joint coordinates, loop gaps, energy and mobility over time,
        events as lines."""
        from svkc.viz.render import plot

        return plot(self, chain)

    def report(self, halved=None) -> "Report":
        """The run's certificate. halved: an error estimated by another run, such as `svkc.accuracy.estimate_error`
        gives, to be told with it."""
        made = _report(self)
        return (
            made if halved is None else dataclasses.replace(made, halved=scalar("halved", halved))
        )


@functools.partial(eager_jit, jit=eqx.filter_jit)
def _report(traj: Trajectory) -> "Report":
    p = traj.phases
    largest = lambda x: jnp.max(jnp.where(jnp.isfinite(x), x, 0), -2)
    worst = lambda saved, ends: jnp.maximum(largest(saved), largest(ends))
    gaps, rates, momentum = (
        worst(traj.gaps, p.gap),
        worst(traj.gap_rates, p.gap_rate),
        largest(p.momentum_drift),
    )
    begun = jnp.isfinite(p.start)
    return Report(
        gap=gaps[..., 1],
        angular_gap=gaps[..., 0],
        gap_rate=rates[..., 1],
        angular_gap_rate=rates[..., 0],
        energy_drift=jnp.sum(jnp.where(begun, p.energy_drift, 0), -1),
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
    """Largest loop gaps (m, rad) at the ends of steps, and rates (m/s, rad/s) at the saved times
    and the ends of phases; energy that no work or impact explains and energy lost in impacts (J);
    over phases in which nothing holds the bodies to the ground (`free`: there is one), momentum
    that gravity does not explain (N s, N m s); estimated errors of all steps added up (inf: the
    solver estimates none); the least rank margin; changes of the dependent coordinates (-1: not
    looked at); the loop that could not be closed (-1: none); steps, evaluations of the vector
    field, phases; when and how the run ended, and whether it has derivatives; the error by a finer
    run, where one was asked for."""

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
    derivative: RESULTS
    halved: Any = None

    def __str__(self) -> str:
        if isinstance(self.gap, jax.core.Tracer) or self.gap.ndim:
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
            else "changes of the dependent coordinates not looked at"
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
        if self.derivative != RESULTS.successful:
            lines.append(f"derivatives             {RESULTS[self.derivative]}")
        return "\n".join(lines)
