"""Collocation schemes: Butcher tables of implicit Runge-Kutta methods."""

import dataclasses
import functools

import numpy as np

from svkc.model.validation import as_array


@dataclasses.dataclass(frozen=True)
class Radau:
    """Radau IIA collocation. With s stages the order is 2 s - 1.

    The last stage is at the end of the interval.

    stages: number s of stages of an interval, from 1 (implicit Euler) to 5.

    Raises ValueError for another number.
    """

    stages: int = 2

    def __post_init__(self) -> None:
        if as_array(self.stages).dtype.kind != "i" or not 1 <= self.stages <= 5:
            raise ValueError(f"Radau: got {self.stages!r} stages, expected a number from 1 to 5")

    @functools.cached_property
    def c(self) -> np.ndarray:
        """Abscissae of the stages; the last is 1."""
        # the right Radau points are the zeros of the derivative of order s - 1 of
        # x^(s - 1) (x - 1)^s
        s = self.stages
        factors = [np.poly1d([1.0, 0.0])] * (s - 1) + [np.poly1d([1.0, -1.0])] * s
        polynomial = functools.reduce(np.polymul, factors, np.poly1d([1.0]))
        return np.append(np.sort(np.roots(polynomial.deriv(s - 1).coeffs).real)[:-1], 1.0)

    @functools.cached_property
    def A(self) -> np.ndarray:
        """Matrix of the stages: integrals of Lagrange's polynomials from 0 to each abscissa."""
        powers = np.arange(1, self.stages + 1)
        vandermonde = self.c[:, None] ** (powers - 1)
        return (self.c[:, None] ** powers / powers) @ np.linalg.inv(vandermonde)

    @property
    def b(self) -> np.ndarray:
        """Weights of the quadrature; the last row of A, as the last abscissa is 1."""
        return self.A[-1]

    def interpolation(self, times: np.ndarray) -> np.ndarray:
        """Return the weights [times s] that interpolate the stages' values.

        times: as fractions of the interval, from 0 to 1.
        """
        powers = np.arange(self.stages)
        vandermonde = self.c[:, None] ** powers
        return (np.asarray(times, float)[:, None] ** powers) @ np.linalg.inv(vandermonde)
