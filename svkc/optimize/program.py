"""The compiled problem: rows, Jacobian and Hessian as sparse entries for a solver.

Blocks return dense matrices of their lanes. Which entries are not zero is found once, at random
points; only these are handed to the solver. Unknowns and rows are divided by their units.
"""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from svkc._jax.eager import eager_jit
from svkc.optimize.blocks import MANY_LANES, Block
from svkc.optimize.charts import quaternion_starts
from svkc.optimize.equations import Params
from svkc.optimize.transcription import Transcription

# of an entry, by the largest of its row
_ROUND_OFF = 1e-13


class Entries:
    """Sparse entries of a matrix: where they are in the blocks' dense results.

    row, column: of each entry of the matrix, without repetition.
    """

    def __init__(
        self,
        parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]],
        shape: tuple[int, int],
        scale: tuple[np.ndarray, np.ndarray],
    ):
        """parts: of each block, flat places, and the row and column of each place.

        shape: of the matrix. scale: (units of rows, units of columns).
        """
        self.places: list[np.ndarray] = [place for place, _, _ in parts]
        row, column = (np.concatenate([np.zeros(0, int), *(p[k] for p in parts)]) for k in (1, 2))
        keys, self._target = np.unique(row * shape[1] + column, return_inverse=True)
        self.row: np.ndarray = keys // shape[1]
        self.column: np.ndarray = keys % shape[1]
        self._weight = scale[1][column] / scale[0][row]

    def gather(self, dense: Sequence[jax.Array | np.ndarray]) -> np.ndarray:
        """Return the values of the entries, in the solver's units."""
        values = [np.asarray(x).reshape(-1)[at] for x, at in zip(dense, self.places)]
        values = np.concatenate([np.zeros(0), *values]) * self._weight
        return np.bincount(self._target, values, len(self.row))


def _not_round_off(dense: np.ndarray, axes) -> np.ndarray:
    """Return the mask of entries above round-off of the largest along some axes."""
    # what is not finite at a random point is an entry
    finite = np.isfinite(dense)
    size = np.where(finite, np.abs(dense), 0)
    return ~finite | (size > _ROUND_OFF * np.max(size, axis=axes, keepdims=True, initial=0.0))


def _not_round_off_of_rows(values: np.ndarray, row: np.ndarray, rows: int) -> np.ndarray:
    """Return the mask of entries [lanes entries] above round-off of the largest of their row."""
    largest = np.zeros((len(values), rows))
    finite = np.isfinite(values)
    size = np.where(finite, np.abs(values), 0)
    for i in range(rows):
        largest[:, i] = np.max(size[:, row == i], axis=1, initial=0.0)
    return ~finite | (size > _ROUND_OFF * largest[:, row])


def _over_blocks(blocks: Sequence[Block], call: Callable) -> Callable:
    """Return (params, data, *x) -> results of a function of each block, compiled.

    Blocks of few lanes are compiled for short compile time.
    """
    many = [len(b.unknowns) >= MANY_LANES for b in blocks]
    programs = []
    for compiled, large in ((jax.jit, True), (eager_jit, False)):
        own = [i for i, x in enumerate(many) if x == large]

        def run(params, data, *x, own=own):
            return [call(blocks[i], params, *parts) for i, *parts in zip(own, data, *x)]

        programs.append((own, compiled(run)))

    def evaluate(params, data, *x):
        results: list[Any] = [None] * len(blocks)
        for own, program in programs:
            if own:
                picked = [[values[i] for i in own] for values in (data, *x)]
                for i, result in zip(own, program(params, *picked), strict=True):
                    results[i] = result
        return results

    return evaluate


