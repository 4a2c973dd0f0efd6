"""Events: changes of structure at a time or at the zero of a guard."""

from collections.abc import Callable, Iterable
from typing import Any

import equinox as eqx
import numpy as np

from svkc.model.validation import boolean, names, real_array
from svkc.transitions.spare_links import Grip


class Action(eqx.Module):
    """What an event does: names of virtual links to connect (those in `here`: where they are) and
    cut, of joints to lock and unlock, grips to make with spare slots and, by slot or by pair of
    bodies, to give up."""

    connect: tuple[str, ...] = eqx.field(static=True, default=())
    cut: tuple[str, ...] = eqx.field(static=True, default=())
    lock: tuple[str, ...] = eqx.field(static=True, default=())
    unlock: tuple[str, ...] = eqx.field(static=True, default=())
    at_current_pose: tuple[str, ...] = eqx.field(static=True, default=())
    stop: bool = eqx.field(static=True, default=False)
    unbind: tuple = eqx.field(static=True, default=())
    bind: tuple[Grip, ...] = ()


class At(eqx.Module):
    """An event at a time (s); the time is differentiable."""

    time: Any
    action: Action


class When(eqx.Module):
    """An event when guard(t, state, args) crosses zero: upwards (True), downwards (False), either
    way (None)."""

    guard: Callable
    action: Action
    direction: bool | None = eqx.field(static=True, default=None)


def _as_tuple(value) -> tuple:
    """One thing, or what holds several."""
    return tuple(value) if isinstance(value, Iterable) and not isinstance(value, str) else (value,)


def _make_action(*, connect, cut, lock, unlock, here, stop, bind, unbind) -> Action:
    bind = _as_tuple(bind)
    if not all(isinstance(g, Grip) for g in bind):
        raise ValueError(f"bind: expected svkc.Grip objects, got {bind!r}")
    unbind = _as_tuple(unbind)
    if (
        len(unbind) == 2
        and all(isinstance(u, str) for u in unbind)
        and not all(u.startswith("spare_") for u in unbind)
    ):
        unbind = (unbind,)
    if not all(isinstance(u, str) or (isinstance(u, tuple) and len(u) == 2) for u in unbind):
        raise ValueError(
            "unbind: expected names of spare slots or pairs of body names (parent, real), got"
            f" {unbind!r}"
        )
    connect = names("connect", connect)
    here = (connect if here else ()) if isinstance(here, bool | np.bool_) else names("here", here)
    if not set(here) <= set(connect):
        raise ValueError(f"here: {here} must be among the links to connect, {connect}")
    cut, lock, unlock = names("cut", cut), names("lock", lock), names("unlock", unlock)
    return Action(
        connect=connect,
        cut=cut,
        lock=lock,
        unlock=unlock,
        at_current_pose=here,
        stop=boolean("stop", stop),
        unbind=unbind,
        bind=bind,
    )


def at(
    time, connect=(), cut=(), *, lock=(), unlock=(), here=False, stop=False, bind=(), unbind=()
) -> At:
    """At this time (s): connect and cut virtual links, lock and unlock joints, by name. Where a
    link is both connected and cut, it is cut.

    here: True, or names: grip where the bodies are. stop: end the run then. bind: `svkc.Grip`s to
    make with spare slots, where the bodies are; where all are taken the run ends with a code.
    unbind: spare slots by name, or all between a pair (parent, real) of bodies, cut and emptied.
    """
    real_array("time", time)
    action = _make_action(
        connect=connect, cut=cut, lock=lock, unlock=unlock, here=here, stop=stop, bind=bind,
        unbind=unbind,
    )  # fmt: skip
    return At(time, action)


def when(
    guard,
    connect=(),
    cut=(),
    direction=None,
    *,
    lock=(),
    unlock=(),
    here=False,
    stop=False,
    bind=(),
    unbind=(),
) -> When:
    """When guard(t, state, args) -> real crosses zero, located to round-off and differentiable in
    time; the actions are those of `at`.

    direction: True for upwards only, False for downwards only. A guard is watched while its action
    would change something, or always if it has none, so name the links it is about where several
    act alike; one that is exactly zero at the start has not crossed, nor has one that rests at zero
    (to eps^(3/4)) after it fired. Crossings are seen between the ends of steps of one phase: two
    within one step go unseen, so bound the step (`stepsize_controller`, `dt`) where that can
    happen. A guard that jumps over zero happens where it jumps; only a smooth one has a time to
    differentiate.
    """
    if not callable(guard):
        raise ValueError(f"when: guard must be a function of (t, state, args), got {guard!r}")
    if direction is not None and not isinstance(direction, bool | np.bool_):
        raise ValueError(f"when: direction must be True, False or None, got {direction!r}")
    direction = None if direction is None else bool(direction)
    action = _make_action(
        connect=connect, cut=cut, lock=lock, unlock=unlock, here=here, stop=stop, bind=bind,
        unbind=unbind,
    )  # fmt: skip
    return When(guard, action, direction)


def as_events(events) -> tuple:
    """The events of a list; ValueError for anything that is not one."""
    events = tuple(events) if isinstance(events, Iterable) else (events,)
    for event in events:
        if not isinstance(event, At | When):
            raise ValueError(f"events: expected svkc.at(...) and svkc.when(...), got {event!r}")
    return events
