"""Checks of a problem at a guess, before it is solved."""

import dataclasses

import numpy as np

from svkc._jax.pytrees import is_concrete
from svkc.model.chain import Chain
from svkc.model.tables import Table, as_text
from svkc.optimize.program import Program

_ROWS_SHOWN = 12
# largest violation of a row whose unknowns are all fixed, in the solver's units
_FIXED_VIOLATION = 1e-6


@dataclasses.dataclass(frozen=True)
class Check:
    """Size, derivatives, units and violations of a problem at a guess.

    unknowns, rows: numbers of unknowns and of constraint rows.
    jacobian, hessian: numbers of entries of the sparsity patterns.
    derivative_error: largest error of the Jacobian times a random direction, against central
        differences of the rows, relative to the largest value.
    hessian_error: largest error of the Hessian of the Lagrangian times a random direction, against
        central differences of its gradient, relative to the largest value.
    cost: cost at the guess.
    units: units by which the solver divides.
    violated: (name, amount in SI units) of the rows that the guess violates most.
    """

    unknowns: int
    rows: int
    jacobian: int
    hessian: int
    derivative_error: float
    hessian_error: float
    cost: float
    units: str
    violated: tuple[tuple[str, float], ...]

    def __str__(self) -> str:
        words = (
            f"{self.unknowns} unknowns, {self.rows} rows; {self.jacobian} entries of the Jacobian,"
            f" {self.hessian} of the Hessian",
            f"derivatives against differences: {self.derivative_error:.1e},"
            f" {self.hessian_error:.1e} (second)",
            f"units: {self.units}",
            f"cost at the guess: {self.cost:.6g}",
        )
        rows = [(name, f"{amount:.3g}") for name, amount in self.violated]
        return as_text([*words, Table(("violated most", "by"), rows)])


def check_passive_links(chain: Chain) -> None:
    """Raise ValueError if a virtual link has a spring, a damper or a joint range.

    A motion over phases has no coordinates of virtual links, and so none of these forces.
    """
    for what in ("stiffness", "damping", "limit_spring"):
        values = getattr(chain, what)
        if values is None or not is_concrete(values):
            continue
        acts = np.any(np.atleast_2d(values)[:, chain.nv :], 0)
        if np.any(acts):
            name = chain.dof_names[chain.nv + int(np.argmax(acts))]
            raise ValueError(
                f"chain: virtual link {name!r} has a spring, a damper or a joint range, which"
                " motions over phases leave out; load the model without this cuttable joint, or"
                " without these in its MJCF"
            )


def check_finite(program: Program, x: np.ndarray) -> None:
    """Check a problem at x, in the solver's units.

    Raises ValueError, with the name of the row, if a row, the cost or a derivative is not finite,
    or if a row of fixed unknowns alone is violated.
    """
    values, table = program.rows(x), program.transcription.rows
    label = lambda row: "the cost" if row == program.cost_row else table.label(row)
    if not np.isfinite(values).all():
        row = int(np.argmin(np.isfinite(values)))
        raise ValueError(f"at the guess {label(row)} is {values[row]}")
    entries = program.jacobian(x)
    if not np.isfinite(entries).all():
        row = int(program.jacobian_entries.row[np.argmin(np.isfinite(entries))])
        raise ValueError(f"at the guess the derivative of {label(row)} is not finite")
    fixed = np.setdiff1d(np.arange(program.cost_row), program.solver_rows)
    violation = program.violation(x)[fixed]
    if np.any(violation > _FIXED_VIOLATION):
        row = int(fixed[np.argmax(violation)])
        raise ValueError(f"{label(row)} depends on fixed unknowns alone, which do not satisfy it")


def check(program: Program, x: np.ndarray) -> Check:
    """Return the `Check` of a problem at x, in the solver's units. Raises as `check_finite`."""
    check_finite(program, x)
    random, step = np.random.default_rng(0), 1e-6
    lower, upper, _, _ = program.bounds()
    # entries are found at the values of the fixed unknowns, so that others may be missing elsewhere
    direction = random.normal(size=program.count) * (lower < upper)
    multipliers = random.normal(size=program.cost_row + 1)
    first, second = program.jacobian_entries, program.hessian_entries

    def along(values):
        return np.bincount(first.row, values * direction[first.column], program.cost_row + 1)

    def gradient(x):
        values = program.jacobian(x)
        return np.bincount(first.column, values * multipliers[first.row], program.count)

    H = program.hessian(x, multipliers)
    product = np.bincount(second.row, H * direction[second.column], program.count)
    off = second.row != second.column
    product += np.bincount(second.column[off], (H * direction[second.row])[off], program.count)
    ends = x + step * direction, x - step * direction
    differences = (program.rows(ends[0]) - program.rows(ends[1])) / (2 * step)
    of_gradients = (gradient(ends[0]) - gradient(ends[1])) / (2 * step)
    error = lambda exact, other: float(np.max(np.abs(exact - other)) / np.max(np.abs(exact)))
    violation, table = program.violation(x), program.transcription.rows
    worst = [i for i in np.argsort(-violation)[:_ROWS_SHOWN] if violation[i] > 0]
    return Check(
        unknowns=program.count,
        rows=program.cost_row,
        jacobian=len(first.row),
        hessian=len(second.row),
        derivative_error=error(along(program.jacobian(x)), differences),
        hessian_error=error(product, of_gradients),
        cost=float(program.rows(x)[-1] * program.row_unit[-1]),
        units=str(program.transcription.builder.units),
        violated=tuple((table.label(i), float(violation[i] * table.unit[i])) for i in worst),
    )
