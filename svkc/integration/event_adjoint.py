"""Derivatives of the time and the state at the end of a phase, by the implicit function theorem.

A phase follows y' = f(t, y; p) and ends at the time T. Integration gives the change dy of y at a
time that stays, for a change dp of everything else. The end moves along the field: its state
changes by dy + f dT.

- At a scheduled end, dT is the change of the schedule.
- At an event, g(T, y(T); p) = 0 holds for every p, so that g_t dT + g_y (dy + f dT) + g_p dp = 0:
  dT = -(g_y dy + g_p dp) / (g_t + g_y f). Where a guard touches zero without crossing it, the
  denominator vanishes and dT is NaN. Where a guard jumps over zero, dT = 0.

Second derivatives differentiate dy by T as well: d(dy)/dT = f_y dy + f_p dp. `carried` has this
derivative and the value dy.
"""

import equinox as eqx
import jax
import jax.numpy as jnp

from svkc._jax.primitive import custom_primitive, is_cotangent_of
from svkc._jax.pytrees import materialise_zeros
from svkc.integration.event_location import vector_field_of
from svkc.integration.ode import FieldArgs, ODEState
from svkc.integration.vector_field import VectorField


def _end_of_phase_jvp(primals, tangents):
    end, at = end_of_phase(*primals)
    _, _, _, scene, guards, _ = primals
    rate = vector_field_of(guards)(end, at, scene)
    return (end, at), end_of_phase_tangent(primals, tangents, end, at, rate)


def end_of_phase_tangent(primals, tangents, end, at: ODEState, rate: ODEState):
    """What y changes by at its time, and its rate times the change of the end's time: that of
    `late`, or dt = -dg / (dg/dt), the implicit function's.

    primals, tangents: of `arrived`; end, at: what it gives; rate: of the motion there.
    """
    t, y, late, scene, guards, found = primals
    d_t, dy, d_late, d_scene, d_guards, _ = tangents
    field, d_field = (
        (guards, d_guards) if isinstance(guards, VectorField) else (guards.field, d_guards.field)
    )
    d_t = materialise_zeros(t, d_t)
    changes = materialise_zeros(y, dy), d_scene, d_field
    dy = transport_tangent(changes, rate, delay=end - t, t=end, at=at, scene=scene, field=field)
    dt = materialise_zeros(late, d_late)
    if found is not None:
        guard = lambda t, y, scene, guards: guards(t, y, scene)[found.first]
        slope = jax.jvp(
            lambda t, y: guard(t, y, scene, guards), (end, at), (jnp.ones_like(end), rate)
        )[1]
        change = eqx.filter_jvp(guard, (end, at, scene, guards), (d_t, dy, d_scene, d_guards))[1]
        none = found.jumps | ~found.occurred
        # where a guard touches zero there is no derivative, and no number that looks like one
        implicit = jnp.where(none, 0, -change) / jnp.where(
            none, 1, jnp.where(found.grazing, jnp.nan, slope)
        )
        dt = jnp.where(found.occurred, implicit, dt)
    return d_t + dt, jax.tree.map(lambda d, r: d + r * dt, dy, rate)


# arrived(t, y, late, scene, guards or field, found or None) -> t, y: the end of a phase, where the
# motion y was found at the time t, a guard's zero, or, `late` by nothing, the time scheduled
end_of_phase = custom_primitive("arrived", lambda t, y, *_: (t, y), _end_of_phase_jvp)


def _tangent_rate(changes, t, at: ODEState, scene: FieldArgs, field: VectorField) -> ODEState:
    """How fast changes of the motion, the scene and the field make the motion's change grow."""
    return eqx.filter_jvp(lambda y, scene, field: field(t, y, scene), (at, scene, field), changes)[
        1
    ]


def _transport_jvp(primals, tangents):
    changes, _, *where = primals
    (further, _, _), delay, *_ = tangents
    ddy = materialise_zeros(changes[0], further)
    if delay is not None:
        ddy = jax.tree.map(lambda d, r: d + delay * r, ddy, _tangent_rate(changes, *where))
    return _transport(*primals), ddy


def _transport_transpose(inputs, cotangent: ODEState):
    changes, *where = inputs
    asked = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(x.aval.shape, x.aval.dtype) if is_cotangent_of(x) else None,
        changes,
        is_leaf=is_cotangent_of,
    )
    return _transport_cotangent(
        materialise_zeros(where[2], cotangent), asked, *where
    ), *jax.tree.map(lambda _: None, tuple(where))


_transport = custom_primitive(
    "carried", lambda changes, *_: changes[0], _transport_jvp, _transport_transpose
)


def transport_tangent(
    changes, rate: ODEState, *, delay, t, at: ODEState, scene: FieldArgs, field: VectorField
) -> ODEState:
    """Of changes = (dy, d_scene, d_field), dy carried along for a time `delay` that is zero but may
    itself change, which second derivatives see."""
    # a number for each lane of its own, as the operation's transpose would not sum over lanes
    one = 1 + 0 * jnp.sum(rate.v)
    return _transport(jax.tree.map(lambda d: d * one, changes), delay, t, at, scene, field)


def _select_cotangents(cotangent: ODEState, asked, *_):
    """The cotangent of dy, and zeros for those of the scene and the field, as far as they are asked
    for."""
    moving, *rest = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), asked)
    return jax.tree.map(
        lambda z, c: None if z is None else c, moving, cotangent, is_leaf=lambda z: z is None
    ), *rest


def _transport_cotangent_jvp(primals, tangents):
    cotangent, asked, _, t, at, scene, field = primals
    further, _, delay, *_ = tangents
    change = _select_cotangents(materialise_zeros(cotangent, further), asked)
    if delay is not None:
        pulled = eqx.filter_vjp(lambda y, scene, field: field(t, y, scene), at, scene, field)[1](
            cotangent
        )
        grown = lambda c, p: None if c is None else c + delay * p
        change = jax.tree.map(grown, change, pulled, is_leaf=lambda c: c is None)
    return _transport_cotangent(*primals), change


# _brought_back(cotangent of dy, shapes, delay, t, at, scene, field) -> cotangents of (dy, d_scene,
# d_field): the transpose of `_carried`
_transport_cotangent = custom_primitive(
    "brought_back", _select_cotangents, _transport_cotangent_jvp
)
