"""The elastic restoration: nearest unknowns with less violation (section 3.3)."""

import numpy as np

from svkc.optimize.barrier import Barrier, Duals
from svkc.optimize.barrier_method import ROW_TOLERANCE, BarrierMethod
from svkc.optimize.nonlinear_program import VIOLATION_WEIGHT, ElasticProgram

# part of the violation that remains at the end, and violation at which no restoration begins
_REMAINING, _LEAST_THETA = 0.1, 1e-9
# largest multiplier of a bound after a restoration; above it all are set to 1
_LARGEST_MULTIPLIER = 1e3


def restore(method: BarrierMethod) -> str | None:
    """Move a method to a point with less violation that its filter accepts.

    Returns the method's result if there is none.
    """
    at, barrier = method.at, method.barrier
    if at.theta < _LEAST_THETA:
        return "failed"
    inner = _method(method)
    count, first = len(at.w), method.run.iterations

    def arrived(w: np.ndarray) -> bool:
        if method.run.iterations == first:
            return False
        w = w[:count]
        theta = float(np.abs(method.program.rows(w)).sum())
        small = theta <= _REMAINING * at.theta
        return small and method.filter.accepts(theta, barrier.cost(w))

    inner.arrived = arrived
    status = inner.solve()
    w = inner.at.w[:count]
    if status == "infeasible":
        if method.program.largest_violation(method.program.rows(w)) <= ROW_TOLERANCE:
            # the nearest point is feasible, but the filter refuses it
            return "failed"
        method.run.x = w[: method.program.count]
    if status != "arrived":
        return status
    of_lower, of_upper = barrier.dual_steps(at.w, method.duals, w - at.w)
    length = barrier.largest_dual_step(method.duals, of_lower, of_upper)
    lower, upper = method.duals.lower + length * of_lower, method.duals.upper + length * of_upper
    if max(lower.max(initial=0.0), upper.max(initial=0.0)) > _LARGEST_MULTIPLIER:
        lower, upper = 1.0 * barrier.has_lower, 1.0 * barrier.has_upper
    method.restart(w, lower, upper)
    return None


def _method(method: BarrierMethod) -> BarrierMethod:
    """Return the method of the restoration, at its start.

    The parts of the violation minimize the barrier cost for the unknowns of the method.
    """
    at, rows, duals, rho = method.at, method.at.rows, method.duals, VIOLATION_WEIGHT
    mu = max(method.barrier.parameter, float(np.abs(rows).max(initial=0.0)))
    program = ElasticProgram(method.program, at.w, float(np.sqrt(mu)))
    half = (mu - rho * rows) / (2 * rho)
    negative = half + np.sqrt(half**2 + mu * rows / (2 * rho))
    positive = rows + negative
    start = Duals(
        np.zeros(len(rows)),
        np.concatenate([np.minimum(rho, duals.lower), mu / positive, mu / negative]),
        np.concatenate([np.minimum(rho, duals.upper), np.zeros(2 * len(rows))]),
    )
    w = np.concatenate([at.w, positive, negative])
    return BarrierMethod(method.run, Barrier(program, mu), w, start)
