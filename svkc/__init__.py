from svkc.chain import *
from svkc.load import load
from svkc.events import at, when
from svkc.simulate import simulate
from svkc.stepping import Baumgarte, Drift, Projection
