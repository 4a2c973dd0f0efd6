"""The iterations of the interior-point method, for a problem and for its restoration."""

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from svkc.optimize.barrier import Barrier, Duals, Evaluation, values_at
from svkc.optimize.block_chain import BlockChain
from svkc.optimize.filter_line_search import Accepted, Filter, LineSearch, Step
from svkc.optimize.newton_system import NewtonSystem, Terms
from svkc.optimize.nonlinear_program import SlackProgram
from svkc.optimize.watchdog import Watchdog

# kappa_mu, theta_mu and kappa_epsilon of equation 7
_LINEAR, _SUPERLINEAR, _ERROR = 0.2, 1.5, 10.0
# tolerances of the unscaled conditions, as of IPOPT with the options of `Ipopt`
ROW_TOLERANCE, _DUAL_TOLERANCE, _PRODUCT_TOLERANCE = 1e-7, 1.0, 1e-4
# acceptable scaled error, and iterations in a row that end the method there
_ACCEPTABLE, _ACCEPTABLE_COUNT = 1e-6, 15
# largest multipliers by least squares, and regularization of their system
_LARGEST_MULTIPLIER, _REGULARIZATION = 1e3, 1e-10
# the restoration begins after this many steps below a length by bounds, if the violation is large
_SHORT_STEPS, _SHORT_LENGTH, _SHORT_THETA = 8, 0.05, 1.0
# steps in a row that the filter alone refused before it is reset, and largest number of resets
_BLOCKED, _RESETS = 5, 5


@dataclasses.dataclass
class Run:
    """What a problem and its restorations share.

    tolerance, max_iterations, max_seconds: of `InteriorPoint`. matrix: solver of linear systems.
    progress: called with the number of iterations as a fraction of the largest number.
    x, duals: free unknowns and multipliers of the problem's last iterate that the line search
        accepted. If the problem is infeasible, x is instead the point of least violation.
    begin: time of the start (s). iterations: number of iterations.
    """

    tolerance: float
    max_iterations: int
    max_seconds: float
    matrix: BlockChain
    progress: Callable[[float], None]
    x: np.ndarray
    duals: Duals
    begin: float
    iterations: int = 0


