"""A problem as the interior-point method sees it: free unknowns, scaled functions, slacks."""

import time

import numpy as np
import scipy.sparse

from svkc.optimize.program import Program

# largest gradient of cost and rows at the start, after scaling, and least scale
_LARGEST_GRADIENT, _LEAST_SCALE = 100.0, 1e-8
# relaxation of bounds, and weight of the restoration's violation
_RELAXATION, VIOLATION_WEIGHT = 1e-8, 1000.0


class Functions:
    """Cost, rows and derivatives as functions of the free unknowns.

    Unknowns whose bounds are equal are fixed. Cost and rows are scaled such that no gradient at the
    start has an entry above 100 (Waechter and Biegler 2006, section 3.8).

    program: the compiled problem. x: all unknowns at the start.
    free: indices of the free unknowns. solver_rows: indices of the rows that have a bound.
    start: free unknowns at the start.
    row, column: of the Jacobian's entries.
    hessian_row, hessian_column: of the entries of the Hessian's lower half.
    cost_scale, row_scale: factors of cost and rows. seconds: wall time in the program (s).
    """

    def __init__(self, program: Program, x: np.ndarray):
        low, high, row_low, row_high = program.bounds()
        rows = program.solver_rows
        rows = rows[np.isfinite(row_low[rows]) | np.isfinite(row_high[rows])]
        self.program = program
        self.solver_rows: np.ndarray = rows
        self._all = np.clip(x, low, high)
        self.free: np.ndarray = np.flatnonzero(low < high)
        self.start: np.ndarray = self._all[self.free]
        self.lower, self.upper = low[self.free], high[self.free]
        self._row_bounds = row_low[rows], row_high[rows]
        self.row_lower, self.row_upper = self._row_bounds
        self.cost_scale: float = 1.0
        self.row_scale: np.ndarray = np.ones(len(rows))
        self.seconds: float = 0.0
        self._cache: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        self._set_entries()

    def _set_entries(self) -> None:
        """Set the places of the derivatives' entries."""
        program, first, second = (
            self.program,
            self.program.jacobian_entries,
            self.program.hessian_entries,
        )
        place, row_place = np.full(program.count, -1), np.full(program.cost_row + 1, -1)
        place[self.free] = np.arange(len(self.free))
        row_place[self.solver_rows] = np.arange(len(self.solver_rows))
        is_free = place[first.column] >= 0
        of_rows = self._of_rows = np.flatnonzero(is_free & (row_place[first.row] >= 0))
        of_cost = self._of_cost = np.flatnonzero(is_free & (first.row == program.cost_row))
        self.row, self.column = row_place[first.row[of_rows]], place[first.column[of_rows]]
        self._cost_column = place[first.column[of_cost]]
        both = np.flatnonzero((place[second.row] >= 0) & (place[second.column] >= 0))
        self._of_hessian = both
        self.hessian_row, self.hessian_column = place[second.row[both]], place[second.column[both]]

    def scale(self, x: np.ndarray) -> None:
        """Set the scales by the gradients at x."""
        self.cost_scale, self.row_scale = 1.0, np.ones(len(self.solver_rows))
        largest = np.zeros(len(self.row_scale))
        np.maximum.at(largest, self.row, np.abs(self.jacobian(x)))
        of_cost = np.abs(self.gradient(x)).max(initial=0.0)
        factor = lambda size: np.clip(
            _LARGEST_GRADIENT / np.maximum(size, _LEAST_SCALE), _LEAST_SCALE, 1.0
        )
        self.cost_scale, self.row_scale = float(factor(of_cost)), factor(largest)
        self.row_lower, self.row_upper = (x * self.row_scale for x in self._row_bounds)

    def all_unknowns(self, x: np.ndarray) -> np.ndarray:
        """Return free unknowns with the fixed ones."""
        result = self._all.copy()
        result[self.free] = x
        return result

    def _at(self, name: str, x: np.ndarray) -> np.ndarray:
        """Return the value of a method of the program, from the cache for the last x."""
        cached = self._cache.get(name)
        if cached is not None and np.array_equal(cached[0], x):
            return cached[1]
        start = time.perf_counter()
        value = getattr(self.program, name)(self.all_unknowns(x))
        self.seconds += time.perf_counter() - start
        self._cache[name] = x.copy(), value
        return value

    def cost(self, x: np.ndarray) -> float:
        return self.cost_scale * float(self._at("rows", x)[-1])

    def rows(self, x: np.ndarray) -> np.ndarray:
        return self.row_scale * self._at("rows", x)[self.solver_rows]

    def gradient(self, x: np.ndarray) -> np.ndarray:
        values = self._at("jacobian", x)[self._of_cost]
        return self.cost_scale * np.bincount(self._cost_column, values, len(self.free))

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        return self._at("jacobian", x)[self._of_rows] * self.row_scale[self.row]

    def hessian(self, x: np.ndarray, multipliers: np.ndarray, factor: float = 1.0) -> np.ndarray:
        """Return the Hessian of factor times the cost plus multipliers times the rows."""
        of_all = np.zeros(self.program.cost_row + 1)
        of_all[self.solver_rows] = multipliers * self.row_scale
        of_all[-1] = factor * self.cost_scale
        start = time.perf_counter()
        values = self.program.hessian(self.all_unknowns(x), of_all)
        self.seconds += time.perf_counter() - start
        return values[self._of_hessian]


