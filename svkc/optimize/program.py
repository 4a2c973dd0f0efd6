"""The compiled problem: rows, Jacobian and Hessian of the Lagrangian as sparse entries.

Row blocks return dense matrices of their lanes. The sparsity pattern is determined once: an entry
belongs to it if a mask of its block says so, or if it is not zero at one of a few random points.
The solver sees unknowns and rows divided by their units.
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
from svkc.optimize.sparsity import Entries, above_round_off, above_round_off_of_rows
from svkc.optimize.transcription import Transcription


def _over_blocks(blocks: Sequence[Block], call: Callable) -> Callable:
    """Return the compiled function (params, data, *x) -> [result of each block].

    Blocks with few lanes are compiled for a short compile time, and others for speed.

    call: (block, params, data, ...) -> result of a block.
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
    """Rows and derivatives of a problem, in the solver's units.

    params: parameters of the problem. samples: random points in SI units, at which the sparsity
        patterns are determined; the first `near` of them also determine the units of rows.
    cost_unit: number by which the cost is divided.
    unit, row_unit: units of unknowns and of rows, the cost's last.
    cost_row: index of the cost's row. solver_rows: indices of the rows that depend on an unknown
        that is not fixed; only these are constraints of the solver.
    """

    def __init__(
        self,
        transcription: Transcription,
        params: Params,
        samples: np.ndarray,
        *,
        near: int,
        cost_unit: float,
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
        first = [self._first(self.params, self._data, self._local(x)) for x in samples]
        self._set_row_units(first[:near])
        self.row_unit: np.ndarray = np.append(transcription.rows.unit, cost_unit)
        rows = [b.rows.reshape(-1) for b in blocks]
        self._target = np.concatenate(rows) if rows else np.zeros(0, int)
        linear = transcription.linear
        self._linear = linear[0], linear[1], linear[2] / self.row_unit[linear[0]]
        entries, of_hessian = self._patterns(samples, first, near)
        self.jacobian_entries: Entries = entries
        self.hessian_entries: Entries = of_hessian
        # rows whose unknowns are all fixed would make the solver's matrices singular
        table = transcription.builder.table
        free = table.lower < table.upper
        self.solver_rows: np.ndarray = np.intersect1d(
            entries.row[free[entries.column]], np.arange(self.cost_row)
        )

    def set_cost_unit(self, cost_unit: float) -> None:
        """Replace the number by which the cost is divided."""
        ratio = self.row_unit[-1] / cost_unit
        self.row_unit[-1] = cost_unit
        self.jacobian_entries.scale_row(self.cost_row, ratio)

    def set_references(self, references: Sequence[np.ndarray]) -> None:
        """Set the origins of the charts: configurations [n + 1 nq] of each phase."""
        if len(quaternion_starts(self.transcription.builder.chain)[0]):
            self.transcription.set_references(references)
            self._data = [jax.tree.map(jnp.asarray, b.data) for b in self.blocks]

    def _local(self, x: np.ndarray) -> list[np.ndarray]:
        """Return the local unknowns of each block. x: unknowns in SI units."""
        padded = np.append(x, 0.0)
        return [padded[index] for index in self._index]

    def _set_row_units(self, jacobians: list[list[jax.Array]]) -> None:
        """Set the units of rows that have none yet.

        Rows of one segment get their largest derivative by a scaled unknown.

        jacobians: dense Jacobians of the blocks at each sample.
        """
        unit = np.append(self.unit, 0.0)
        largest = np.zeros(self.cost_row + 2)
        for dense in jacobians:
            for block, index, values in zip(self.blocks, self._index, dense, strict=True):
                row, column = block.jacobian_pattern
                size = np.abs(values) * unit[index][:, column]
                np.maximum.at(largest, block.rows[:, row], np.where(np.isfinite(size), size, 0))
        table = self.transcription.rows
        for segment in table.segments:
            own = slice(segment.start, segment.stop)
            if np.isnan(table.unit[own]).any():
                table.unit[own] = np.max(largest[own], initial=0.0) or 1.0

    def _patterns(self, samples: np.ndarray, jacobians, near: int) -> tuple[Entries, Entries]:
        """Return the entries of the Jacobian and of the lower half of the Hessian.

        jacobians: dense Jacobians of the blocks at each sample. near: number of samples at which
            entries that are not finite count as nonzero.
        """
        random = np.random.default_rng(1)
        patterns = (
            [b.jacobian_pattern for b in self.blocks],
            [b.hessian_pattern for b in self.blocks],
        )
        masks = [(False, False) if b.masks is None else b.masks for b in self.blocks]
        jacobian_used: list[Any] = [of_jacobian for of_jacobian, _ in masks]
        hessian_used: list[Any] = [of_hessian for _, of_hessian in masks]
        unit = np.append(self.unit, 1.0)
        for k, (x, jacobian) in enumerate(zip(samples, jacobians, strict=True)):
            # far from the guess a function may not be defined
            counts = lambda values, far=k >= near: np.isfinite(values) | (not far)
            multipliers = [
                np.where(b.rows < 0, 0, random.normal(size=b.rows.shape)) for b in self.blocks
            ]
            hessian = self._second(self.params, self._data, self._local(x), multipliers)
            for i, (index, block) in enumerate(zip(self._index, self.blocks)):
                (row, column), scale = patterns[0][i], unit[index]
                scaled = np.asarray(jacobian[i]) * scale[:, column]
                own = above_round_off_of_rows(scaled, row, block.rows.shape[1])
                jacobian_used[i] = jacobian_used[i] | own & counts(scaled)
                row, column = patterns[1][i]
                scaled = np.asarray(hessian[i]) * scale[:, row] * scale[:, column]
                own = above_round_off(scaled, axes=1)
                hessian_used[i] = hessian_used[i] | own & counts(scaled)
        jacobian = [
            self._part(used, b.rows, b.unknowns, at)
            for used, b, at in zip(jacobian_used, self.blocks, patterns[0])
        ]
        jacobian.append((np.arange(len(self._linear[0])), *self._linear[:2]))
        hessian = [
            self._part(used, b.unknowns, b.unknowns, at, lower=True)
            for used, b, at in zip(hessian_used, self.blocks, patterns[1])
        ]
        return (
            Entries(jacobian, (self.cost_row + 1, self.count), (self.row_unit, self.unit)),
            Entries(hessian, (self.count, self.count), (1 / self.unit, self.unit)),
        )

    @staticmethod
    def _part(used: np.ndarray, rows: np.ndarray, columns: np.ndarray, at, lower: bool = False):
        """Return the part of a block in `Entries`.

        used: mask [lanes entries] of nonzero entries. at: local row and local column of each entry.
        rows, columns: [lanes ...] problem's index of each local row and column.
        lower: whether entries above the diagonal are moved to the lower half.
        """
        # lanes of a large block share one pattern. Those of a small one may differ: unknowns that
        # are fixed at the start have the value of their bounds at all samples
        used = used if len(used) < MANY_LANES else np.broadcast_to(used.any(0), used.shape)
        row, column = rows[:, at[0]], columns[:, at[1]]
        keep = used & (row >= 0) & (column >= 0)
        flat, row, column = np.flatnonzero(keep), row[keep], column[keep]
        return (
            (flat, np.maximum(row, column), np.minimum(row, column))
            if lower
            else (flat, row, column)
        )

    def length(self, name: str) -> int:
        """Return how many values the method "rows", "jacobian" or "hessian" returns."""
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
        """Return the values of `jacobian_entries`, which include the gradient of the cost."""
        dense = self._first(self.params, self._data, self._local(x * self.unit))
        return self.jacobian_entries.gather([*dense, self.transcription.linear[2]])

    def hessian(self, x: np.ndarray, multipliers: np.ndarray) -> np.ndarray:
        """Return the values of `hessian_entries`.

        multipliers: of all rows; the last one is the factor of the cost.
        """
        scaled = np.append(multipliers / self.row_unit, 0.0)
        local = [scaled[np.where(b.rows < 0, len(scaled) - 1, b.rows)] for b in self.blocks]
        dense = self._second(self.params, self._data, self._local(x * self.unit), local)
        return self.hessian_entries.gather(dense)

    def parameter_gradient(self, x: np.ndarray, multipliers: np.ndarray) -> Params:
        """Return the derivatives of the Lagrangian by the parameters, in the unit of the cost.

        multipliers: of all rows but the cost.
        """
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
        """Return how far each row but the cost is outside its bounds, in the solver's units."""
        values, (_, _, low, high) = self.rows(x)[:-1], self.bounds()
        return np.maximum(np.maximum(low - values, values - high), 0)
