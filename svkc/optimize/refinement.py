"""Mesh refinement: intervals with large defects are split, those with small ones are joined."""

import dataclasses
from typing import Any

import numpy as np

from svkc.optimize.certificate import SolutionReport

# tolerance of defects in velocity, as a multiple of the tolerance in position
VELOCITY_TOLERANCE = 10.0
# largest number of intervals that one is split into, the defect that is aimed at, and the largest
# predicted defect of two joined intervals; defects are relative to the tolerance
_MOST, _BELOW, _JOINED = 4, 0.5, 0.05


def is_fine(report: SolutionReport, tol: float) -> bool:
    """Return whether all defects are below the tolerance."""
    position, velocity = report.largest()
    return position <= tol and velocity <= VELOCITY_TOLERANCE * tol


def new_mesh(places: np.ndarray, defects: np.ndarray, order: int) -> np.ndarray:
    """Return the nodes of a phase's next mesh, as fractions of the duration.

    Intervals with a defect above the tolerance are split into equal parts. Two neighbours with
    defects far below the tolerance are joined. The defect of an interval is assumed proportional to
    its length to the power of order + 1.

    places: [n + 1] nodes of the mesh, as fractions of the duration.
    defects: [n] defects of the intervals, divided by the tolerance.
    order: order of the scheme.
    """
    parts = np.ceil((defects / _BELOW) ** (1 / order))
    parts = np.where(defects > 1, np.clip(parts, 2, _MOST), 1).astype(int)
    kept, k = [places[0]], 0
    while k < len(defects):
        pair = slice(k, k + 2)
        length = (places[min(k + 2, len(defects))] - places[k]) / np.min(np.diff(places)[pair])
        joined = np.max(defects[pair]) * length ** (order + 1)
        if len(defects[pair]) == 2 and joined < _JOINED and len(defects) > 2:
            kept.append(places[k + 2])
            k += 2
        else:
            kept.extend(np.linspace(places[k], places[k + 1], parts[k] + 1)[1:])
            k += 1
    return np.array(kept)


def refined(problem: Any, solution: Any, tol: float, rounds: int, options: dict[str, Any]) -> Any:
    """Return the solution that `Solution.refined` describes.

    tol, rounds: as of `Solution.refined`. options: keyword arguments of `Problem.solve`.
    """
    order = 2 * problem.scheme.stages - 1
    for _ in range(rounds):
        report = solution.report(replay=False)
        if is_fine(report, tol):
            break
        defects = (
            np.maximum(of_q, of_v / VELOCITY_TOLERANCE) / tol
            for of_q, of_v in zip(report.position, report.velocity, strict=True)
        )
        phases = solution.problem.phases
        meshes = [
            new_mesh(p.node_fractions, x, order) for p, x in zip(phases, defects, strict=True)
        ]
        finer = problem.with_mesh(meshes).solve(solution, **options)
        change = abs(float(finer.cost) - float(solution.cost))
        solution = dataclasses.replace(finer, cost_error=np.asarray(change))
    return solution
