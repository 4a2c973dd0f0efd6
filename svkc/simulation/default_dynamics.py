"""The dynamics of a run, by default the fastest that hold for its chain."""

from typing import Any

import numpy as np

from svkc._jax.pytrees import is_concrete
from svkc.integration.replay import Replay
from svkc.integration.stabilization import AbstractStabilization, Projection
from svkc.loops.constrained_dynamics import (
    AbstractDynamics,
    ArticulatedBodies,
    Dynamics,
    default_dynamics,
)
from svkc.model.chain import Chain

# Largest ratio of two masses at which articulated bodies compute forces of loops to 1e-9 of them:
# the condition number of Delassus' matrix grows with that ratio.
SIMILAR_MASSES = 1e5


def _has_similar_masses(chain: Chain) -> bool:
    """Return whether the masses are similar. They are not known while they are traced."""
    if not is_concrete(chain.mass):
        return False
    masses = np.asarray(chain.mass)
    masses = masses[masses > 0]
    return not masses.size or float(np.max(masses)) <= SIMILAR_MASSES * float(np.min(masses))


def resolve_dynamics(
    chain: Chain, dynamics: Any, stabilization: AbstractStabilization, adjoint: Any
) -> AbstractDynamics:
    """Return the dynamics. Raises ValueError for another type.

    The default is articulated bodies where the stepping loop of svkc can reduce the rows of the
    loops: steps are projected by `Projection`, and the adjoint is `Replay`. With other
    stabilizations or adjoints, where masses may differ by more than `SIMILAR_MASSES`, and in
    float32, the default is composite bodies if the chain has virtual links. In float32 articulated
    bodies leave larger errors in the forces of loops, so that tolerances of 1e-4 take several times
    as many steps on some scenes (benchmarks/README.md).
    """
    if dynamics is None:
        can_reduce = type(stabilization) is Projection and isinstance(adjoint, Replay)
        is_float64 = chain.q_load.dtype == np.float64
        if can_reduce and is_float64 and _has_similar_masses(chain):
            return ArticulatedBodies()
        return default_dynamics(chain)
    if isinstance(dynamics, Dynamics):
        return dynamics.resolved(chain)
    if not isinstance(dynamics, AbstractDynamics):
        raise ValueError(
            "dynamics: expected an object of svkc.dynamics, such as"
            f" svkc.dynamics.CompositeBodies(), got {dynamics!r}"
        )
    return dynamics
