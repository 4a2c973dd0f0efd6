"""Changes of the structure of a state: connect, cut, lock, unlock, unbind (paper, section V).

Connecting a link or locking a joint is an inelastic impact: the velocity jumps. Cutting, unlocking
and unbinding leave q and v unchanged.
"""

import functools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from svkc._jax.eager import eager_jit
from svkc._jax.pytrees import is_concrete
from svkc._jax.select import where
from svkc.loops.constraint import gap_tolerance
from svkc.loops.frames import loop_frames
from svkc.model.annotations import Names, Numbers
from svkc.model.chain import Chain, State, Structure
from svkc.model.checked_jit import check_state
from svkc.model.names import connection_mask, link_index, spare_slot, v_slice
from svkc.model.validation import boolean
from svkc.transitions.impact import StructureChange, lock_projection
from svkc.transitions.initial_state import check_closed
from svkc.transitions.newton import decide_rank, solve_structure
from svkc.transitions.newton_state import CONNECTION, RANK_SEARCH, NewtonState, Schedule
from svkc.transitions.placement import joint_coordinates, place_at_current_pose, with_coordinates
from svkc.transitions.spare_links import check_bound, cleared
from svkc.tree.kinematics import kinematics


def _with_masks(
    chain: Chain, structure: Structure, connected, locked
) -> tuple[Structure, Bool[Array, " links"], Bool[Array, ""]]:
    """Return the structure with these masks and its old rank, the links that are new, and whether
    any link or lock is new."""
    new_links = connected & ~structure.connected
    any_new = jnp.any(new_links)
    after = eqx.tree_at(lambda s: s.connected, structure, connected)
    if locked is None:
        return after, new_links, any_new
    locked_before = jnp.zeros(chain.dofs, bool) if structure.locked is None else structure.locked
    return (
        eqx.tree_at(lambda s: s.locked, after, locked, is_leaf=lambda x: x is None),
        new_links,
        any_new | jnp.any(locked & ~locked_before),
    )


@eqx.filter_checkpoint
def _place_new_links(
    chain: Chain, structure: Structure, new_links, at_current_pose, q
) -> tuple[Structure, Float[Array, " q"]]:
    """Return the structure with the links in `at_current_pose` placed there, and q with the
    coordinates of the new joints computed from the poses of their bodies."""
    kin, old = kinematics(chain, q), q
    if at_current_pose is not None:
        structure = place_at_current_pose(chain, structure, q, at_current_pose & new_links, kin)
        # another joint than before, so that it does not keep the full turns of the old one
        old = with_coordinates(chain, at_current_pose & new_links, jnp.zeros_like(q), q)
    frames = loop_frames(chain, structure, kin, q)
    new = joint_coordinates(chain, structure, kin, old, frames)
    return structure, with_coordinates(chain, new_links, new, q)


@functools.partial(eager_jit, jit=eqx.filter_jit)
def change_structure(
    chain: Chain,
    state: State,
    connected: Bool[Array, " links"],
    locked: Bool[Array, " dofs"] | None = None,
    at_current_pose: Bool[Array, " links"] | None = None,
) -> StructureChange:
    """Return the state with these links connected and these joints locked.

    If a link or a lock is new, the coordinates of the new joints are computed from the poses of
    their bodies, the remaining loop gaps are closed by the least change of q, and the velocity is
    projected as by an inelastic impact. Otherwise q and v stay unchanged, bit for bit.

    locked: None leaves the locks of the state unchanged.
    at_current_pose: new links whose joint is made at the current poses of its bodies; None: no
        link.
    """
    structure, new_links, any_new = _with_masks(chain, state.structure, connected, locked)
    if not len(chain.link_names):
        return _lock_without_links(chain, state, structure, any_new)
    structure, q = _place_new_links(chain, structure, new_links, at_current_pose, state.q)
    solution = solve_structure(chain, structure, q, state.v, Schedule(RANK_SEARCH + CONNECTION))
    return _select_change(state, structure, solution, any_new)


