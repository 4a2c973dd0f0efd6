"""Phases of a problem, and what their users say of them: bounds, constraints, costs."""

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from svkc.model.annotations import Checked, Function, Names, Scalar
from svkc.model.chain import Chain
from svkc.model.names import unknown_name
from svkc.model.validation import as_array, boolean, check_function, names, real_array

# what a bound may be on
QUANTITIES = ("position", "velocity", "torque", "control")


@dataclasses.dataclass(frozen=True)
class Between:
    """Bounds on coordinates of joints; see `between`."""

    joint: Any
    lower: Any
    upper: Any
    of: str


def between(joint: Names, lower: Scalar, upper: Scalar, *, of: str = "position") -> Between:
    """Return bounds on a joint's coordinate, for the lists `bounds`, `start` and `end` of phases.

    joint: name of a joint, of a coordinate (`Chain.dof_names`), or of several. For `of="control"`
        names of controls.
    lower, upper: least and largest value, in SI units and radians; -inf and inf: no bound.
    of: "position", "velocity", "torque", or "control". Torques have bounds where they are states,
        with `TorqueRates`; otherwise torques are controls.

    Raises ValueError if the bounds contradict each other, are no numbers, or `of` is unknown.
    """
    lower, upper = (np.asarray(real_array("between", x, float)) for x in (lower, upper))
    if of not in QUANTITIES:
        raise ValueError(f"of: got {of!r}, expected one of {', '.join(QUANTITIES)}")
    if not np.all(lower <= upper):
        raise ValueError(
            f"between: {joint!r} has the bounds {lower} to {upper}, which no value has"
        )
    return Between(joint=names("joint", joint), lower=lower, upper=upper, of=of)


@dataclasses.dataclass(frozen=True)
class Constraint:
    """A named constraint lower <= function(point) <= upper; see `constraint`."""

    name: str
    function: Any
    lower: Any = 0.0
    upper: Any = np.inf


def constraint(
    name: str, function: Function, lower: Scalar = 0.0, upper: Scalar = np.inf
) -> Constraint:
    """Return a named constraint, for the lists `path`, `start` and `end` of phases.

    name: shown where the constraint is violated.
    function: a function of a `Point` that returns a number or an array.
    lower, upper: bounds of its values; equal bounds make an equation.
    """
    return Constraint(name=name, function=function, lower=lower, upper=upper)


def as_constraint(where: str, index: int, entry: Any) -> Any:
    """Return an entry of a list of constraints as a `Constraint`, or a `Between` unchanged."""
    if isinstance(entry, Between | Constraint):
        return entry
    lower, upper = 0.0, np.inf
    if isinstance(entry, tuple) and len(entry) == 3:
        entry, lower, upper = entry
    if not callable(entry):
        raise ValueError(
            f"{where}: got {entry!r}, expected a function of a point, (function, lower, upper),"
            " optimize.constraint(...) or optimize.between(...)"
        )
    name = getattr(entry, "__name__", "<lambda>")
    name = f"{where}[{index}]" if name == "<lambda>" else name
    return Constraint(name=name, function=entry, lower=lower, upper=upper)


