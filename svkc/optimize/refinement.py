"""Meshes on which a solution is a motion: intervals are added where defects are large."""

import numpy as np

from svkc.optimize.certificate import SolutionReport

# a velocity may err by this multiple of the tolerance of a position
VELOCITY_TOLERANCE = 10.0
# most intervals that a round puts in the place of one; and a defect, by the tolerance, below which
# intervals are joined
_MOST, _FAR_BELOW = 2.0, 0.01


def is_fine(report: SolutionReport, tol: float) -> bool:
    """Return whether all defects are below the tolerance."""
    position, velocity = report.largest()
    return position <= tol and velocity <= VELOCITY_TOLERANCE * tol


def new_counts(report: SolutionReport, order: int, tol: float) -> list[int]:
    """Return the numbers of intervals of the phases for the next mesh."""
    counts = []
    for of_q, of_v in zip(report.position, report.velocity, strict=True):
        ratio = max(float(np.max(of_q)), float(np.max(of_v)) / VELOCITY_TOLERANCE) / tol
        factor = 1.0
        if ratio > 1:
            factor = np.clip(1.1 * ratio ** (1 / order), 1.1, _MOST)
        elif ratio < _FAR_BELOW:
            factor = max(0.7, (10 * ratio) ** (1 / order))
        counts.append(max(2, int(np.ceil(factor * len(of_q)))))
    return counts
