"""What is done about the drift of the loops, for `svkc.simulate(..., stabilization=...)`."""

from svkc.integration.stabilization import (
    Baumgarte as Baumgarte,
    CoordinatePartitioning as CoordinatePartitioning,
    NoStabilization as NoStabilization,
    Projection as Projection,
)
