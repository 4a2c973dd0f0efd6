"""The backflip solved by CasADi's IPOPT, the baseline of optimize.py.

`Backflip().solve(guess)` solves from a point (see `backflip`). `confirm(point)` says which cost
CasADi's IPOPT converges to from a point that another solver found.
"""

import pathlib
import re
import tempfile
import time
import typing

import backflip
import casadi as ca
import numpy as np
from backflip import (
    FIRST_INTERVAL,
    FIRST_NODE,
    FREEDOMS,
    LAST_NODE,
    PHASES,
    SHAPES,
    STAGES,
    TORQUES,
)
from backflip_sx import (
    center_of_mass,
    impact_function,
    interval_function,
    point,
    point_functions,
)

COST_UNIT, FORCE_UNIT = 1e5, 500.0
NODE_UNIT = np.repeat([1.0, 10.0, 100.0], [FREEDOMS, FREEDOMS, TORQUES])
UNITS = {"durations": 1, "x": NODE_UNIT, "u": 1e3, "a": 1e2, "f": FORCE_UNIT, "impulse": FORCE_UNIT}
DURATION_COSTS = [1000, 10, -10, 10, 100]
OPTIONS = {
    "tol": 1e-6,
    "constr_viol_tol": 1e-7,
    "mu_strategy": "monotone",
    "linear_solver": "mumps",
    "mumps_pivot_order": 2,
    "max_iter": 1000,
    "max_cpu_time": 300.0,
    "print_level": 0,
    "sb": "yes",
}
STATISTICS = {"print_timing_statistics": "yes", "file_print_level": 5}
# from a point that is nearly a solution: stay close to it
WARM = {
    "mu_init": 1e-7,
    "bound_push": 1e-9,
    "bound_frac": 1e-9,
    "bound_relax_factor": 0.0,
    "tol": 1e-9,
}


class Solve(typing.NamedTuple):
    """What a solver returns. Seconds are of the processor, but for those with `wall` in their name.

    violation: the largest of all rows and bounds, in the solver's units.
    """

    point: dict
    cost: float
    violation: float
    iterations: int
    status: str
    functions_s: float
    functions_wall_s: float
    linear_algebra_s: float
    total_s: float
    wall_s: float


def seconds(log: pathlib.Path) -> dict:
    """Return the seconds of IPOPT's own statistics, from the file of its output.

    Linear algebra is its primal-dual system: assembly, MUMPS, refinement.
    """
    labels = {
        "functions_s": "Function Evaluations",
        "linear_algebra_s": "PDSystemSolverTotal",
        "total_s": "OverallAlgorithm",
    }
    text = log.read_text()
    result = {
        name: float(re.findall(rf"{label}\.*: +([\d.]+)", text)[-1])
        for name, label in labels.items()
    }
    wall = re.findall(r"Function Evaluations\.*: .* wall: +([\d.]+)", text)[-1]
    return result | {"functions_wall_s": float(wall)}


class Rows:
    """Rows of constraints and their bounds."""

    def __init__(self):
        self.rows, self.low, self.high = [], [], []

    def add(self, rows, low=0.0, high=0.0):
        """Add rows between bounds."""
        self.rows.append(rows)
        self.low += [low] * rows.numel()
        self.high += [high] * rows.numel()

    def add_cone(self, normal, tangential, friction):
        """Bound the size of a tangential force by a part of the normal one."""
        for side in (-1, 1):
            self.add((friction * normal + side * tangential) / FORCE_UNIT, high=np.inf)


def flat(point_of: dict) -> np.ndarray:
    """Return all numbers of a point in one array."""
    return np.concatenate([np.asarray(point_of[name], float).ravel() for name in SHAPES])


def unflat(numbers: np.ndarray) -> dict:
    """Return the point of numbers in one array."""
    ends = np.cumsum([np.prod(shape) for shape in SHAPES.values()])[:-1]
    parts = np.split(numbers, ends)
    return {n: part.reshape(SHAPES[n]) for n, part in zip(SHAPES, parts, strict=True)}


def symbols(numbers: ca.SX) -> dict:
    """Return the vectors and matrices of a point: a list of nodes, intervals, ..., by name."""
    result, start = {}, 0
    for name, (count, *rest) in SHAPES.items():
        size = int(np.prod(rest))
        parts = ca.vertsplit(numbers[start : start + count * size], size)
        result[name] = [ca.reshape(x, rest[1], rest[0]) if len(rest) == 2 else x for x in parts]
        start += count * size
    return result


def parts_of(x: ca.SX) -> list:
    """Return q, v and tau of a node."""
    return ca.vertsplit(x, [0, FREEDOMS, 2 * FREEDOMS, backflip.NODE])


def add_intervals(w: dict, rows: Rows):
    """Add the rows of all intervals. Returns the integral of the cost."""
    cost = 0
    for p, phase in enumerate(PHASES):
        interval, h = interval_function(phase.connection), w["durations"][p] / phase.intervals
        for k in range(phase.intervals):
            i, n = FIRST_INTERVAL[p] + k, FIRST_NODE[p] + k
            f = w["f"][i] if phase.connection else ca.SX(0, STAGES)
            stage_rows, after, running = interval(h, w["x"][n], w["u"][i], w["a"][i], f)
            rows.add(stage_rows)
            rows.add((w["x"][n + 1] - after) / NODE_UNIT)
            cost += running
            if phase.connection == "toe":
                rows.add_cone(f[1, :].T, f[0, :].T, 0.5)
            if phase.connection == "shank":
                rows.add_cone(-f[0, :].T, f[1, :].T, 1.0)
    return cost


