"""svkc: structure-varying kinematic chains in JAX, after Nakamura and Yamane (2000)."""

from importlib.metadata import PackageNotFoundError as _Missing
from importlib.metadata import version as _version

# nouns
from svkc.model.chain import Chain as Chain, State as State, Structure as Structure
from svkc.model.virtual_link import VirtualLink as VirtualLink

# models in, runs out
from svkc.simulation.archive import load_chain as load_chain, load_trajectory as load_trajectory
from svkc.mjcf.convert import from_mujoco as from_mujoco, to_mujoco as to_mujoco
from svkc.tree.configuration import xyzw as xyzw
from svkc.mjcf.load import load as load
from svkc.simulation.records import RESULTS as RESULTS
from svkc.simulation.trajectory import Trajectory as Trajectory
from svkc import page as page
from svkc.viz.render import plot as plot, render as render

# how bodies are and move
from svkc.tree.configuration import difference as difference, integrate as integrate
from svkc.tree.kinematics import poses as poses, velocities as velocities
from svkc.tree.energy import (
    energy as energy,
    kinetic_energy as kinetic_energy,
    momentum as momentum,
    potential_energy as potential_energy,
)
from svkc.tree.inverse_dynamics import (
    bias_force as bias_force,
    inverse_dynamics as inverse_dynamics,
)
from svkc.tree.mass_matrix import mass_matrix as mass_matrix

# loops
from svkc.loops.constraint import (
    jacobian as jacobian,
    loop_gaps as loop_gaps,
    velocity_gaps as velocity_gaps,
)
from svkc.loops.coordinates import coordinates as coordinates
from svkc.loops.forward_dynamics import (
    forward_dynamics as forward_dynamics,
    loop_forces as loop_forces,
)
from svkc.loops.actuation import actuation as actuation
from svkc.loops.mobility import mobility as mobility
from svkc.loops.coordinates import prefer as prefer

# changes of structure
from svkc.transitions.transition import (
    connect as connect,
    cut as cut,
    lock as lock,
    transition as transition,
    unbind as unbind,
    unlock as unlock,
)
from svkc.transitions.spare_links import Grip as Grip, bind as bind
from svkc.transitions.events import at as at, when as when
from svkc.transitions.guards import leaves as leaves, overload as overload, touch as touch

# runs
from svkc.simulation.simulate import simulate as simulate
from svkc.integration.replay import Replay as Replay
from svkc.tools.rollout import rollout as rollout
from svkc.tools.accuracy import error_between as error_between, halved as halved, tune as tune
from svkc.integration.stabilization import (
    Baumgarte as Baumgarte,
    Projection as Projection,
)
from svkc import dynamics as dynamics, stabilization as stabilization
from svkc.loops.constrained_dynamics import by_bodies as by_bodies
from svkc.loops.constrained_dynamics import Dynamics as Dynamics
from svkc.tree.mass_matrix import (
    inertia_by_composites as inertia_by_composites,
    inertia_by_unit_vectors as inertia_by_unit_vectors,
)
from svkc.integration.integrators import (
    RodriguesEuler as RodriguesEuler,
    SemiImplicitEuler as SemiImplicitEuler,
    step as step,
)

# derivatives
from svkc.tools.gradient_check import Check as Check, check_grad as check_grad
from svkc.tree.configuration import tangent as tangent

# old names
Exact, Drift = stabilization.CoordinatePartitioning, stabilization.NoStabilization

try:
    __version__ = _version("svkc")
except _Missing:  # a source tree that is not installed
    __version__ = "0"
