"""The change of structure that the events at the end of a phase make."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from svkc._jax.control_flow import unvmap_any
from svkc.integration.integrators import Motion, finite
from svkc.model.chain import Chain, State, Structure
from svkc.simulation.phase import Run, Solved
from svkc.simulation.records import RESULTS, Events
from svkc.transitions.events import Plan
from svkc.transitions.spare_links import emptied, grip
from svkc.transitions.transition import change, connect_tolerance, release


def reevaluated(made: Plan) -> np.ndarray:
    """Return which guards are re-evaluated after a change of structure, so that a guard is compared
    within one phase: all but those that need torques."""
    return np.array([not g.needs_torques for g in made.guards], bool)


def apply_events(
    chain: Chain, run: Run, ended: State, solved: Solved, fired: Bool[Array, " events"], made: Plan
):
    """The change of structure that all events of this instant make together; one record row for
    each of them."""
    any_of = lambda what: jnp.any(fired[:, None] & made.table(chain, what), 0)
    connected = (ended.structure.connected | any_of("connect")) & ~any_of("cut")
    locked = (ended.structure.locked | any_of("lock")) & ~any_of("unlock") if made.locks else None
    here = any_of("here") if made.table(chain, "here").any() or made.binds else None
    happened, full, emptying = jnp.any(fired), jnp.zeros((), bool), None
    if made.binds:
        structure, gripped, full, emptying = _bound(chain, ended.structure, fired, made)
        ended = State(ended.q, ended.v, structure)
        connected, here = (connected | gripped) & ~emptying, here | gripped

    def changed():
        done = (
            change(chain, ended, connected, locked, here)
            if made.joins(chain)
            else release(chain, ended, connected, locked)
        )
        return (
            done
            if emptying is None
            else eqx.tree_at(
                lambda d: d.state.structure, done, emptied(done.state.structure, emptying)
            )
        )

    def same():
        return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), eqx.filter_eval_shape(changed))

    done = jax.lax.cond(unvmap_any(happened), changed, same)
    # what a change makes of numbers that are not is not taken
    sound = finite(Motion(done.state.q, done.state.v)) & ~jnp.isnan(done.gap)
    after = jax.tree.map(lambda new, old: jnp.where(happened & sound, new, old), done.state, ended)
    r, count = run.events, jnp.sum(fired, dtype=jnp.int32)
    place = r.count + jnp.cumsum(fired, dtype=jnp.int32) - 1
    rows = jnp.arange(r.time.shape[0], dtype=jnp.int32)
    hit = (rows[:, None] == place[None]) & fired[None]
    written = jnp.any(hit, 1)
    first = written & (rows == r.count)
    mine = jnp.any(
        hit[:, :, None] & (made.table(chain, "connect") | made.table_of_grips(chain))[None], 1
    )[:, :, None]
    events = Events(
        jnp.where(written, solved.t, r.time),
        jnp.where(written, jnp.argmax(hit, 1).astype(jnp.int32), r.which),
        jnp.where(mine, done.impulse[None], r.impulse),
        jnp.where(mine, done.angular_impulse[None], r.angular_impulse),
        jnp.where(first, done.energy_lost, r.energy_lost),
        jnp.minimum(r.count + count, r.time.shape[0]),
    )
    stops = jnp.any(fired & np.array([a.stop for a in made.actions], bool))
    result = RESULTS.where(stops, RESULTS.stopped, solved.result)
    result = RESULTS.where(happened & (done.gap > connect_tolerance), RESULTS.not_in_place, result)
    result = RESULTS.where(sound, result, RESULTS.non_finite)
    result = RESULTS.where(full, RESULTS.no_slot, result)
    result = RESULTS.where(r.count + count > r.time.shape[0], RESULTS.max_events, result)
    return after, events, result


def _bound(chain: Chain, structure: Structure, fired: Bool[Array, " events"], made: Plan):
    """The structure with the slots that the events of this instant bind, the slots to connect,
    whether one was lacking, and the slots to empty."""
    emptying = jnp.any(fired[:, None] & made.unbound(chain, structure), 0)
    gripped, full = jnp.zeros(len(chain.link_names), bool), jnp.zeros((), bool)
    for event, wishes in enumerate(made.grips):
        for wish in wishes:
            # slots given to others at this instant are no longer free
            taken = eqx.tree_at(lambda s: s.connected, structure, structure.connected | gripped)
            bound, slot, lacking = grip(chain, taken, wish)
            bound = eqx.tree_at(lambda s: s.connected, bound, structure.connected)
            structure = jax.tree.map(
                lambda new, old, e=event: jnp.where(fired[e], new, old), bound, structure
            )
            gripped, full = gripped | (slot & fired[event]), full | (lacking & fired[event])
    return structure, gripped, full, emptying
