"""The change of structure by the events at the end of a phase."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from svkc._jax.control_flow import unvmap_any
from svkc._jax.select import where
from svkc.integration.ode import ODEState, is_finite
from svkc.model.chain import Chain, State, Structure
from svkc.simulation.codes import RESULTS
from svkc.simulation.phase import PhaseOutcome, RunState
from svkc.simulation.records import Events
from svkc.transitions.impact import StructureChange
from svkc.transitions.plan import Plan
from svkc.transitions.spare_links import bind_grip, cleared, unbound_slots
from svkc.transitions.transition import CONNECT_TOLERANCE, change_structure, release_constraints


def reevaluated_guards(plan: Plan) -> np.ndarray:
    """Return the mask of guards that are re-evaluated after a change of structure.

    They are all guards but those that need torques. The search for a crossing then compares two
    values of the same structure.
    """
    return np.array([not g.needs_torques for g in plan.guards], bool)


def apply_events(
    chain: Chain,
    run: RunState,
    end_state: State,
    outcome: PhaseOutcome,
    fired: Bool[Array, " events"],
    plan: Plan,
    *,
    gap_tolerance: float,
) -> Any:
    """Apply the events that fired at the end of a phase, all in one change of structure.

    Return the state after the change, the records of events, and the result of the run so far. A
    change that fails is neither applied nor recorded: the run keeps the state before the events.

    end_state: the state at the end of the phase.
    fired: mask of the plan's events that fired.
    gap_tolerance: largest loop gap with which a change succeeds (rad, or multiples of
        `chain.length`).
    """
    any_fired = jnp.any(fired)
    start, masks, any_no_slot = _prepare_change(chain, end_state, fired, plan)

    def apply():
        return _change_structure(chain, start, masks, plan)

    def skip():
        return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), eqx.filter_eval_shape(apply))

    change = jax.lax.cond(unvmap_any(any_fired), apply, skip)
    connects = plan.action_mask(chain, "connect") | plan.grip_mask(chain)
    failure = _failure(chain, start.structure, masks["connected"], change, plan, gap_tolerance)
    overflow = run.events.count + jnp.sum(fired, dtype=jnp.int32) > run.events.time.shape[0]
    failure = RESULTS.where(overflow, RESULTS.max_events, failure)
    applied = any_fired & (failure == RESULTS.successful)
    after = jax.tree.map(lambda new, old: where(applied, new, old), change.state, end_state)
    events = _write_events(run.events, outcome.t, fired & applied, connects, change)
    stops = jnp.any(fired & np.array([a.stop for a in plan.actions], bool))
    result = RESULTS.where(stops, RESULTS.stopped, outcome.result)
    result = RESULTS.where(any_no_slot, RESULTS.no_slot, result)
    result = RESULTS.where(any_fired & ~applied, failure, result)
    return after, events, result


def _failure(
    chain: Chain,
    structure: Structure,
    connected: Bool[Array, " links"],
    change: StructureChange,
    plan: Plan,
    gap_tolerance: float,
) -> RESULTS:
    """Return why a change of structure cannot be made, or `RESULTS.successful`.

    structure: the structure before the change.
    connected: mask of the links that are connected after the change.
    """
    new = connected & ~structure.connected
    misplaced = change.initial_gap > CONNECT_TOLERANCE
    result = RESULTS.where(misplaced, RESULTS.not_in_place, RESULTS.successful)
    if plan.needs_impact(chain):
        open_loop = ~(jnp.max(change.residual_gaps, initial=0) <= gap_tolerance)
        result = RESULTS.where(jnp.any(new) & ~misplaced & open_loop, RESULTS.loop_open, result)
    finite = is_finite(ODEState(change.state.q, change.state.v)) & ~jnp.isnan(change.initial_gap)
    result = RESULTS.where(finite, result, RESULTS.non_finite)
    if (plan.action_mask(chain, "connect") & np.array(chain.topology.link_spare, bool)).any():
        unbound = jnp.any(new & unbound_slots(chain, structure))
        result = RESULTS.where(unbound, RESULTS.not_bound, result)
    return result


def _prepare_change(
    chain: Chain, end_state: State, fired: Bool[Array, " events"], plan: Plan
) -> tuple[State, dict, Bool[Array, ""]]:
    """Return the state with spare slots cleared and bound, masks, and whether a grip had no slot.

    The masks are the keyword arguments of `change_structure`. Links are cut and slots are cleared
    before grips are made, so that a grip may take a slot that an event of the same instant cuts or
    clears.
    """
    masks, structure = _new_masks(chain, end_state.structure, fired, plan), end_state.structure
    if not plan.has_binds:
        return end_state, masks, jnp.zeros((), bool)
    to_clear = jnp.any(fired[:, None] & plan.slots_to_unbind(chain, structure), 0)
    masks["connected"] = masks["connected"] & ~to_clear
    # A slot that is cut and bound again counts as a new link.
    structure = eqx.tree_at(
        lambda s: s.connected,
        cleared(structure, to_clear),
        structure.connected & masks["connected"],
    )
    structure, to_connect, any_no_slot = _bind_slots(chain, structure, fired, plan)
    masks["connected"] = masks["connected"] | to_connect
    masks["at_current_pose"] = masks["at_current_pose"] | to_connect
    return State(end_state.q, end_state.v, structure), masks, any_no_slot


def _new_masks(
    chain: Chain, structure: Structure, fired: Bool[Array, " events"], plan: Plan
) -> dict:
    """Return the keyword arguments of `change_structure` for the events that fired.

    These are masks: the connected links, the locked joints, and the new links placed at the current
    poses of their bodies. The last two are None if no event of the plan changes them.
    """
    any_of = lambda name: jnp.any(fired[:, None] & plan.action_mask(chain, name), 0)
    locked = at_current_pose = None
    if plan.has_locks:
        assert structure.locked is not None
        locked = (structure.locked | any_of("lock")) & ~any_of("unlock")
    if plan.has_binds or plan.action_mask(chain, "at_current_pose").any():
        at_current_pose = any_of("at_current_pose")
    return {
        "connected": (structure.connected | any_of("connect")) & ~any_of("cut"),
        "locked": locked,
        "at_current_pose": at_current_pose,
    }


def _change_structure(chain: Chain, end_state: State, masks: dict, plan: Plan) -> StructureChange:
    """Change the structure; the impact is compiled only if an event of the plan needs one."""
    if plan.needs_impact(chain):
        return change_structure(chain, end_state, **masks)
    return release_constraints(chain, end_state, masks["connected"], masks["locked"])


def _write_events(
    events: Events,
    t,
    fired: Bool[Array, " events"],
    connects: Bool[np.ndarray, "events links"],
    change: StructureChange,
) -> Events:
    """Return the records with a row for each event that fired.

    The energy lost in the one impact of these events is in the first of their rows.

    connects: the links that each event connects; their impulses are in the event's row.
    """
    r = events
    row = r.count + jnp.cumsum(fired, dtype=jnp.int32) - 1
    rows = jnp.arange(events.time.shape[0], dtype=jnp.int32)
    # [rows, events]
    row_of_event = (rows[:, None] == row[None]) & fired[None]
    written = jnp.any(row_of_event, 1)
    first = written & (rows == r.count)
    connected_by_row = jnp.any(row_of_event[:, :, None] & connects[None], 1)[:, :, None]
    return Events(
        time=where(written, t, r.time),
        which=where(written, jnp.argmax(row_of_event, 1).astype(jnp.int32), r.which),
        impulse=where(connected_by_row, change.impulse[None], r.impulse),
        angular_impulse=where(connected_by_row, change.angular_impulse[None], r.angular_impulse),
        energy_lost=where(first, change.energy_lost, r.energy_lost),
        count=r.count + jnp.sum(fired, dtype=jnp.int32),
    )


def _bind_slots(
    chain: Chain, structure: Structure, fired: Bool[Array, " events"], plan: Plan
) -> tuple[Structure, Bool[Array, " links"], Bool[Array, ""]]:
    """Return the structure with spare slots bound, the slots to connect, and if a slot was missing.

    The last two are the mask of the slots that the events that fired have bound, and whether one of
    their grips had no free slot.
    """
    to_connect, any_no_slot = jnp.zeros(len(chain.link_names), bool), jnp.zeros((), bool)
    for event, grips in enumerate(plan.grips):
        for grip in grips:
            # A slot that an earlier grip of this instant has bound is no longer free.
            occupied = eqx.tree_at(
                lambda s: s.connected, structure, structure.connected | to_connect
            )
            bound, slot, no_slot = bind_grip(chain, occupied, grip)
            bound = eqx.tree_at(lambda s: s.connected, bound, structure.connected)
            structure = jax.tree.map(
                lambda new, old, e=event: where(fired[e], new, old), bound, structure
            )
            to_connect = to_connect | (slot & fired[event])
            any_no_slot = any_no_slot | (no_slot & fired[event])
    return structure, to_connect, any_no_slot
