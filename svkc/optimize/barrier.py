"""The barrier problem: bounds as logarithms, steps within the bounds, optimality error."""

import dataclasses
from typing import Any

import numpy as np

from svkc.optimize.nonlinear_program import SlackProgram

# damping of unknowns with one bound; limit of bound multipliers; limit of scaling factors
_DAMPING, _MULTIPLIER_LIMIT, _SCALE_LIMIT = 1e-5, 1e10, 100.0
# distance to bounds at the start, relative to the bound's size or to the bounds' distance
PUSH = 1e-2


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """Unknowns, with values and derivatives of the functions there.

    w: unknowns. gradient: of the cost. rows: c(w). jacobian: entries. matrix: the Jacobian by x.
    """

    w: np.ndarray
    gradient: np.ndarray
    rows: np.ndarray
    jacobian: np.ndarray
    matrix: Any

    @property
    def theta(self) -> float:
        """Sum of the rows' absolute values."""
        return float(np.abs(self.rows).sum())

    @property
    def finite(self) -> bool:
        """Whether all values are finite."""
        return all(bool(np.isfinite(x).all()) for x in (self.gradient, self.rows, self.jacobian))


@dataclasses.dataclass(frozen=True)
class Duals:
    """Multipliers of the rows, and of lower and upper bounds."""

    rows: np.ndarray
    lower: np.ndarray
    upper: np.ndarray


def interior(w: np.ndarray, lower: np.ndarray, upper: np.ndarray, push: float) -> np.ndarray:
    """Return w moved into the interior of its bounds (section 3.6)."""
    below, above = np.isfinite(lower), np.isfinite(upper)
    low, high = np.where(below, lower, 0.0), np.where(above, upper, 0.0)
    part = np.where(below & above, push * (high - low), np.inf)
    distance = lambda bound: np.minimum(push * np.maximum(1, np.abs(bound)), part)
    w = np.where(below, np.maximum(w, low + distance(low)), w)
    return np.where(above, np.minimum(w, high - distance(high)), w)


def values_at(program: SlackProgram, w: np.ndarray) -> Evaluation:
    """Return values and derivatives of a program's functions."""
    jacobian = program.jacobian(w)
    return Evaluation(
        w=w,
        gradient=program.gradient(w),
        rows=program.rows(w),
        jacobian=jacobian,
        matrix=program.matrix(jacobian),
    )


