"""Fixed steps that end at every save time, as a step-size controller of diffrax."""

import diffrax
import jax.numpy as jnp
from jaxtyping import Array, Float

from svkc.integration.ode import is_finite

# A step is stretched by up to this fraction of its length if it then ends at a save time.
MAX_STRETCH = 1e-6


class FixedSteps(diffrax.AbstractStepSizeController):
    """Steps of a fixed size, clipped at save times. A step to a non-finite state ends the solve.

    dt: step size (s).
    ts: times (s) to clip steps at. Empty where the stepping loop clips them.
    """

    dt: Float[Array, ""]
    ts: Float[Array, " times"]

    def wrap(self, direction):
        return self

    def _tnext(self, t):
        """Return the end of the step from t."""
        times = jnp.where(self.ts > t, self.ts, jnp.inf)
        stop = jnp.min(times, initial=jnp.inf)
        return jnp.where(t + self.dt * (1 + MAX_STRETCH) >= stop, stop, t + self.dt)

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        return self._tnext(t0), None

    def adapt_step_size(
        self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state
    ):
        keep_step = is_finite(y1_candidate)
        result = diffrax.RESULTS.where(
            keep_step, diffrax.RESULTS.successful, diffrax.RESULTS.internal_error
        )
        next_t0 = jnp.where(keep_step, t1, t0)
        return keep_step, next_t0, self._tnext(t1), False, controller_state, result
