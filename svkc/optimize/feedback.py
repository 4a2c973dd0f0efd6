"""Time-varying LQR: feedback gains along a solution, and the growth of errors without feedback."""

from typing import Any

import numpy as np

from svkc.optimize.guesses import PhaseMotion
from svkc.optimize.linearization import LinearMaps
from svkc.optimize.plans import driven_coordinates

# weight of squared torques; that of squared errors is 1. Both are in the problem's units
EFFORT = 0.01


def error_units(problem: Any) -> np.ndarray:
    """Return the units [2 nv] of errors: 1 for positions (rad, m), then that of velocities."""
    nv = problem.chain.nv
    return np.concatenate([np.ones(nv), np.full(nv, problem.units.velocity)])


def riccati_gains(problem: Any, motion: tuple[PhaseMotion, ...], maps: LinearMaps) -> np.ndarray:
    """Return the time-varying LQR gains [N 2 driven 2nv] at both ends of each interval.

    The backward Riccati recursion minimizes, for the linearized motion, the integral of the squared
    errors plus `EFFORT` times the squared torques, plus the squared errors at the end times 1 s.
    Errors and torques are in the problem's units. The part of a velocity error that violates
    connected links is projected out first, as `svkc.connect` does.
    """
    steps = np.concatenate([np.diff(m.times) for m in motion])
    Q = np.diag(error_units(problem) ** -2.0)
    driven = len(driven_coordinates(problem))
    R = np.eye(driven) * EFFORT / problem.units.torque**2
    gains, P = np.zeros((len(steps), driven, len(Q))), Q
    for k in range(len(steps) - 1, -1, -1):
        A, B = maps.A[k], maps.B[k]
        K = np.linalg.solve(steps[k] * R + B.T @ P @ B, B.T @ P @ A)
        P = steps[k] * Q + A.T @ P @ (A - B @ K)
        P = maps.before[k].T @ (P + P.T) / 2 @ maps.before[k]
        gains[k] = K @ maps.after[k]
    # gains are linear between nodes, and constant over the last interval of a phase
    next_interval = np.append(np.arange(1, len(steps)), len(steps) - 1)
    lasts = np.cumsum([len(m.vdot) for m in motion]) - 1
    next_interval[lasts] = lasts
    return np.stack([gains, gains[next_interval]], 1)


def growth(problem: Any, motion: tuple[PhaseMotion, ...], maps: LinearMaps) -> np.ndarray:
    """Return the largest factors [phases] by which each phase multiplies an error without feedback.

    They are 2-norms of the phases' linear maps, with errors in the problem's units.
    """
    units, first, factors = error_units(problem), 0, []
    for m in motion:
        total = maps.after[first]
        for k in range(first, first + len(m.vdot)):
            total = maps.A[k] @ total
        factors.append(np.linalg.norm(total * units / units[:, None], 2))
        first += len(m.vdot)
    return np.array(factors)