class Barrier:
    """The barrier problem of a program.

    program: the program. parameter: the barrier parameter mu.
    has_lower, has_upper: masks of unknowns with a lower, and with an upper bound.
    """

    def __init__(self, program: SlackProgram, parameter: float):
        self.program = program
        self.parameter: float = parameter
        self.has_lower: np.ndarray = np.isfinite(program.lower)
        self.has_upper: np.ndarray = np.isfinite(program.upper)
        self._lower = np.where(self.has_lower, program.lower, 0.0)
        self._upper = np.where(self.has_upper, program.upper, 0.0)
        self._one_sided = 1.0 * (self.has_lower & ~self.has_upper) - 1.0 * (
            self.has_upper & ~self.has_lower
        )
        self._bounds = max(int(self.has_lower.sum() + self.has_upper.sum()), 1)

    @property
    def fraction(self) -> float:
        """Part of the way to the boundary that a step may go (equation 8)."""
        return max(0.99, 1 - self.parameter)

    def gaps(self, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the distances to lower and upper bounds; 1 where there is no bound."""
        low = np.where(self.has_lower, w - self._lower, 1.0)
        return low, np.where(self.has_upper, self._upper - w, 1.0)

    def cost(self, w: np.ndarray) -> float:
        """Return the cost with the logarithms and the damping (section 3.7).

        It is infinite outside the bounds.
        """
        low, high = self.gaps(w)
        if min(low.min(initial=1.0), high.min(initial=1.0)) <= 0:
            return np.inf
        logarithms = float(np.log(low).sum() + np.log(high).sum())
        one_sided = float(low[self._one_sided > 0].sum() + high[self._one_sided < 0].sum())
        return self.program.cost(w) + self.parameter * (_DAMPING * one_sided - logarithms)

    def gradient(self, at: Evaluation) -> np.ndarray:
        """Return the gradient of the cost with the logarithms."""
        low, high = self.gaps(at.w)
        slope = self.has_lower / low - self.has_upper / high - _DAMPING * self._one_sided
        return at.gradient - self.parameter * slope

    def curvature(self, w: np.ndarray, duals: Duals) -> np.ndarray:
        """Return the diagonal of multipliers divided by gaps (Sigma in equation 11)."""
        low, high = self.gaps(w)
        return duals.lower / low + duals.upper / high

    def dual_steps(self, w: np.ndarray, duals: Duals, d: np.ndarray) -> tuple:
        """Return the steps of the bounds' multipliers for a step d of w (equation 12)."""
        low, high = self.gaps(w)
        of_lower = self.parameter / low - duals.lower - duals.lower / low * d
        of_upper = self.parameter / high - duals.upper + duals.upper / high * d
        return of_lower * self.has_lower, of_upper * self.has_upper

    def largest_step(self, w: np.ndarray, d: np.ndarray) -> float:
        """Return the largest step length at most 1 that keeps w + length d within the bounds."""
        low, high = self.gaps(w)
        inward, outward = self.has_lower & (d < 0), self.has_upper & (d > 0)
        down = (low[inward] / -d[inward]).min(initial=np.inf)
        up = (high[outward] / d[outward]).min(initial=np.inf)
        return min(1.0, self.fraction * float(min(down, up)))

    def largest_dual_step(self, duals: Duals, of_lower: np.ndarray, of_upper: np.ndarray) -> float:
        """Return the largest step length at most 1 that keeps multipliers of bounds positive."""
        least = np.inf
        for z, dz in ((duals.lower, of_lower), (duals.upper, of_upper)):
            falls = dz < 0
            least = min(least, float((z[falls] / -dz[falls]).min(initial=np.inf)))
        return min(1.0, self.fraction * least)

    def limited(self, w: np.ndarray, duals: Duals) -> Duals:
        """Return multipliers whose products with gaps are near the parameter (equation 16)."""
        low, high = self.gaps(w)
        limits = lambda gap: (
            self.parameter / _MULTIPLIER_LIMIT / gap, self.parameter * _MULTIPLIER_LIMIT / gap
        )  # fmt: skip
        return Duals(
            duals.rows,
            np.clip(duals.lower, *limits(low)) * self.has_lower,
            np.clip(duals.upper, *limits(high)) * self.has_upper,
        )

    def lagrangian_gradient(self, at: Evaluation, duals: Duals) -> np.ndarray:
        """Return the gradient of the Lagrangian."""
        of_rows = self.program.transposed(at.matrix, duals.rows)
        return at.gradient + of_rows - duals.lower + duals.upper

    def errors(self, at: Evaluation, duals: Duals, parameter: float) -> tuple[float, float, float]:
        """Return the scaled error of the optimality conditions (equation 5), and parts of it.

        The parts are the largest entries of the Lagrangian's gradient and of the complementarity.
        """
        low, high = self.gaps(at.w)
        bounds = float(duals.lower.sum() + duals.upper.sum())
        total = float(np.abs(duals.rows).sum()) + bounds
        count = len(duals.rows) + self._bounds
        of_dual = max(_SCALE_LIMIT, total / count) / _SCALE_LIMIT
        of_products = max(_SCALE_LIMIT, bounds / self._bounds) / _SCALE_LIMIT
        size = lambda x: float(np.abs(x).max(initial=0.0))
        dual = size(self.lagrangian_gradient(at, duals))
        products = max(
            size((low * duals.lower - parameter) * self.has_lower),
            size((high * duals.upper - parameter) * self.has_upper),
        )
        return max(dual / of_dual, size(at.rows), products / of_products), dual, products