def _lock_without_links(
    chain: Chain, state: State, structure: Structure, any_new: Bool[Array, ""]
) -> StructureChange:
    """Return the change of structure of a chain without virtual links."""
    v, energy_lost = lock_projection(chain, structure, state.q, state.v)
    no_impulse = jnp.zeros((0, 3), state.v.dtype)
    return StructureChange(
        state=State(state.q, where(any_new, v, state.v), structure),
        impulse=no_impulse,
        angular_impulse=no_impulse,
        energy_lost=where(any_new, energy_lost, 0),
        initial_gap=jnp.zeros((), state.v.dtype),
        residual_gaps=no_impulse[:, 0],
    )


def _select_change(
    state: State, structure: Structure, solution: NewtonState, any_new: Bool[Array, ""]
) -> StructureChange:
    """Return the solution as a change of structure, with the old q and v where nothing is new."""
    rank = (solution.rank, solution.margin)
    structure = eqx.tree_at(lambda s: (s.rank, s.margin), structure, rank)
    q, v = where(any_new, solution.q, state.q), where(any_new, solution.v, state.v)
    impulse = where(any_new, solution.spatial_impulse, 0)
    return StructureChange(
        state=State(q, v, structure),
        impulse=impulse[:, 3:],
        angular_impulse=impulse[:, :3],
        energy_lost=where(any_new, solution.energy_lost, 0),
        initial_gap=where(any_new, jnp.max(solution.search_gaps[0]), 0),
        residual_gaps=where(any_new, solution.residual_gaps, 0),
    )


@functools.partial(eager_jit, jit=eqx.filter_jit)
def release_constraints(
    chain: Chain,
    state: State,
    connected: Bool[Array, " links"],
    locked: Bool[Array, " dofs"] | None = None,
) -> StructureChange:
    """Return the state after cutting links and unlocking joints: q and v stay unchanged and the
    rank is decided again.

    `change_structure` gives the same state; this function compiles no impact, and gives no gaps.
    """
    structure, _, _ = _with_masks(chain, state.structure, connected, locked)
    no_impulse = jnp.zeros((len(chain.link_names), 3), state.v.dtype)
    zero = jnp.zeros((), state.v.dtype)
    return StructureChange(
        state=State(state.q, state.v, decide_rank(chain, structure, state.q)),
        impulse=no_impulse,
        angular_impulse=no_impulse,
        energy_lost=zero,
        initial_gap=zero,
        residual_gaps=no_impulse[:, 0],
    )


def transition(chain: Chain, state: State, connected: Names | Numbers) -> State:
    """Return the state with exactly these virtual links connected.

    Links that are not connected yet are connected at their declared placements, with the inelastic
    impact of the paper's (29)-(38); connected links that are not named are cut.

    connected: names of virtual links, or a Boolean mask over `chain.link_names`.

    Raises ValueError for unknown names; also, as a runtime error under jit, for a spare slot that
    is not bound, if bodies are too far from the placement, and if a loop cannot be closed.
    """
    check_state(chain, state)
    mask = connection_mask(chain.topology, connected, chain.structure.connected)
    state = check_bound(chain, state, mask)
    return _check_connected(chain, change_structure(chain, state, jnp.asarray(mask)))


def connect(chain: Chain, state: State, *names: str, here: bool = False) -> State:
    """Return the state with virtual links connected, after the inelastic impact (paper, section
    V-C).

    The coordinates of the new joints are computed from the poses of their bodies. Links that are
    already connected stay unchanged.

    names: virtual links to connect.
    here: False makes each joint at its placement (declared, or set by the last here=True), where
        the bodies must already be; True makes it at the current poses of the bodies. This is
        another joint: its coordinates start at zero, and springs and ranges count from there.

    Raises ValueError for unknown names; also, as a runtime error under jit, for a spare slot that
    is not bound, if bodies are too far from the placement, and if a loop cannot be closed.
    """
    check_state(chain, state)
    named = _link_mask(chain, names)
    state = check_bound(chain, state, named)
    connected = state.structure.connected | named
    at_current_pose = jnp.asarray(named) if boolean("here", here) else None
    change = change_structure(chain, state, connected, at_current_pose=at_current_pose)
    return _check_connected(chain, change)