def add_links(w: dict, rows: Rows):
    """Add the rows between phases; torques may jump at take-off."""
    impact, points = impact_function(), point_functions()
    for p in range(1, len(PHASES)):
        q, v, tau = parts_of(w["x"][LAST_NODE[p - 1]])
        q_after, v_after, tau_after = parts_of(w["x"][FIRST_NODE[p]])
        rows.add(q_after - q)
        if PHASES[p].name == "landing":
            rows.add(impact(q, v, v_after, ca.vertcat(*w["impulse"])))
            rows.add(points["toe"](q, v_after)[1])
        else:
            rows.add((v_after - v) / NODE_UNIT[FREEDOMS])
        if PHASES[p].name == "tuck":
            for row in points["shank"](q, v):
                rows.add(row)
        if p > 1:
            rows.add((tau_after - tau) / NODE_UNIT[-1])


def add_ends(w: dict, rows: Rows):
    """Add the rows at the start, at landing and at the end. Returns the cost at points."""
    points = point_functions()
    push, take_off, landing, end = (
        parts_of(w["x"][n]) for n in (0, LAST_NODE[0], FIRST_NODE[-1], LAST_NODE[-1])
    )
    for q, _, _ in (push, landing, end):
        toe = point(q, "feet", backflip.TOE)
        rows.add(toe[1])
        rows.add(toe[0], -0.1, 0.1)
    for (q, _, _), place in ((push, backflip.UNDER_COM), (end, backflip.TOE)):
        rows.add(center_of_mass(q)[0] - point(q, "feet", place)[0])
    com, com_speed = points["com"](*end[:2])
    upward_speed = points["com"](*take_off[:2])[1][1]
    cost = 100 * (ca.sumsqr(end[1]) + ca.sumsqr(com_speed) + com[0] ** 2) - upward_speed**2
    return cost + ca.dot(ca.vertcat(*w["durations"]), ca.DM(DURATION_COSTS))


class Backflip:
    """The problem, made ready for IPOPT: `seconds` of the processor, with all derivatives."""

    def __init__(self, **options):
        started = time.process_time()
        low, high = backflip.bounds()
        self.low, self.high = flat(low), flat(high)
        self.unit = flat({n: np.broadcast_to(UNITS[n], shape) for n, shape in SHAPES.items()})
        inert = (self.low == 0) & (self.high == 0) & (self.unit == FORCE_UNIT)
        self.free = np.flatnonzero(~inert)
        z, numbers, self.rows = ca.SX.sym("z", self.free.size), ca.SX(inert.size, 1), Rows()
        numbers[self.free.tolist()] = z * ca.DM(self.unit[self.free])
        w = symbols(numbers)
        cost = add_intervals(w, self.rows) + add_ends(w, self.rows)
        add_links(w, self.rows)
        self.problem = {"x": z, "f": cost / COST_UNIT, "g": ca.vertcat(*self.rows.rows)}
        self.options, self.log = OPTIONS | options, pathlib.Path(tempfile.mkdtemp()) / "ipopt.txt"
        ipopt = self.options | STATISTICS | {"output_file": str(self.log)}
        self.ipopt = ca.nlpsol(
            "ipopt", "ipopt", self.problem, {"ipopt": ipopt, "print_time": False}
        )
        self.seconds = time.process_time() - started

    def solve(self, start: dict) -> Solve:
        """Solve from a point, moved into its bounds."""
        unit, low, high = self.unit[self.free], self.low[self.free], self.high[self.free]
        x0 = np.clip(flat(start)[self.free], low, high) / unit
        rows_low, rows_high = np.array(self.rows.low), np.array(self.rows.high)
        begin = time.perf_counter()
        solution = self.ipopt(x0=x0, lbx=low / unit, ubx=high / unit, lbg=rows_low, ubg=rows_high)
        wall = time.perf_counter() - begin
        stats, x, g = self.ipopt.stats(), *(solution[name].full().ravel() for name in "xg")
        excess = np.concatenate([rows_low - g, g - rows_high, x - high / unit, low / unit - x])
        numbers = np.zeros(self.unit.size)
        numbers[self.free] = x * unit
        return Solve(
            point=unflat(numbers),
            cost=float(solution["f"]) * COST_UNIT,
            violation=float(max(excess.max(), 0)),
            iterations=stats["iter_count"],
            status=stats["return_status"],
            wall_s=wall,
            **seconds(self.log),
        )

    def functions(self, at: dict) -> dict:
        """Return calls of the functions that IPOPT calls, at a point."""
        x = flat(at)[self.free] / self.unit[self.free]
        multipliers = np.ones(len(self.rows.low))
        rows, jacobian, hessian = (
            self.ipopt.get_function(name) for name in ("nlp_g", "nlp_jac_g", "nlp_hess_l")
        )
        return {
            "rows": lambda: rows(x, []),
            "Jacobian": lambda: jacobian(x, []),
            "Hessian": lambda: hessian(x, [], 1.0, multipliers),
        }


def confirm(point_of: dict) -> Solve:
    """Return what CasADi's IPOPT converges to from a point that is nearly a solution."""
    return Backflip(**WARM).solve(point_of)
