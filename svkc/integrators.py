"""Integrators and derivatives of svkc's own, for `svkc.simulate(..., solver=..., adjoint=...)`."""

from svkc.integration.integrators import (
    RodriguesEuler as RodriguesEuler,
    SymplecticEuler as SymplecticEuler,
)
from svkc.integration.replay import Replay as Replay