def _link_mask(chain: Chain, names: tuple[str, ...]) -> np.ndarray:
    """Return the mask of these virtual links. Raises ValueError for unknown names."""
    return np.isin(np.arange(len(chain.link_names)), [link_index(chain.topology, n) for n in names])


def _check_connected(chain: Chain, change: StructureChange) -> State:
    """Return the state after a change.

    Raises ValueError (a runtime error under jit) if bodies were too far from the declared placement
    or a loop is still open.
    """
    if not is_concrete(change.initial_gap):
        state = eqx.error_if(
            change.state,
            ~(change.initial_gap <= CONNECT_TOLERANCE),
            "connect: the bodies are not where the joint is declared; use here=True",
        )
        limit = gap_tolerance(state.q.dtype)
        return eqx.error_if(
            state,
            ~(jnp.max(change.residual_gaps, initial=0) < limit),
            "connect: a loop cannot be closed where the bodies are",
        )
    if change.initial_gap > CONNECT_TOLERANCE:
        raise ValueError(
            f"connect: the bodies are {float(change.initial_gap):.3g} (rad, or lengths of"
            f" {float(chain.length):.3g} m) away from where the joint is declared; move them there,"
            " or grip where they are with here=True"
        )
    return check_closed(chain, change.state, change.residual_gaps)


# largest gap (rad, or in `chain.length`s) that connecting closes by moving the bodies
CONNECT_TOLERANCE = 1e-2


def cut(chain: Chain, state: State, *names: str) -> State:
    """Return the state with virtual links cut; q and v stay unchanged, bit for bit (paper, section
    V-C).

    names: virtual links to cut. Raises ValueError for unknown names.
    """
    check_state(chain, state)
    connected = state.structure.connected & ~_link_mask(chain, names)
    return release_constraints(chain, state, connected).state


def _set_locked(chain: Chain, state: State, joints, value: bool) -> State:
    """Return the state with these joints locked, or unlocked where value is False."""
    check_state(chain, state)
    locked = (
        jnp.zeros(chain.dofs, bool) if state.structure.locked is None else state.structure.locked
    )
    for name in joints:
        locked = locked.at[v_slice(chain.topology, name)].set(value)
    return (change_structure if value else release_constraints)(
        chain, state, state.structure.connected, locked
    ).state


def lock(chain: Chain, state: State, *joints: str) -> State:
    """Return the state with joints of the tree locked at their current coordinates.

    The velocity jumps as in the impact of a connected link (paper, (29)-(38)), so that the locked
    joints are at rest.

    joints: names of joints. Raises ValueError for unknown names.
    """
    return _set_locked(chain, state, joints, True)


def unlock(chain: Chain, state: State, *joints: str) -> State:
    """Return the state with joints unlocked; q and v stay unchanged.

    joints: names of joints. Raises ValueError for unknown names.
    """
    return _set_locked(chain, state, joints, False)


def unbind(chain: Chain, state: State, *names: str) -> State:
    """Return the state with spare virtual links cut and their slots cleared, so that the slots can
    be bound to other bodies; q and v stay unchanged.

    names: spare slots. Raises ValueError for names that are not spare slots.
    """
    check_state(chain, state)
    slots = np.isin(
        np.arange(len(chain.link_names)), [spare_slot(chain.topology, n) for n in names]
    )
    after = release_constraints(chain, state, state.structure.connected & ~jnp.asarray(slots)).state
    return State(after.q, after.v, cleared(after.structure, jnp.asarray(slots)))
