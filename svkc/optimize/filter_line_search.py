"""The filter, and the backtracking line search with second-order correction."""

import dataclasses

import numpy as np

from svkc.optimize.barrier import Barrier, Evaluation
from svkc.optimize.newton_system import NewtonSystem, Terms

# gamma_theta, gamma_phi, s_theta, s_phi, delta, eta_phi, gamma_alpha, kappa_soc of section 2.3
_THETA_MARGIN, _COST_MARGIN = 1e-5, 1e-8
_THETA_POWER, _COST_POWER, _SWITCH, _ARMIJO = 1.1, 2.3, 1.0, 1e-8
_LEAST_PART, _CORRECTION_DECREASE, _CORRECTIONS = 0.05, 0.99, 4
# multiples of the round-off of a number that count as no change
_ROUND_OFF = 10 * float(np.finfo(float).eps)
# violation below which a tiny step is accepted
_TINY_THETA = 1e-4


class Filter:
    """Pairs (violation, barrier cost) that a trial point must improve on (section 2.3)."""

    def __init__(self, theta: float):
        self.largest: float = 1e4 * max(1.0, theta)
        self.small: float = 1e-4 * max(1.0, theta)
        self._pairs: list[tuple[float, float]] = []

    def accepts(self, theta: float, cost: float) -> bool:
        """Return whether a pair is better than each of the filter in one of both."""
        return not any(theta > a and cost > b for a, b in self._pairs)

    def add(self, theta: float, cost: float) -> None:
        """Add a pair, with the margins of equation 22."""
        self._pairs.append(((1 - _THETA_MARGIN) * theta, cost - _COST_MARGIN * theta))

    def reset(self) -> None:
        """Remove all pairs."""
        self._pairs = []


@dataclasses.dataclass(frozen=True)
class Step:
    """A Newton step: its terms, right-hand side and shifts, and the step in all variables.

    at: values where it starts. slope: derivative of the barrier cost along d.
    length, dual_length: largest step lengths by the bounds, and by their multipliers.
    """

    at: Evaluation
    terms: Terms
    of_unknowns: np.ndarray
    shifts: tuple[float, float]
    d: np.ndarray
    dy: np.ndarray
    of_lower: np.ndarray
    of_upper: np.ndarray
    slope: float
    length: float
    dual_length: float


@dataclasses.dataclass(frozen=True)
class Reference:
    """Where a trial point is compared with: violation, barrier cost, its slope, step length."""

    theta: float
    cost: float
    slope: float
    length: float


@dataclasses.dataclass(frozen=True)
class Trial:
    """A trial point: whether it is accepted, and its rows.

    augments: whether the filter gets the reference. by_filter: whether the filter alone refused it.
    theta: violation; infinite where a function is not finite.
    """

    accepted: bool
    augments: bool
    by_filter: bool
    theta: float
    rows: np.ndarray


@dataclasses.dataclass(frozen=True)
class Accepted:
    """An accepted step: the new unknowns, the step of the multipliers, and its length."""

    w: np.ndarray
    dy: np.ndarray
    length: float


class LineSearch:
    """Backtracking line search (section 2.3, with section 2.4 for second-order corrections).

    by_filter: whether, in the last search, the last refused trial point was refused by the filter
        alone.
    tiny: whether the last step was as small as round-off.
    """

    def __init__(self, barrier: Barrier, pairs: Filter, system: NewtonSystem):
        self.barrier = barrier
        self.filter = pairs
        self.system = system
        self.by_filter: bool = False
        self.tiny: bool = False

    def reference(self, step: Step) -> Reference:
        cost = self.barrier.cost(step.at.w)
        return Reference(theta=step.at.theta, cost=cost, slope=step.slope, length=step.length)

    def trial(self, w: np.ndarray, origin: Reference) -> Trial:
        """Return how a trial point compares with a reference (equations 18 to 20)."""
        rows = self.barrier.program.rows(w)
        theta, cost = float(np.abs(rows).sum()), self.barrier.cost(w)
        refused = Trial(accepted=False, augments=False, by_filter=False, theta=theta, rows=rows)
        if not (np.isfinite(theta) and np.isfinite(cost)):
            return dataclasses.replace(refused, theta=np.inf)
        if theta > self.filter.largest:
            return refused
        slope, change = origin.slope, cost - origin.cost - _ROUND_OFF * abs(origin.cost)
        switches = slope < 0 and (
            origin.length * np.power(-slope, _COST_POWER) > _SWITCH * origin.theta**_THETA_POWER
        )
        decreases = change <= _ARMIJO * origin.length * slope
        if switches and origin.theta <= self.filter.small:
            sufficient = decreases
        else:
            sufficient = (
                theta <= (1 - _THETA_MARGIN) * origin.theta
                or change <= -_COST_MARGIN * origin.theta
            )
        allowed = self.filter.accepts(theta, cost)
        return Trial(
            accepted=bool(sufficient and allowed),
            augments=not (switches and decreases),
            by_filter=bool(sufficient and not allowed),
            theta=theta,
            rows=rows,
        )

    def _least_length(self, origin: Reference) -> float:
        """Return the step length below which the restoration begins (equation 23)."""
        slope, theta = origin.slope, origin.theta
        least = _THETA_MARGIN
        if slope < 0:
            least = min(least, _COST_MARGIN * theta / -slope)
            if theta <= self.filter.small:
                ratio = np.divide(theta**_THETA_POWER, np.power(-slope, _COST_POWER))
                least = min(least, _SWITCH * float(ratio))
        return _LEAST_PART * least

    def search(self, step: Step) -> Accepted | None:
        """Return the accepted step, or None if the step length would be too small."""
        w, origin = step.at.w, self.reference(step)
        self.by_filter = False
        self.tiny = bool(np.max(np.abs(step.d) / (1 + np.abs(w)), initial=0.0) < _ROUND_OFF)
        if self.tiny and origin.theta < _TINY_THETA:
            return Accepted(w + step.length * step.d, step.dy, step.length)
        least, length = self._least_length(origin), step.length
        while length >= least or length == step.length:
            origin = dataclasses.replace(origin, length=length)
            at = w + length * step.d
            trial, accepted = self.trial(at, origin), Accepted(at, step.dy, length)
            if not trial.accepted:
                self.by_filter = trial.by_filter
                if length == step.length and origin.theta <= trial.theta < np.inf:
                    trial, accepted = self._corrected(step, trial, origin)
            if trial.accepted:
                if trial.augments:
                    self.filter.add(origin.theta, origin.cost)
                return accepted
            length /= 2
        return None

    def _corrected(self, step: Step, trial: Trial, origin: Reference) -> tuple[Trial, Accepted]:
        """Return the trial after second-order corrections, and its step."""
        length, last, w = step.length, trial.theta, step.at.w
        rows, accepted = step.length * step.at.rows + trial.rows, Accepted(w, step.dy, 0.0)
        for _ in range(_CORRECTIONS):
            solution = self.system.solve(step.of_unknowns, rows)
            if solution is None:
                break
            d, dy = solution
            length = self.barrier.largest_step(w, d)
            accepted = Accepted(w + length * d, dy, length)
            trial = self.trial(accepted.w, origin)
            if trial.accepted or not trial.theta <= _CORRECTION_DECREASE * last:
                break
            rows, last = length * rows + trial.rows, trial.theta
        return trial, accepted
