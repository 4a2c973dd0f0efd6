"""Checks of traced arguments of a run, compiled into the start of the run.

Invalid concrete arguments raise ValueError in `option_checks`, and compile none of these checks.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from svkc._jax.pytrees import stop_gradient_tree
from svkc._jax.select import where
from svkc.integration.ode import Times
from svkc.model.chain import Chain
from svkc.model.inertial_parameters import has_invalid_inertial_parameters
from svkc.simulation.codes import RESULTS
from svkc.simulation.options import Options
from svkc.transitions.plan import Plan


def initial_result(chain: Chain, times: Times, plan: Plan, options: Options) -> RESULTS:
    """Return the result of a run before its first phase: `successful`, or why it cannot start.

    times: start, end and save times (s).
    """
    result = _check_times(times, plan) if options.traced_times else RESULTS.successful
    if options.traced_steps:
        result = RESULTS.where(_has_step_size(options), result, RESULTS.step_too_small)
    if not options.traced_masses:
        return result
    invalid = has_invalid_inertial_parameters(chain)
    return RESULTS.where(invalid, RESULTS.not_positive_definite, result)


def _has_step_size(options: Options) -> Bool[Array, ""]:
    """Return whether the step, or the tolerances and the largest step, are positive numbers."""
    controller, numbers = options.controller, (options.dt,)
    if options.dt is None:
        numbers = (controller.rtol, controller.atol, controller.dtmax)
    positive = [jnp.asarray(x) > 0 for x in numbers if x is not None]
    return jnp.all(jnp.stack(positive))


def _check_times(times, plan: Plan) -> RESULTS:
    """Return `not_a_time` or `reversed` if the times of a run cannot be run, else `successful`.

    The time of an event may be inf: such an event does not happen. Save times may be before t0 by
    round-off. They may be past t1, as the lanes of a batch share save times and may end earlier.

    times: start, end and save times (s).
    """
    t0, t1, ts = stop_gradient_tree(times)
    event_times = stop_gradient_tree(plan.times)
    # the delay of an event after another may not be negative
    waits = np.array([plan.after[i] is not None for i in plan.timed], bool)
    # the rounding error of t0 + n dt is a few eps of the largest time
    slack = 8 * jnp.finfo(ts.dtype).eps * jnp.maximum(jnp.abs(t0), jnp.abs(t1))
    in_order = (
        (t0 <= t1)
        & jnp.all(event_times >= where(waits, 0, t0))
        & jnp.all(ts >= t0 - slack)
        & jnp.all(ts[1:] >= ts[:-1])
    )
    finite = jnp.isfinite(t0) & jnp.isfinite(t1) & jnp.all(jnp.isfinite(ts))
    finite = finite & ~jnp.any(jnp.isnan(event_times))
    result = RESULTS.where(in_order, RESULTS.successful, RESULTS.reversed)
    return RESULTS.where(finite, result, RESULTS.not_a_time)
