"""Feedback to the plan of a solution: gains over time from Riccati's recursion."""

from typing import Any

import numpy as np

from svkc.optimize.guesses import PhaseMotion
from svkc.optimize.linearization import LinearMaps
from svkc.optimize.plans import driven_coordinates

# weight of torques beside that of errors, both in the problem's units
EFFORT = 0.01


def error_units(problem: Any) -> np.ndarray:
    """Return the units [2 nv] of errors: 1 (rad, m), and the unit of velocities."""
    nv = problem.chain.nv
    return np.concatenate([np.ones(nv), np.full(nv, problem.units.velocity)])


def riccati_gains(problem: Any, motion: tuple[PhaseMotion, ...], maps: LinearMaps) -> np.ndarray:
    """Return the gains at both ends of each interval [N 2 driven 2nv].

    They minimize, to first order, the integral of the squared errors and of `EFFORT` times the
    squared torques, both in the problem's units, plus the squared errors at the end times 1 s. An
    error that links do not admit is first projected as `svkc.connect` does.
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
    # linear between nodes, and held over the last interval of a phase
    following = np.append(np.arange(1, len(steps)), len(steps) - 1)
    lasts = np.cumsum([len(m.vdot) for m in motion]) - 1
    following[lasts] = lasts
    return np.stack([gains, gains[following]], 1)


def growth(problem: Any, motion: tuple[PhaseMotion, ...], maps: LinearMaps) -> np.ndarray:
    """Return by which factor each phase multiplies an error without feedback, at most [phases].

    Errors are measured in the problem's units.
    """
    units, first, factors = error_units(problem), 0, []
    for m in motion:
        total = maps.after[first]
        for k in range(first, first + len(m.vdot)):
            total = maps.A[k] @ total
        factors.append(np.linalg.norm(total * units / units[:, None], 2))
        first += len(m.vdot)
    return np.array(factors)
