"""F5: the structure changes: connect, cut, lock, and the velocity just after (paper, section V)."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Array, Bool, Float

from svkc._jax.eager import eager_jit
from svkc.loops.constraint import active_dofs, ends, joint_coordinates, loop_jacobian, with_coordinates
from svkc.loops.coordinates import constrained
from svkc.loops.forward_dynamics import reduced_inertia, solve_free_motion
from svkc.model.chain import Chain, State, Structure
from svkc.model.checked_jit import check_state
from svkc.model.topology import V_SIZE
from svkc.model.validation import yes_or_no
from svkc.transitions.initial_state import check_closed, connection_mask, joint_slice, link_index
from svkc.transitions.newton import CONNECT, RANK, Held, Schedule, decide_rank, solve_structure
from svkc.transitions.spare_links import emptied, spare_slot
from svkc.tree.inverse_dynamics import inertia_by_composites, inertia_times
from svkc.tree.kinematics import Kinematics, kinematics, twists
from svkc.tree.spatial import quat_conjugate, quat_multiply, quat_rotate


class Change(eqx.Module):
    """What a change of structure did: the state after it, impulses on the real links from their parents, at the joints, and energy lost (J).

    `gap`: the largest gap of a loop before it was closed; `left`: of each loop after it (rad, or `chain.length`s).
    """

    state: State
    impulse: Float[Array, "links 3"]
    angular_impulse: Float[Array, "links 3"]
    energy_lost: Float[Array, ""]
    gap: Float[Array, ""]
    left: Float[Array, " links"]


def gripped_here(chain: Chain, structure: Structure, q, here: Bool[Array, " links"], kin: Kinematics) -> Structure:
    """Placements of the links in `here` taken from where the bodies are: the point is the real link's own, the axes stay the parent's.

    So a palm grips the bar where it touches it, about the bar's direction; floats of the placement stay differentiable.
    """
    end = ends(chain, structure, kin, q)
    p = structure.parent
    to_parent = quat_conjugate(kin.quat[p])
    place = end.real - kin.r[p] - (kin.root[p] - kin.root[structure.real])
    pos = quat_rotate(to_parent, place)
    real_quat = quat_multiply(quat_conjugate(kin.quat[structure.real]), end.base_quat)
    take = here[:, None]
    return eqx.tree_at(
        lambda s: (s.pos, s.real_quat),
        structure,
        (jnp.where(take, pos, structure.pos), jnp.where(take, real_quat, structure.real_quat)),
    )


def _restructured(chain: Chain, structure: Structure, connected, locked) -> tuple[Structure, Bool[Array, " links"], Bool[Array, ""]]:
    """Return the structure with these masks, its rank not decided yet, the links that are new, and whether anything new holds."""
    new_links = connected & ~structure.connected
    holds, after = jnp.any(new_links), eqx.tree_at(lambda s: s.connected, structure, connected)
    if locked is None:
        return after, new_links, holds
    was = jnp.zeros(chain.dofs, bool) if structure.locked is None else structure.locked
    return eqx.tree_at(lambda s: s.locked, after, locked, is_leaf=lambda x: x is None), new_links, holds | jnp.any(locked & ~was)


@eqx.filter_checkpoint
def _placed(chain: Chain, structure: Structure, new_links, here, q) -> tuple[Structure, Float[Array, " q"]]:
    """Return the structure with the placements of the links in `here`, and q with the coordinates of the new joints read off from where the bodies are."""
    kin = kinematics(chain, q)
    if here is not None:
        structure = gripped_here(chain, structure, q, here & new_links, kin)
    return structure, with_coordinates(chain, new_links, joint_coordinates(chain, structure, kin, q), q)


@functools.partial(eager_jit, jit=eqx.filter_jit)
def change(
    chain: Chain, state: State, connected: Bool[Array, " links"], locked: Bool[Array, " dofs"] | None = None, here: Bool[Array, " links"] | None = None
) -> Change:
    """The state under another set of connected links and locked joints.

    Where links are only cut or joints only unlocked, q and v are kept bit for bit; where something new holds, coordinates of the new joints
    are read off, the remaining gap is closed by the least change, and the velocity is projected.
    """
    structure, new_links, holds = _restructured(chain, state.structure, connected, locked)
    q, v, nothing = state.q, state.v, jnp.zeros((len(chain.link_names), 3), state.v.dtype)
    if not len(chain.link_names):
        after, lost = lock_projection(chain, structure, q, v)
        v = jnp.where(holds, after, v)
        return Change(State(q, v, structure), nothing, nothing, jnp.where(holds, lost, 0), jnp.zeros((), v.dtype), nothing[:, 0])
    structure, new_q = _placed(chain, structure, new_links, here, q)
    # the armature of a joint that is made anew is at rest before
    before = v if chain.link_armature is None else jnp.where(active_dofs(chain, state.structure), v, 0)
    joined = solve_structure(chain, structure, new_q, before, Held(), Schedule(RANK + CONNECT))
    structure = eqx.tree_at(lambda s: (s.rank, s.margin), structure, (joined.rank, joined.margin))
    q, v = jnp.where(holds, joined.q, q), jnp.where(holds, joined.v, v)
    wrench, lost = jnp.where(holds, joined.wrench, 0), jnp.where(holds, joined.lost, 0)
    found, left = jnp.where(holds, jnp.max(joined.open[0]), 0), jnp.where(holds, joined.left, joined.open[0])
    return Change(State(q, v, structure), wrench[:, 3:], wrench[:, :3], lost, found, left)


@functools.partial(eager_jit, jit=eqx.filter_jit)
def release(chain: Chain, state: State, connected: Bool[Array, " links"], locked: Bool[Array, " dofs"] | None = None) -> Change:
    """`change` where links are only cut and joints only unlocked: q and v stay, the rank is decided anew."""
    structure, _, _ = _restructured(chain, state.structure, connected, locked)
    nothing, zero = jnp.zeros((len(chain.link_names), 3), state.v.dtype), jnp.zeros((), state.v.dtype)
    return Change(State(state.q, state.v, decide_rank(chain, structure, state.q)), nothing, nothing, zero, zero, nothing[:, 0])


def lock_projection(chain: Chain, structure: Structure, q, v):
    """The projection where only joints are locked and there are no virtual links; velocity after, energy lost."""
    if structure.locked is None:
        return v, jnp.zeros((), v.dtype)
    kin = kinematics(chain, q)
    after = solve_free_motion(chain, structure, kin, inertia_times(chain, kin, v))
    jump = after - v
    return after, jump @ inertia_times(chain, kin, jump) / 2


def transition(chain: Chain, state: State, connected) -> State:
    """The state with exactly these virtual links connected (mask, or names): new ones with their impact (paper, (29)-(38)), the others cut."""
    check_state(chain, state)
    mask = jnp.asarray(connection_mask(chain, connected))
    return _checked(chain, change(chain, state, mask))


def connect(chain: Chain, state: State, *names: str, here: bool = False) -> State:
    """Connects virtual links: coordinates of the new joints, and the velocity after the impact (paper, section V-C).

    At their declared placement, where the bodies must already be; here=True: the joint is made where the real link is. ValueError: unknown
    names, or bodies that are not at the placement (says by how much).
    """
    check_state(chain, state)
    chosen = np.isin(np.arange(len(chain.link_names)), [link_index(chain, n) for n in names])
    mask = state.structure.connected | jnp.asarray(chosen)
    return _checked(chain, change(chain, state, mask, here=jnp.asarray(chosen) if yes_or_no("here", here) else None))


def _checked(chain: Chain, done: Change) -> State:
    """The state after a change; an error where bodies were too far from the declared placement to be joined."""
    limit = connect_tolerance
    if isinstance(done.gap, jax.core.Tracer):
        return eqx.error_if(done.state, done.gap > limit, "connect: the bodies are not where the joint is declared; use here=True")
    if done.gap > limit:
        raise ValueError(
            f"connect: the bodies are {float(done.gap):.3g} (rad, or lengths of {float(chain.length):.3g} m) away from where the joint is "
            "declared; move them there, or grip where they are with here=True"
        )
    return check_closed(chain, done.state, done.left)


# gap, in rad or in `chain.length`s, up to which connecting may still move the bodies to their declared placement
connect_tolerance = 1e-2


def cut(chain: Chain, state: State, *names: str) -> State:
    """Cuts virtual links: q and v stay as they are, bit for bit (paper, section V-C)."""
    check_state(chain, state)
    chosen = np.isin(np.arange(len(chain.link_names)), [link_index(chain, n) for n in names])
    return release(chain, state, state.structure.connected & ~jnp.asarray(chosen)).state


def _locked(chain: Chain, state: State, joints, value: bool) -> State:
    check_state(chain, state)
    locked = jnp.zeros(chain.dofs, bool) if state.structure.locked is None else state.structure.locked
    for name in joints:
        locked = locked.at[joint_slice(chain, name, V_SIZE, chain.topology.v_start)].set(value)
    return (change if value else release)(chain, state, state.structure.connected, locked).state


def lock(chain: Chain, state: State, *joints: str) -> State:
    """Holds joints of the tree still from now on, with the impact of stopping them: velocities (rad/s, m/s) as by (29)-(38) for connecting."""
    return _locked(chain, state, joints, True)


def unlock(chain: Chain, state: State, *joints: str) -> State:
    """Lets locked joints move again; q (m, rad) and v (m/s, rad/s) stay as they are."""
    return _locked(chain, state, joints, False)


def unbind(chain: Chain, state: State, *names: str) -> State:
    """Cuts spare virtual links and empties their slots for other bodies; q and v stay as they are."""
    check_state(chain, state)
    slots = np.isin(np.arange(len(chain.link_names)), [spare_slot(chain, n) for n in names])
    after = release(chain, state, state.structure.connected & ~jnp.asarray(slots)).state
    return State(after.q, after.v, emptied(after.structure, jnp.asarray(slots)))


@functools.partial(jax.jit, static_argnames="name")
def velocity_by_impulse(chain: Chain, state: State, name: str) -> tuple[Float[Array, " dofs"], Float[Array, "6"]]:
    """The velocity after connecting one link and the impulse F_1 on it, by the paper's (34)-(38) in the coordinates theta_G of the old structure.

    The paper's own form, good where B is regular; it checks the projection that `connect` uses. State: not connected yet, bodies in place.
    """
    slot, nv = link_index(chain, name), chain.nv
    kin = kinematics(chain, state.q)
    before = constrained(chain, state.structure, state.q, state.v, kin, twists(chain, kin, state.v))
    after = eqx.tree_at(lambda s: s.connected, state.structure, state.structure.connected.at[slot].set(True))
    q = with_coordinates(chain, after.connected & ~state.structure.connected, joint_coordinates(chain, after, kin, state.q), state.q)
    J = loop_jacobian(chain, after, kin, ends(chain, after, kin, q))[6 * slot : 6 * slot + 6]
    own = np.array([d for d in chain.topology.links.dof[slot] if d < chain.dofs], int)
    # J_1 - J_2 along theta_G, and the axes of the new joint, on the side where (27) has them
    J_G, J_r = J[:, :nv] @ before.W[:nv], -J[:, own]
    A = cho_factor(reduced_inertia(chain, before, inertia_by_composites(chain, kin)))
    B_inverse = jnp.linalg.inv(J_G @ cho_solve(A, J_G.T))
    C = J_r @ jnp.linalg.solve(J_r.T @ B_inverse @ J_r, J_r.T @ B_inverse) if len(own) else jnp.zeros_like(B_inverse)
    u = J[:, :nv] @ state.v[:nv]
    F = -B_inverse @ (jnp.eye(6, dtype=u.dtype) - C) @ u
    v = state.v + before.W @ cho_solve(A, J_G.T @ F)
    if len(own):
        v = v.at[own].set(jnp.linalg.lstsq(J_r, J[:, :nv] @ v[:nv])[0])
    return v, F
