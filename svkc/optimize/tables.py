"""Tables of a problem's unknowns and rows: indices, bounds, units and names."""

import dataclasses
from collections.abc import Sequence

import numpy as np


@dataclasses.dataclass
class Segment:
    """Consecutive entries of a table: one array of unknowns or of rows of one phase.

    name: name of the array. phase: name of the phase.
    entries: names of the entries along the last axis.
    start: index of the first entry in the table.
    shape: shape of the array. With several axes, the first one is over intervals or nodes.
    """

    name: str
    phase: str
    entries: Sequence[str]
    start: int
    shape: tuple[int, ...]

    @property
    def stop(self) -> int:
        """Index after the last entry."""
        return self.start + int(np.prod(self.shape))

    def label(self, index: int) -> str:
        """Return the name of an entry, with its phase and its interval or node."""
        at = np.unravel_index(index - self.start, self.shape)
        entry = self.entries[int(at[-1])] if len(self.entries) else ""
        places = "".join(f", {n} {i}" for n, i in zip(("interval", "stage"), at[:-1]))
        return f"{self.name}{' of ' + entry if entry else ''} in {self.phase}{places}"


class Table:
    """Unknowns or rows with bounds, units and names, appended segment by segment.

    The attributes below exist after `freeze`.

    lower, upper: bounds, in SI units and radians.
    unit: number by which the solver divides an entry; NaN: not known yet.
    """

    lower: np.ndarray
    upper: np.ndarray
    unit: np.ndarray

    def __init__(self) -> None:
        self.segments: list[Segment] = []
        self._lower: list[np.ndarray] = []
        self._upper: list[np.ndarray] = []
        self._unit: list[np.ndarray] = []
        self.count: int = 0

    def add(
        self,
        name: str,
        phase: str,
        shape: tuple[int, ...],
        *,
        lower: object = -np.inf,
        upper: object = np.inf,
        unit: object = 1.0,
        entries: Sequence[str] = (),
    ) -> np.ndarray:
        """Append a segment and return the indices of its entries, as an array of this shape."""
        self.segments.append(Segment(name, phase, entries, start=self.count, shape=shape))
        at = self.count + np.arange(int(np.prod(shape))).reshape(shape)
        self.count += at.size
        for column, value in ((self._lower, lower), (self._upper, upper), (self._unit, unit)):
            column.append(np.broadcast_to(np.asarray(value, float), shape).ravel().copy())
        return at

    def freeze(self) -> None:
        """Set `lower`, `upper` and `unit`. Nothing may be appended afterwards."""
        join = lambda parts: np.concatenate([np.zeros(0), *parts])
        self.lower, self.upper, self.unit = map(join, (self._lower, self._upper, self._unit))

    def label(self, index: int | np.integer) -> str:
        """Return the name of an entry."""
        return next(s for s in self.segments if s.start <= index < s.stop).label(int(index))


@dataclasses.dataclass
class PhaseIndices:
    """Indices of a phase's unknowns in the table; -1 for unknowns that the phase does not have.

    start_time, duration: scalars.
    nodes: [n + 1, (q v states)].
    blocks: [n, blocks, control] control blocks. Where controls have states, the first block of an
        interval is that of its first node.
    vdot: [n, s, nv]. forces: [n, s, rows]. impulse: [rows].
    projection_q, projection_v: [n, rows] multipliers of the projection at the end of each interval.
    kept_gap: [rows] gaps of links that connect with `here`, which stay constant in the phase.
    """

    start_time: int
    duration: int
    nodes: np.ndarray
    blocks: np.ndarray
    vdot: np.ndarray
    forces: np.ndarray
    impulse: np.ndarray
    projection_q: np.ndarray
    projection_v: np.ndarray
    kept_gap: np.ndarray

    def intervals(self, forces: np.ndarray | None = None) -> np.ndarray:
        """Return the indices [n z] of the unknowns of each interval, in the order of `Layout`.

        forces: indices [n s rows] in place of those of the stages' multipliers.
        """
        n, half = len(self.vdot), self.vdot.shape[-1]
        times = np.broadcast_to([self.start_time, self.duration], (n, 2))
        motion = np.concatenate([self.nodes[:-1, : 2 * half], self.vdot.reshape(n, -1)], 1)
        forces = self.forces if forces is None else forces
        return np.concatenate([times, motion, self.blocks.reshape(n, -1), forces.reshape(n, -1)], 1)
