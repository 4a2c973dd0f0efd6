"""Meshes on which a solution is a motion: intervals are added where defects are large."""

import dataclasses
from typing import Any

import numpy as np

from svkc.optimize.certificate import SolutionReport
from svkc.optimize.problem import Problem
from svkc.optimize.solution import Solution

# a velocity may err by this multiple of the tolerance of a position
VELOCITY_TOLERANCE = 10.0
# most intervals that a round puts in the place of one; and a defect, by the tolerance, below which
# intervals are joined
_MOST, _FAR_BELOW = 2.0, 0.01


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


def refine(
    solution: Solution, tol: float, rounds: int, solver: Any, progress_meter: Any
) -> Solution:
    """Return a solution whose defects are below the tolerance, or that of the last round."""
    order = 2 * solution.problem.scheme.stages - 1
    for _ in range(rounds):
        report = solution.report()
        position, velocity = report.largest()
        if position <= tol and velocity <= VELOCITY_TOLERANCE * tol:
            break
        problem = with_intervals(solution.problem, new_counts(report, order, tol))
        finer = problem.solve(solution, solver=solver, progress_meter=progress_meter)
        change = abs(float(finer.cost) - float(solution.cost))
        solution = dataclasses.replace(finer, cost_error=np.asarray(change))
    return solution


def with_intervals(problem: Problem, counts: list[int]) -> Problem:
    """Return a problem with other numbers of intervals."""
    phases = [
        dataclasses.replace(phase, intervals=n)
        for phase, n in zip(problem.phases, counts, strict=True)
    ]
    return Problem(
        problem.chain,
        phases,
        controls=problem.controls,
        running=problem.running,
        final=problem.final,
        scheme=problem.scheme,
        args=problem.args,
        units=problem.units,
        project=problem.project,
    )
