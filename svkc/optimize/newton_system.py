"""The linear system of a Newton step of the barrier problem, with corrected inertia."""

import dataclasses

import numpy as np

from svkc.optimize.barrier import Evaluation
from svkc.optimize.block_chain import BlockChain
from svkc.optimize.nonlinear_program import Functions, SlackProgram

# constants of Algorithm IC: first, least and largest shift; factors of its growth and decrease
_FIRST, _LEAST, _LARGEST = 1e-4, 1e-20, 1e40
_FIRST_GROWTH, _GROWTH, _DECREASE = 100.0, 8.0, 3.0
_ROW_SHIFT, _ROW_EXPONENT = 1e-8, 0.25
# iterative refinement: largest number of solves, goal, and largest accepted residual
_SOLVES, _GOAL, _LARGEST_RESIDUAL = 6, 1e-10, 1e-5


def interval_groups(functions: Functions) -> np.ndarray:
    """Return the group of each free unknown and then of each row; -1: the border.

    A group has the unknowns of one node and of the interval that starts there. A row belongs to the
    last group of its unknowns. Durations, times, kept gaps and free args are the border.
    """
    group, first = np.full(functions.program.count, -1), 0
    for of_phase in functions.program.transcription.indices:
        nodes = first + np.arange(len(of_phase.nodes))
        for indices, groups in (
            (of_phase.nodes, nodes),
            (of_phase.vdot, nodes[:-1]),
            (of_phase.blocks, nodes[:-1]),
            (of_phase.forces, nodes[:-1]),
            (of_phase.projection_q, nodes[1:]),
            (of_phase.projection_v, nodes[1:]),
            (of_phase.impulse[None], nodes[:1]),
        ):
            lanes = groups.reshape(-1, *[1] * (indices.ndim - 1))
            exists = indices >= 0
            group[indices[exists]] = np.broadcast_to(lanes, indices.shape)[exists]
        first = int(nodes[-1]) + 1
    of_unknowns = group[functions.free]
    of_rows = np.full(len(functions.solver_rows), -1)
    np.maximum.at(of_rows, functions.row, of_unknowns[functions.column])
    return np.concatenate([of_unknowns, of_rows])


def newton_matrix(functions: Functions) -> BlockChain:
    """Return the solver of systems with the Hessian, a diagonal, and the Jacobian below them."""
    n, diagonal = len(functions.free), np.arange(len(functions.free) + len(functions.solver_rows))
    row = np.concatenate([functions.hessian_row, n + functions.row, diagonal])
    column = np.concatenate([functions.hessian_column, functions.column, diagonal])
    return BlockChain(interval_groups(functions), row, column)


@dataclasses.dataclass(frozen=True)
class Terms:
    """Terms of the system: at values, entries of the Hessian by x, and a diagonal by w."""

    at: Evaluation
    hessian: np.ndarray
    diagonal: np.ndarray


class NewtonSystem:
    """The system [W + shift, A'; A, -row_shift] (d, dy) = -(of_unknowns, of_rows) (equation 13).

    Slacks are eliminated, because their part of W is a diagonal.

    program: the program. matrix: of `newton_matrix`.
    shifts: (shift, row_shift) of the last direction. last_shift: last shift above zero.
    """

    def __init__(self, program: SlackProgram, matrix: BlockChain):
        self.program = program
        self._matrix = matrix
        self._below = program.functions.hessian_row != program.functions.hessian_column
        self.shifts: tuple[float, float] = (0.0, 0.0)
        self.last_shift: float = 0.0

    def factor(self, terms: Terms, shift: float, row_shift: float) -> int | None:
        """Factor the system; return its number of negative eigenvalues, or None if singular."""
        program = self.program
        shifted = terms.diagonal + shift
        self._terms, self._of_x = terms, shifted[: program.count]
        self._of_slacks = shifted[program.count :]
        of_rows = program.of_slacks(program.slack_sign**2 / self._of_slacks)
        self._of_rows = row_shift + of_rows
        diagonal = np.concatenate([self._of_x, -self._of_rows])
        return self._matrix.factor(np.concatenate([terms.hessian, terms.at.jacobian, diagonal]))

    def _product(self, solution: np.ndarray) -> np.ndarray:
        """Return the matrix, without slacks, times a vector."""
        functions, jacobian = self.program.functions, self._terms.at.matrix
        count, below = self.program.count, self._below
        x, y = solution[:count], solution[count:]
        row, column, entries = functions.hessian_row, functions.hessian_column, self._terms.hessian
        of_x = np.bincount(row, entries * x[column], count)
        mirrored = np.bincount(column[below], entries[below] * x[row[below]], count)
        of_x = of_x + mirrored + self._of_x * x + jacobian.T @ y
        return np.concatenate([of_x, jacobian @ x - self._of_rows * y])

    def solve(self, of_unknowns: np.ndarray, of_rows: np.ndarray) -> tuple | None:
        """Return (d, dy) for the system that was factored last, by iterative refinement.

        Returns None if the residual remains large.
        """
        program, count = self.program, self.program.count
        slacks = program.slack_sign * of_unknowns[count:] / self._of_slacks
        right = -np.concatenate([of_unknowns[:count], of_rows - program.of_slacks(slacks)])
        largest = lambda x: float(np.abs(x).max(initial=0.0))
        solution, best, least = self._matrix.solve(right), None, np.inf
        for k in range(_SOLVES):
            rest = right - self._product(solution)
            scale = min(largest(solution), 1e6 * largest(right)) + largest(right)
            error = largest(rest) / max(scale, 1e-300)
            if error < least:
                least, best = error, solution
            elif k > 1 or not np.isfinite(error):
                break
            if (k and error < _GOAL) or k == _SOLVES - 1:
                break
            solution = solution + self._matrix.solve(rest)
        if best is None or least > _LARGEST_RESIDUAL:
            return None
        dy = best[count:]
        of_slacks = -(of_unknowns[count:] + program.slack_sign * dy[program.slack_row])
        return np.concatenate([best[:count], of_slacks / self._of_slacks]), dy

    def direction(
        self, terms: Terms, of_unknowns: np.ndarray, of_rows: np.ndarray, parameter: float
    ) -> tuple | None:
        """Return (d, dy) with the first of growing shifts that gives the inertia (n, m, 0).

        This is Algorithm IC of section 3.1, in which a matrix with a large residual is singular.

        parameter: the barrier parameter. Returns None if there is no such shift.
        """
        shift = row_shift = 0.0
        while shift <= _LARGEST:
            negative = self.factor(terms, shift, row_shift)
            if negative == self.program.row_count:
                solution = self.solve(of_unknowns, of_rows)
                if solution is not None:
                    self.last_shift = shift or self.last_shift
                    self.shifts = shift, row_shift
                    return solution
            # also the matrix of a large residual counts as singular
            if row_shift == 0 and (negative is None or negative <= self.program.row_count):
                row_shift = _ROW_SHIFT * parameter**_ROW_EXPONENT
            elif shift == 0:
                first = self.last_shift == 0
                shift = _FIRST if first else max(_LEAST, self.last_shift / _DECREASE)
            else:
                shift *= _GROWTH if self.last_shift else _FIRST_GROWTH
        return None
