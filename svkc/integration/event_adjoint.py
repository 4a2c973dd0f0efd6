"""Derivatives of the time and the state at the end of a phase, by the implicit function theorem.

A phase follows y' = f(t, y; p) from a fixed start and ends at the time T. Integration over the
fixed times of the steps gives the tangent dy of y at a fixed time, for a tangent dp of everything
else. The end moves along the field, so the tangent of its state is dy + f dT.

- At a scheduled end, dT is the tangent of the schedule.
- At an event, g(T, y(T); p) = 0 holds for every p, so that g_t dT + g_y (dy + f dT) + g_p dp = 0:
  dT = -(g_y dy + g_p dp) / (g_t + g_y f). Where a guard touches zero without crossing it, the
  denominator vanishes and dT is NaN. Where a guard jumps over zero, dT = 0.

Second derivatives differentiate dy by T as well: d(dy)/dT = f_y dy + f_p dp. `transport_tangent`
has this derivative and the value dy.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from svkc._jax.primitive import custom_primitive, undefined_primals
from svkc._jax.pytrees import materialise_zeros
from svkc._jax.select import where
from svkc.integration.event_location import EventInfo, vector_field_of
from svkc.integration.ode import FieldArgs, ODEState
from svkc.integration.vector_field import VectorField
from svkc.model.annotations import Scalar


def _end_of_phase_jvp(primals, tangents):
    end = end_of_phase(*primals)
    _, _, _, field_args, guards, _ = primals
    rate = vector_field_of(guards)(end[0], end[1], field_args)
    return end, end_of_phase_tangent(primals, tangents, end, rate)


def end_of_phase_tangent(
    primals: tuple[Any, ...], tangents: tuple[Any, ...], end: tuple[Any, ...], rate: ODEState
) -> tuple[Any, ...]:
    """Return the tangent of `end_of_phase`.

    primals, tangents: of `end_of_phase`.
    end: its value (t, y).
    rate: derivative of the state by time there.
    """
    t, y, stop_shift, field_args, guards, event = primals
    d_t, dy, d_stop_shift, d_field_args, d_guards, _ = tangents
    t_end, y_end = end
    field, d_field = vector_field_of(guards), vector_field_of(d_guards)
    d_t, dy = materialise_zeros(t, d_t), materialise_zeros(y, dy)
    dy = transport_tangent(
        (dy, d_field_args, d_field),
        rate,
        duration=t_end - t,
        t=t_end,
        y=y_end,
        field_args=field_args,
        field=field,
    )
    dt = materialise_zeros(stop_shift, d_stop_shift)
    if event is not None:
        changes = d_t, dy, d_field_args, d_guards
        dt_event = _event_time_tangent(event, (t_end, y_end, field_args, guards), changes, rate)
        dt = where(event.occurred, dt_event, dt)
    return d_t + dt, jax.tree.map(lambda d, r: d + r * dt, dy, rate)


def _event_time_tangent(event: EventInfo, primals, tangents, rate: ODEState):
    """Return dT = -dg / (dg/dt) of the guard whose root was located.

    primals, tangents: time, state, field arguments and guards.
    rate: derivative of the state by time.
    """
    t, y, field_args, guards = primals
    guard = lambda t, y, field_args, guards: guards(t, y, field_args)[event.first]
    along = lambda t, y: guard(t, y, field_args, guards)
    slope = jax.jvp(along, (t, y), (jnp.ones_like(t), rate))[1]
    # a guard that only jumps has no tangent at all
    change = materialise_zeros(*eqx.filter_jvp(guard, primals, tangents))
    fixed = event.jumps | ~event.occurred
    # The time of a grazing event has no derivative: NaN rather than a plausible number.
    denominator = where(fixed, 1, where(event.grazing, jnp.nan, slope))
    return where(fixed, 0, -change) / denominator


def _end_of_phase(t, y: ODEState, stop_shift, field_args: FieldArgs, guards, event):
    """Return (t, y). The JVP moves both along the field by dt.

    dt is the tangent of `stop_shift` (zero in value) at a scheduled end, -dg / (dg/dt) at an event,
    NaN where the guard only touches zero.

    guards: the `GuardValues`, or the `VectorField` if there are no guards.
    event: the `EventInfo` of the end. None: there are no guards.
    """
    return t, y


end_of_phase: Callable[..., Any] = custom_primitive(
    "end_of_phase", _end_of_phase, _end_of_phase_jvp
)


def _tangent_rate(tangents, t, y: ODEState, field_args: FieldArgs, field: VectorField) -> ODEState:
    """Return f_y dy + f_p dp, the derivative by time of a tangent along the linearised flow.

    tangents: of the state, the field arguments and the field.
    """
    evaluate = lambda y, field_args, field: field(t, y, field_args)
    return eqx.filter_jvp(evaluate, (y, field_args, field), tangents)[1]


def _transport_jvp(primals, tangents):
    changes, _, *where = primals
    (ddy, _, _), d_duration, *_ = tangents
    ddy = materialise_zeros(changes[0], ddy)
    if d_duration is not None:
        rate = _tangent_rate(changes, *where)
        ddy = jax.tree.map(lambda d, r: d + d_duration * r, ddy, rate)
    return _transport(*primals), ddy


def _transport_transpose(inputs, cotangent: ODEState):
    changes, *where = inputs
    shapes, _ = undefined_primals(changes)
    y = where[2]
    cotangents = _transport_cotangent(materialise_zeros(y, cotangent), shapes, *where)
    return cotangents, *jax.tree.map(lambda _: None, tuple(where))


# _transport((dy, d_field_args, d_field), duration, t, y, field_args, field) -> dy, linear in its
# first argument
_transport = custom_primitive(
    "transport_tangent", lambda changes, *_: changes[0], _transport_jvp, _transport_transpose
)


def transport_tangent(
    changes: tuple[Any, ...],
    rate: ODEState,
    *,
    duration: Scalar,
    t: Scalar,
    y: ODEState,
    field_args: FieldArgs,
    field: VectorField,
) -> ODEState:
    """Transport dy along the linearised flow over an interval of length zero.

    Its value is dy. Its derivative by the interval's length is what second derivatives need.

    changes: tangents (dy, d_field_args, d_field).
    rate: derivative of the state by time.
    duration: length of the interval (s), zero in value.
    """
    # Give each lane of a vmap its own tangents: the transpose of the primitive does not sum over
    # lanes.
    lane_one = 1 + 0 * jnp.sum(rate.v)
    changes = jax.tree.map(lambda d: d * lane_one, changes)
    return _transport(changes, duration, t, y, field_args, field)


def _state_cotangent_and_zeros(cotangent: ODEState, shapes, *_):
    """Return the cotangent of dy, and zeros for those of the field arguments and the field.

    shapes: shapes of the cotangents to return, None where there is none.
    """
    zeros_y, *zeros = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)
    y = jax.tree.map(
        lambda z, c: None if z is None else c, zeros_y, cotangent, is_leaf=lambda z: z is None
    )
    return y, *zeros


def _transport_cotangent_jvp(primals, tangents):
    cotangent, shapes, _, t, y, field_args, field = primals
    d_cotangent, _, d_duration, *_ = tangents
    change = _state_cotangent_and_zeros(materialise_zeros(cotangent, d_cotangent), shapes)
    if d_duration is not None:
        evaluate = lambda y, field_args, field: field(t, y, field_args)
        pulled_back = eqx.filter_vjp(evaluate, y, field_args, field)[1](cotangent)
        add = lambda c, p: None if c is None else c + d_duration * p
        change = jax.tree.map(add, change, pulled_back, is_leaf=lambda c: c is None)
    return _transport_cotangent(*primals), change


# _transport_cotangent(cotangent of dy, shapes, duration, t, y, field_args, field) -> cotangents of
# (dy, d_field_args, d_field): the transpose of `_transport`
_transport_cotangent = custom_primitive(
    "transport_cotangent", _state_cotangent_and_zeros, _transport_cotangent_jvp
)
