"""The events of a run as static tables and differentiable data, validated against the chain."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from svkc._jax.pytrees import is_concrete
from svkc._jax.select import where
from svkc.model.annotations import DType
from svkc.model.chain import Chain, Structure
from svkc.model.names import body_rows, link_index, spare_slot, v_slice
from svkc.transitions.events import Action, At, When
from svkc.transitions.guards import AbstractGuard, UserGuard
from svkc.transitions.spare_links import (
    Grip,
    as_placement,
    bound_between,
    rotation_to_axis,
    spare_link_freedoms,
)


class Plan(eqx.Module):
    """The events of a run as tables.

    times: time of each timed event (s); the delay of one that is after another event.
    guards: guard of each event with a guard.
    max_steps: longest step while each guard is armed (s), inf where not given. None: no event gives
        one.
    timed, guarded: indices of the timed events and of the events with a guard in the user's list.
    directions: direction of each guard's crossing: True rising, False falling, None either.
    actions: what each event in the user's list changes, without its grips, which hold
        differentiable data.
    grips: grips that each event in the user's list makes.
    after: for each event in the user's list, the index of the event that it is after.
    """

    times: Float[Array, " timed"]
    guards: tuple[AbstractGuard, ...]
    max_steps: Float[Array, " guards"] | None
    timed: tuple[int, ...] = eqx.field(static=True)
    guarded: tuple[int, ...] = eqx.field(static=True)
    directions: tuple[bool | None, ...] = eqx.field(static=True)
    actions: tuple[Action, ...] = eqx.field(static=True)
    grips: tuple[tuple[Grip, ...], ...] = ()
    after: tuple[int | None, ...] = eqx.field(static=True, default=())

    @property
    def has_binds(self) -> bool:
        """Whether any event binds or unbinds a spare slot."""
        return any(self.grips) or any(a.unbind for a in self.actions)

    def slots_to_unbind(self, chain: Chain, structure: Structure) -> Bool[Array, "events links"]:
        """Return the mask of spare slots that each event would unbind in this structure."""
        none = jnp.zeros(len(chain.link_names), bool)
        rows = []
        for action in self.actions:
            row = none
            for slot_or_pair in action.unbind:
                slots = (
                    np.array(chain.link_names) == slot_or_pair
                    if isinstance(slot_or_pair, str)
                    else bound_between(chain, structure, *slot_or_pair)
                )
                row = row | slots
            rows.append(row)
        return jnp.stack(rows)

    def needs_impact(self, chain: Chain) -> bool:
        """Return whether any event connects a link, makes a grip or locks a joint.

        If none does, no impact is compiled.
        """
        return bool(
            any(self.grips)
            or self.action_mask(chain, "connect").any()
            or self.action_mask(chain, "lock").any()
        )

    @property
    def has_locks(self) -> bool:
        """Whether any event locks or unlocks a joint."""
        return any(a.lock or a.unlock for a in self.actions)

    def action_mask(self, chain: Chain, action_name: str) -> np.ndarray:
        """Return the mask of one field of `Action`: [events, dofs] for "lock" and "unlock",
        [events, links] for "connect" and "cut". Raises ValueError for unknown names."""
        if action_name in ("lock", "unlock"):
            table = np.zeros((len(self.actions), chain.dofs), bool)
            for row, action in zip(table, self.actions, strict=True):
                for name in getattr(action, action_name):
                    row[v_slice(chain.topology, name)] = True
            return table
        table = np.zeros((len(self.actions), len(chain.link_names)), bool)
        for row, action in zip(table, self.actions, strict=True):
            row[[link_index(chain.topology, name) for name in getattr(action, action_name)]] = True
        return table

    def grip_mask(self, chain: Chain) -> np.ndarray:
        """Return the mask [events, links] of the spare slots that each event may bind."""
        return (
            np.array([bool(g) for g in self.grips], bool)[:, None]
            & np.array(chain.topology.link_spare, bool)[None]
        )

    def armed(self, chain: Chain, structure: Structure) -> Bool[Array, " guards"]:
        """Return which guards are armed: those whose action would change the structure or stop the
        run, and those without an action, which only record their events."""
        rows, connected = list(self.guarded), structure.connected[None]
        connect, cut = (self.action_mask(chain, name)[rows] for name in ("connect", "cut"))
        changes = jnp.any(connect & ~connected, 1) | jnp.any(cut & connected, 1)
        if self.has_locks:
            assert structure.locked is not None
            lock, unlock = (self.action_mask(chain, name)[rows] for name in ("lock", "unlock"))
            changes = (
                changes
                | jnp.any(lock & ~structure.locked[None], 1)
                | jnp.any(unlock & structure.locked[None], 1)
            )
        if self.has_binds:
            slots = self.slots_to_unbind(chain, structure)[np.array(rows)]
            unbinds = jnp.any(slots & connected, 1)
            exists = lambda g: jnp.any(bound_between(chain, structure, g.parent, g.real))
            binds = [
                (
                    jnp.any(~jnp.stack([exists(g) for g in self.grips[i]]))
                    if self.grips[i]
                    else jnp.zeros((), bool)
                )
                for i in rows
            ]
            changes = changes | unbinds | jnp.stack(binds)
        always = [
            (a := self.actions[i]).stop
            or not (a.connect + a.cut + a.lock + a.unlock + a.unbind + self.grips[i])
            for i in rows
        ]
        return changes | np.array(always, bool)

    def crossed(
        self, before: Float[Array, " guards"], after: Float[Array, " guards"]
    ) -> Bool[Array, " guards"]:
        """Return which guards crossed zero in their direction from `before` to `after`. A guard
        that is zero before has not crossed."""
        rises, falls = (before < 0) & (after >= 0), (before > 0) & (after <= 0)
        either = np.array([d is None for d in self.directions], bool)
        rising = np.array([d is True for d in self.directions], bool)
        return where(either, rises | falls, where(rising, rises, falls))


def guard_round_off(dtype: DType) -> float:
    """Return the absolute value below which a guard that starts a phase counts as zero.

    eps^(3/4): 1.8e-12 in float64, 6.4e-6 in float32, for guards whose values are of order one.
    """
    return float(np.finfo(dtype).eps ** 0.75)


def make_plan(chain: Chain, events: tuple[Any, ...], dtype: DType) -> Plan:
    """Return the tables of these events. Raises ValueError for names that the chain does not
    have."""
    timed = tuple(i for i, e in enumerate(events) if isinstance(e, At))
    guarded = tuple(i for i, e in enumerate(events) if isinstance(e, When))
    times = [events[i].time for i in timed]
    if any(np.shape(t) != () for t in times):
        raise ValueError("at: time must be one number; for a time in each lane use vmap")
    max_steps = [events[i].max_step for i in guarded]
    plan = Plan(
        times=_stack(times, dtype),
        max_steps=(
            None
            if all(x is None for x in max_steps)
            else _stack([np.inf if x is None else x for x in max_steps], dtype)
        ),
        guards=tuple(_as_guard(events[i].guard) for i in guarded),
        timed=timed,
        guarded=guarded,
        directions=tuple(events[i].direction for i in guarded),
        # actions are static; the grips hold differentiable data
        actions=tuple(
            dataclasses.replace(e.action, bind=()) if e.action.bind else e.action for e in events
        ),
        grips=tuple(tuple(_validate_grip(chain, g, dtype) for g in e.action.bind) for e in events),
        after=tuple(_index_of(e.after, events) for e in events),
    )
    _check_names(chain, plan)
    return plan


def _index_of(event, events: tuple[Any, ...]) -> int | None:
    """Return the index of an event among all. Raises ValueError if it is not one of them."""
    if event is None:
        return None
    for i, other in enumerate(events):
        if other is event:
            return i
    raise ValueError(
        "after: the event is not among the events of the run; give simulate both, and make both on"
        " the same side of jit and vmap"
    )


def _stack(numbers: list, dtype) -> Float[Array, " numbers"]:
    """Return numbers as an array."""
    # concrete numbers are stacked by numpy: JAX compiles a program for every eager operation
    return jnp.asarray(
        np.array(numbers, dtype)
        if is_concrete(*numbers)
        else jnp.stack([jnp.asarray(x, dtype) for x in numbers]),
        dtype,
    )


def _check_names(chain: Chain, plan: Plan) -> None:
    """Raise ValueError if an action names a link, joint, slot or body that the chain lacks."""
    for action_name in ("connect", "cut", "lock", "unlock"):
        plan.action_mask(chain, action_name)
    for action in plan.actions:
        for slot_or_pair in action.unbind:
            if isinstance(slot_or_pair, str):
                spare_slot(chain.topology, slot_or_pair)
            else:
                body_rows(chain.topology, *slot_or_pair)


def _as_guard(guard: Callable) -> AbstractGuard:
    """Wrap a function of the user as a guard; return a guard unchanged."""
    return guard if isinstance(guard, AbstractGuard) else UserGuard(guard)


def _validate_grip(chain: Chain, grip: Grip, dtype) -> Grip:
    """Return the grip with its point as an array. Raises ValueError for an invalid grip."""
    body_rows(chain.topology, grip.parent, grip.real)
    spare_link_freedoms(grip.joint)
    rotation_to_axis(grip.axis)
    if grip.slot is not None:
        spare_slot(chain.topology, grip.slot)
    elif not any(chain.topology.link_spare):
        raise ValueError("bind: the chain has no spare slots; load it with spare=n")
    return dataclasses.replace(grip, real_pos=as_placement("real_pos", grip.real_pos, dtype))
