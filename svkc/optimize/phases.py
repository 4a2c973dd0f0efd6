"""Phases of a problem, with their bounds, constraints and costs."""

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from svkc.model.annotations import Checked, Function, Names, Scalar
from svkc.model.chain import Chain
from svkc.model.names import unknown_name
from svkc.model.validation import as_array, boolean, check_function, names, real_array

# quantities that `between` can bound
QUANTITIES = ("position", "velocity", "torque", "control")


@dataclasses.dataclass(frozen=True)
class Between:
    """Bounds on coordinates of joints; see `between`."""

    joint: Any
    lower: Any
    upper: Any
    of: str


def between(joint: Names, lower: Scalar, upper: Scalar, *, of: str = "position") -> Between:
    """Return bounds on coordinates, for the lists `bounds`, `start` and `end` of phases.

    joint: one name or several, of joints or of coordinates (`Chain.dof_names`). For `of="control"`
        names of controls.
    lower, upper: smallest and largest value, in SI units and radians; -inf and inf: no bound.
        Orientations of ball and free joints cannot be bounded here, and their velocities can only
        be fixed at zero. Bound them by a function of a `Point` in `path`, `start` or `end`.
    of: "position", "velocity", "torque", or "control". "torque" is for torques that are states, as
        with `TorqueRates`. The torques of `Torques` are controls. Controls are bounded in whole
        phases only.

    Raises ValueError if the lower bound is above the upper one, if a bound is not a number, or if
    `of` is unknown.
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

    name: name of the constraint in messages and in tables of violations.
    function: a function of a `Point` that returns a number or an array.
    lower, upper: bounds of the function's values; equal bounds make an equality constraint.
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
    """A phase of a motion: a time span with one structure and a duration between bounds.

    name: name of the phase.
    connected: names of the virtual links that are connected in the phase.
    duration: smallest and largest duration (s), or one number for a fixed duration.
    intervals: number of mesh intervals, of equal length.
    mesh: positions of the nodes as fractions of the duration, from 0 to 1. They take the place of
        `intervals`. None: equal intervals.
    bounds: bounds on coordinates at all nodes, from `between`.
    path: constraints at every stage: functions g of a `Point` with g >= 0, tuples (g, lower,
        upper), or `constraint(...)`. Constraints that do not read accelerations, forces or torques
        of links also hold at the start of the phase.
    start, end: constraints at the start and at the end of the phase, in the forms of `path`, or
        bounds from `between`.
    impact: whether links that connect at the start do so with an impact, as in `svkc.connect`.
        False: velocities are continuous, and must already satisfy the new loops.
    here: names of links that connect at the bodies' current poses, as with `svkc.connect(...,
        here=True)`, and keep that placement in later phases. True: all links that are new in the
        phase, except for links of the first phase that are connected when the chain is loaded.
        Other links connect at their declared placements.
    running: running cost of the phase (cost per second), a function of a `Point`. It is added to
        the running cost of the problem.
    final: cost at the end of the phase, a function of a `Point`. It is added to other costs.
    continuous_torques: whether torques are continuous from the phase before, where they are states.

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
    def node_fractions(self) -> np.ndarray:
        """Positions [intervals + 1] of the nodes, as fractions of the duration."""
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
            # the controls of an interval have no value at a node
            if name in ("start", "end") and getattr(entry, "of", "") == "control":
                raise ValueError(
                    f'phase {self.name!r}: {name} has a between(..., of="control"), which bounds'
                    " whole phases; put it in `bounds`, or give a function of p.u"
                )
        return entries

    def constraints(self, which: str) -> list[Constraint]:
        """Return the constraints that are functions, in the list `path`, `start` or `end`."""
        return [c for c in getattr(self, which) if isinstance(c, Constraint)]

    def bounds_at(self, which: str) -> list[Between]:
        """Return the bounds on coordinates in the list `bounds`, `start` or `end`."""
        return [b for b in getattr(self, which) if isinstance(b, Between)]


def coordinates_of(chain: Chain, bound: Between, controls: list[str]) -> np.ndarray:
    """Return the indices of a bound's coordinates in v of the tree, or in a control block.

    controls: names of a control block's numbers.

    Raises ValueError, with the nearest names, for unknown names, and for another number of bounds.
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
    at = np.array([i for name in bound.joint for i in known[name]], int)
    for bounds in (bound.lower, bound.upper):
        if bounds.shape not in ((), (1,), at.shape):
            raise ValueError(
                f"between: got bounds of shape {bounds.shape} for {at.size} coordinates of"
                f" {', '.join(bound.joint)}"
            )
    return at
