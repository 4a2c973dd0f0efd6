"""The change of structure by the events at the end of a phase."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from svkc._jax.control_flow import unvmap_any
from svkc.integration.ode import ODEState, is_finite
from svkc.model.chain import Chain, State, Structure
from svkc.simulation.codes import RESULTS
from svkc.simulation.phase import PhaseOutcome, RunState
from svkc.simulation.records import Events
from svkc.transitions.impact import StructureChange
from svkc.transitions.plan import Plan
from svkc.transitions.spare_links import bind_grip, cleared
from svkc.transitions.transition import CONNECT_TOLERANCE, change_structure, release_constraints


def reevaluated_guards(plan: Plan) -> np.ndarray:
    """Return which guards are re-evaluated after a change of structure: all but those that need
    torques. A crossing is thus detected between two values of one structure."""
    return np.array([not g.needs_torques for g in plan.guards], bool)


def apply_events(
    chain: Chain,
    run: RunState,
    end_state: State,
    outcome: PhaseOutcome,
    fired: Bool[Array, " events"],
    plan: Plan,
):
    """Apply the events that fired at the end of a phase, all in one change of structure.

    Returns the state after the change, the records of events, and the result of the run so far.

    end_state: the state at the end of the phase. fired: which events of the plan fired.
    """
    any_fired, any_no_slot, to_clear = jnp.any(fired), jnp.zeros((), bool), None
    masks = _new_masks(chain, end_state.structure, fired, plan)
    if plan.has_binds:
        structure, to_connect, any_no_slot, to_clear = _bind_slots(
            chain, end_state.structure, fired, plan
        )
        end_state = State(end_state.q, end_state.v, structure)
        masks["connected"] = (masks["connected"] | to_connect) & ~to_clear
        masks["at_current_pose"] = masks["at_current_pose"] | to_connect

    def apply():
        return _change_structure(chain, end_state, masks, to_clear, plan)

    def skip():
        return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), eqx.filter_eval_shape(apply))

    change = jax.lax.cond(unvmap_any(any_fired), apply, skip)
    # a change that is not finite is discarded, so that the run keeps its last finite state
    finite = is_finite(ODEState(change.state.q, change.state.v)) & ~jnp.isnan(change.initial_gap)
    after = jax.tree.map(
        lambda new, old: jnp.where(any_fired & finite, new, old), change.state, end_state
    )
    connects = plan.action_mask(chain, "connect") | plan.grip_mask(chain)
    events, overflow = _write_events(run.events, outcome.t, fired, connects, change)
    stops = jnp.any(fired & np.array([a.stop for a in plan.actions], bool))
    result = RESULTS.where(stops, RESULTS.stopped, outcome.result)
    misplaced = any_fired & (change.initial_gap > CONNECT_TOLERANCE)
    result = RESULTS.where(misplaced, RESULTS.not_in_place, result)
    result = RESULTS.where(finite, result, RESULTS.non_finite)
    result = RESULTS.where(any_no_slot, RESULTS.no_slot, result)
    result = RESULTS.where(overflow, RESULTS.max_events, result)
    return after, events, result


def _new_masks(
    chain: Chain, structure: Structure, fired: Bool[Array, " events"], plan: Plan
) -> dict:
    """Return the arguments of `change_structure` after these events: the connected links, the
    locked joints, and the new links made at the current poses of their bodies. None: no event of
    the plan changes them."""
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


def _change_structure(
    chain: Chain, end_state: State, masks: dict, to_clear, plan: Plan
) -> StructureChange:
    """Change the structure; the impact is compiled only if an event of the plan needs one.

    to_clear: mask of spare slots to clear; None: no event of the plan clears slots.
    """
    if plan.needs_impact(chain):
        change = change_structure(chain, end_state, **masks)
    else:
        change = release_constraints(chain, end_state, masks["connected"], masks["locked"])
    if to_clear is None:
        return change
    structure = cleared(change.state.structure, to_clear)
    return eqx.tree_at(lambda c: c.state.structure, change, structure)


def _write_events(
    events: Events,
    t,
    fired: Bool[Array, " events"],
    connects: Bool[np.ndarray, "events links"],
    change: StructureChange,
) -> tuple[Events, Bool[Array, ""]]:
    """Return the records with a row for each event that fired, and whether rows were lacking.

    connects: the links that each event connects, whose impulses are written in the event's row.
    """
    r, count, capacity = events, jnp.sum(fired, dtype=jnp.int32), events.time.shape[0]
    row = r.count + jnp.cumsum(fired, dtype=jnp.int32) - 1
    rows = jnp.arange(capacity, dtype=jnp.int32)
    # [rows, events]
    row_of_event = (rows[:, None] == row[None]) & fired[None]
    written = jnp.any(row_of_event, 1)
    first = written & (rows == r.count)
    connected_by_row = jnp.any(row_of_event[:, :, None] & connects[None], 1)[:, :, None]
    return Events(
        time=jnp.where(written, t, r.time),
        which=jnp.where(written, jnp.argmax(row_of_event, 1).astype(jnp.int32), r.which),
        impulse=jnp.where(connected_by_row, change.impulse[None], r.impulse),
        angular_impulse=jnp.where(
            connected_by_row, change.angular_impulse[None], r.angular_impulse
        ),
        energy_lost=jnp.where(first, change.energy_lost, r.energy_lost),
        count=jnp.minimum(r.count + count, capacity),
    ), r.count + count > capacity


def _bind_slots(chain: Chain, structure: Structure, fired: Bool[Array, " events"], plan: Plan):
    """Return the structure with the spare slots bound by the events that fired, the mask of slots
    to connect, whether a grip had no free slot, and the mask of slots to clear."""
    to_clear = jnp.any(fired[:, None] & plan.slots_to_unbind(chain, structure), 0)
    to_connect, any_no_slot = jnp.zeros(len(chain.link_names), bool), jnp.zeros((), bool)
    for event, grips in enumerate(plan.grips):
        for grip in grips:
            # a slot that an earlier grip of this instant has bound is no longer free
            occupied = eqx.tree_at(
                lambda s: s.connected, structure, structure.connected | to_connect
            )
            bound, slot, no_slot = bind_grip(chain, occupied, grip)
            bound = eqx.tree_at(lambda s: s.connected, bound, structure.connected)
            structure = jax.tree.map(
                lambda new, old, e=event: jnp.where(fired[e], new, old), bound, structure
            )
            to_connect = to_connect | (slot & fired[event])
            any_no_slot = any_no_slot | (no_slot & fired[event])
    return structure, to_connect, any_no_slot, to_clear
