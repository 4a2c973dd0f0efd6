"""The events of a run as tables, checked against the chain."""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from svkc._jax.pytrees import is_concrete
from svkc.model.chain import Chain, Structure
from svkc.model.names import body_rows, joint_slice, link_index, spare_slot
from svkc.model.topology import V_SIZE
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
    """A list of events as tables: which are timed, and what each does."""

    times: Float[Array, " timed"]
    guards: tuple[AbstractGuard, ...]
    timed: tuple[int, ...] = eqx.field(static=True)
    guarded: tuple[int, ...] = eqx.field(static=True)
    directions: tuple[bool | None, ...] = eqx.field(static=True)
    actions: tuple[Action, ...] = eqx.field(static=True)
    grips: tuple[tuple[Grip, ...], ...] = ()

    @property
    def has_binds(self) -> bool:
        return any(self.grips) or any(a.unbind for a in self.actions)

    def slots_to_unbind(self, chain: Chain, structure: Structure) -> Bool[Array, "events links"]:
        """Spare slots that each event would empty now."""
        none = jnp.zeros(len(chain.link_names), bool)
        rows = []
        for action in self.actions:
            row = none
            for what in action.unbind:
                slots = (
                    np.array(chain.link_names) == what
                    if isinstance(what, str)
                    else bound_between(chain, structure, *what)
                )
                row = row | slots
            rows.append(row)
        return jnp.stack(rows)

    def needs_impact(self, chain: Chain) -> bool:
        """Return whether any event connects a link or locks a joint. If none does, no impact is
        compiled."""
        return bool(
            self.has_binds
            or self.action_mask(chain, "connect").any()
            or self.action_mask(chain, "lock").any()
        )

    @property
    def has_locks(self) -> bool:
        return any(a.lock or a.unlock for a in self.actions)

    def action_mask(self, chain: Chain, action_name: str) -> np.ndarray:
        """[events, links or dofs] Boolean of one part of the actions."""
        if action_name in ("lock", "unlock"):
            table = np.zeros((len(self.actions), chain.dofs), bool)
            for row, action in zip(table, self.actions, strict=True):
                for name in getattr(action, action_name):
                    row[joint_slice(chain, name, V_SIZE, chain.topology.v_start)] = True
            return table
        table = np.zeros((len(self.actions), len(chain.link_names)), bool)
        for row, action in zip(table, self.actions, strict=True):
            row[[link_index(chain, name) for name in getattr(action, action_name)]] = True
        return table

    def grip_mask(self, chain: Chain) -> np.ndarray:
        """[events, links] Boolean of the spare slots an event may bind."""
        return (
            np.array([bool(g) for g in self.grips], bool)[:, None]
            & np.array(chain.topology.link_spare, bool)[None]
        )

    def armed(self, chain: Chain, structure: Structure) -> Bool[Array, " guards"]:
        """Guards whose action would change something now, or that have none."""
        rows = list(self.guarded)
        on, off = (self.action_mask(chain, what)[rows] for what in ("connect", "cut"))
        c = structure.connected[None]
        change = jnp.any(on & ~c, 1) | jnp.any(off & c, 1)
        if self.has_locks:
            on, off = (self.action_mask(chain, what)[rows] for what in ("lock", "unlock"))
            change = (
                change
                | jnp.any(on & ~structure.locked[None], 1)
                | jnp.any(off & structure.locked[None], 1)
            )
        if self.has_binds:
            empties = jnp.any(
                self.slots_to_unbind(chain, structure)[np.array(rows)] & structure.connected[None],
                1,
            )
            held = lambda g: jnp.any(bound_between(chain, structure, g.parent, g.real))
            grips = [
                (
                    jnp.any(~jnp.stack([held(g) for g in self.grips[i]]))
                    if self.grips[i]
                    else jnp.zeros((), bool)
                )
                for i in rows
            ]
            change = change | empties | jnp.stack(grips)
        always = [
            (a := self.actions[i]).stop
            or not (a.connect + a.cut + a.lock + a.unlock + a.unbind + self.grips[i])
            for i in rows
        ]
        return change | np.array(always, bool)

    def crossed(
        self, before: Float[Array, " guards"], after: Float[Array, " guards"]
    ) -> Bool[Array, " guards"]:
        """Guards that went through zero; one that starts at zero has not."""
        up, down = (before < 0) & (after >= 0), (before > 0) & (after <= 0)
        either = np.array([d is None for d in self.directions], bool)
        upward = np.array([d is True for d in self.directions], bool)
        return jnp.where(either, up | down, jnp.where(upward, up, down))


def make_plan(chain: Chain, events: tuple, dtype) -> Plan:
    """Tables of the events; ValueError for names the chain does not have."""
    timed = tuple(i for i, e in enumerate(events) if isinstance(e, At))
    guarded = tuple(i for i, e in enumerate(events) if isinstance(e, When))
    times = [events[i].time for i in timed]
    if any(np.shape(t) != () for t in times):
        raise ValueError("at: time must be one number; for a time in each lane use vmap")
    # on the host where nothing is traced, as a program of its own would be compiled to stack them
    times = (
        np.array(times, dtype)
        if is_concrete(*times)
        else jnp.stack([jnp.asarray(t, dtype) for t in times])
    )
    plan = Plan(
        times=jnp.asarray(times, dtype),
        guards=tuple(_as_guard(events[i].guard) for i in guarded),
        timed=timed,
        guarded=guarded,
        directions=tuple(events[i].direction for i in guarded),
        # what is static and what can be differentiated, apart
        actions=tuple(
            dataclasses.replace(e.action, bind=()) if e.action.bind else e.action for e in events
        ),
        grips=tuple(tuple(_validate_grip(chain, g, dtype) for g in e.action.bind) for e in events),
    )
    for what in ("connect", "cut", "lock", "unlock"):
        plan.action_mask(chain, what)
    for action in plan.actions:
        for what in action.unbind:
            spare_slot(chain, what) if isinstance(what, str) else body_rows(chain, *what)
    return plan


def _as_guard(guard: Callable) -> AbstractGuard:
    """Return a function of the user as a guard, and a guard as it is."""
    return guard if isinstance(guard, AbstractGuard) else UserGuard(guard)


def _validate_grip(chain: Chain, grip: Grip, dtype) -> Grip:
    body_rows(chain, grip.parent, grip.real)
    spare_link_freedoms(grip.joint)
    rotation_to_axis(grip.axis)
    if grip.slot is not None:
        spare_slot(chain, grip.slot)
    elif not any(chain.topology.link_spare):
        raise ValueError("bind: the chain has no spare slots; load it with spare=n")
    return dataclasses.replace(grip, real_pos=as_placement("real_pos", grip.real_pos, dtype))