class Program:
    """Rows and derivatives of a problem at unknowns in the solver's units.

    whole: the transcription. params: for which it is solved. draws: points in SI units at which the
    patterns are found. cost_unit: by which the cost is divided.
    """

    def __init__(
        self, transcription: Transcription, params: Params, draws: np.ndarray, cost_unit: float
    ):
        self.transcription = transcription
        self.params = params
        self.blocks: list[Block] = transcription.blocks
        self.unit: np.ndarray = transcription.builder.table.unit
        self.count: int = transcription.builder.table.count
        self.cost_row: int = transcription.rows.count
        self._index = [np.where(b.unknowns < 0, self.count, b.unknowns) for b in self.blocks]
        blocks = self.blocks
        self._data = [jax.tree.map(jnp.asarray, b.data) for b in blocks]
        self._values = _over_blocks(blocks, lambda b, *x: b.values(*x))
        self._first = _over_blocks(blocks, lambda b, *x: b.jacobian(*x))
        self._second = _over_blocks(blocks, lambda b, *x: b.hessian(*x))
        first = [self._first(self.params, self._data, self._local(x)) for x in draws]
        self._set_row_units(first)
        self.row_unit: np.ndarray = np.append(transcription.rows.unit, cost_unit)
        rows = [b.rows.reshape(-1) for b in blocks]
        self._target = np.concatenate(rows) if rows else np.zeros(0, int)
        linear = transcription.linear
        self._linear = linear[0], linear[1], linear[2] / self.row_unit[linear[0]]
        entries, of_hessian = self._patterns(draws, first)
        self.jacobian_entries: Entries = entries
        self.hessian_entries: Entries = of_hessian
        # rows of fixed unknowns alone would make the solver's matrices singular
        table = transcription.builder.table
        free = table.lower < table.upper
        self.kept: np.ndarray = np.intersect1d(
            entries.row[free[entries.column]], np.arange(self.cost_row)
        )

    def set_cost_unit(self, cost_unit: float) -> None:
        """Divide the cost by this number."""
        ratio = self.row_unit[-1] / cost_unit
        self.row_unit[-1] = cost_unit
        entries = self.jacobian_entries
        of_cost = entries.row[entries._target] == self.cost_row
        entries._weight = np.where(of_cost, entries._weight * ratio, entries._weight)

    def set_references(self, references: Sequence[np.ndarray]) -> None:
        """Set the origins of the charts: configurations [n + 1 nq] of each phase."""
        if len(quaternion_starts(self.transcription.builder.chain)[0]):
            self.transcription.set_references(references)
            self._data = [jax.tree.map(jnp.asarray, b.data) for b in self.blocks]

    def _local(self, x: np.ndarray) -> list[np.ndarray]:
        """Return the local unknowns of the blocks at unknowns in SI units."""
        padded = np.append(x, 0.0)
        return [padded[index] for index in self._index]

    def _set_row_units(self, jacobians: list[list[jax.Array]]) -> None:
        """Set units that are not known: each kind of row gets the size of its gradient."""
        unit = np.append(self.unit, 0.0)
        largest = np.zeros(self.cost_row + 2)
        for dense in jacobians:
            for block, index, values in zip(self.blocks, self._index, dense, strict=True):
                row, column = block.jacobian_places
                size = np.abs(values) * unit[index][:, column]
                np.maximum.at(largest, block.rows[:, row], np.where(np.isfinite(size), size, 0))
        table = self.transcription.rows
        for segment in table.segments:
            own = slice(segment.start, segment.stop)
            if np.isnan(table.unit[own]).any():
                table.unit[own] = np.max(largest[own], initial=0.0) or 1.0

    def _patterns(self, draws: np.ndarray, jacobians) -> tuple[Entries, Entries]:
        """Return the entries of the Jacobian and of the lower half of the Hessian."""
        random = np.random.default_rng(1)
        places = [b.jacobian_places for b in self.blocks], [b.hessian_places for b in self.blocks]
        first: list[Any] = [False] * len(self.blocks)
        second: list[Any] = [False] * len(self.blocks)
        unit = np.append(self.unit, 1.0)
        for x, jacobian in zip(draws, jacobians, strict=True):
            multipliers = [
                np.where(b.rows < 0, 0, random.normal(size=b.rows.shape)) for b in self.blocks
            ]
            hessian = self._second(self.params, self._data, self._local(x), multipliers)
            for i, (index, block) in enumerate(zip(self._index, self.blocks)):
                (row, column), u = places[0][i], unit[index]
                scaled = np.asarray(jacobian[i]) * u[:, column]
                first[i] = first[i] | _not_round_off_of_rows(scaled, row, block.rows.shape[1])
                row, column = places[1][i]
                scaled = np.asarray(hessian[i]) * u[:, row] * u[:, column]
                second[i] = second[i] | _not_round_off(scaled, axes=1)
        jacobian = [
            self._places(u, b.rows, b.unknowns, at)
            for u, b, at in zip(first, self.blocks, places[0])
        ]
        jacobian.append((np.arange(len(self._linear[0])), *self._linear[:2]))
        hessian = [
            self._places(u, b.unknowns, b.unknowns, at, lower=True)
            for u, b, at in zip(second, self.blocks, places[1])
        ]
        return (
            Entries(jacobian, (self.cost_row + 1, self.count), (self.row_unit, self.unit)),
            Entries(hessian, (self.count, self.count), (1 / self.unit, self.unit)),
        )

    @staticmethod
    def _places(used: np.ndarray, rows: np.ndarray, columns: np.ndarray, at, lower: bool = False):
        """Return flat places, rows and columns of entries that are used.

        used: [lanes entries]. at: local row and column of each entry.
        """
        # few lanes may differ from one another, as in what is fixed at the start
        used = used if len(used) < MANY_LANES else np.broadcast_to(used.any(0), used.shape)
        row, column = rows[:, at[0]], columns[:, at[1]]
        keep = used & (row >= 0) & (column >= 0)
        place, row, column = np.flatnonzero(keep), row[keep], column[keep]
        return (
            (place, np.maximum(row, column), np.minimum(row, column))
            if lower
            else (place, row, column)
        )

    def length(self, name: str) -> int:
        """Return the number of values that a method returns."""
        if name == "rows":
            return self.cost_row + 1
        return len(getattr(self, f"{name}_entries").row)

    def rows(self, x: np.ndarray) -> np.ndarray:
        """Return all rows, the cost last, in the solver's units. x: in the solver's units."""
        values = self._values(self.params, self._data, self._local(x * self.unit))
        values = np.concatenate([np.zeros(0), *(np.asarray(v).reshape(-1) for v in values)])
        kept = self._target >= 0
        total = np.bincount(self._target[kept], values[kept], self.cost_row + 1) / self.row_unit
        row, column, factor = self._linear
        return total + np.bincount(row, factor * (x * self.unit)[column], self.cost_row + 1)

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        """Return the values of `jacobian_entries`, the cost's gradient among them."""
        dense = self._first(self.params, self._data, self._local(x * self.unit))
        return self.jacobian_entries.gather([*dense, self.transcription.linear[2]])

    def hessian(self, x: np.ndarray, multipliers: np.ndarray) -> np.ndarray:
        """Return the values of `hessian_entries` for multipliers of all rows, the cost's last."""
        scaled = np.append(multipliers / self.row_unit, 0.0)
        local = [scaled[np.where(b.rows < 0, len(scaled) - 1, b.rows)] for b in self.blocks]
        dense = self._second(self.params, self._data, self._local(x * self.unit), local)
        return self.hessian_entries.gather(dense)

    def parameter_gradient(self, x: np.ndarray, multipliers: np.ndarray) -> Params:
        """Return the derivatives of the Lagrangian by the parameters, in the cost's unit."""
        scaled = np.append(multipliers / self.row_unit[:-1], [1 / self.row_unit[-1], 0.0])
        local = [scaled[np.where(b.rows < 0, len(scaled) - 1, b.rows)] for b in self.blocks]
        z = self._local(x * self.unit)

        @eqx.filter_jit
        def gradient(params, data, z, local):
            arrays, rest = eqx.partition(params, eqx.is_inexact_array)

            def lagrangian(arrays):
                own = eqx.combine(arrays, rest)
                values = (b.values(own, d, x) for b, d, x in zip(self.blocks, data, z))
                return sum(jnp.sum(v * m) for v, m in zip(values, local))

            return jax.grad(lagrangian)(arrays)

        result = gradient(self.params, self._data, z, local)
        return jax.tree.map(lambda x: x * self.row_unit[-1], result)

    def bounds(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return lower and upper bounds of unknowns and of rows, in the solver's units."""
        table, rows = self.transcription.builder.table, self.transcription.rows
        return (
            table.lower / self.unit,
            table.upper / self.unit,
            rows.lower / rows.unit,
            rows.upper / rows.unit,
        )

    def violation(self, x: np.ndarray) -> np.ndarray:
        """Return how far each row is outside its bounds, in the solver's units."""
        values, (_, _, low, high) = self.rows(x)[:-1], self.bounds()
        return np.maximum(np.maximum(low - values, values - high), 0)
