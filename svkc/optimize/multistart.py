"""Solutions from several starts."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from svkc.model.tables import Table, as_text
from svkc.optimize.solution import OUTCOME, Solution
from svkc.optimize.workers import solve_in_processes


class Solutions(list[Solution]):
    """A list of solutions, in the order of their guesses.

    `result` of a solution says how its run ended.
    """

    @property
    def solved(self) -> np.ndarray:
        """Mask of the solutions whose result is `successful` or `acceptable`."""
        ended = (OUTCOME.successful, OUTCOME.acceptable)
        return np.array([any(bool(s.result == code) for code in ended) for s in self], bool)

    @property
    def best(self) -> Solution | None:
        """The solution of least cost among those in `solved`; None if there are none."""
        solved = [s for s, is_solved in zip(self, self.solved, strict=True) if is_solved]
        return min(solved, key=lambda s: float(s.cost), default=None)

    def __str__(self) -> str:
        header = ("start", "cost", "violation", "iterations", "seconds", "result")
        rows = [
            (str(k), f"{float(s.cost):.6g}", f"{float(s.violation):.1e}", str(int(s.iterations)),
             f"{float(s.seconds[0]):.3g}", str(s.result))
            for k, s in enumerate(self)
        ]  # fmt: skip
        return as_text([f"{int(self.solved.sum())} of {len(self)} solved", Table(header, rows)])


def multistart(
    problem: Any, guesses: Sequence[Any], *, processes: int, solver: Any, progress_meter: Any
) -> Solutions:
    """Return the solutions that `Problem.multistart` describes."""
    if processes == 1 or len(guesses) < 2:
        options = {"solver": solver, "progress_meter": progress_meter, "throw": False}
        return Solutions(problem.solve(guess, **options) for guess in guesses)
    meter = None if progress_meter is None else [progress_meter, progress_meter.init()]

    def progress(fraction: float) -> None:
        if meter is not None:
            meter[1] = meter[0].step(meter[1], jnp.asarray(fraction))

    solutions = solve_in_processes(problem, guesses, processes, solver=solver, progress=progress)
    if meter is not None:
        meter[0].close(meter[1])
    return Solutions(solutions)
