"""IPOPT as the solver, through the wheel of cyipopt or through CasADi."""

import abc
import dataclasses
import importlib
import importlib.util
import os
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from svkc.model.annotations import Checked, Integer, Scalar
from svkc.model.validation import integer, positive_scalar
from svkc.optimize.program import Program

INSTALL = "pip install 'svkc[optimize]'"
# results of `Solution` by IPOPT's return codes; other codes: "failed"
STATUS = {
    0: "successful",
    1: "acceptable",
    2: "infeasible",
    5: "interrupted",
    -1: "max_iterations",
    -4: "max_time",
    -5: "max_time",
    -13: "not_finite",
}
# results of `Solution` by CasADi's names of these codes
CASADI_STATUS = {
    "Solve_Succeeded": "successful",
    "Solved_To_Acceptable_Level": "acceptable",
    "Infeasible_Problem_Detected": "infeasible",
    "User_Requested_Stop": "interrupted",
    "Maximum_Iterations_Exceeded": "max_iterations",
    "Maximum_CpuTime_Exceeded": "max_time",
    "Maximum_WallTime_Exceeded": "max_time",
    "Invalid_Number_Detected": "not_finite",
}


@dataclasses.dataclass
class SolverResult:
    """Unknowns and multipliers in the solver's units: the start of a solver, or its result.

    x: unknowns. multipliers: of the rows. lower, upper: of the unknowns' bounds.
    status: name of the `OUTCOME`. iterations: number of iterations.
    seconds: wall time of the solver. functions: part of this time in rows and derivatives (s).
    """

    x: np.ndarray
    multipliers: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    status: str = ""
    iterations: int = 0
    seconds: float = 0.0
    functions: float = 0.0


class AbstractSolver(abc.ABC):
    """Base class of solvers."""

    @abc.abstractmethod
    def solve(
        self, program: Program, start: SolverResult, warm: bool, progress: Callable[[float], None]
    ) -> SolverResult:
        """Return the solution from a start.

        warm: whether the start is near a solution.
        progress: called with the number of iterations as a fraction of the largest number.
        """


