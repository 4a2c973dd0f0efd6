"""svkc: structure-varying kinematic chains in JAX, after Nakamura and Yamane (2000)."""

from importlib.metadata import PackageNotFoundError as _Missing
from importlib.metadata import version as _version

# nouns
from svkc.chain import Chain as Chain, State as State, Structure as Structure, VirtualLink as VirtualLink

# models in, runs out
from svkc.archive import load_chain as load_chain, load_trajectory as load_trajectory
from svkc.interop import from_mujoco as from_mujoco, to_mujoco as to_mujoco, xyzw as xyzw
from svkc.load import load as load
from svkc.trajectory import RESULTS as RESULTS, Trajectory as Trajectory
from svkc.view import plot as plot, render as render

# how bodies are and move
from svkc.kinematics import difference as difference, integrate as integrate, poses as poses, velocities as velocities
from svkc.energy import energy as energy, kinetic_energy as kinetic_energy, momentum as momentum, potential_energy as potential_energy
from svkc.inverse_dynamics import bias_force as bias_force, inverse_dynamics as inverse_dynamics, mass_matrix as mass_matrix

# loops
from svkc.closure import coordinates as coordinates, jacobian as jacobian, loop_gaps as loop_gaps, velocity_gaps as velocity_gaps
from svkc.forward_dynamics import forward_dynamics as forward_dynamics, loop_forces as loop_forces
from svkc.actuation import actuation as actuation
from svkc.mobility import mobility as mobility
from svkc.assembly import prefer as prefer

# changes of structure
from svkc.transition import connect as connect, cut as cut, lock as lock, transition as transition, unbind as unbind, unlock as unlock
from svkc.binding import Grip as Grip, bind as bind
from svkc.events import at as at, when as when
from svkc.guards import leaves as leaves, overload as overload, touch as touch

# runs
from svkc.simulate import simulate as simulate
from svkc.replay import Replay as Replay
from svkc.rollout import rollout as rollout
from svkc.ahead import Program as Program, compile as compile
from svkc.tuning import error_between as error_between, halved as halved, tune as tune
from svkc.projection import dependent_change as dependent_change, inertia_change as inertia_change, least_change as least_change
from svkc.stepping import Baumgarte as Baumgarte, Drift as Drift, Exact as Exact, Projection as Projection
from svkc.articulated import by_bodies as by_bodies
from svkc.forward_dynamics import Dynamics as Dynamics
from svkc.inverse_dynamics import inertia_by_composites as inertia_by_composites, inertia_by_unit_vectors as inertia_by_unit_vectors
from svkc.solvers import RodriguesEuler as RodriguesEuler, SemiImplicitEuler as SemiImplicitEuler, step as step

# derivatives
from svkc.derivative import Check as Check, check_grad as check_grad, tangent as tangent

try:
    __version__ = _version("svkc")
except _Missing:  # a source tree that is not installed
    __version__ = "0"
