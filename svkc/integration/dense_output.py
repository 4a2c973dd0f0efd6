"""Dense output: the state within a step, by the solver's own interpolation."""

from typing import Any

import diffrax
import jax

from svkc.integration.ode import ODEState


class ProjectedInterpolation(diffrax.AbstractLocalInterpolation):
    """The solver's dense output plus a linear part that ends at the projected state.

    shift: the change of the step's end by the projection.
    """

    t0: Any
    t1: Any
    inner: Any
    shift: ODEState

    def evaluate(self, t0, t1=None, left=True):
        def at(t):
            fraction = (t - self.t0) / (self.t1 - self.t0)
            return jax.tree.map(
                lambda y, s: y + fraction * s, self.inner.evaluate(t, left=left), self.shift
            )

        if t1 is None:
            return at(t0)
        return jax.tree.map(lambda a, b: b - a, at(t0), at(t1))


def make_interpolation(cls, *, t0, t1, inner, shift) -> ProjectedInterpolation:
    """Return the dense output of one step.

    cls: interpolation class of the solver.
    inner: what the solver's step returned for the dense output.
    """
    interpolation = cls(t0=t0, t1=t1, **inner)
    return ProjectedInterpolation(t0=t0, t1=t1, inner=interpolation, shift=shift)
