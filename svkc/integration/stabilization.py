"""What is done about the drift of the loops."""

import equinox as eqx
from jaxtyping import Array, Float

from svkc.integration.integrators import FieldArgs
from svkc.model.validation import integer, scalar


class AbstractStabilization(eqx.Module):
    """What is done about the drift of the loops."""


class Projection(AbstractStabilization):
    """Loop drift is taken away after every step by the change of q and v that closes the loops and
    is the least in the metric of the inertia: a velocity that is projected loses kinetic energy of
    second order only.

    iterations: Newton steps on the position; one leaves a gap of the second order in the drift of a
    step.
    """

    iterations: int = eqx.field(static=True, default=2)

    def __check_init__(self):
        integer("iterations", self.iterations, 0)


class CoordinatePartitioning(Projection):
    """Dependent coordinates are functions of the independent ones, solved for at every evaluation
    of the field as well as after every step: what is integrated is the paper's theta_G, and the
    rest follows from it. Only dependent coordinates are moved. `iterations` as in `Projection`."""


class Baumgarte(AbstractStabilization):
    """Loop drift is pulled back while integrating, as by a critically damped spring of this rate
    (1/s); nothing is projected."""

    rate: Float[Array, ""] | float = 20.0

    def __check_init__(self):
        scalar("rate", self.rate)


class NoStabilization(AbstractStabilization):
    """Nothing is done about loop drift."""


def needs_projection(stabilization, scene: FieldArgs) -> bool:
    """Whether steps are put back onto the loops."""
    return bool(scene.chain.topology.link_names) and isinstance(stabilization, Projection)
