"""The transcription of a problem: its unknowns, its rows, and the functions that give the rows."""

import functools
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import numpy as np

from svkc.optimize.blocks import Block, PlainBlock, StageBlock
from svkc.optimize.closed_forms import has_closed_forms
from svkc.optimize.equations import (
    IntervalData,
    Model,
    connection,
    end_of_interval,
    projection,
    stage_equations,
)
from svkc.optimize.lift import polynomials
from svkc.optimize.motion_block import CLOSED_FORMS, MotionBlock, NodeBlock
from svkc.optimize.phases import Phase
from svkc.optimize.points import PhaseStructure
from svkc.optimize.schemes import Radau
from svkc.optimize.tables import PhaseIndices, Table
from svkc.optimize.unknowns import UnknownsBuilder

EQUATION = {"lower": 0.0, "upper": 0.0}


class Transcription:
    """A problem as unknowns x and rows g(x).

    Rows are sums of the values of row blocks and of linear terms. The row after the last is the
    cost.

    builder: builder and table of the unknowns. rows: table of the rows.
    phases: the phases of the problem. indices: of each phase, the indices of its unknowns.
    structures: of each phase. blocks: the row blocks.
    references: of each phase, configurations [n + 1 nq] at the origins of its nodes' charts.
    """

    def __init__(
        self,
        builder: UnknownsBuilder,
        phases: Sequence[Phase],
        model: Model,
        *,
        scheme: Radau,
        structures: Sequence[PhaseStructure],
        references: Sequence[np.ndarray],
    ):
        self.builder = builder
        self.model = model
        self.scheme = scheme
        self.phases: Sequence[Phase] = phases
        self.structures = structures
        self.references: Sequence[np.ndarray] = references
        self.rows: Table = Table()
        self.blocks: list[Block] = []
        # of each block, the function that returns its lanes' data for the current references
        self._sources: list[Callable] = []
        self._linear: list[tuple] = []
        self.indices: list[PhaseIndices] = []
        for i, (phase, structure) in enumerate(zip(phases, structures)):
            before = self.indices[-1] if i else None
            self.indices.append(builder.add_phase(phase, structure, before, self.has_impact(i)))
        self._add_times()
        self._add_motion()
        self._add_connections()
        if builder.project:
            self._add_projections()

    def has_impact(self, i: int) -> bool:
        """Return whether phase i starts with an impact."""
        return bool(i and self.phases[i].impact and np.any(self.structures[i].new))

    @property
    def linear(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(row, unknown, factor) of the linear terms: factor times unknown is added to the row."""
        triplets = [np.broadcast_arrays(*parts) for parts in self._linear]
        empty = np.zeros(0)
        row, column, factor = (
            np.concatenate([empty, *(np.ravel(part[k]) for part in triplets)]) for k in range(3)
        )
        return row.astype(int), column.astype(int), factor

    def _add_linear(self, rows: Any, unknowns: Any, factor: float) -> None:
        """Append linear terms. rows, unknowns: indices, broadcast against each other."""
        self._linear.append((np.asarray(rows), np.asarray(unknowns), factor))

    def data(self, i: int) -> IntervalData:
        """Return the data of phase i, with a leading axis over its n + 1 nodes.

        Entry k < n is also the data of interval k, which starts at node k.
        """
        n, structure = self.phases[i].intervals, self.structures[i]
        repeat = lambda x: np.broadcast_to(np.asarray(x), (n + 1, *np.shape(x)))
        reference = np.asarray(self.references[i])
        return IntervalData(
            reference=reference,
            next_reference=np.concatenate([reference[1:], reference[-1:]]),
            active=repeat(structure.active),
            structure=jax.tree.map(repeat, structure.structure),
        )

    def add_block(self, block: Block, source: Callable) -> None:
        """Append a row block. source: () -> data of its lanes for the current references."""
        self.blocks.append(block)
        self._sources.append(source)

    def set_references(self, references: Sequence[np.ndarray]) -> None:
        """Set the origins of the charts, and the data of the blocks that depends on them."""
        self.references = references
        for block, source in zip(self.blocks, self._sources, strict=True):
            block.set_lanes(source())

    def lanes(self, i: int, nodes: slice | np.ndarray) -> IntervalData:
        """Return the data of some nodes of phase i."""
        return jax.tree.map(lambda x: x[nodes], self.data(i))

    def _add_rows(self, name: str, i: int, shape: tuple[int, ...], **options: Any) -> np.ndarray:
        """Append equality rows of phase i and return their indices."""
        return self.rows.add(name, self.phases[i].name, shape, **EQUATION, **options)

    def _add_link_rows(self, name: str, i: int, shape, active, unit: float = 1.0) -> np.ndarray:
        """Append equality rows of phase i for the active rows of links.

        Returns the indices [*shape rows], which are -1 for rows that are not active.
        """
        at = np.flatnonzero(active)
        out = np.full((*shape, len(self.model.rows)), -1)
        entries = [self.builder.names.rows[k] for k in at]
        out[..., at] = self._add_rows(name, i, (*shape, len(at)), unit=unit, entries=entries)
        return out

    def _add_times(self) -> None:
        """Append the rows by which each phase starts when the previous one ends."""
        for i, (before, after) in enumerate(zip(self.indices, self.indices[1:]), 1):
            row = self._add_rows("start time", i, (1,))
            self._add_linear(row, after.start_time, 1.0)
            self._add_linear(row, [before.start_time, before.duration], -1.0)

    def _add_motion(self) -> None:
        """Append the stages' equations and the continuity of nodes, in blocks over all phases."""
        layout, s, names = self.model.layout, self.scheme.stages, self.builder.names
        units, needs_state = self.builder.units, self.model.controls.needs_state
        equations: list[np.ndarray] = []
        self.continuity: list[np.ndarray] = []
        for i, phase in enumerate(self.phases):
            n = phase.intervals
            dynamics = self._add_rows(
                "dynamics", i, (n, s, layout.nv), unit=units.torque, entries=names.dofs
            )
            active = self.structures[i].active
            links = self._add_link_rows("link", i, (n, s), active, units.acceleration)
            equations.append(np.concatenate([dynamics, links], -1).reshape(n, -1))
            nodes = self.indices[i].nodes
            self.continuity.append(
                self._add_rows(
                    "continuity",
                    i,
                    (n, nodes.shape[1]),
                    unit=self.builder.node_units,
                    entries=names.node(self.model.controls.has_state),
                )
            )
            self._add_linear(self.continuity[-1], nodes[1:], -1.0)
        first_control, motion = 2 + 3 * layout.nv, 2 + np.arange(2 * layout.nv)
        control = np.arange(first_control, layout.stage_size - layout.rows)
        nonlinear = np.concatenate([[0], motion, control]) if needs_state else motion
        self.add_stages(stage_equations, list(range(s)), equations, nonlinear)
        has_quaternions = len(self.builder.chain.topology.quaternion_starts[0])
        self.add_stages(
            end_of_interval, [s - 1], self.continuity, motion if has_quaternions else motion[:0]
        )

    def add_stages(
        self,
        function: Callable[..., jax.Array],
        stages: list[int],
        rows: Sequence[np.ndarray],
        nonlinear: np.ndarray,
    ) -> None:
        """Append a row block of a function of stages, over the intervals of all phases.

        function: of `equations`. stages: indices of the stages. rows: of each phase [n m].
        nonlinear: as of `StageBlock`.
        """
        model, phases = self.model, range(len(self.phases))
        start_ratio, duration_ratio = zip(*(normalized_times(phase) for phase in self.phases))
        source = lambda: join_lanes(self.lanes(i, slice(-1)) for i in phases)
        poly = polynomials(self.scheme, model.controls, stages)
        options = {
            "data": source(),
            "start_ratio": np.concatenate(start_ratio),
            "duration_ratio": np.concatenate(duration_ratio),
            "unknowns": np.concatenate([phase.intervals() for phase in self.indices]),
            "rows": np.concatenate(rows),
            "nonlinear": nonlinear,
        }
        if function is stage_equations and has_closed_forms(self.builder.chain, model.controls):
            block = MotionBlock(model, poly, **options)
        else:
            call = functools.partial(function, model)
            block = StageBlock(call, model.layout, poly, **options)
        self.add_block(block, source)

    def _add_nodes(self, function: Callable, parts: list, nodes: slice) -> None:
        """Append a row block of a function of nodes.

        function: of `equations`. parts: (phase's index, unknowns, rows) of each phase that has such
        nodes. nodes: which nodes of these phases.
        """
        if parts:
            source = lambda: join_lanes(self.lanes(i, nodes) for i, _, _ in parts)
            unknowns, rows = (np.concatenate([part[k] for part in parts]) for k in (1, 2))
            lanes, model = (source(), unknowns, rows), self.model
            closed = has_closed_forms(self.builder.chain, model.controls)
            if closed and function in CLOSED_FORMS:
                block = NodeBlock(model, function, CLOSED_FORMS[function], *lanes)
            else:
                block = PlainBlock(functools.partial(function, model), *lanes)
            self.add_block(block, source)

    def _add_connections(self) -> None:
        """Append the rows of the first nodes of phases.

        They are continuous with the last node of the previous phase, and links connect there.
        """
        nv, units, builder = self.model.layout.nv, self.builder.units, self.builder
        parts = []
        for i, phase in enumerate(self.phases):
            impact, own, structure = self.has_impact(i), self.indices[i], self.structures[i]
            if i:
                before, after = self.indices[i - 1].nodes[-1], own.nodes[0]
                same = np.arange(len(after)) < (2 - impact) * nv
                same |= (np.arange(len(after)) >= 2 * nv) & phase.continuous_torques
                names = np.array(builder.names.node(self.model.controls.has_state))[same]
                row = self._add_rows(
                    "start", i, (int(same.sum()),), unit=builder.node_units[same],
                    entries=list(names),
                )  # fmt: skip
                self._add_linear(row, after[same], 1.0)
                self._add_linear(row, before[same], -1.0)
            if not np.any(structure.new):
                continue
            gaps = self._add_link_rows("gap", i, (), structure.new)
            at = structure.new & structure.here
            self._add_linear(gaps[at], own.kept_gap[at], -1.0)
            stopped = structure.active if impact else structure.new
            rates = self._add_link_rows("gap rate", i, (), stopped, units.velocity)
            momentum = np.full(nv, -1)
            if impact:
                unit = units.torque * units.velocity / units.acceleration
                momentum = self._add_rows("impact", i, (nv,), unit=unit, entries=builder.names.dofs)
            v_before = self.indices[i - 1].nodes[-1, nv : 2 * nv] if impact else np.full(nv, -1)
            unknowns = [[*own.nodes[0, : 2 * nv], *v_before, *own.impulse]]
            parts.append((i, unknowns, [[*gaps, *rates, *momentum]]))
        self._add_nodes(connection, parts, slice(1))

    def _add_projections(self) -> None:
        """Append the rows that keep loops closed at all nodes of a phase but the first."""
        nv, units = self.model.layout.nv, self.builder.units
        parts = []
        for i, phase in enumerate(self.phases):
            active, own, n = self.structures[i].active, self.indices[i], phase.intervals
            if not np.any(active):
                continue
            gaps = self._add_link_rows("gap", i, (n,), active)
            at = np.flatnonzero(own.kept_gap >= 0)
            self._add_linear(gaps[:, at], own.kept_gap[at], -1.0)
            rates = self._add_link_rows("gap rate", i, (n,), active, units.velocity)
            changes = self.continuity[i][:, : 2 * nv]
            unknowns = [own.nodes[1:, : 2 * nv], own.projection_q, own.projection_v]
            rows = np.concatenate([changes, gaps, rates], 1)
            parts.append((i, np.concatenate(unknowns, 1), rows))
        self._add_nodes(projection, parts, slice(1, None))


def normalized_times(phase: Phase) -> tuple[np.ndarray, np.ndarray]:
    """Return the start of each interval and the phase's duration, divided by the interval's length.

    With n equal intervals they are 0 ... n - 1, and n for each interval.
    """
    lengths = np.diff(phase.node_fractions)
    return phase.node_fractions[:-1] / lengths, 1 / lengths


def join_lanes(parts: Iterable[IntervalData]) -> IntervalData:
    """Return the concatenation of data along the leading axis."""
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)
