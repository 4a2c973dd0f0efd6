"""The table of a problem's unknowns."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from svkc.model.chain import Chain
from svkc.optimize.charts import quaternion_starts
from svkc.optimize.controls import AbstractControls
from svkc.optimize.free_args import ArgsModel
from svkc.optimize.phases import Between, Phase, coordinates_of
from svkc.optimize.points import PhaseStructure
from svkc.optimize.schemes import Radau
from svkc.optimize.tables import PhaseIndices, Table
from svkc.optimize.units import Units

LINK_ROWS = ("rx", "ry", "rz", "x", "y", "z")


class Names(NamedTuple):
    """Names for labels.

    dofs: of the tree's coordinates. controls: of a control block's numbers. rows: of links' rows.
    """

    dofs: list[str]
    controls: list[str]
    rows: list[str]

    def node(self, has_state: bool) -> list[str]:
        """Return the names of a node's entries."""
        velocities = [f"velocity of {d}" for d in self.dofs]
        return [*self.dofs, *velocities, *(f"torque of {c}" for c in self.controls * has_state)]


class UnknownsBuilder:
    """Builder of the table of unknowns, phase by phase.

    rows: the links' rows that are constraints in some phase, as in `LinkRows`.
    project: whether nodes are projected onto their loops.
    """

    def __init__(
        self,
        chain: Chain,
        controls: AbstractControls,
        rows: np.ndarray,
        *,
        scheme: Radau,
        units: Units,
        project: bool,
    ):
        self.chain = chain
        self.controls = controls
        self.scheme = scheme
        self.units = units
        self.project = project
        self.table: Table = Table()
        of_rows = [f"{chain.link_names[row // 6]}.{LINK_ROWS[row % 6]}" for row in rows]
        dofs = list(chain.dof_names[: chain.nv])
        self.names: Names = Names(dofs, controls.names(chain), of_rows)
        # indices of the free args' unknowns
        self.free_args: np.ndarray = np.zeros(0, int)
        self._force_unit = np.where(rows % 6 < 3, units.torque, units.force)

    def add_free_args(self, model: ArgsModel) -> np.ndarray:
        """Append the free args; return the indices of their numbers."""
        low, high = model.lower, model.upper
        options = {"lower": low, "upper": high, "unit": high - low, "entries": model.labels}
        self.free_args = self.table.add("arg", "the whole motion", (len(low),), **options)
        return self.free_args

    @property
    def node_units(self) -> np.ndarray:
        """Units of a node's entries."""
        nv, states = self.chain.nv, len(self.names.controls) * self.controls.has_state
        u = self.units
        return np.concatenate([np.ones(nv), np.full(nv, u.velocity), np.full(states, u.torque)])

    def add_phase(
        self, phase: Phase, structure: PhaseStructure, before: PhaseIndices | None, impact: bool
    ) -> PhaseIndices:
        """Append the unknowns of a phase and return their indices.

        before: indices of the phase before; None for the first phase, which starts at time 0.
        impact: whether the phase starts with an impact.
        """
        units, n, s, nv = self.units, phase.intervals, self.scheme.stages, self.chain.nv
        add = lambda name, shape, **options: self.table.add(name, phase.name, shape, **options)
        free_time = 0.0 if before is None else np.inf
        time = add("start time", (1,), lower=-free_time, upper=free_time)
        duration = add("duration", (1,), lower=phase.duration[0], upper=phase.duration[1])
        low, high, of_u = self._bounds(phase)
        names = self.names.node(self.controls.has_state)
        nodes = add("node", low.shape, lower=low, upper=high, unit=self.node_units, entries=names)
        blocks = self._add_controls(add, n, nodes, of_u)
        vdot = add("acceleration", (n, s, nv), unit=units.acceleration, entries=self.names.dofs)
        active = np.asarray(structure.active)
        of_links = lambda name, shape, active, unit: self._of_links(add, name, shape, active, unit)
        by_time = units.velocity / units.acceleration
        projected = active & self.project
        return PhaseIndices(
            start_time=int(time[0]),
            duration=int(duration[0]),
            nodes=nodes,
            blocks=blocks,
            vdot=vdot,
            forces=of_links("link force", (n, s), active, self._force_unit),
            impulse=of_links("impulse", (), active & impact, self._force_unit * by_time),
            projection_q=of_links("projection of q", (n,), projected, np.ones(len(active))),
            projection_v=of_links("projection of v", (n,), projected, np.ones(len(active))),
            kept_gap=self._kept_gaps(of_links, structure, before),
        )

    @staticmethod
    def _kept_gaps(
        of_links: Callable, structure: PhaseStructure, before: PhaseIndices | None
    ) -> np.ndarray:
        """Return the indices [rows] of the constant gaps of links placed by `Phase.here`.

        A link that was connected in the phase before keeps the unknowns of that phase.
        """
        kept = np.full(len(structure.active), -1)
        if before is not None:
            kept = np.where(structure.here & ~structure.new, before.kept_gap, kept)
        own = structure.here & (kept < 0)
        return np.maximum(kept, of_links("kept gap", (), own, np.ones(len(own))))

    def _add_controls(self, add: Callable, n: int, nodes: np.ndarray, bounds) -> np.ndarray:
        """Append the controls of a phase; return the indices [n blocks control].

        nodes: indices of the nodes' unknowns, which include the states of controls.
        bounds: lower and upper bounds of a block.
        """
        controls, states = self.controls, int(self.controls.has_state)
        unit = self.units.rate if states else 1.0 if controls.needs_state else self.units.torque
        shape = (n, controls.blocks(self.scheme) - states, len(self.names.controls))
        low, high = bounds
        free = add("control", shape, lower=low, upper=high, unit=unit, entries=self.names.controls)
        of_states = nodes[:-1, None, 2 * self.chain.nv :] if states else free[:, :0]
        return np.concatenate([of_states, free], 1)

    def _of_links(self, add: Callable, name: str, shape, active, unit) -> np.ndarray:
        """Append unknowns for the active rows of links; return their indices, -1 for others."""
        at = np.flatnonzero(active)
        names, out = [self.names.rows[k] for k in at], np.full((*shape, len(active)), -1)
        out[..., at] = add(name, (*shape, len(at)), unit=unit[at], entries=names)
        return out

    def _bounds(self, phase: Phase) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the bounds of a phase's unknowns.

        Lower and upper bounds of the nodes [n + 1, (q v states)], and both of a control block
        [2 control].
        """
        nv = self.chain.nv
        *states, of_u = (np.array(x, float) for x in self.controls.limits(self.chain))
        unbounded = np.full((2, 2 * nv), [[-np.inf], [np.inf]])
        nodes = np.concatenate([unbounded, *states], 1)
        nodes = np.tile(nodes[:, None], (1, phase.intervals + 1, 1))
        offset = {"position": 0, "velocity": nv, "torque": 2 * nv}
        places = (("bounds", slice(None)), ("start", 0), ("end", -1))
        for bound, where in [(b, at) for name, at in places for b in phase.bounds_at(name)]:
            at = coordinates_of(self.chain, bound, self.names.controls)
            self._check_orientation(phase, bound, at)
            if bound.of == "torque" and not states:
                raise ValueError('between: of="torque" needs TorqueRates; use of="control"')
            target = of_u if bound.of == "control" else nodes[:, where]
            columns = at + offset.get(bound.of, 0)
            target[0][..., columns] = np.maximum(target[0][..., columns], bound.lower)
            target[1][..., columns] = np.minimum(target[1][..., columns], bound.upper)
        self._check_bounds(phase, nodes, of_u)
        return nodes[0], nodes[1], of_u

    def _check_orientation(self, phase: Phase, bound: Between, at: np.ndarray) -> None:
        """Raise ValueError if a bound is for the orientation of a ball or a free joint.

        Its unknowns are a rotation vector relative to the guess, and its rate. A bound on them
        depends on the guess, except that a rate of zero is an angular velocity of zero.
        """
        if bound.of not in ("position", "velocity"):
            return
        low, high = (np.broadcast_to(x, at.shape) for x in (bound.lower, bound.upper))
        bounded = np.isfinite(low) | np.isfinite(high)
        if bound.of == "velocity":
            bounded &= (low != 0) | (high != 0)
        wrong = bounded & np.isin(at, quaternion_starts(self.chain)[1][:, None] + np.arange(3))
        if np.any(wrong):
            name = self.chain.dof_names[int(at[np.argmax(wrong)])]
            raise ValueError(
                f"phase {phase.name!r}: between bounds the {bound.of} of {name!r}, an orientation,"
                " whose coordinates depend on the guess; give a function of p.state in `path`,"
                " `start` or `end` instead"
            )

    def _check_bounds(self, phase: Phase, nodes: np.ndarray, of_u: np.ndarray) -> None:
        """Raise ValueError if a lower bound is above its upper bound."""
        names = self.names.node(self.controls.has_state)
        for (low, high), entries in ((nodes, names), (of_u, self.names.controls)):
            if np.any(wrong := low > high):
                at = tuple(int(i[0]) for i in np.nonzero(wrong))
                raise ValueError(
                    f"phase {phase.name!r}: the bounds of {entries[at[-1]]} contradict each other:"
                    f" {low[at]:g} to {high[at]:g}"
                )
