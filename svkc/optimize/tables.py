"""Tables of a problem's unknowns and rows: places, bounds, units and names."""

import dataclasses
from collections.abc import Sequence

import numpy as np


@dataclasses.dataclass
class Segment:
    """Consecutive entries of one kind: an array of unknowns, or of rows, of a phase.

    name: what they are. phase: name of the phase. entries: names along the last axis.
    start, shape: place in the whole. First axis: intervals or nodes, if there is more than one.
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
    """Entries with bounds, units and names, appended segment by segment.

    lower, upper: bounds, in SI units and radians. unit: by which the solver divides an entry; NaN:
        not known yet. All three are there once the table is frozen.
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
        """Append entries and return their indices, of the given shape."""
        self.segments.append(Segment(name, phase, entries, start=self.count, shape=shape))
        at = self.count + np.arange(int(np.prod(shape))).reshape(shape)
        self.count += at.size
        for column, value in ((self._lower, lower), (self._upper, upper), (self._unit, unit)):
            column.append(np.broadcast_to(np.asarray(value, float), shape).ravel().copy())
        return at

    def freeze(self) -> None:
        """Join the columns; nothing is added afterwards."""
        join = lambda parts: np.concatenate([np.zeros(0), *parts])
        self.lower, self.upper, self.unit = map(join, (self._lower, self._upper, self._unit))

    def label(self, index: int | np.integer) -> str:
        """Return the name of an entry."""
        return next(s for s in self.segments if s.start <= index < s.stop).label(int(index))


@dataclasses.dataclass
class PhaseIndices:
    """Indices of a phase's unknowns; -1 for unknowns that the phase lacks.

    start_time, duration: scalars. nodes: [n + 1, q v states]. blocks: [n, blocks, control], with
    the states of the interval's first node as its first block. vdot: [n, s, nv].
    forces: [n, s, rows]. impulse: [rows].
    change_q, change_v: [n, rows] multipliers of the projection at the end of each interval.
    offset: [rows] gaps that a link that connects where it is keeps.
    """

    start_time: int
    duration: int
    nodes: np.ndarray
    blocks: np.ndarray
    vdot: np.ndarray
    forces: np.ndarray
    impulse: np.ndarray
    change_q: np.ndarray
    change_v: np.ndarray
    offset: np.ndarray

    def intervals(self, forces: np.ndarray | None = None) -> np.ndarray:
        """Return the indices [n z] of the unknowns of each interval, as `Layout` orders them.

        forces: in place of those of the stages.
        """
        n, half = len(self.vdot), self.vdot.shape[-1]
        times = np.broadcast_to([self.start_time, self.duration], (n, 2))
        motion = np.concatenate([self.nodes[:-1, : 2 * half], self.vdot.reshape(n, -1)], 1)
        forces = self.forces if forces is None else forces
        return np.concatenate([times, motion, self.blocks.reshape(n, -1), forces.reshape(n, -1)], 1)
