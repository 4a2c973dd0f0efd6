"""Events: changes of structure at a given time, or when a guard crosses zero.

An event says when something happens and what happens; `svkc.transitions.plan` checks events against
a chain and turns them into tables.
"""

import dataclasses
import re
from collections.abc import Callable, Iterable
from typing import Any, TypeAlias

import equinox as eqx
import numpy as np

from svkc._jax.pytrees import stop_gradient_tree
from svkc.model.annotations import Checked, Function, Names, Scalar
from svkc.model.validation import (
    boolean,
    check_function,
    finite_array,
    names,
    positive_scalar,
    real_array,
)
from svkc.transitions.spare_links import Grip

# one grip or several; spare slots by name, or pairs (parent, real) of body names
Grips: TypeAlias = Checked[Grip | Iterable[Grip]]
SlotsOrPairs: TypeAlias = Checked[str | Iterable[str | tuple[str, str]]]


class Action(eqx.Module):
    """The changes of structure that one event makes.

    connect, cut: names of virtual links.
    lock, unlock: names of joints.
    at_current_pose: the links of `connect` whose joint is made at the current poses of the bodies.
    stop: whether the event ends the run.
    unbind: spare slots to clear, by name or as pairs (parent, real) of body names.
    bind: grips to make with spare slots.
    """

    connect: tuple[str, ...] = eqx.field(static=True, default=())
    cut: tuple[str, ...] = eqx.field(static=True, default=())
    lock: tuple[str, ...] = eqx.field(static=True, default=())
    unlock: tuple[str, ...] = eqx.field(static=True, default=())
    at_current_pose: tuple[str, ...] = eqx.field(static=True, default=())
    stop: bool = eqx.field(static=True, default=False)
    unbind: tuple[Any, ...] = eqx.field(static=True, default=())
    bind: tuple[Grip, ...] = ()


class At(eqx.Module):
    """An event at a given time (s). The time is differentiable.

    after: the event from which the time counts. None: the time counts from zero.
    """

    time: Any
    action: Action
    after: "At | When | None" = None


class When(eqx.Module):
    """An event at the time at which guard(t, state, args) crosses zero.

    direction: True for rising crossings only, False for falling ones only, None for either.
    max_step: the longest step while the guard is armed (s). None: any.
    after: the event before which the guard is not armed. None: the guard waits for no event.
    """

    guard: Callable
    action: Action
    direction: bool | None = eqx.field(static=True, default=None)
    max_step: Any = None
    after: "At | When | None" = None


# an event, as `after` takes it
AnyEvent: TypeAlias = Checked[At | When]


def _as_tuple(value) -> tuple[Any, ...]:
    """Return an iterable as a tuple, and any other value or a string as a tuple of one."""
    return tuple(value) if isinstance(value, Iterable) and not isinstance(value, str) else (value,)


