"""Meshes on which a solution is a motion: intervals with large defects are split."""

import dataclasses
from typing import Any

import numpy as np

from svkc.optimize.certificate import SolutionReport

# a velocity may err by this multiple of the tolerance of a position
VELOCITY_TOLERANCE = 10.0
# most intervals that a round puts in the place of one, by how much a new defect is to be below the
# tolerance, and the defect that two joined intervals may be expected to have
_MOST, _BELOW, _JOINED = 4, 0.5, 0.05


def is_fine(report: SolutionReport, tol: float) -> bool:
    """Return whether all defects are below the tolerance."""
    position, velocity = report.largest()
    return position <= tol and velocity <= VELOCITY_TOLERANCE * tol


def new_mesh(places: np.ndarray, defects: np.ndarray, order: int) -> np.ndarray:
    """Return the nodes of a phase's next mesh, as fractions of the duration.

    Intervals with a defect above the tolerance are split into equal parts; two neighbours with
    defects far below it are joined.

    places: [n + 1] nodes. defects: [n] of the intervals, by the tolerance.
    order: of the scheme; the defect of an interval falls with its length to the power of order + 1.
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

    problem: of the solution. tol, rounds: as there. options: of `Problem.solve`.
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
