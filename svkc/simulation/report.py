"""The certificate of a run (`Report`), and its verdict in words."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from svkc.loops.constraint import gap_tolerance
from svkc.model.chain_names import ChainNames
from svkc.model.tables import Block, Printed, Table, lane_name, ranges
from svkc.simulation.codes import DERIVATIVE, RESULTS

# Energy drift divided by the kinetic energy. The relative error of speeds is half of it: 5 %
# at 0.1, where the motion is no longer that of the model. A run of low accuracy has 0.01.
DRIFT_TOO_LARGE, DRIFT_NOTABLE = 0.1, 0.01
# Round-off of the energy in eps. Energy is a sum over bodies and steps, whose round-off adds up.
ROUND_OFF_DRIFT = 1e3
# Sum of the errors of all steps divided by the size of the state. The sum bounds the final error if
# errors do not grow.
ERROR_NOTABLE = 0.1
# Rejected steps for each accepted one, and the least number of rejected steps that is judged. With
# smooth forces, controllers reject at most about one step for each accepted one.
REJECTED_NOTABLE, REJECTED_AT_LEAST = 2, 20


class Report(Printed):
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
    margin: least rank margin |R_mm| / |R_11| (R of the loop Jacobian's pivoted QR, m its rank).
    swaps: how often the choice of dependent coordinates changed (-1: not recorded).
    reduced_steps: accepted steps by articulated bodies with reduced rows of the loops, as near a
        singular configuration and at the start of phases with redundant loops (-1: not by
        articulated bodies).
    accepted, rejected: numbers of steps.
    evaluations: number of evaluations of the vector field in steps.
    drift_share: sum of the phases' absolute energy drifts, divided by the largest kinetic energy at
        the ends of phases and at save times. Drift within round-off counts as zero.
    error_share: `error` divided by the largest root mean square of q and v at save times, or by one
        (rad, m, rad/s, m/s) if that is larger.
    loop: index of the loop that could not be closed (-1: none).
    phases: number of phases.
    t_final: end of the run (s).
    result, derivative: codes of the trajectory.
    halved: result of `svkc.accuracy.estimate_error` (a finer run), if `report` was given it.
    names: names of the chain's bodies, joints, links and coordinates, if the trajectory has them.
    """

    gap: Float[Array, "*lanes"]
    angular_gap: Float[Array, "*lanes"]
    gap_rate: Float[Array, "*lanes"]
    angular_gap_rate: Float[Array, "*lanes"]
    energy_drift: Float[Array, "*lanes"]
    energy_lost: Float[Array, "*lanes"]
    momentum_drift: Float[Array, "*lanes"]
    angular_momentum_drift: Float[Array, "*lanes"]
    free: Bool[Array, "*lanes"]
    error: Float[Array, "*lanes"]
    margin: Float[Array, "*lanes"]
    swaps: Int[Array, "*lanes"]
    reduced_steps: Int[Array, "*lanes"]
    accepted: Int[Array, "*lanes"]
    rejected: Int[Array, "*lanes"]
    evaluations: Int[Array, "*lanes"]
    drift_share: Float[Array, "*lanes"]
    error_share: Float[Array, "*lanes"]
    loop: Int[Array, "*lanes"]
    phases: Int[Array, "*lanes"]
    t_final: Float[Array, "*lanes"]
    result: RESULTS
    derivative: DERIVATIVE
    halved: Any = None
    names: ChainNames | None = eqx.field(static=True, default=None)

    def verdict(self) -> str:
        """Return in words whether the run can be relied on; for a batch, those of the worst lane.

        docs/accuracy.md lists what is judged, and the limits.
        """
        shape = np.shape(self.gap)
        gap = np.maximum(np.asarray(self.gap), np.asarray(self.angular_gap))
        ended = (RESULTS.successful._value, RESULTS.stopped._value)
        failed = ~np.isin(np.asarray(self.result._value), [np.asarray(code) for code in ended])
        fields = {
            "failed": failed,
            "drift": self.drift_share,
            "error": self.error_share,
            "gap": gap,
            "is_open": ~(gap <= gap_tolerance(gap.dtype)),
            "accepted": self.accepted,
            "rejected": self.rejected,
        }
        values = zip(*(np.ravel(x).tolist() for x in fields.values()))
        lanes = [_judge(**dict(zip(fields, lane))) for lane in values]
        worst = max(range(len(lanes)), key=lambda i: lanes[i][0])
        words = lanes[worst][1]
        if failed.flat[worst]:
            result = jax.tree.map(lambda x: jnp.ravel(x)[worst], self.result)
            words = [f"the run did not reach its end: {RESULTS[result]}", *words]
        lane = lane_name(worst, shape) if shape else ""
        return f"worst of {len(lanes)} lanes, lane {lane}: " * bool(shape) + "; ".join(words)

    def _blocks(self) -> list[Block]:
        if not np.ndim(self.gap):
            return [Table((), self._rows())]
        values = {
            "end (s)": self.t_final,
            "steps": self.accepted,
            "rejected steps": self.rejected,
            "energy drift, without sign (J)": np.abs(self.energy_drift),
            "energy lost in impacts (J)": self.energy_lost,
            "largest loop gap (m)": self.gap,
            "largest loop gap (rad)": self.angular_gap,
            "errors of steps, summed": self.error,
            "rank margin": self.margin,
        }
        rows = [("ended", str(self.result)), ("derivatives", str(self.derivative))]
        return [ranges(values), Table((), [*rows, ("verdict", self.verdict())])]

    def _rows(self) -> list[tuple[str, str]]:
        """Return the names and the values of the certificate of one run."""
        balance = (
            f"{float(self.momentum_drift):.2e} N s, {float(self.angular_momentum_drift):.2e} N m s"
            if self.free
            else "in no phase are all bodies free of the ground"
        )
        error = (
            f"{float(self.error):.2e}"
            if np.isfinite(self.error)
            else "not estimated by this solver"
        )
        swaps = (
            f"{int(self.swaps)} changes of the dependent coordinates"
            if self.swaps >= 0
            else "changes of the dependent coordinates not recorded"
        )
        if self.reduced_steps >= 0:
            swaps = f"steps with reduced rows: {int(self.reduced_steps)}"
        if self.halved is not None:
            error += f"; by a finer run {float(self.halved):.2e} rad, m"
        gap = f"{float(self.gap):.2e} m, {float(self.angular_gap):.2e} rad"
        rate = f"{float(self.gap_rate):.2e} m/s, {float(self.angular_gap_rate):.2e} rad/s"
        energy = (
            f"{float(self.energy_drift):.2e} J, lost in impacts {float(self.energy_lost):.4g} J"
        )
        work = f"{int(self.accepted)} steps, {int(self.rejected)} rejected"
        rows = [
            ("largest loop gap", f"{gap}; rate {rate}"),
            ("energy", f"drift {energy}"),
            ("momentum where free", balance),
            ("errors of steps, summed", error),
            ("rank margin", f"{float(self.margin):.2e}; {swaps}"),
            ("work", f"{work}, {int(self.evaluations)} evaluations, {int(self.phases)} phases"),
            (
                "ended",
                f"at {float(self.t_final):.9g} s: {RESULTS[self.result] or 'successful'}",
            ),
        ]
        if self.loop >= 0:
            loop = self.names.links[int(self.loop)] if self.names else f"link {int(self.loop)}"
            rows.append(("could not be closed", f"loop {loop}"))
        if self.derivative != DERIVATIVE.successful:
            rows.append(("derivatives", DERIVATIVE[self.derivative]))
        return [*rows, ("verdict", self.verdict())]


