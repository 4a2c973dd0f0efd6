"""The change of structure that the events at the end of a phase make."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from svkc._jax.control_flow import unvmap_any
from svkc.integration.ode import ODEState, is_finite
from svkc.model.chain import Chain, State, Structure
from svkc.simulation.phase import PhaseOutcome, RunState
from svkc.simulation.records import RESULTS, Events
from svkc.transitions.impact import StructureChange
from svkc.transitions.plan import Plan
from svkc.transitions.spare_links import bind_grip, cleared
from svkc.transitions.transition import CONNECT_TOLERANCE, change_structure, release_constraints


def reevaluated_guards(made: Plan) -> np.ndarray:
    """Return which guards are re-evaluated after a change of structure, so that a guard is compared
    within one phase: all but those that need torques."""
    return np.array([not g.needs_torques for g in made.guards], bool)


def apply_events(
    chain: Chain,
    run: RunState,
    ended: State,
    solved: PhaseOutcome,
    fired: Bool[Array, " events"],
    made: Plan,
):
    """The change of structure that all events of this instant make together; one record row for
    each of them."""
    happened, full, emptying = jnp.any(fired), jnp.zeros((), bool), None
    masks = _masks(chain, ended.structure, fired, made)
    if made.has_binds:
        structure, gripped, full, emptying = _bound(chain, ended.structure, fired, made)
        ended = State(ended.q, ended.v, structure)
        masks["connected"] = (masks["connected"] | gripped) & ~emptying
        masks["here"] = masks["here"] | gripped

    def changed():
        done = _change(chain, ended, masks, made)
        if emptying is None:
            return done
        structure = cleared(done.state.structure, emptying)
        return eqx.tree_at(lambda d: d.state.structure, done, structure)

    def same():
        return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), eqx.filter_eval_shape(changed))

    done = jax.lax.cond(unvmap_any(happened), changed, same)
    # what a change makes of numbers that are not is not taken
    sound = is_finite(ODEState(done.state.q, done.state.v)) & ~jnp.isnan(done.initial_gap)
    after = jax.tree.map(lambda new, old: jnp.where(happened & sound, new, old), done.state, ended)
    mine = made.action_mask(chain, "connect") | made.grip_mask(chain)
    events, overflow = _recorded(run.events, solved.t, fired, mine, done)
    stops = jnp.any(fired & np.array([a.stop for a in made.actions], bool))
    result = RESULTS.where(stops, RESULTS.stopped, solved.result)
    result = RESULTS.where(
        happened & (done.initial_gap > CONNECT_TOLERANCE), RESULTS.not_in_place, result
    )
    result = RESULTS.where(sound, result, RESULTS.non_finite)
    result = RESULTS.where(full, RESULTS.no_slot, result)
    result = RESULTS.where(overflow, RESULTS.max_events, result)
    return after, events, result


def _masks(chain: Chain, structure: Structure, fired: Bool[Array, " events"], made: Plan) -> dict:
    """Return the connected links, the locked joints, and the new links whose joint is made where
    the bodies are, after the events of this instant. None: no event has to do with that."""
    any_of = lambda what: jnp.any(fired[:, None] & made.action_mask(chain, what), 0)
    return {
        "connected": (structure.connected | any_of("connect")) & ~any_of("cut"),
        "locked": (structure.locked | any_of("lock")) & ~any_of("unlock")
        if made.has_locks
        else None,
        "here": any_of("here") if made.action_mask(chain, "here").any() or made.has_binds else None,
    }


def _change(chain: Chain, ended: State, masks: dict, made: Plan) -> StructureChange:
    """Change the structure: with an impact, where an event of the plan can make one."""
    if made.needs_impact(chain):
        return change_structure(chain, ended, masks["connected"], masks["locked"], masks["here"])
    return release_constraints(chain, ended, masks["connected"], masks["locked"])


def _recorded(
    events: Events,
    t,
    fired: Bool[Array, " events"],
    mine: Bool[np.ndarray, "events links"],
    done: StructureChange,
) -> tuple[Events, Bool[Array, ""]]:
    """Return the records with a row for each event that fired, and whether there were too few rows.

    mine: the links that each event connects, whose impulses are written in its row.
    """
    r, count, capacity = events, jnp.sum(fired, dtype=jnp.int32), events.time.shape[0]
    place = r.count + jnp.cumsum(fired, dtype=jnp.int32) - 1
    rows = jnp.arange(capacity, dtype=jnp.int32)
    hit = (rows[:, None] == place[None]) & fired[None]
    written = jnp.any(hit, 1)
    first = written & (rows == r.count)
    mine = jnp.any(hit[:, :, None] & mine[None], 1)[:, :, None]
    return Events(
        time=jnp.where(written, t, r.time),
        which=jnp.where(written, jnp.argmax(hit, 1).astype(jnp.int32), r.which),
        impulse=jnp.where(mine, done.impulse[None], r.impulse),
        angular_impulse=jnp.where(mine, done.angular_impulse[None], r.angular_impulse),
        energy_lost=jnp.where(first, done.energy_lost, r.energy_lost),
        count=jnp.minimum(r.count + count, capacity),
    ), r.count + count > capacity


def _bound(chain: Chain, structure: Structure, fired: Bool[Array, " events"], made: Plan):
    """The structure with the slots that the events of this instant bind, the slots to connect,
    whether one was lacking, and the slots to empty."""
    emptying = jnp.any(fired[:, None] & made.slots_to_unbind(chain, structure), 0)
    gripped, full = jnp.zeros(len(chain.link_names), bool), jnp.zeros((), bool)
    for event, wishes in enumerate(made.grips):
        for wish in wishes:
            # slots given to others at this instant are no longer free
            taken = eqx.tree_at(lambda s: s.connected, structure, structure.connected | gripped)
            bound, slot, lacking = bind_grip(chain, taken, wish)
            bound = eqx.tree_at(lambda s: s.connected, bound, structure.connected)
            structure = jax.tree.map(
                lambda new, old, e=event: jnp.where(fired[e], new, old), bound, structure
            )
            gripped, full = gripped | (slot & fired[event]), full | (lacking & fired[event])
    return structure, gripped, full, emptying
