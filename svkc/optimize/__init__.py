"""Motion optimization: phases of different structure, solved by collocation and IPOPT."""

from svkc.optimize.certificate import SolutionReport as SolutionReport
from svkc.optimize.checks import Check as Check
from svkc.optimize.controls import (
    AbstractControls as AbstractControls,
    Parametrized as Parametrized,
    TorqueRates as TorqueRates,
    Torques as Torques,
)
from svkc.optimize.guesses import Guess as Guess, PhaseMotion as PhaseMotion
from svkc.optimize.interior_point import InteriorPoint as InteriorPoint
from svkc.optimize.ipopt import AbstractSolver as AbstractSolver, Ipopt as Ipopt
from svkc.optimize.loading import load_solution as load_solution
from svkc.optimize.multistart import Solutions as Solutions
from svkc.optimize.phases import (
    Phase as Phase,
    between as between,
    constraint as constraint,
)
from svkc.optimize.points import Point as Point
from svkc.optimize.problem import Problem as Problem
from svkc.optimize.replay import Distance as Distance, ReplayReport as ReplayReport
from svkc.optimize.schemes import Radau as Radau
from svkc.optimize.solution import OUTCOME as OUTCOME, Solution as Solution
from svkc.optimize.units import Units as Units
