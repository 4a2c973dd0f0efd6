"""Changes of structure: connect, cut, lock, unlock, unbind (paper, section V)."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from svkc._jax.eager import eager_jit
from svkc.model.chain import Chain, State, Structure
from svkc.model.checked_jit import check_state
from svkc.model.names import connection_mask, joint_slice, link_index, spare_slot
from svkc.model.topology import V_SIZE
from svkc.model.validation import boolean
from svkc.transitions.impact import StructureChange, lock_projection
from svkc.transitions.initial_state import check_closed
from svkc.transitions.newton import (
    CONNECTION,
    RANK_SEARCH,
    HeldCoordinates,
    Schedule,
    decide_rank,
    solve_structure,
)
from svkc.transitions.placement import joint_coordinates, place_at_current_pose, with_coordinates
from svkc.transitions.spare_links import cleared
from svkc.tree.kinematics import kinematics


def _with_masks(
    chain: Chain, structure: Structure, connected, locked
) -> tuple[Structure, Bool[Array, " links"], Bool[Array, ""]]:
    """Return the structure with these masks, its rank not decided yet, the links that are new, and
    whether anything new holds."""
    new_links = connected & ~structure.connected
    holds, after = jnp.any(new_links), eqx.tree_at(lambda s: s.connected, structure, connected)
    if locked is None:
        return after, new_links, holds
    was = jnp.zeros(chain.dofs, bool) if structure.locked is None else structure.locked
    return (
        eqx.tree_at(lambda s: s.locked, after, locked, is_leaf=lambda x: x is None),
        new_links,
        holds | jnp.any(locked & ~was),
    )


@eqx.filter_checkpoint
def _place_new_links(
    chain: Chain, structure: Structure, new_links, here, q
) -> tuple[Structure, Float[Array, " q"]]:
    """Return the structure with the placements of the links in `here`, and q with the coordinates
    of the new joints read off from where the bodies are."""
    kin = kinematics(chain, q)
    if here is not None:
        structure = place_at_current_pose(chain, structure, q, here & new_links, kin)
    return structure, with_coordinates(
        chain, new_links, joint_coordinates(chain, structure, kin, q), q
    )


@functools.partial(eager_jit, jit=eqx.filter_jit)
def change_structure(
    chain: Chain,
    state: State,
    connected: Bool[Array, " links"],
    locked: Bool[Array, " dofs"] | None = None,
    here: Bool[Array, " links"] | None = None,
) -> StructureChange:
    """The state under another set of connected links and locked joints.

    Where links are only cut or joints only unlocked, q and v are kept bit for bit; where something
    new holds, coordinates of the new joints are read off, the remaining gap is closed by the least
    change, and the velocity is projected.
    """
    structure, new_links, holds = _with_masks(chain, state.structure, connected, locked)
    q, v, nothing = state.q, state.v, jnp.zeros((len(chain.link_names), 3), state.v.dtype)
    if not len(chain.link_names):
        after, lost = lock_projection(chain, structure, q, v)
        v = jnp.where(holds, after, v)
        return StructureChange(
            state=State(q, v, structure),
            impulse=nothing,
            angular_impulse=nothing,
            energy_lost=jnp.where(holds, lost, 0),
            initial_gap=jnp.zeros((), v.dtype),
            residual_gaps=nothing[:, 0],
        )
    structure, new_q = _place_new_links(chain, structure, new_links, here, q)
    joined = solve_structure(
        chain, structure, new_q, v, HeldCoordinates(), Schedule(RANK_SEARCH + CONNECTION)
    )
    structure = eqx.tree_at(lambda s: (s.rank, s.margin), structure, (joined.rank, joined.margin))
    q, v = jnp.where(holds, joined.q, q), jnp.where(holds, joined.v, v)
    wrench = jnp.where(holds, joined.spatial_impulse, 0)
    return StructureChange(
        state=State(q, v, structure),
        impulse=wrench[:, 3:],
        angular_impulse=wrench[:, :3],
        energy_lost=jnp.where(holds, joined.energy_lost, 0),
        initial_gap=jnp.where(holds, jnp.max(joined.search_gaps[0]), 0),
        residual_gaps=jnp.where(holds, joined.residual_gaps, joined.search_gaps[0]),
    )


@functools.partial(eager_jit, jit=eqx.filter_jit)
def release_constraints(
    chain: Chain,
    state: State,
    connected: Bool[Array, " links"],
    locked: Bool[Array, " dofs"] | None = None,
) -> StructureChange:
    """`change` where links are only cut and joints only unlocked: q and v stay, the rank is decided
    anew."""
    structure, _, _ = _with_masks(chain, state.structure, connected, locked)
    nothing = jnp.zeros((len(chain.link_names), 3), state.v.dtype)
    zero = jnp.zeros((), state.v.dtype)
    return StructureChange(
        state=State(state.q, state.v, decide_rank(chain, structure, state.q)),
        impulse=nothing,
        angular_impulse=nothing,
        energy_lost=zero,
        initial_gap=zero,
        residual_gaps=nothing[:, 0],
    )


def transition(chain: Chain, state: State, connected) -> State:
    """The state with exactly these virtual links connected (mask, or names): new ones with their
    impact (paper, (29)-(38)), the others cut."""
    check_state(chain, state)
    mask = jnp.asarray(connection_mask(chain, connected))
    return _check_connected(chain, change_structure(chain, state, mask))


def connect(chain: Chain, state: State, *names: str, here: bool = False) -> State:
    """Connects virtual links: coordinates of the new joints, and the velocity after the impact
    (paper, section V-C).

    At their declared placement, where the bodies must already be; here=True: the joint is made
    where the real link is. ValueError: unknown names, or bodies that are not at the placement (says
    by how much).
    """
    check_state(chain, state)
    chosen = np.isin(np.arange(len(chain.link_names)), [link_index(chain, n) for n in names])
    mask = state.structure.connected | jnp.asarray(chosen)
    return _check_connected(
        chain,
        change_structure(
            chain, state, mask, here=jnp.asarray(chosen) if boolean("here", here) else None
        ),
    )


def _check_connected(chain: Chain, done: StructureChange) -> State:
    """The state after a change; an error where bodies were too far from the declared placement to
    be joined."""
    limit = CONNECT_TOLERANCE
    if isinstance(done.initial_gap, jax.core.Tracer):
        return eqx.error_if(
            done.state,
            done.initial_gap > limit,
            "connect: the bodies are not where the joint is declared; use here=True",
        )
    if done.initial_gap > limit:
        raise ValueError(
            f"connect: the bodies are {float(done.initial_gap):.3g} (rad, or lengths of"
            f" {float(chain.length):.3g} m) away from where the joint is declared; move them there,"
            " or grip where they are with here=True"
        )
    return check_closed(chain, done.state, done.residual_gaps)


# gap, in rad or in `chain.length`s, up to which connecting may still move the bodies to their
# declared placement
CONNECT_TOLERANCE = 1e-2


def cut(chain: Chain, state: State, *names: str) -> State:
    """Cuts virtual links: q and v stay as they are, bit for bit (paper, section V-C)."""
    check_state(chain, state)
    chosen = np.isin(np.arange(len(chain.link_names)), [link_index(chain, n) for n in names])
    return release_constraints(chain, state, state.structure.connected & ~jnp.asarray(chosen)).state


def _set_locked(chain: Chain, state: State, joints, value: bool) -> State:
    check_state(chain, state)
    locked = (
        jnp.zeros(chain.dofs, bool) if state.structure.locked is None else state.structure.locked
    )
    for name in joints:
        locked = locked.at[joint_slice(chain, name, V_SIZE, chain.topology.v_start)].set(value)
    return (change_structure if value else release_constraints)(
        chain, state, state.structure.connected, locked
    ).state


def lock(chain: Chain, state: State, *joints: str) -> State:
    """Holds joints of the tree still from now on, with the impact of stopping them: velocities
    (rad/s, m/s) as by (29)-(38) for connecting."""
    return _set_locked(chain, state, joints, True)


def unlock(chain: Chain, state: State, *joints: str) -> State:
    """Lets locked joints move again; q (m, rad) and v (m/s, rad/s) stay as they are."""
    return _set_locked(chain, state, joints, False)


def unbind(chain: Chain, state: State, *names: str) -> State:
    """Cuts spare virtual links and empties their slots for other bodies; q and v stay as they
    are."""
    check_state(chain, state)
    slots = np.isin(np.arange(len(chain.link_names)), [spare_slot(chain, n) for n in names])
    after = release_constraints(chain, state, state.structure.connected & ~jnp.asarray(slots)).state
    return State(after.q, after.v, cleared(after.structure, jnp.asarray(slots)))