def _make_action(*, connect, cut, lock, unlock, here, stop, bind, unbind) -> Action:
    """Return the validated action of an event. Raises ValueError for invalid arguments."""
    bind = _as_tuple(bind)
    if not all(isinstance(g, Grip) for g in bind):
        raise ValueError(f"bind: expected svkc.Grip objects, got {bind!r}")
    unbind = _as_tuple(unbind)
    if (
        len(unbind) == 2
        and all(isinstance(u, str) for u in unbind)
        and not all(re.fullmatch(r"spare_\d+", u) for u in unbind)
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
    _check_no_contradiction(connect=connect, cut=cut)
    _check_no_contradiction(connect=connect, unbind=unbind)
    _check_no_contradiction(lock=lock, unlock=unlock)
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


def _check_no_contradiction(**arguments) -> None:
    """Raise ValueError if two arguments of one event, by keyword, have a name in common."""
    (first, of_first), (second, of_second) = arguments.items()
    for name in of_first:
        if name in of_second:
            raise ValueError(
                f"{first} and {second} both name {name!r}; an event does one of the two"
            )


def at(
    time: Scalar, connect: Names = (), cut: Names = (), *, lock: Names = (), unlock: Names = (),
    here: bool | Names = False, stop: Checked[bool] = False, bind: Grips = (),
    unbind: SlotsOrPairs = (), after: AnyEvent | None = None,
) -> At:  # fmt: skip
    """Return an event that changes the structure at a given time.

    All events of one instant make one change, whatever their order. A link that one event connects
    and another one cuts is cut; a joint that one locks and another unlocks is free. Slots are cut
    and cleared before grips are made, so that a grip may take such a slot.

    time: when the event happens (s); with `after`, the delay after that event. The time is
        differentiable.
    connect, cut: name or names of virtual links.
    lock, unlock: name or names of joints of the tree.
    here: make new joints at the current poses of the bodies instead of at their declared
        placements: True for all links of `connect`, or names of some of them.
    stop: end the run at this event.
    bind: `svkc.Grip` or several, made with spare slots at the current poses of the bodies. The run
        ends with the result `no_slot` if no spare slot is free, or if the slot that a grip names
        stays connected.
    unbind: spare slots to cut and clear: names of slots, or pairs (parent, real) of body names for
        all slots between two bodies.
    after: another event of the run, from which the time counts: `at(0.4, cut="hand", after=catch)`
        lets go 0.4 s after the event `catch`. If that event happens again, the time counts anew.

    Raises ValueError if an argument has another type, if `here` names a link that `connect` does
    not name, or if `connect` and `cut`, `connect` and `unbind`, or `lock` and `unlock` have a name
    in common. Names are checked against the chain by `simulate`. The run ends with the result
    `not_bound` if `connect` names a spare slot that is bound to no bodies.
    """
    real_array("time", time)
    _check_after(after)
    action = _make_action(
        connect=connect, cut=cut, lock=lock, unlock=unlock, here=here, stop=stop, bind=bind,
        unbind=unbind,
    )  # fmt: skip
    return At(time, action, after)


def when(
    guard: Function, connect: Names = (), cut: Names = (),
    direction: Checked[bool | None] = None, *, lock: Names = (), unlock: Names = (),
    here: bool | Names = False, stop: Checked[bool] = False, bind: Grips = (),
    unbind: SlotsOrPairs = (), max_step: Scalar | None = None, after: AnyEvent | None = None,
) -> When:  # fmt: skip
    """Return an event that changes the structure when a guard crosses zero.

    The time of the event is located to round-off and is differentiable if the guard is smooth.

    A guard is armed while its action would change the structure; one whose event stops the run, or
    has no action, is always armed. A guard with `after` is armed once that event has happened.
    Before that it may be NaN, but in reverse mode its derivatives must be finite.
    A guard that starts the run within round-off of zero (eps^(3/4): 1.8e-12 in float64, 6.4e-6 in
    float32) has not crossed zero, whatever its sign and `direction`. It fires at its first crossing
    after it has left zero. The same holds after an event, for the guard that fired and for a guard
    that the event puts at zero; an armed guard that is on its way through zero at the time of
    another event does fire.
    The event of a discontinuous guard is at the jump; derivatives treat its time as constant.
    Of several crossings within a step the first is located: guards are evaluated at seven points of
    its dense output (one if a guard needs torques). Missed are jumps there and back, faster
    oscillations, and pairs closer than 1e-5 of the step or the output's error.

    guard: function (t, state, args) -> real number, or a guard such as `svkc.touch` returns.
    connect, cut, lock, unlock, here, stop, bind, unbind: as for `svkc.at`.
    direction: True for rising crossings only, False for falling ones only, None for either.
    max_step: the longest step while this guard is armed (s); None: any.
    after: another event of the run, before which this guard is not armed.

    Raises ValueError if the guard is no function of these arguments, `max_step` is not positive and
    finite, or an argument has another type.
    """
    check_function("when: guard", guard, "t", "state", "args")
    if direction is not None and not isinstance(direction, bool | np.bool_):
        raise ValueError(f"when: direction must be True, False or None, got {direction!r}")
    direction = None if direction is None else bool(direction)
    if max_step is not None:
        positive_scalar("when: max_step", finite_array("when: max_step", max_step))
    _check_after(after)
    action = _make_action(
        connect=connect, cut=cut, lock=lock, unlock=unlock, here=here, stop=stop, bind=bind,
        unbind=unbind,
    )  # fmt: skip
    return When(guard=guard, action=action, direction=direction, max_step=max_step, after=after)


def _check_after(event: Any) -> None:
    """Raise ValueError unless the argument `after` is an event or None."""
    if not isinstance(event, At | When | None):
        raise ValueError(f"after: expected svkc.at(...) or svkc.when(...), got {event!r}")


def as_events(events: Any) -> tuple[Any, ...]:
    """Return one event or an iterable of events as a tuple.

    Raises ValueError if an element is not an event.
    """
    events = tuple(events) if isinstance(events, Iterable) else (events,)
    for event in events:
        if not isinstance(event, At | When):
            raise ValueError(f"events: expected svkc.at(...) and svkc.when(...), got {event!r}")
    return events


def stop_gradient_of_events(events: Any) -> tuple[Any, ...]:
    """Return one event or several, without derivatives.

    `after` of each copy is the copy of that event, since events are recognized by identity.
    """
    copies: dict[int, Any] = {}

    def copied(event):
        if event is None:
            return None
        if id(event) not in copies:
            after = copied(event.after)
            alone = stop_gradient_tree(dataclasses.replace(event, after=None))
            copies[id(event)] = dataclasses.replace(alone, after=after)
        return copies[id(event)]

    return tuple(map(copied, as_events(events)))
