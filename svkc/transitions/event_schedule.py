"""When the timed events of a run happen, and which of its events have happened."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from svkc._jax.select import where
from svkc.model.chain import Chain, Structure
from svkc.transitions.plan import Plan


class EventSchedule(eqx.Module):
    """The state of the events of a run.

    times: of each timed event (s); inf for one that waits for another event.
    pending: which timed events have not happened yet.
    happened: which events have happened. None: no guard waits for an event.
    """

    times: Float[Array, " timed"]
    pending: Bool[Array, " timed"]
    happened: Bool[Array, " events"] | None

    @classmethod
    def at_start(cls, plan: Plan) -> "EventSchedule":
        """Return the schedule before the first phase."""
        waits = np.array([plan.after[i] is not None for i in plan.timed], bool)
        guard_waits = any(plan.after[i] is not None for i in plan.guarded)
        return cls(
            times=where(waits, jnp.inf, plan.times),
            pending=jnp.ones(len(plan.timed), bool),
            happened=jnp.zeros(len(plan.actions), bool) if guard_waits else None,
        )

    def next_time(self) -> Float[Array, ""]:
        """Return the time of the next timed event (s), inf if there is none."""
        return jnp.min(where(self.pending, self.times, jnp.inf), initial=jnp.inf)

    def due(self, t: Float[Array, ""]) -> Bool[Array, " timed"]:
        """Return which timed events are pending and happen up to the time t (s)."""
        return self.pending & (self.times <= t)

    def advance(
        self,
        plan: Plan,
        t: Float[Array, ""],
        fired: Bool[Array, " events"],
        timed: Bool[Array, " timed"],
    ) -> "EventSchedule":
        """Return the schedule after the events that fired at the time t (s).

        Each timed event whose `after` event fired is rescheduled to t plus its delay, also if it
        was pending.

        timed: which timed events fired.
        """
        new = replace(self, pending=self.pending & ~timed)
        if self.happened is not None:
            new = replace(new, happened=self.happened | fired)
        rows = [k for k, i in enumerate(plan.timed) if plan.after[i] is not None]
        if not rows:
            return new
        starts = np.zeros((len(plan.timed), len(plan.actions)), bool)
        for k in rows:
            starts[k, plan.after[plan.timed[k]]] = True
        started = jnp.any(starts & fired[None], 1)
        return replace(
            new,
            times=where(started, t + plan.times, new.times),
            pending=new.pending | started,
        )


def armed_guards(
    chain: Chain, structure: Structure, plan: Plan, schedule: EventSchedule
) -> Bool[Array, " guards"]:
    """Return which guards are armed: those for which `Plan.armed` holds and whose `after` event, if
    any, has happened."""
    armed = plan.armed(chain, structure)
    if schedule.happened is None:
        return armed
    waits_for = [plan.after[i] for i in plan.guarded]
    free = np.array([j is None for j in waits_for], bool)
    events = np.array([0 if j is None else j for j in waits_for])
    return armed & (free | schedule.happened[events])


def event_capacity(plan: Plan) -> int:
    """Return the default capacity for events: four for each guard, and one for each timed event. A
    timed event after another event has as many as that event."""

    def capacity(event: int) -> int:
        if event in plan.guarded:
            return 4
        before = plan.after[event]
        return 1 if before is None else capacity(before)

    return sum(map(capacity, range(len(plan.actions))))
