"""svkc: structure-varying kinematic chains in JAX, after Nakamura and Yamane (2000)."""

from importlib import import_module as _import_module
from importlib.metadata import PackageNotFoundError as _Missing, version as _version
from typing import Any as _Any

from svkc import _deprecated

# groups with several members have a namespace of their own
from svkc import (
    accuracy as accuracy,
    dynamics as dynamics,
    integrators as integrators,
    interop as interop,
    stabilization as stabilization,
    types as types,
)

# nouns
from svkc.model.chain import Chain as Chain, State as State, Structure as Structure
from svkc.model.virtual_link import VirtualLink as VirtualLink
from svkc.transitions.spare_links import Grip as Grip
from svkc.simulation.trajectory import Trajectory as Trajectory
from svkc.simulation.codes import RESULTS as RESULTS

# files
from svkc.mjcf.load import load as load
from svkc.simulation.archive import load_chain as load_chain, load_trajectory as load_trajectory

# bodies: how they are placed and move
from svkc.tree.bodies import poses as poses, velocities as velocities
from svkc.tree.points import (
    center_of_mass as center_of_mass,
    jacobian as _jacobian,
    point_position as point_position,
    point_velocity as point_velocity,
    apply_force as apply_force,
)
from svkc.tree.configuration import integrate as integrate, difference as difference
from svkc.tree.energy import (
    energy as energy,
    kinetic_energy as kinetic_energy,
    potential_energy as potential_energy,
    momentum as momentum,
)
from svkc.tree.mass_matrix import mass_matrix as mass_matrix
from svkc.tree.inverse_dynamics import (
    bias_force as bias_force,
    inverse_dynamics as inverse_dynamics,
)

# loops
from svkc.loops.mobility import mobility as mobility
from svkc.loops.coordinates import coordinates as coordinates, with_independent as with_independent
from svkc.loops.forward_dynamics import (
    forward_dynamics as forward_dynamics,
    loop_forces as loop_forces,
)
from svkc.loops.actuation import actuation as actuation
from svkc.tools.inverse_dynamics_along import inverse_dynamics_along as inverse_dynamics_along
from svkc.loops.constraint import (
    loop_gaps as loop_gaps,
    loop_gap_rates as loop_gap_rates,
    loop_jacobian as loop_jacobian,
)

# changes of structure
from svkc.transitions.transition import (
    connect as connect,
    cut as cut,
    lock as lock,
    unlock as unlock,
    unbind as unbind,
    transition as transition,
)
from svkc.transitions.spare_links import bind as bind

# events
from svkc.transitions.events import at as at, when as when
from svkc.transitions.guards import touch as touch, leaves as leaves, overload as overload

# runs
from svkc.simulation.simulate import simulate as simulate
from svkc.integration.integrators import step as step
from svkc.tools.rollout import rollout as rollout

# derivatives
from svkc.tools.gradient_check import check_grad as check_grad
from svkc.tree.configuration import tangent_gradient as tangent_gradient

# pictures
from svkc.viz.render import render as render, plot as plot
from svkc.viz.html_page import show as show

jacobian = _deprecated.or_loop_jacobian(_jacobian)

__all__ = [
    "Chain",
    "State",
    "Structure",
    "VirtualLink",
    "Grip",
    "Trajectory",
    "RESULTS",
    "load",
    "load_chain",
    "load_trajectory",
    "poses",
    "velocities",
    "center_of_mass",
    "jacobian",
    "point_position",
    "point_velocity",
    "apply_force",
    "integrate",
    "difference",
    "energy",
    "kinetic_energy",
    "potential_energy",
    "momentum",
    "mass_matrix",
    "bias_force",
    "inverse_dynamics",
    "mobility",
    "coordinates",
    "forward_dynamics",
    "loop_forces",
    "actuation",
    "inverse_dynamics_along",
    "loop_gaps",
    "loop_gap_rates",
    "loop_jacobian",
    "with_independent",
    "connect",
    "cut",
    "lock",
    "unlock",
    "bind",
    "unbind",
    "transition",
    "at",
    "when",
    "touch",
    "leaves",
    "overload",
    "simulate",
    "step",
    "rollout",
    "check_grad",
    "tangent_gradient",
    "render",
    "plot",
    "show",
    "dynamics",
    "stabilization",
    "integrators",
    "accuracy",
    "interop",
    "types",
]

try:
    __version__ = _version("svkc")
except _Missing:  # a source tree that is not installed
    __version__ = "0"


def __getattr__(name: str) -> _Any:
    """Return `svkc.scenes` or `svkc.optimize`, imported at its first use; or the object of a
    deprecated name, with a `DeprecationWarning`."""
    if name in ("scenes", "optimize"):
        return _import_module(f"svkc.{name}")
    return _deprecated.resolve(name)
