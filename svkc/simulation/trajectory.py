"""F2: what a run leaves behind."""

import dataclasses
import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from svkc._jax.eager import eager_jit
from svkc.model.chain import State
from svkc.model.validation import one


class RESULTS(eqx.Enumeration):
    """How a run ended, lane by lane."""

    successful = ""
    stopped = "An event asked the run to stop."
    max_events = "More events than max_events: the state is that of the last event handled. Raise max_events, or look for chattering."
    max_steps = "More steps than max_steps in one phase. Raise max_steps, or loosen rtol and atol."
    step_too_small = "The step size fell to its lower bound: the problem is too stiff, or singular, for this solver and tolerance."
    not_in_place = "A link was to be connected at its declared placement, but its bodies were elsewhere. Use here, or a guard that waits."
    loop_open = "A loop is open by more than the tolerance. Use smaller steps, or projection; look at mobility and its margin there."
    non_finite = "A number that is not finite appeared."
    grazing = "A guard touched zero rather than crossed it: the time of its event has no derivative, and those given are not numbers."
    jump = "A guard jumped over zero: the time of its event counts as fixed in derivatives."
    together = "Events happened at one instant: derivatives are those of this order, and none where their times can change apart."
    rank_lost = "The loops lose rank at an end of a phase: derivatives across it are not to be relied on."
    no_slot = "A grip was to be made and every spare slot was taken: it was not made, everything else was. Load with more spare slots, or unbind."


class Events(eqx.Module):
    """What happened, in the order of time; rows past `count` are unused (time inf, which -1).

    `which`: the event's place in the list given; `impulse` (N s), `angular_impulse` (N m s): on each real link from its parent, at the joint, in
    world axes, for the links this event connected; `energy_lost` (J): of events at one instant, in the first one's row.
    """

    time: Float[Array, " events"]
    which: Int[Array, " events"]
    impulse: Float[Array, "events links 3"]
    angular_impulse: Float[Array, "events links 3"]
    energy_lost: Float[Array, " events"]
    count: Int[Array, ""]


class Phases(eqx.Module):
    """The stretches between changes of structure; rows past `count` are unused.

    `energy`: mechanical energy (J) at start and end; `work`: done in between by control, limits and dampers (J); `margin`: the least |R_mm| / |R_11| of
    the phase (of its two ends where steps are not projected), how far the weakest row that counts is from being redundant; `swaps`: how often the
    choice of dependent coordinates changed from step to step (-1: not looked at); `loop`: the one that could not be closed (-1: none);
    `evaluations`: of the vector field, in steps alone; `error`: the estimated errors of the steps added up (root mean square over q and v; inf: the
    solver estimates none); `gap`: the largest of the loops' gaps (rad, m) at the ends of steps (of the phase, with a diffrax adjoint); `gap_rate`: of
    their rates (rad/s, m/s) at the phase's two ends, before the event that ends it; `free`: nothing holds the bodies to the ground; `momentum_drift`:
    then, the change of linear momentum (N s) that gravity does not explain and that of the angular momentum about the centre of mass (N m s).
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


class Trajectory(eqx.Module):
    """A run: `states` at `ts` (leading time axis), the loop gaps (rad, m) and their rates (rad/s, m/s) there, events, phases, the final state and how it ended.

    `derivative`: successful where the run has derivatives, else why not: a guard that grazed or jumped, events that could change order, rank lost.
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
        """Writes the run to one .npz, whole or not at all, with its certificate; `svkc.load_trajectory` gives back an equal object.

        chain: its model and floats are kept too, for `svkc.load_chain` and the command `svkc view`. options: what else is to be told of the run, such as
        rtol=1e-8; numbers and text as they are, other things as they print.
        """
        # a verb the contract puts on the noun; its room is one floor up
        from svkc.simulation.archive import save

        save(self, path, chain, options)

    def plot(self, chain=None):
        """A matplotlib figure of joint coordinates, loop gaps, energy and mobility over time, events as lines."""
        from svkc.viz.render import plot

        return plot(self, chain)

    def report(self, halved=None) -> "Report":
        """The run's certificate. halved: an error estimated by another run, such as `svkc.halved` gives, to be told with it."""
        made = _report(self)
        return made if halved is None else dataclasses.replace(made, halved=one("halved", halved))


@functools.partial(eager_jit, jit=eqx.filter_jit)
def _report(traj: Trajectory) -> "Report":
    p = traj.phases
    largest = lambda x: jnp.max(jnp.where(jnp.isfinite(x), x, 0), -2)
    worst = lambda saved, ends: jnp.maximum(largest(saved), largest(ends))
    gaps, rates, momentum = worst(traj.gaps, p.gap), worst(traj.gap_rates, p.gap_rate), largest(p.momentum_drift)
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
    """Largest loop gaps (m, rad) at the ends of steps, and rates (m/s, rad/s) at the saved times and the ends of phases; energy that no work or impact
    explains and energy lost in impacts (J); over phases in which nothing holds the bodies to the ground (`free`: there is one), momentum that gravity does
    not explain (N s, N m s); estimated errors of all steps added up (inf: the solver estimates none); the least rank margin; changes of the dependent
    coordinates (-1: not looked at); the loop that could not be closed (-1: none); steps, evaluations of the vector field, phases; when and how the run
    ended, and whether it has derivatives; the error by a finer run, where one was asked for."""

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
        balance = f"{float(self.momentum_drift):.2e} N s, {float(self.angular_momentum_drift):.2e} N m s" if self.free else "held to the ground throughout"
        error = f"{float(self.error):.2e}" if jnp.isfinite(self.error) else "not estimated by this solver"
        swaps = f"{int(self.swaps)} changes of the dependent coordinates" if self.swaps >= 0 else "changes of the dependent coordinates not looked at"
        if self.halved is not None:
            error += f"; by a finer run {float(self.halved):.2e} rad, m"
        lines = [
            f"largest loop gap        {float(self.gap):.2e} m, {float(self.angular_gap):.2e} rad; rate {float(self.gap_rate):.2e} m/s, "
            f"{float(self.angular_gap_rate):.2e} rad/s",
            f"energy                  drift {float(self.energy_drift):.2e} J, lost in impacts {float(self.energy_lost):.4g} J",
            f"momentum where free     {balance}",
            f"errors of steps, summed {error}",
            f"rank margin             {float(self.margin):.2e}; {swaps}",
            f"work                    {int(self.accepted)} steps, {int(self.rejected)} rejected, {int(self.evaluations)} evaluations, "
            f"{int(self.phases)} phases",
            f"ended                   at {float(self.t_final):.9g} s: {RESULTS[self.result] or 'successful'}",
        ]
        if self.loop >= 0:
            lines.append(f"could not be closed     loop {int(self.loop)}, counted from 0")
        if self.derivative != RESULTS.successful:
            lines.append(f"derivatives             {RESULTS[self.derivative]}")
        return "\n".join(lines)
