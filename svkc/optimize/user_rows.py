"""Rows of the user's functions: constraints, and terms of the cost."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from svkc._jax.dependence import NONLINEAR, dependence
from svkc._jax.pytrees import is_concrete
from svkc.model.validation import as_array, description, is_real
from svkc.optimize.blocks import StageBlock
from svkc.optimize.entry_masks import entry_masks
from svkc.optimize.equations import Params, point_of_stage
from svkc.optimize.free_args import ArgsModel
from svkc.optimize.lift import polynomials
from svkc.optimize.phases import Constraint
from svkc.optimize.points import AbsentAtStartError, Point
from svkc.optimize.transcription import Transcription, join_lanes, normalized_times


class Values(NamedTuple):
    """What a constraint's function returned: numbers, and their bounds.

    numbers: values, or the shape of the values.
    """

    numbers: Any
    lower: Any
    upper: Any


def _evaluate(entry: Constraint, point: Point) -> Values:
    """Return the values of a constraint at a point. Raises ValueError if they are not numbers."""
    result, lower, upper = entry.function(point), entry.lower, entry.upper
    if isinstance(result, tuple) and len(result) == 3:
        result, lower, upper = result
    if not is_real(as_array(result)):
        raise ValueError(f"constraint {entry.name!r}: expected numbers, got {description(result)}")
    return Values(_as_float(result), lower, upper)


def _as_float(value: Any) -> Array:
    """Return real numbers as a vector of floats, which can be differentiated."""
    value = jnp.ravel(jnp.asarray(value))
    floats = jnp.issubdtype(value.dtype, jnp.floating)
    return value if floats else value.astype(jnp.result_type(float))


def _cost(function: Callable, name: str, point: Point) -> Any:
    """Return the value of a cost at a point. Raises ValueError if it is not a single number."""
    value = function(point)
    if not is_real(as_array(value)) or jnp.shape(value) != ():
        raise ValueError(f"{name}: expected a cost of one number, got {description(value)}")
    return _as_float(value)


class RowGroup(NamedTuple):
    """Constraints and costs that one block evaluates, for all phases that have them.

    place: "path", "start" or "end". entries, costs: constraints and cost functions.
    stages: indices of the stages; -1 is the interval's start.
    active: mask [links' rows] of the constraints in these phases.
    parts: of each phase its index, the indices of the intervals, and their rows.
    """

    place: str
    entries: Sequence[Constraint]
    costs: Sequence[Callable]
    stages: list[int]
    active: np.ndarray
    parts: list[tuple[int, np.ndarray, np.ndarray]]


class UserRows:
    """Builder of the rows and cost terms of users' functions, which it appends to a transcription.

    args_model: how the chain depends on the args. params: the chain that the user gave, and args.
    """

    def __init__(self, transcription: Transcription, args_model: ArgsModel, params: Params):
        self.transcription = transcription
        self.args_model = args_model
        self.params = params
        self._groups: dict[tuple, RowGroup] = {}
        # (block, mask of its local rows that are cost terms); the index of the cost's row is known
        # only when all other rows are there
        self._cost_terms: list[tuple[StageBlock, np.ndarray]] = []

    def add_phase(
        self, i: int, running: Sequence[Callable[..., Any]], final: Sequence[Callable[..., Any]]
    ) -> None:
        """Append the constraints and costs of phase i. running, final: functions of the costs."""
        phase, s = self.transcription.phases[i], self.transcription.scheme.stages
        path, every = phase.constraints("path"), np.arange(phase.intervals)
        self._add("path", i, path, running, stages=list(range(s)), intervals=every)
        at_start = [c for c in path if self._holds_at_start(i, c)] + phase.constraints("start")
        self._add("start", i, at_start, (), stages=[-1], intervals=every[:1])
        end = phase.constraints("end")
        self._add("end", i, end, final, stages=[s - 1], intervals=every[-1:])

    def _set_dependence(self, block: StageBlock) -> None:
        """Find out on what a block's functions depend, and set its options and patterns.

        Functions that do not read coordinates of virtual joints need not compute them.
        """
        n = block.layout.stage_size
        lane = jax.tree.map(lambda x: jnp.asarray(x[0]), block.data[0])
        y = jnp.zeros(n, self.params.chain.q_load.dtype)
        numbers = jnp.asarray(self.args_model.numbers(self.params.args), y.dtype)

        def rows(y, numbers, *fill):
            block.options = {"fill": fill[0]} if fill else {}
            params = self.args_model.resolve(self.params, numbers)
            return block.function(params, lane, 1.0, y)

        kinds = dependence(rows, y, numbers, y[0])
        if kinds[:, -1].any():
            kinds = dependence(rows, y, numbers)
            block.options = {}
        else:
            kinds = kinds[:, :-1]
            block.options = {"fill": 0.0}
        nonlinear = kinds == NONLINEAR
        block.nonlinear = block.variables = np.flatnonzero(nonlinear[:, :n].any(0))
        block.masks = entry_masks(block, nonlinear[:, :n])
        block.by_args = nonlinear[:, n:]

    def _holds_at_start(self, i: int, entry: Constraint) -> bool:
        """Return whether a path constraint can be evaluated at the start of phase i.

        Points there have no accelerations and no forces of links.
        """
        try:
            self._shapes(i, [entry], at_start=True)
        except AbsentAtStartError:
            return False
        return True

    def _shapes(self, i: int, entries: Sequence[Constraint], at_start: bool) -> list[Values]:
        """Return the shapes and bounds of constraints' values, by abstract evaluation."""
        out: list[Values] = []
        data = jax.tree.map(lambda x: jnp.asarray(x[0]), self.transcription.data(i))

        def evaluate(y, numbers):
            active = np.asarray(self.transcription.structures[i].active)
            params = self.args_model.resolve(self.params, numbers)
            point = point_of_stage(
                self.transcription.model, params, data, y, active, at_start=at_start
            )
            values = [_evaluate(entry, point) for entry in entries]
            out.extend(values)
            return [v.numbers for v in values]

        y = jnp.zeros(self.transcription.model.layout.stage_size, self.params.chain.q_load.dtype)
        shapes = jax.eval_shape(evaluate, y, self.args_model.numbers(self.params.args))
        return [Values(x.shape, v.lower, v.upper) for x, v in zip(shapes, out)]

    def _add(self, place, i: int, entries, costs, *, stages, intervals) -> None:
        """Append rows of constraints and costs of phase i.

        One block will evaluate these rows for all phases with these functions and connected links.

        place: "path", "start" or "end". stages: indices of the stages; -1 is the interval's start.
        intervals: indices of the intervals.
        """
        if not entries and not costs:
            return
        rows = self._rows_of(place, i, entries, (len(intervals), len(stages)))
        cost_rows = np.full((len(intervals), len(stages), len(costs)), -1)
        rows = np.concatenate([*rows, cost_rows], -1).reshape(len(intervals), -1)
        active = np.asarray(self.transcription.structures[i].active)
        functions = [id(f) for f in (*(entry.function for entry in entries), *costs)]
        key = place, len(costs), *functions, active.tobytes()
        group = self._groups.get(key)
        if group is None:
            group = RowGroup(
                place=place, entries=entries, costs=costs, stages=stages, active=active, parts=[]
            )
            self._groups[key] = group
        group.parts.append((i, intervals, rows))

    def add_blocks(self) -> None:
        """Append the blocks of all phases, after which no rows can be added."""
        for group in self._groups.values():
            self._add_block(group)
        rows = self.transcription.rows
        rows.freeze()
        for block, is_cost in self._cost_terms:
            block.rows = np.where(is_cost, rows.count, block.rows)

    def _add_block(self, group: RowGroup) -> None:
        """Append the block of a group."""
        transcription, stages, costs = self.transcription, group.stages, group.costs
        at_start, is_running = group.place == "start", group.place == "path"
        name = "running" if is_running else "final"

        def function(params, data, weight, y):
            options = {"at_start": at_start, **block.options}
            point = point_of_stage(transcription.model, params, data, y, group.active, **options)
            parts = [_evaluate(entry, point).numbers for entry in group.entries]
            scale = weight * point.duration if is_running else 1.0
            return jnp.concatenate([*parts, *(scale * _cost(f, name, point) for f in costs)])

        lanes = lambda of_phase: np.concatenate([of_phase(i)[at] for i, at, _ in group.parts])
        places = [normalized_times(phase) for phase in transcription.phases]
        source = lambda: join_lanes(transcription.lanes(i, at) for i, at, _ in group.parts)
        block = StageBlock(
            function,
            transcription.model.layout,
            polynomials(transcription.scheme, transcription.model.controls, stages),
            data=source(),
            start_ratio=lanes(lambda i: places[i][0]),
            duration_ratio=lanes(lambda i: places[i][1]),
            unknowns=lanes(lambda i: self._unknowns(i, at_start)),
            rows=np.concatenate([rows for _, _, rows in group.parts]),
            nonlinear=np.arange(transcription.model.layout.stage_size),
        )
        self._set_dependence(block)
        if costs:
            columns, of_stage = block.rows.shape[1], block.rows.shape[1] // len(stages)
            is_cost = np.arange(columns) % of_stage >= of_stage - len(costs)
            self._cost_terms.append((block, is_cost))
        transcription.add_block(block, source)

    def _unknowns(self, i: int, at_start: bool) -> np.ndarray:
        """Return the unknowns [intervals n] of a phase, at its start with impulses as forces."""
        phase = self.transcription.indices[i]
        if not at_start:
            return phase.intervals(None)
        forces = np.full_like(phase.forces, -1)
        forces[:, 0] = phase.impulse
        return phase.intervals(forces)

    def _rows_of(self, place: str, i: int, entries, lanes: tuple[int, int]) -> list[np.ndarray]:
        """Append the rows of constraints; return their indices [lanes stages values] of each.

        lanes: numbers of lanes and of stages.
        """
        rows, phase = [], self.transcription.phases[i]
        for entry, shape in zip(entries, self._shapes(i, entries, place == "start")):
            lower, upper = self._bounds(entry, shape)
            name = entry.name if entry.name.startswith(place) else f"{place} {entry.name!r}"
            count = shape.numbers[0]
            rows.append(
                self.transcription.rows.add(
                    name,
                    phase.name,
                    (*lanes, count),
                    lower=lower,
                    upper=upper,
                    unit=np.nan,
                    entries=[str(k) for k in range(count)] * (count > 1),
                )
            )
        return rows

    def _bounds(self, entry: Constraint, shape: Values) -> list[np.ndarray]:
        """Return a constraint's bounds, one for all values or one for each.

        Raises ValueError if bounds are traced, have another shape, or contradict each other.
        """
        bounds = []
        for bound in (shape.lower, shape.upper):
            if not is_concrete(bound):
                raise ValueError(
                    f"constraint {entry.name!r}: its bounds depend on the point or on free args,"
                    " or jnp made them inside the function; put what depends on these into the"
                    " function's value, and make numbers by numpy"
                )
            bounds.append(np.ravel(np.asarray(as_array(bound), float)))
        if not all(b.shape in ((1,), shape.numbers) for b in bounds) or not np.all(
            bounds[0] <= bounds[1]
        ):
            raise ValueError(
                f"constraint {entry.name!r}: got the bounds {shape.lower} to {shape.upper} for"
                f" {shape.numbers[0]} values"
            )
        return bounds