class SlackProgram:
    """A program with equations as rows: min f(w) with c(w) = 0 and bounds of w = [x, slacks].

    c is g(x) - slack for an inequality, and g(x) - value for an equation. Bounds are relaxed by
    1e-8 of their size (equation 35).

    count: number of free unknowns x. row_count: number of rows.
    slack_row, slack_sign: row of each slack, and its sign in the row.
    lower, upper: bounds of w. target: values of the equations.
    """

    def __init__(self, functions: Functions):
        self.functions = functions
        low, high = functions.row_lower, functions.row_upper
        between = low < high
        self.count, self.row_count = len(functions.free), len(low)
        self.slack_row: np.ndarray = np.flatnonzero(between)
        self.slack_sign: np.ndarray = -np.ones(len(self.slack_row))
        self.target: np.ndarray = np.where(between, 0.0, low)
        lower = np.concatenate([functions.lower, low[between]])
        upper = np.concatenate([functions.upper, high[between]])
        # infinite bounds stay infinite
        self.lower: np.ndarray = lower - _RELAXATION * np.maximum(1, np.abs(lower))
        self.upper: np.ndarray = upper + _RELAXATION * np.maximum(1, np.abs(upper))

    def cost(self, w: np.ndarray) -> float:
        return self.functions.cost(w[: self.count])

    def gradient(self, w: np.ndarray) -> np.ndarray:
        of_x = self.functions.gradient(w[: self.count])
        return np.concatenate([of_x, np.zeros(len(self.slack_row))])

    def rows(self, w: np.ndarray) -> np.ndarray:
        of_x = self.functions.rows(w[: self.count]) - self.target
        return of_x + self.of_slacks(self.slack_sign * w[self.count :])

    def largest_violation(self, rows: np.ndarray) -> float:
        """Return the largest absolute value of rows, not scaled."""
        return float(np.abs(rows / self.functions.row_scale).max(initial=0.0))

    def of_slacks(self, values: np.ndarray) -> np.ndarray:
        """Return the sums of the slacks' values over the slacks of each row."""
        return np.bincount(self.slack_row, values, self.row_count)

    def jacobian(self, w: np.ndarray) -> np.ndarray:
        """Return the entries of the Jacobian by x."""
        return self.functions.jacobian(w[: self.count])

    def matrix(self, entries: np.ndarray) -> scipy.sparse.csr_array:
        """Return the Jacobian by x of these entries."""
        places = (self.functions.row, self.functions.column)
        return scipy.sparse.csr_array((entries, places), (self.row_count, self.count))

    def transposed(self, matrix: scipy.sparse.csr_array, values: np.ndarray) -> np.ndarray:
        """Return the transposed Jacobian by w times values of the rows."""
        return np.concatenate([matrix.T @ values, self.slack_sign * values[self.slack_row]])

    def hessian(self, w: np.ndarray, multipliers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the entries of the Lagrangian's Hessian by x, and a diagonal by w."""
        return self.functions.hessian(w[: self.count], multipliers), np.zeros(len(w))


class ElasticProgram(SlackProgram):
    """The program of least violation near a point (section 3.3).

    min rho sum(p + n) + zeta / 2 |D (w - near)|^2 with c(w) - p + n = 0 and p, n >= 0. D divides by
    the size of entries above 1. Slacks are those of the program, then p and n.

    program: the program. near: its unknowns w. zeta: weight of the distance.
    """

    def __init__(self, program: SlackProgram, near: np.ndarray, zeta: float):
        self.functions = program.functions
        self.count, self.row_count = program.count, program.row_count
        self.target = program.target
        rows, ones = np.arange(self.row_count), np.ones(self.row_count)
        self.slack_row = np.concatenate([program.slack_row, rows, rows])
        self.slack_sign = np.concatenate([program.slack_sign, -ones, ones])
        self.lower = np.concatenate([program.lower, 0 * ones, 0 * ones])
        self.upper = np.concatenate([program.upper, np.inf * ones, np.inf * ones])
        self._near = near
        self._weight = zeta / np.maximum(1, np.abs(near)) ** 2

    def _distance(self, w: np.ndarray) -> np.ndarray:
        return w[: len(self._near)] - self._near

    def cost(self, w: np.ndarray) -> float:
        violation = VIOLATION_WEIGHT * float(w[len(self._near) :].sum())
        return violation + float(self._weight @ self._distance(w) ** 2) / 2

    def gradient(self, w: np.ndarray) -> np.ndarray:
        of_violation = np.full(2 * self.row_count, VIOLATION_WEIGHT)
        return np.concatenate([self._weight * self._distance(w), of_violation])

    def hessian(self, w: np.ndarray, multipliers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        diagonal = np.concatenate([self._weight, np.zeros(2 * self.row_count)])
        return self.functions.hessian(w[: self.count], multipliers, 0.0), diagonal