class BarrierMethod:
    """Primal-dual iterations of a program with a barrier parameter that only decreases.

    restore: (method) -> result, or None after a call of `restart`. None: the program is that of a
        restoration.
    arrived: (w) -> whether a restoration may end.
    """

    def __init__(
        self,
        run: Run,
        barrier: Barrier,
        w: np.ndarray,
        duals: Duals,
        *,
        restore: Callable[[Any], str | None] | None = None,
        arrived: Callable[[np.ndarray], bool] | None = None,
    ):
        self.run = run
        self.barrier = barrier
        self.program: SlackProgram = barrier.program
        self.at: Evaluation = values_at(self.program, w)
        self.duals = duals
        self.restore = restore
        self.arrived = arrived
        self.filter: Filter = Filter(self.at.theta)
        self.system: NewtonSystem = NewtonSystem(self.program, run.matrix)
        self.search: LineSearch = LineSearch(barrier, self.filter, self.system)
        self._watchdog = Watchdog(self.search)
        self._tiny = self._short = self._blocked = self._resets = self._acceptable = 0

    def solve(self) -> str:
        """Iterate to the end and return the result: the name of an `OUTCOME`, or "arrived"."""
        status = self._iterate()
        if self.restore is not None and status == "failed":
            self._store()
            return "acceptable" if self.is_acceptable else status
        return status

    def _iterate(self) -> str:
        while True:
            if not self._watchdog.active:
                self._store()
            self.run.progress(min(self.run.iterations / self.run.max_iterations, 1.0))
            status = self._ended() or self._update_parameter()
            if status:
                if status in ("successful", "acceptable"):
                    self._store()
                return status
            step = self._step()
            if isinstance(step, str):
                return step
            status = self._advance(step)
            if status:
                return status
            self.run.iterations += 1

    def _store(self) -> None:
        """Store the iterate as the last one of the problem. Iterates of a restoration are not."""
        if self.restore is not None:
            self.run.x, self.run.duals = self.at.w[: self.program.count], self.duals

    def _ended(self) -> str | None:
        """Return the result if the iterate is the last one."""
        run = self.run
        if not self.at.finite:
            return "not_finite"
        if self.arrived is not None and self.arrived(self.at.w):
            return "arrived"
        error, dual, products = self.barrier.errors(self.at, self.duals, 0.0)
        if self.restore is None:
            if error <= run.tolerance:
                return "infeasible"
        else:
            scale = self.program.functions.cost_scale
            fine = self.largest_violation <= ROW_TOLERANCE and dual <= _DUAL_TOLERANCE * scale
            if fine and error <= run.tolerance and products <= _PRODUCT_TOLERANCE * scale:
                return "successful"
            self._acceptable = self._acceptable + 1 if self.is_acceptable else 0
            if self._acceptable >= _ACCEPTABLE_COUNT:
                return "acceptable"
        if run.iterations >= run.max_iterations:
            return "max_iterations"
        return "max_time" if time.perf_counter() - run.begin > run.max_seconds else None

    @property
    def largest_violation(self) -> float:
        """Largest violation of a row, not scaled."""
        return self.program.largest_violation(self.at.rows)

    @property
    def is_acceptable(self) -> bool:
        """Whether the iterate satisfies the conditions to the acceptable tolerance."""
        error = self.barrier.errors(self.at, self.duals, 0.0)[0]
        return max(error, self.largest_violation) <= _ACCEPTABLE

    def _update_parameter(self) -> str | None:
        """Decrease the barrier parameter if its problem is solved (section 2.1).

        Returns "failed" if steps are tiny although the parameter is at its least value.
        """
        barrier, tolerance = self.barrier, self.run.tolerance
        least = tolerance / (_ERROR + 1)
        if self.restore is not None:
            least *= min(1.0, self.program.functions.cost_scale)
        solved = lambda mu: barrier.errors(self.at, self.duals, mu)[0] <= _ERROR * mu
        while barrier.parameter > least and (solved(barrier.parameter) or self._tiny > 1):
            mu = barrier.parameter
            barrier.parameter = max(least, min(_LINEAR * mu, mu**_SUPERLINEAR))
            self.filter.reset()
            self._tiny = 0
        return "failed" if self._tiny > 1 else None

    def _step(self) -> Step | str:
        """Return the Newton step of the iterate, or the result if there is none."""
        at, barrier, program = self.at, self.barrier, self.program
        hessian, diagonal = program.hessian(at.w, self.duals.rows)
        if not np.isfinite(hessian).all():
            return "not_finite"
        terms = Terms(at, hessian, diagonal + barrier.curvature(at.w, self.duals))
        gradient = barrier.gradient(at)
        of_unknowns = gradient + program.transposed(at.matrix, self.duals.rows)
        solution = self.system.direction(terms, of_unknowns, at.rows, barrier.parameter)
        if solution is None:
            return "failed"
        d, dy = solution
        of_lower, of_upper = barrier.dual_steps(at.w, self.duals, d)
        return Step(
            at=at,
            terms=terms,
            of_unknowns=of_unknowns,
            shifts=self.system.shifts,
            d=d,
            dy=dy,
            of_lower=of_lower,
            of_upper=of_upper,
            slope=float(gradient @ d),
            length=barrier.largest_step(at.w, d),
            dual_length=barrier.largest_dual_step(self.duals, of_lower, of_upper),
        )

    def _advance(self, step: Step) -> str | None:
        """Move to the next iterate; return the result if there is none."""
        if self.restore is None:
            accepted = self.search.search(step)
        else:
            state, step, accepted = self._watchdog.take((self.at, self.duals), step)
            self.at, self.duals = state
        self._reset_filter_if_blocked()
        is_short = step.length < _SHORT_LENGTH and self.at.theta > _SHORT_THETA
        self._short = self._short + 1 if is_short else 0
        # during an attempt of the watchdog, the iterate may be one that the filter refuses; a
        # restoration must not begin there
        goes_on = self.restore is None or self._watchdog.active or self._short < _SHORT_STEPS
        if accepted is not None and goes_on:
            self._accept(step, accepted)
            return None
        if self.restore is None:
            return "failed"
        self._short = 0
        self._watchdog.stop()
        self.filter.add(self.at.theta, self.barrier.cost(self.at.w))
        return self.restore(self)

    def _accept(self, step: Step, accepted: Accepted) -> None:
        """Move by an accepted step."""
        self._tiny = self._tiny + 1 if self.search.tiny else 0
        duals = self.duals
        self.duals = Duals(
            duals.rows + accepted.length * accepted.dy,
            duals.lower + step.dual_length * step.of_lower,
            duals.upper + step.dual_length * step.of_upper,
        )
        self.at = values_at(self.program, accepted.w)
        self.duals = self.barrier.limited(self.at.w, self.duals)

    def restart(self, w: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> None:
        """Go on from other unknowns and multipliers of bounds, after a restoration."""
        self.at = values_at(self.program, w)
        self.duals = self.barrier.limited(w, Duals(self.duals.rows, lower, upper))
        self.duals = dataclasses.replace(self.duals, rows=self.least_squares())
        self.system.last_shift = 0.0

    def _reset_filter_if_blocked(self) -> None:
        """Remove the filter's pairs after steps that they alone shortened."""
        self._blocked = self._blocked + 1 if self.search.by_filter else 0
        blocked = self._blocked >= _BLOCKED and self._resets < _RESETS
        if blocked and not self._watchdog.active:
            self.filter.reset()
            self._blocked = 0
            self._resets += 1

    def least_squares(self) -> np.ndarray:
        """Return the rows' multipliers of least squared dual error, or zero if they are large.

        The system is that of section 3.6.
        """
        at, duals, program = self.at, self.duals, self.program
        zero = np.zeros(program.row_count)
        if not at.finite:
            return zero
        hessian = np.zeros(len(program.functions.hessian_row))
        terms = Terms(at, hessian, np.ones(len(at.w)))
        if self.system.factor(terms, 0.0, _REGULARIZATION) is None:
            return zero
        solution = self.system.solve(at.gradient - duals.lower + duals.upper, zero)
        if solution is None or np.abs(solution[1]).max(initial=0.0) > _LARGEST_MULTIPLIER:
            return zero
        return solution[1]