def _percent(share: float) -> str:
    """Return a share in percent, with two digits below 100 %."""
    return f"{100 * share:.2g} %" if share < 1 else f"{100 * share:.0f} %"


def _judge(
    *,
    failed: bool,
    drift: float,
    error: float,
    gap: float,
    is_open: bool,
    accepted: int,
    rejected: int,
) -> tuple[tuple[int, float], list[str]]:
    """Return a rank of how bad one run is, by which lanes are compared, and the verdict in words.

    The rank is (level, drift). Levels: 3 failed, 2 drift too large, 1 another fault, 0 no fault.

    drift, error: `drift_share` and `error_share`.
    gap: largest loop gap (rad, m). is_open: whether the gap is above `gap_tolerance`.
    """
    drift_text, words = f"energy drift is {_percent(drift)} of the kinetic energy", []
    if drift >= DRIFT_TOO_LARGE:
        words.append(f"{drift_text}: the steps are too long for this motion (smaller dt, or rtol)")
    elif drift >= DRIFT_NOTABLE:
        words.append(f"{drift_text}: shorter steps (dt, or rtol) would be more accurate")
    if is_open:
        words.append(f"a loop is open by {gap:.1e} (m or rad): shorter steps, or Projection()")
    if rejected > max(REJECTED_NOTABLE * accepted, REJECTED_AT_LEAST):
        words.append(f"{rejected} of {accepted + rejected} steps were rejected: a force may jump")
    if ERROR_NOTABLE <= error < np.inf:
        words.append(f"errors of the steps add up to {_percent(error)} of the state")
    level = 3 if failed else 2 if drift >= DRIFT_TOO_LARGE else int(bool(words))
    if np.isnan(drift):
        words.append("the energy balance is not known; judged by loop gaps, rejected steps, errors")
    elif not words and not failed:
        drift_text = f"{drift:.1e} of the kinetic energy" if drift else "within round-off"
        loops = f", loops are closed to {gap:.1e} (m, rad)" if gap else ""
        words.append(f"no fault found: energy drift is {drift_text}{loops}")
    return (level, np.inf if np.isnan(drift) else float(drift)), words
