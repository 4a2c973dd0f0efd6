"""The dynamics of a run, by default the fastest that hold for its chain."""

from svkc.integration.stabilization import AbstractStabilization, Projection
from svkc.loops.constrained_dynamics import (
    AbstractDynamics,
    ArticulatedBodies,
    Dynamics,
    default_dynamics,
)
from svkc.loops.delassus import LAPACK_MIN_ROWS
from svkc.model.chain import Chain


def resolve_dynamics(
    chain: Chain, dynamics, stabilization: AbstractStabilization
) -> AbstractDynamics:
    """Return the dynamics. Raises ValueError for another type.

    The default is articulated bodies, which reduce the rows of the loops near singular
    configurations if steps are projected by `Projection`. With other stabilizations, and for many
    loops, where a reduction costs more than pivots that are held, it is that of the chain.
    """
    if dynamics is None:
        few_rows = 6 * len(chain.link_names) < LAPACK_MIN_ROWS
        return (
            ArticulatedBodies()
            if type(stabilization) is Projection and few_rows
            else default_dynamics(chain)
        )
    if isinstance(dynamics, Dynamics):
        return dynamics.resolved(chain)
    if not isinstance(dynamics, AbstractDynamics):
        raise ValueError(
            "dynamics: expected an object of svkc.dynamics, such as"
            f" svkc.dynamics.CompositeBodies(), got {dynamics!r}"
        )
    return dynamics
