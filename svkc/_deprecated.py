"""Names of version 0.1, kept for one release. Each warns and names its replacement."""

import functools
import importlib
import warnings
from collections.abc import Callable
from typing import TypeVar, cast

_Function = TypeVar("_Function", bound=Callable)

# the old name, below `svkc.`: the new one
RENAMED = {
    "Baumgarte": "stabilization.Baumgarte",
    "Check": "types.GradientCheck",
    "Drift": "stabilization.NoStabilization",
    "Exact": "stabilization.CoordinatePartitioning",
    "Projection": "stabilization.Projection",
    "RESULTS.grazing": "types.DERIVATIVE.grazing",
    "RESULTS.jump": "types.DERIVATIVE.jump",
    "RESULTS.rank_lost": "types.DERIVATIVE.rank_lost",
    "RESULTS.together": "types.DERIVATIVE.together",
    "Replay": "integrators.Replay",
    "RodriguesEuler": "integrators.RodriguesEuler",
    "SemiImplicitEuler": "integrators.SymplecticEuler",
    "error_between": "accuracy.configuration_error",
    "from_mujoco": "interop.from_mujoco",
    "halved": "accuracy.estimate_error",
    "page.show": "show",
    "prefer": "with_independent",
    "scenes.GRIP": "scenes.HALF_GRIP_WIDTH",
    "scenes.brachiation.swung_back": "scenes.brachiation.hanging_state",
    "scenes.swing.EDGE": "scenes.swing.PLATE_EDGE",
    "scenes.swing.leaving": "scenes.swing.seat_events",
    "scenes.swing.parts": "scenes.swing.model_and_links",
    "scenes.swinging": "scenes.hanging_state",
    "scenes.walking.ANKLE": "scenes.walking.ANKLE_HEIGHT",
    "scenes.walking.HIP": "scenes.walking.HIP_HEIGHT",
    "scenes.walking.SOLE": "scenes.walking.SOLE_OFFSET",
    "scenes.walking.leg": "scenes.walking.leg_angles",
    "tangent": "tangent_gradient",
    "to_mujoco": "interop.to_mujoco",
    "tune": "accuracy.tune",
    "velocity_gaps": "loop_gap_rates",
    "xyzw": "interop.quaternions_xyzw",
}
# the old name: the file and name of the object that still serves it, and what to use now
SUPERSEDED = {
    "Dynamics": (
        "loops.constrained_dynamics.Dynamics",
        "an object of svkc.dynamics: ArticulatedBodies(), CompositeBodies(hold=...), UnitVectors()",
    ),
    "by_bodies": (
        "loops.constrained_dynamics.articulated_bodies",
        "svkc.dynamics.ArticulatedBodies()",
    ),
    "inertia_by_composites": (
        "tree.mass_matrix.mass_matrix_crba",
        "svkc.dynamics.CompositeBodies()",
    ),
    "inertia_by_unit_vectors": (
        "tree.mass_matrix.mass_matrix_unit_vectors",
        "svkc.dynamics.UnitVectors()",
    ),
}


def _warn(name: str, use: str, stacklevel: int) -> None:
    """Warn that a name below `svkc.` is deprecated."""
    warnings.warn(
        f"svkc.{name} is deprecated and leaves with the next release; use {use}",
        DeprecationWarning,
        stacklevel=stacklevel,
    )


def warn_of_results(name: str, stacklevel: int) -> None:
    """Warn that a code of derivatives was read from `svkc.RESULTS`.

    name: of the code; "": `svkc.RESULTS` was compared with, or indexed by, such a code.
    """
    if name:
        _warn(f"RESULTS.{name}", f"svkc.{RENAMED[f'RESULTS.{name}']}", stacklevel + 1)
    else:
        _warn("RESULTS for traj.derivative", "svkc.types.DERIVATIVE", stacklevel + 1)


def or_loop_jacobian(jacobian: _Function) -> _Function:
    """Wrap `svkc.jacobian` so that a call without `body`, which returned the loop Jacobian, still
    does, with a `DeprecationWarning`."""

    @functools.wraps(jacobian)
    def call(*args, **options):
        if len(args) > 2 or {"body", "point"} & options.keys():
            return jacobian(*args, **options)
        _warn("jacobian without a body", "svkc.loop_jacobian", stacklevel=3)
        return importlib.import_module("svkc").loop_jacobian(*args, **options)

    return cast(_Function, call)


def resolve(name: str):
    """Return the object of a deprecated name `svkc.<name>`, with a `DeprecationWarning`.

    Raises AttributeError if the name is not one of them.
    """
    if name == "page":
        return importlib.import_module("svkc.page")
    if name in RENAMED:
        path, use = RENAMED[name], f"svkc.{RENAMED[name]}"
    elif name in SUPERSEDED:
        path, use = SUPERSEDED[name]
    else:
        module, _, attribute = f"svkc.{name}".rpartition(".")
        raise AttributeError(f"module {module!r} has no attribute {attribute!r}")
    _warn(name, use, stacklevel=4)
    module, _, attribute = f"svkc.{path}".rpartition(".")
    return getattr(importlib.import_module(module), attribute)