class Callbacks:
    """The functions that IPOPT calls, with the names that cyipopt expects.

    Rows and the Jacobian are cached for the last x: cost and constraints are computed together. The
    first exception in a function, or Ctrl-C, is stored and ends the run at the next iteration.
    """

    def __init__(self, program: Program, progress: Callable[[float], None], iterations: int):
        self.program = program
        self.progress = progress
        self.limit: int = iterations
        entries = program.jacobian_entries
        self.of_rows: np.ndarray = np.isin(entries.row, program.solver_rows)
        self.of_cost: np.ndarray = entries.row == program.cost_row
        self.columns: np.ndarray = entries.column[self.of_cost]
        self.exception: BaseException | None = None
        self.iterations: int = 0
        self.functions: float = 0.0
        self._cache: dict[str, tuple[np.ndarray, np.ndarray]] = {}

    def _at(self, name: str, x: np.ndarray, *others: Any) -> np.ndarray:
        """Return the value of a method of the program at x, from the cache if possible."""
        cached = self._cache.get(name)
        if cached is not None and not others and np.array_equal(cached[0], x):
            return cached[1]
        start = time.perf_counter()
        try:
            value = getattr(self.program, name)(np.asarray(x), *others)
        except BaseException as error:  # raised again after the run; IPOPT swallows exceptions
            self.exception = self.exception or error
            value = np.full(self.program.length(name), np.nan)
        self.functions += time.perf_counter() - start
        self._cache[name] = np.array(x), value
        return value

    def bounds(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        low, high, *of_rows = self.program.bounds()
        row_low, row_high = (x[self.program.solver_rows] for x in of_rows)
        return low, high, row_low, row_high

    def objective(self, x: np.ndarray) -> float:
        return float(self._at("rows", x)[-1])

    def constraints(self, x: np.ndarray) -> np.ndarray:
        return self._at("rows", x)[self.program.solver_rows]

    def gradient(self, x: np.ndarray) -> np.ndarray:
        values = self._at("jacobian", x)[self.of_cost]
        return np.bincount(self.columns, values, self.program.count)

    def jacobianstructure(self) -> tuple[np.ndarray, np.ndarray]:
        entries = self.program.jacobian_entries
        rows = np.searchsorted(self.program.solver_rows, entries.row[self.of_rows])
        return rows, entries.column[self.of_rows]

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        return self._at("jacobian", x)[self.of_rows]

    def hessianstructure(self) -> tuple[np.ndarray, np.ndarray]:
        return self.program.hessian_entries.row, self.program.hessian_entries.column

    def hessian(self, x: np.ndarray, multipliers: np.ndarray, factor: float) -> np.ndarray:
        return self._at("hessian", x, np.append(self.all_rows(multipliers), factor))

    def all_rows(self, values: np.ndarray) -> np.ndarray:
        """Return values of the solver's rows as values of all rows, zero for the others."""
        out = np.zeros(self.program.cost_row)
        out[self.program.solver_rows] = values
        return out

    def intermediate(self, _mode: int, iteration: int, *_rest: float | int) -> bool:
        self.iterations = int(iteration)
        try:
            self.progress(min(self.iterations / self.limit, 1.0))
        except BaseException as error:
            self.exception = self.exception or error
        return self.exception is None


def _import(name: str) -> Any:
    """Return the module cyipopt or casadi. Raises ImportError with the command that installs it."""
    # several threads for small dense blocks cost more time than they save
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ImportError(f"optimize needs IPOPT: {INSTALL}") from error


@dataclasses.dataclass(frozen=True)
class Ipopt(AbstractSolver):
    """The interior-point solver IPOPT, with exact sparse Jacobian and Hessian.

    max_iterations: largest number of iterations.
    max_seconds: largest wall time (s).
    tolerance: tolerance of the scaled optimality conditions; `tol` of IPOPT.
    backend: "cyipopt" (extra `optimize`), or "casadi" (the IPOPT inside CasADi). None: CasADi where
        it is installed, because its linear algebra is faster.
    options: further options of IPOPT, by name.

    Raises ValueError for wrong limits or an unknown backend.
    """

    max_iterations: Integer = 1000
    max_seconds: Scalar = 600.0
    tolerance: Scalar = 1e-8
    backend: Checked[str | None] = None
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        integer("max_iterations", self.max_iterations, 1)
        positive_scalar("max_seconds", self.max_seconds)
        positive_scalar("tolerance", self.tolerance)
        if self.backend not in (None, "cyipopt", "casadi"):
            raise ValueError(f"backend: got {self.backend!r}, expected 'cyipopt' or 'casadi'")

    def _options(self, warm: bool) -> dict[str, Any]:
        options: dict[str, Any] = {
            "max_iter": int(self.max_iterations),
            "max_wall_time": float(self.max_seconds),
            "tol": float(self.tolerance),
            # absolute violation of rows, before the scaling of IPOPT
            "constr_viol_tol": 1e-7,
            "print_level": 0,
            "sb": "yes",
            "mumps_mem_percent": 200,
            "honor_original_bounds": "yes",
            # NaN in a matrix would crash MUMPS
            "check_derivatives_for_naninf": "yes",
        }
        if warm:
            options |= {
                "warm_start_init_point": "yes",
                "mu_strategy": "monotone",
                "mu_init": 1e-6,
                "warm_start_bound_push": 1e-8,
                "warm_start_mult_bound_push": 1e-8,
                "warm_start_slack_bound_push": 1e-8,
                "warm_start_bound_frac": 1e-8,
                "warm_start_slack_bound_frac": 1e-8,
            }
        return options | dict(self.options)

    def solve(
        self, program: Program, start: SolverResult, warm: bool, progress: Callable[[float], None]
    ) -> SolverResult:
        backend = self.backend
        if backend is None:
            backend = "casadi" if importlib.util.find_spec("casadi") else "cyipopt"
        callbacks = Callbacks(program, progress, int(self.max_iterations))
        run = _by_casadi if backend == "casadi" else _by_cyipopt
        begin, iterations = time.perf_counter(), 0
        for strategy in ("adaptive", "monotone"):
            options = {"mu_strategy": strategy} | self._options(warm)
            x, multipliers, lower, upper, status = run(callbacks, options, start)
            iterations += callbacks.iterations
            # the second strategy often converges where the first one fails
            if status not in ("infeasible", "failed") or "mu_strategy" in self._options(warm):
                break
        seconds = time.perf_counter() - begin
        if isinstance(callbacks.exception, KeyboardInterrupt):
            status = "interrupted"
        elif callbacks.exception is not None:
            raise callbacks.exception
        return SolverResult(
            x=x,
            multipliers=callbacks.all_rows(multipliers),
            lower=lower,
            upper=upper,
            status=status,
            iterations=iterations,
            seconds=seconds,
            functions=callbacks.functions,
        )


def _by_cyipopt(callbacks: Callbacks, options: dict[str, Any], start: SolverResult) -> tuple:
    """Return (x, multipliers, lower, upper, status) of a run of cyipopt."""
    cyipopt = _import("cyipopt")
    low, high, row_low, row_high = callbacks.bounds()
    problem = cyipopt.Problem(
        n=len(low), m=len(row_low), problem_obj=callbacks, lb=low, ub=high, cl=row_low, cu=row_high
    )
    # the wheel of cyipopt has no METIS; its other orderings are slower than number 2
    for name, value in ({"mumps_pivot_order": 2} | options).items():
        problem.add_option(name, value)
    of_rows = start.multipliers[callbacks.program.solver_rows]
    multipliers = {"lagrange": of_rows, "zl": start.lower, "zu": start.upper}
    x, info = problem.solve(start.x, **multipliers)
    status = STATUS.get(info["status"], "failed")
    return x, info["mult_g"], info["mult_x_L"], info["mult_x_U"], status


def _by_casadi(callbacks: Callbacks, options: dict[str, Any], start: SolverResult) -> tuple:
    """Return (x, multipliers, lower, upper, status) of a run of the IPOPT in CasADi."""
    from svkc.optimize.casadi_functions import iteration_callback, nlp_functions

    casadi, program = _import("casadi"), callbacks.program
    functions, progress = nlp_functions(casadi, callbacks), iteration_callback(casadi, callbacks)
    low, high, row_low, row_high = callbacks.bounds()
    solver = casadi.nlpsol(
        "solver",
        "ipopt",
        functions["nlp"],
        {name: f for name, f in functions.items() if name != "nlp"}
        | {
            "print_time": False,
            "no_nlp_grad": True,
            "calc_lam_p": False,
            "ipopt": options,
            "error_on_fail": False,
            "iteration_callback": progress,
        },
    )
    result = solver(
        x0=start.x, lbx=low, ubx=high, lbg=row_low, ubg=row_high,
        lam_x0=start.upper - start.lower, lam_g0=start.multipliers[program.solver_rows],
    )  # fmt: skip
    x, of_rows, of_x = (np.array(result[name]).ravel() for name in ("x", "lam_g", "lam_x"))
    callbacks.iterations = int(solver.stats()["iter_count"])
    status = CASADI_STATUS.get(solver.stats()["return_status"], "failed")
    return x, of_rows, np.maximum(-of_x, 0), np.maximum(of_x, 0), status
