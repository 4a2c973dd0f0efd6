"""Dense output: the state within a step, by the solver's own interpolation."""

from collections.abc import Callable, Mapping
from typing import Any

import diffrax
import jax

from svkc._jax.select import where
from svkc.integration.ode import ODEState
from svkc.model.annotations import Scalar


class ProjectedInterpolation(diffrax.AbstractLocalInterpolation):
    """The solver's dense output plus a linear term, so that it ends at the projected state.

    inner: the solver's dense output.
    shift: projected state less the solver's state, at the end of the step.
    """

    t0: Any
    t1: Any
    inner: Any
    shift: ODEState

    def evaluate(self, t0: Scalar, t1: Scalar | None = None, left: bool = True) -> ODEState:
        def at(t):
            duration = self.t1 - self.t0  # zero in a lane that has ended before others
            fraction = (t - self.t0) / where(duration == 0, 1, duration)
            return jax.tree.map(
                lambda y, s: y + fraction * s, self.inner.evaluate(t, left=left), self.shift
            )

        if t1 is None:
            return at(t0)
        return jax.tree.map(lambda a, b: b - a, at(t0), at(t1))


def make_interpolation(
    cls: Callable[..., diffrax.AbstractLocalInterpolation],
    *,
    t0: Scalar,
    t1: Scalar,
    inner: Mapping[str, Any],
    shift: ODEState,
) -> ProjectedInterpolation:
    """Return the dense output of one step.

    cls: interpolation class of the solver.
    inner: the `dense_info` that the solver's step returned.
    shift: as in `ProjectedInterpolation`.
    """
    interpolation = cls(t0=t0, t1=t1, **inner)
    return ProjectedInterpolation(t0=t0, t1=t1, inner=interpolation, shift=shift)