@dataclasses.dataclass(frozen=True)
class Phase:
    """A phase of a motion: one structure, for a duration that is free within bounds.

    name: name of the phase.
    connected: names of the virtual links that are connected in the phase.
    duration: least and largest duration (s), or one number for a fixed one.
    intervals: number of collocation intervals of equal length.
    mesh: places of the nodes as fractions of the duration, from 0 to 1, in place of `intervals`;
        None: equal intervals.
    bounds: of coordinates at the nodes, from `between`.
    path: constraints at every stage: functions g of a `Point` with g >= 0, (g, lower, upper), or
        `constraint(...)`. Those that depend on the state alone hold at the start too.
    start, end: constraints at the start and at the end, in the same forms, or from `between`.
    impact: whether links that connect at the start do so with an impact, as `svkc.connect` does.
        False: the velocity before already keeps the new loops.
    here: names of the links that connect where the bodies are, as `svkc.connect(..., here=True)`
        does, and stay at that place in the phases that follow. True: all links that are new in the
        phase, but for links of the first phase that are connected when the chain is loaded. Other
        links connect at their declared placements.
    running: running cost of this phase (1/s), a function of a `Point`; added to the problem's.
    final: cost at the end of this phase, a function of a `Point`; added to the problem's.
    continuous_torques: whether torques that are states go on from the phase before.

    Raises ValueError if a field has another form.
    """

    name: str
    connected: Any = ()
    duration: Any = (0.1, 1.0)
    intervals: Any = 20
    bounds: Sequence[Any] = ()
    path: Sequence[Any] = ()
    start: Sequence[Any] = ()
    end: Sequence[Any] = ()
    impact: bool = True
    here: bool | Names = False
    running: Checked[Function | None] = None
    final: Checked[Function | None] = None
    continuous_torques: bool = True
    mesh: Any = None

    def __post_init__(self) -> None:
        if not isinstance(self.name, str):
            raise ValueError(f"phase: name must be text, got {self.name!r}")
        put = lambda name, value: object.__setattr__(self, name, value)
        put("connected", tuple(names("connected", self.connected)))
        put("duration", self._checked_duration())
        if self.mesh is not None:
            put("mesh", self._checked_mesh())
            put("intervals", len(self.mesh) - 1)
        count = as_array(self.intervals)
        if count.shape != () or count.dtype.kind not in "iu" or count < 1:
            raise ValueError(
                f"phase {self.name!r}: got {self.intervals!r} intervals, expected 1 or more"
            )
        put("intervals", int(count))
        if not isinstance(self.here, bool):
            put("here", tuple(names("here", self.here)))
            for name in self.here:
                if name not in self.connected:
                    raise ValueError(
                        f"phase {self.name!r}: here names {name!r}, which is not connected in it"
                    )
        for name in ("impact", "continuous_torques"):
            boolean(f"phase {self.name!r}: {name}", getattr(self, name))
        for name in ("running", "final"):
            if getattr(self, name) is not None:
                check_function(f"phase {self.name!r}: {name}", getattr(self, name), "point")
        for name in ("bounds", "path", "start", "end"):
            put(name, self._checked_list(name))

    def _checked_duration(self) -> tuple[float, float]:
        value = np.asarray(real_array(f"phase {self.name!r}: duration", self.duration), float)
        value = np.broadcast_to(value, 2) if value.shape in ((), (1,), (2,)) else np.full(2, np.nan)
        if not 0 < value[0] <= value[1] < np.inf:
            raise ValueError(
                f"phase {self.name!r}: got the duration {self.duration!r}, expected bounds (lower,"
                " upper) with 0 < lower <= upper, or one number"
            )
        return float(value[0]), float(value[1])

    def _checked_mesh(self) -> tuple[float, ...]:
        mesh = np.asarray(real_array(f"phase {self.name!r}: mesh", self.mesh, float))
        if (
            mesh.ndim != 1
            or len(mesh) < 2
            or mesh[0] != 0
            or mesh[-1] != 1
            or any(mesh[1:] <= mesh[:-1])
        ):
            raise ValueError(
                f"phase {self.name!r}: got the mesh {self.mesh!r}, expected increasing places of"
                " nodes from 0 to 1"
            )
        return tuple(mesh.tolist())

    @property
    def places(self) -> np.ndarray:
        """Places [intervals + 1] of the nodes, as fractions of the duration."""
        return np.linspace(0, 1, self.intervals + 1) if self.mesh is None else np.array(self.mesh)

    def _checked_list(self, name: str) -> tuple[Any, ...]:
        entries, where = getattr(self, name), f"{name} of {self.name}"
        if callable(entries) or isinstance(entries, Between | Constraint):
            entries = [entries]
        if not isinstance(entries, Iterable):
            raise ValueError(f"phase {self.name!r}: {name} must be a list, got {entries!r}")
        entries = tuple(as_constraint(where, i, entry) for i, entry in enumerate(entries))
        for entry in entries:
            if name == "path" and isinstance(entry, Between):
                raise ValueError(
                    f"phase {self.name!r}: path has a between(...); put it in `bounds`"
                )
            if name == "bounds" and isinstance(entry, Constraint):
                raise ValueError(
                    f"phase {self.name!r}: bounds has a function; it belongs in `path`, `start`"
                    " or `end`"
                )
        return entries

    def constraints(self, which: str) -> list[Constraint]:
        """Return the constraints by functions of one of the lists."""
        return [c for c in getattr(self, which) if isinstance(c, Constraint)]

    def bounds_at(self, which: str) -> list[Between]:
        """Return the bounds on coordinates of one of the lists."""
        return [b for b in getattr(self, which) if isinstance(b, Between)]


def coordinates_of(chain: Chain, bound: Between, controls: list[str]) -> np.ndarray:
    """Return the indices of a bound's coordinates in v of the tree, or in a block of controls.

    Raises ValueError, with the nearest names, for unknown names.
    """
    if bound.of in ("torque", "control"):
        known = {name: [i] for i, name in enumerate(controls)}
    else:
        known = {name: [i] for i, name in enumerate(chain.dof_names[: chain.nv])}
        for joint in chain.joint_names:
            known[joint] = list(range(chain.nv)[chain.v_index(joint)])
    for name in bound.joint:
        if name not in known:
            raise unknown_name(f"{bound.of} of a joint", name, tuple(known))
    return np.array([i for name in bound.joint for i in known[name]], int)
