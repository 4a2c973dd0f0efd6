"""The interior-point solver of svkc, which needs no wheel of IPOPT. Experimental."""

import dataclasses
import time
from collections.abc import Callable

import numpy as np

from svkc.model.annotations import Integer, Scalar
from svkc.model.validation import integer, positive_scalar
from svkc.optimize.barrier import PUSH, Barrier, Duals, interior
from svkc.optimize.barrier_method import BarrierMethod, Run
from svkc.optimize.ipopt import AbstractSolver, SolverResult
from svkc.optimize.newton_system import newton_matrix
from svkc.optimize.nonlinear_program import Functions, SlackProgram
from svkc.optimize.program import Program
from svkc.optimize.restoration import restore

# barrier parameters at the start: cold, warm without multipliers, warm
_COLD, _WARM_PRIMAL, _WARM = 0.1, 1e-4, 1e-6
# distances to bounds of warm starts, without multipliers and with them
_PUSH_PRIMAL, _PUSH_WARM = 1e-4, 1e-8
# least multiplier of a bound at the start
_LEAST_MULTIPLIER = 1e-8


@dataclasses.dataclass(frozen=True)
class InteriorPoint(AbstractSolver):
    """An interior-point solver in numpy and scipy. It needs no wheel of IPOPT. Experimental.

    The method is that of Waechter and Biegler (2006), "On the implementation of an interior-point
    filter line-search algorithm for large-scale nonlinear programming": a barrier parameter that
    only decreases (section 2.1), steps within a fraction of the boundary (2.2), a filter line
    search (2.3) with second-order correction (2.4), corrected inertia (3.1), a filter that is reset
    (3.2), and an elastic restoration (3.3). A watchdog tries full steps after shortened ones. The
    linear systems are chains of dense blocks, one for each interval, with a border for durations
    and free args. LAPACK factors the blocks as L D L^T, which gives the inertia. A matrix with a
    singular block counts as singular.

    A warm start begins from the unknowns and multipliers of the solution, with the barrier
    parameter 1e-6. On another mesh there are no multipliers; then the barrier parameter is 1e-4.

    max_iterations: largest number of iterations, those of restorations included.
    max_seconds: largest wall time (s).
    tolerance: tolerance of the scaled optimality conditions; `tol` of IPOPT.

    Raises ValueError for wrong limits, and if rows of a large problem couple intervals that are
    not neighbours.
    """

    max_iterations: Integer = 1000
    max_seconds: Scalar = 600.0
    tolerance: Scalar = 1e-8

    def __post_init__(self) -> None:
        integer("max_iterations", self.max_iterations, 1)
        positive_scalar("max_seconds", self.max_seconds)
        positive_scalar("tolerance", self.tolerance)

    def solve(
        self, program: Program, start: SolverResult, warm: bool, progress: Callable[[float], None]
    ) -> SolverResult:
        begin, functions = time.perf_counter(), Functions(program, start.x)
        n = len(functions.free)
        run = Run(
            tolerance=float(self.tolerance),
            max_iterations=int(self.max_iterations),
            max_seconds=float(self.max_seconds),
            matrix=newton_matrix(functions),
            progress=progress,
            x=functions.start,
            duals=Duals(np.zeros(len(functions.solver_rows)), np.zeros(n), np.zeros(n)),
            begin=begin,
        )
        try:
            # functions may overflow at trial points, which are then refused
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
                status = _method(functions, run, start, warm).solve()
        except KeyboardInterrupt:
            status = "interrupted"
        lower, upper = np.zeros(program.count), np.zeros(program.count)
        lower[functions.free] = run.duals.lower[:n] / functions.cost_scale
        upper[functions.free] = run.duals.upper[:n] / functions.cost_scale
        multipliers = np.zeros(program.cost_row)
        multipliers[functions.solver_rows] = (
            run.duals.rows * functions.row_scale / functions.cost_scale
        )
        return SolverResult(
            x=functions.all_unknowns(np.clip(run.x, functions.lower, functions.upper)),
            multipliers=multipliers,
            lower=lower,
            upper=upper,
            status=status,
            iterations=run.iterations,
            seconds=time.perf_counter() - begin,
            functions=functions.seconds,
        )


def _method(functions: Functions, run: Run, start: SolverResult, warm: bool) -> BarrierMethod:
    """Return the method at its start (section 3.6)."""
    known = warm and bool(start.multipliers.any() or start.lower.any() or start.upper.any())
    parameter, push = (_WARM_PRIMAL, _PUSH_PRIMAL) if warm else (_COLD, PUSH)
    if known:
        parameter, push = _WARM, _PUSH_WARM
    x = functions.start
    functions.scale(interior(x, functions.lower, functions.upper, push))
    program = SlackProgram(functions)
    n, barrier = program.count, Barrier(program, parameter)
    x = interior(x, program.lower[:n], program.upper[:n], push)
    slacks = functions.rows(x)[program.slack_row]
    w = interior(np.concatenate([x, slacks]), program.lower, program.upper, push)
    if known:
        duals = _scaled_duals(barrier, start)
        return BarrierMethod(run, barrier, w, barrier.limited(w, duals), restore=restore)
    low, high = barrier.gaps(w) if warm else (parameter, parameter)
    zero = np.zeros(program.row_count)
    duals = Duals(zero, parameter / low * barrier.has_lower, parameter / high * barrier.has_upper)
    method = BarrierMethod(run, barrier, w, duals, restore=restore)
    method.duals = dataclasses.replace(duals, rows=method.least_squares())
    return method


def _scaled_duals(barrier: Barrier, start: SolverResult) -> Duals:
    """Return the multipliers of a start, scaled as the program, with those of the slacks."""
    program, functions = barrier.program, barrier.program.functions
    scale = functions.cost_scale
    rows = start.multipliers[functions.solver_rows] * scale / functions.row_scale
    of_slacks = rows[program.slack_row]
    lower = np.concatenate([start.lower[functions.free] * scale, np.maximum(-of_slacks, 0)])
    upper = np.concatenate([start.upper[functions.free] * scale, np.maximum(of_slacks, 0)])
    at_least = lambda values: np.maximum(values, _LEAST_MULTIPLIER)
    return Duals(rows, at_least(lower) * barrier.has_lower, at_least(upper) * barrier.has_upper)
