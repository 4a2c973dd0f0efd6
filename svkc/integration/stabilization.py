"""Ways to keep loops closed while errors of integration open them (constraint drift)."""

import equinox as eqx
from jaxtyping import Array, Float

from svkc.model.chain import Chain
from svkc.model.validation import integer, scalar


class AbstractStabilization(eqx.Module):
    """A way to keep loops closed during integration."""


class Projection(AbstractStabilization):
    """Project q and v onto the constraint manifold after every step (coordinate projection).

    The projection is the change of least norm in the metric of the mass matrix M: that of an
    impulse of the loops, paper (29). Projecting a velocity in this metric changes its kinetic
    energy only in second order. Method: Hairer and Wanner, Solving Ordinary Differential Equations
    II, 2nd edition, section VII.2.

    iterations: Newton steps on the positions. One Newton step leaves a gap of second order in the
        drift of a step; 0 projects the velocity alone.

    Raises ValueError if `iterations` is not an integer of at least 0.
    """

    iterations: int = eqx.field(static=True, default=2)

    def __check_init__(self) -> None:
        integer("iterations", self.iterations, 0)


class CoordinatePartitioning(Projection):
    """Compute dependent coordinates from the independent ones, paper (16).

    The dependent coordinates are solved for at every evaluation of the vector field and after every
    step. Independent coordinates (the paper's theta_G) are integrated and never projected. Method:
    Wehage and Haug, Journal of Mechanical Design 104 (1982), 247-255.

    iterations: Newton steps on the dependent coordinates, as in `Projection`.

    Raises ValueError if `iterations` is not an integer of at least 0.
    """


class Baumgarte(AbstractStabilization):
    """Pull open loops back by a critically damped spring while integrating; project nothing.

    The gap g of a loop follows g'' + 2 rate g' + rate^2 g = 0. Method: Baumgarte, Computer Methods
    in Applied Mechanics and Engineering 1 (1972), 1-16.

    rate: decay rate of the gaps (1/s).

    Raises ValueError if `rate` is not one real number.
    """

    rate: Float[Array, ""] | float = 20.0

    def __check_init__(self) -> None:
        scalar("rate", self.rate)


class NoStabilization(AbstractStabilization):
    """Let loops drift. A run whose gap exceeds the tolerance ends with the result `loop_open`."""


def needs_projection(stabilization: AbstractStabilization, chain: Chain) -> bool:
    """Return whether steps are projected: the scene has loops and the method is a projection."""
    has_loops = bool(chain.topology.link_names)
    return has_loops and isinstance(stabilization, Projection)
