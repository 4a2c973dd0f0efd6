"""Ways to compute accelerations, for `svkc.simulate(..., dynamics=...)`."""

from svkc.loops.constrained_dynamics import (
    ArticulatedBodies as ArticulatedBodies,
    CompositeBodies as CompositeBodies,
    UnitVectors as UnitVectors,
)
