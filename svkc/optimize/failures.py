"""The exception that is raised if a solver fails."""

import numpy as np

from svkc.optimize.ipopt import SolverResult
from svkc.optimize.program import Program
from svkc.optimize.solution import OUTCOME

# rows named in the message of a run that failed
_ROWS_SHOWN = 6


def raise_on_failure(program: Program, result: SolverResult) -> None:
    """Check a solver's result.

    Raises RuntimeError if the solver failed, with the rows that are violated most.
    """
    if result.status in ("successful", "acceptable"):
        return
    words = OUTCOME[OUTCOME._name_to_item[result.status]]
    raise RuntimeError(
        f"solve: {words} After {result.iterations} iterations the largest violations are:"
        f" {violated_rows(program, result.x) or 'none'}"
    )


def violated_rows(program: Program, x: np.ndarray, tolerance: float = 1e-6) -> str:
    """Return the names of the rows that are violated most, with the amounts in SI units.

    tolerance: in the solver's units; rows with a smaller violation are left out.
    """
    violation = program.violation(x)
    order = np.argsort(-np.nan_to_num(violation, nan=np.inf))[:_ROWS_SHOWN]
    table = program.transcription.rows
    return "; ".join(
        f"{table.label(i)}: {violation[i] * table.unit[i]:.3g}"
        for i in order
        if not violation[i] <= tolerance
    )
