"""Step-size control: fixed steps, the default controller, and steps clipped at save times."""

from collections.abc import Callable
from typing import Any

import diffrax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from svkc._jax.select import where
from svkc.integration.ode import Times, is_finite

# A step is stretched by up to this fraction of its length if it then ends at a save time.
MAX_STRETCH = 1e-6

# A new step has this fraction of the length at which its error would meet the tolerance.
SAFETY = 0.8


class FixedSteps(diffrax.AbstractStepSizeController[None, Any]):
    """Steps of a fixed size, clipped at save times. A step to a non-finite state ends the solve.

    dt: step size (s).
    ts: times (s) to clip steps at. Empty where the stepping loop clips them.
    """

    dt: Float[Array, ""]
    ts: Float[Array, " times"]

    def wrap(self, direction: Any) -> "FixedSteps":
        return self

    def _tnext(self, t):
        """Return the end of the step from t."""
        times = where(self.ts > t, self.ts, jnp.inf)
        stop = jnp.min(times, initial=jnp.inf)
        return where(t + self.dt * (1 + MAX_STRETCH) >= stop, stop, t + self.dt)

    def init(
        self,
        terms: Any,
        t0: Any,
        t1: Any,
        y0: Any,
        dt0: Any,
        args: Any,
        func: Callable,
        error_order: Any,
    ) -> Any:
        return self._tnext(t0), None

    def adapt_step_size(
        self,
        t0: Any,
        t1: Any,
        y0: Any,
        y1_candidate: Any,
        args: Any,
        y_error: Any,
        error_order: Any,
        controller_state: Any,
    ) -> Any:
        keep_step = is_finite(y1_candidate)
        result = diffrax.RESULTS.where(
            keep_step, diffrax.RESULTS.successful, diffrax.RESULTS.internal_error
        )
        next_t0 = where(keep_step, t1, t0)
        return keep_step, next_t0, self._tnext(t1), False, controller_state, result


class LimitedPIDController(diffrax.PIDController):
    """A PID controller that does not lengthen the step right after a rejected one.

    After a rejection the step is as long as its error allows. A longer step at once would often be
    rejected again (Hairer, Norsett and Wanner, Solving Ordinary Differential Equations
    I, section II.4).
    """

    def init(self, *args: Any, **kwargs: Any) -> Any:
        t1, state = super().init(*args, **kwargs)
        return t1, (state, jnp.full_like(t1, jnp.inf))

    def adapt_step_size(
        self, t0: Any, t1: Any, y0: Any, y1_candidate: Any, args: Any, y_error: Any,
        error_order: Any, controller_state: Any,
    ) -> Any:  # fmt: skip
        state, longest = controller_state
        keep_step, next_t0, next_t1, made_jump, state, result = super().adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order=error_order, controller_state=state
        )
        # the size proposed by the rejection, as a save time may have clipped the step since
        next_t1 = where(keep_step, jnp.minimum(next_t1, next_t0 + longest), next_t1)
        longest = where(keep_step, jnp.inf, next_t1 - next_t0)
        # the time is rounded, so that the next step would end where the rejected one did
        too_small = ~keep_step & (next_t1 >= t1)
        result = diffrax.RESULTS.where(too_small, diffrax.RESULTS.dt_min_reached, result)
        return keep_step, next_t0, next_t1, made_jump, (state, longest), result


def clip_step(
    t: Float[Array, ""],
    proposed: Float[Array, ""],
    times: Times,
    max_step: Float[Array, ""] | None = None,
) -> Float[Array, ""]:
    """Return the end of a step from t: the proposed one, clipped to the next save time or stop.

    max_step: the longest step (s). None: any.
    """
    _, stop, save_ts = times
    if max_step is not None:
        proposed = jnp.minimum(proposed, t + max_step / (1 + MAX_STRETCH))
    next_save_t = jnp.min(where(save_ts > t, save_ts, jnp.inf), initial=jnp.inf)
    limit = jnp.minimum(stop, next_save_t)
    return where(t + (proposed - t) * (1 + MAX_STRETCH) >= limit, limit, proposed)


def unclipped_step_size(
    controller: Any,
    keep_step: Bool[Array, ""],
    taken: Float[Array, ""],
    *,
    proposed: Float[Array, ""],
    before: Float[Array, ""],
) -> Float[Array, ""]:
    """Return the size of the next step, as if the last one had not been clipped at a save time.

    A PID controller bounds the growth from the step taken. Where the proposed size reaches that
    bound, the size from before the clipping is restored.

    keep_step: whether the controller keeps the step.
    taken, proposed, before: sizes of the clipped step, of the next step by the controller, and of
        the step before it was clipped.
    """
    if not isinstance(controller, diffrax.PIDController):
        return proposed
    at_bound = keep_step & (proposed >= 0.99 * controller.factormax * taken)
    return where(at_bound, jnp.maximum(proposed, before), proposed)


def has_jumps(controller: Any) -> bool:
    """Return whether a controller, or one that it wraps, steps around the times of jumps."""
    while controller is not None:
        if getattr(controller, "jump_ts", None) is not None:
            return True
        controller = getattr(controller, "controller", None)
    return False
