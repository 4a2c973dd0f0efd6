"""Units by which the solver divides unknowns, rows and the cost."""

import dataclasses

import numpy as np

from svkc.model.chain import Chain


@dataclasses.dataclass(frozen=True)
class Units:
    """Typical magnitudes of a problem's quantities.

    The solver divides unknowns and rows by these numbers, so that scaled values are near one.

    velocity: rad/s, m/s. acceleration: rad/s^2, m/s^2. force: N. torque: N m.
    rate: rate of torques (N m/s). cost: in the unit of the cost; None: from the cost at random
        points.
    """

    velocity: float
    acceleration: float
    force: float
    torque: float
    rate: float
    cost: float | None = None

    def __str__(self) -> str:
        return ", ".join(f"{f.name} {getattr(self, f.name):.3g}" for f in dataclasses.fields(self)
                         if getattr(self, f.name) is not None)  # fmt: skip


def units_of(chain: Chain, duration: float) -> Units:
    """Return units from the chain's mass, length and gravity.

    duration: of the motion (s). Without gravity, accelerations are scaled by it.
    """
    mass = max(float(np.sum(chain.mass)), 1e-6)
    length = max(float(chain.length), 1e-6)
    gravity = float(np.linalg.norm(chain.gravity)) or 4 * length / duration**2
    velocity = max(2 * np.sqrt(gravity / length), 1.0)
    torque = mass * gravity * length / 3
    return Units(
        velocity=velocity,
        acceleration=velocity**2,
        force=mass * gravity,
        torque=torque,
        rate=torque * velocity,
    )
