"""Sparsity patterns, and the sum of row blocks' dense derivatives into sparse entries."""

from collections.abc import Sequence

import jax
import numpy as np

# entries below this fraction of the largest in their row are taken for zero
_ROUND_OFF = 1e-13


class Entries:
    """The sparsity pattern of a matrix, and the sum of the blocks' dense results into it.

    row, column: indices of each entry of the matrix, each pair once.
    """

    def __init__(
        self,
        parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]],
        shape: tuple[int, int],
        scale: tuple[np.ndarray, np.ndarray],
    ):
        """Build the pattern.

        parts: of each block, flat indices into its dense result, and the row and column of each.
        shape: of the matrix. scale: (units of rows, units of columns).
        """
        self._sources: list[np.ndarray] = [at for at, _, _ in parts]
        row, column = (np.concatenate([np.zeros(0, int), *(p[k] for p in parts)]) for k in (1, 2))
        keys, self._target = np.unique(row * shape[1] + column, return_inverse=True)
        self.row: np.ndarray = keys // shape[1]
        self.column: np.ndarray = keys % shape[1]
        self._weight = scale[1][column] / scale[0][row]

    def scale_row(self, row: int, factor: float) -> None:
        """Multiply the values of a row by a factor, in all later results of `gather`."""
        of_row = self.row[self._target] == row
        self._weight = np.where(of_row, self._weight * factor, self._weight)

    def gather(self, dense: Sequence[jax.Array | np.ndarray]) -> np.ndarray:
        """Return the values of the entries, in the solver's units. dense: results of the blocks."""
        values = [np.asarray(x).reshape(-1)[at] for x, at in zip(dense, self._sources)]
        values = np.concatenate([np.zeros(0), *values]) * self._weight
        return np.bincount(self._target, values, len(self.row))


def above_round_off(dense: np.ndarray, axes) -> np.ndarray:
    """Return the mask of entries that are above round-off of the largest along some axes.

    Entries that are not finite are in the mask.
    """
    finite = np.isfinite(dense)
    size = np.where(finite, np.abs(dense), 0)
    return ~finite | (size > _ROUND_OFF * np.max(size, axis=axes, keepdims=True, initial=0.0))


def above_round_off_of_rows(values: np.ndarray, row: np.ndarray, rows: int) -> np.ndarray:
    """Return the mask of entries [lanes entries] above round-off of the largest in their row.

    row: [entries] row of each entry. rows: number of rows.
    """
    largest = np.zeros((len(values), rows))
    finite = np.isfinite(values)
    size = np.where(finite, np.abs(values), 0)
    for i in range(rows):
        largest[:, i] = np.max(size[:, row == i], axis=1, initial=0.0)
    return ~finite | (size > _ROUND_OFF * largest[:, row])
