"""Types of results, for annotations and for `isinstance`, and the codes in `traj.derivative`."""

from svkc.loops.actuation import Actuation as Actuation
from svkc.loops.constrained_dynamics import AbstractDynamics as AbstractDynamics
from svkc.loops.coordinates import Coordinates as Coordinates
from svkc.loops.forward_dynamics import LoopForces as LoopForces
from svkc.loops.mobility import Mobility as Mobility
from svkc.model.chain_names import ChainNames as ChainNames
from svkc.model.named_access import JointState as JointState
from svkc.model.parameters import BodyParameters as BodyParameters
from svkc.simulation.codes import DERIVATIVE as DERIVATIVE
from svkc.simulation.records import Events as Events, Phases as Phases
from svkc.simulation.report import Report as Report
from svkc.tools.gradient_check import GradientCheck as GradientCheck
from svkc.tools.inverse_dynamics_along import InverseDynamics as InverseDynamics
from svkc.transitions.guards import AbstractGuard as AbstractGuard
from svkc.tree.bodies import Jacobian as Jacobian, Poses as Poses, Velocities as Velocities
from svkc.tree.energy import Momentum as Momentum
from svkc.tree.points import CenterOfMass as CenterOfMass
