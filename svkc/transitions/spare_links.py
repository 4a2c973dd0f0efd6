"""Spare virtual links: slots that are bound to two bodies at run time.

The bodies, the joint and the placement of a spare link are data of the `Structure`, so that binding
a slot does not compile a new program.
"""

from collections.abc import Iterable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from svkc._jax.pytrees import is_concrete
from svkc._jax.select import where
from svkc.model.annotations import Checked, DType, Numbers
from svkc.model.chain import Chain, State, Structure
from svkc.model.checked_jit import check_state
from svkc.model.names import body_rows, spare_slot
from svkc.model.validation import finite_array
from svkc.model.virtual_link import joint_freedoms


def _hashable(x):
    """Return an iterable as a tuple: static fields must be hashable."""
    return tuple(x) if np.iterable(x) else x


class Grip(eqx.Module):
    """A joint that an event makes between two bodies with a spare slot (`bind=` of `svkc.at` and
    `svkc.when`).

    The joint is made at the current poses of the bodies. A grip changes nothing if a connected slot
    joins the same parent and real link already. The chain needs spare slots
    (`svkc.load(..., spare=n)`). `simulate` raises ValueError for unknown names and invalid values.

    parent, real: names of the two bodies.
    joint: name of the joint, or six Booleans for its freedoms, as for `svkc.VirtualLink`; joints
        with two rotations, such as "universal", are refused, as a slot has no room for their
        coordinates.
    axis: axis of the joint in the frame of the parent.
    real_pos: point of the joint in the frame of the real link (m); differentiable.
    slot: name of the spare slot; None: the first free slot.
    """

    parent: str = eqx.field(static=True)
    real: str = eqx.field(static=True)
    joint: Any = eqx.field(static=True, default="weld")
    axis: Any = eqx.field(static=True, default=(0.0, 0.0, 1.0), converter=_hashable)
    real_pos: Any = (0.0, 0.0, 0.0)
    slot: str | None = eqx.field(static=True, default=None)


def spare_link_freedoms(joint: Any) -> tuple[bool, ...]:
    """Return the joint's six freedoms. Raises ValueError for a joint with two rotations, for which
    a spare slot has no coordinates."""
    freedoms = joint_freedoms(joint)
    if sum(freedoms[:3]) == 2:
        raise ValueError(
            f"bind: a spare slot has no coordinates for {joint!r}; declare the link when loading"
        )
    return freedoms


def rotation_to_axis(axis: Numbers) -> np.ndarray:
    """Return the quaternion (wxyz) of the smallest rotation that takes z to an axis. Raises
    ValueError for an axis of zero length."""
    axis = np.asarray(finite_array("bind: axis", axis), float)
    if axis.shape != (3,) or not 0 < np.linalg.norm(axis) < np.inf:
        raise ValueError(f"bind: axis: expected three numbers that are not all zero, got {axis}")
    x, y, z = axis / np.linalg.norm(axis)
    quat = np.array([1 + z, -y, x, 0.0]) if z > -1 + 1e-12 else np.array([0.0, 1, 0, 0])
    return quat / np.linalg.norm(quat)


def as_placement(name: str, value: Any, dtype: DType) -> Array:
    """Return a point (m) as an array. Raises ValueError if it is not three finite numbers."""
    point = finite_array(f"bind: {name}", value, dtype)
    if point.shape != (3,):
        raise ValueError(f"bind: {name}: expected three numbers (m), got shape {point.shape}")
    return point


def set_links(
    structure: Structure,
    links: Bool[Array, " links"],
    *,
    rows: Any,
    freedoms: Any,
    quat: Any,
    pos: Any,
    real_pos: Any,
) -> Structure:
    """Return the structure with new bodies, joint and placement of `links`.

    rows: topology rows of the parent and of the real link.
    freedoms: six Booleans, as in `Structure`.
    quat: orientation of the joint in the parent, and also in the real link (wxyz).
    pos, real_pos: position of the joint in the parent and in the real link (m).
    """
    dtype = structure.pos.dtype
    column = links[:, None]
    quat = jnp.asarray(quat, dtype)[None]
    return eqx.tree_at(
        lambda s: (s.parent, s.real, s.freedoms, s.quat, s.real_quat, s.pos, s.real_pos),
        structure,
        (
            where(links, jnp.asarray(rows[0], structure.parent.dtype), structure.parent),
            where(links, jnp.asarray(rows[1], structure.real.dtype), structure.real),
            where(column, np.array(freedoms)[None], structure.freedoms),
            where(column, quat, structure.quat),
            where(column, quat, structure.real_quat),
            where(column, jnp.asarray(pos, dtype)[None], structure.pos),
            where(column, jnp.asarray(real_pos, dtype)[None], structure.real_pos),
        ),
    )


def unbound_slots(chain: Chain, structure: Structure) -> Bool[Array, " links"]:
    """Return the mask of the spare slots that are bound to no bodies: both of their rows are the
    world's, 0."""
    spare = jnp.asarray(np.array(chain.topology.link_spare, bool))
    return spare & (structure.parent == 0) & (structure.real == 0)


def check_bound(chain: Chain, state: State, to_connect: Any) -> State:
    """Return the state.

    to_connect: mask of the links to connect.

    Raises ValueError (a runtime error under jit) if one of them is a spare slot that is bound to no
    bodies.
    """
    spare = np.array(chain.topology.link_spare, bool)
    if not spare.any() or (is_concrete(to_connect) and not np.any(np.asarray(to_connect) & spare)):
        return state
    structure = state.structure
    if not is_concrete(to_connect, structure.parent, structure.real):
        return eqx.error_if(
            state,
            jnp.any(to_connect & unbound_slots(chain, structure)),
            "connect: a spare slot is not bound to two bodies; bind it first",
        )
    is_unbound = (np.asarray(structure.parent) == 0) & (np.asarray(structure.real) == 0)
    missing = np.flatnonzero(np.asarray(to_connect) & spare & is_unbound)
    if len(missing):
        names = ", ".join(chain.link_names[i] for i in missing)
        raise ValueError(
            f"connect: spare slots that are not bound to two bodies: {names}; bind them first, as"
            f" in svkc.bind(chain, state, {chain.link_names[missing[0]]!r}, parent, real)"
        )
    return state


def bound_between(
    chain: Chain, structure: Structure, parent: str, real: str
) -> Bool[Array, " links"]:
    """Return the mask of the connected spare slots with this parent and this real link.

    parent, real: names of bodies. Slots with the two exchanged are not in the mask.
    """
    p, r = body_rows(chain.topology, parent, real)
    return (
        jnp.asarray(np.array(chain.topology.link_spare, bool))
        & structure.connected
        & (structure.parent == p)
        & (structure.real == r)
    )


def bind_grip(
    chain: Chain, structure: Structure, grip: Grip
) -> tuple[Structure, Bool[Array, " links"], Bool[Array, ""]]:
    """Return the structure with a slot bound as the grip says, the mask of the slot to connect, and
    whether the grip failed for want of a slot: none is free, or the named one is connected.

    The mask is empty if a connected slot joins the same parent and real link already.
    """
    spare = jnp.asarray(np.array(chain.topology.link_spare, bool))
    rows = body_rows(chain.topology, grip.parent, grip.real)
    if grip.slot is None:
        free = unbound_slots(chain, structure) & ~structure.connected
        slot = free & (jnp.cumsum(free, dtype=jnp.int32) == 1)
    else:
        slot = (
            jnp.arange(spare.shape[0]) == spare_slot(chain.topology, grip.slot)
        ) & ~structure.connected
    already_bound = jnp.any(bound_between(chain, structure, grip.parent, grip.real))
    slot = slot & ~already_bound
    bound = set_links(
        structure,
        slot,
        rows=rows,
        freedoms=spare_link_freedoms(grip.joint),
        quat=rotation_to_axis(grip.axis),
        pos=jnp.zeros(3, structure.pos.dtype),
        real_pos=grip.real_pos,
    )
    return bound, slot, ~already_bound & ~jnp.any(slot)


def cleared(structure: Structure, slots: Bool[Array, " links"]) -> Structure:
    """Return the structure with these spare slots bound to no bodies."""
    zero = jnp.zeros(3, structure.pos.dtype)
    return set_links(
        structure,
        slots,
        rows=(0, 0),
        freedoms=(True,) * 6,
        quat=np.array([1.0, 0, 0, 0]),
        pos=zero,
        real_pos=zero,
    )


def bind(
    chain: Chain,
    state: State,
    name: str,
    parent: str,
    real: str,
    *,
    joint: Checked[str | Iterable[bool]] = "weld",
    axis: Numbers = (0.0, 0.0, 1.0),
    pos: Numbers = (0.0, 0.0, 0.0),
    real_pos: Numbers = (0.0, 0.0, 0.0),
) -> State:
    """Return the state with a spare slot, which must not be connected, bound to two bodies.

    The slot is run-time data: binding does not retrace. `svkc.connect` then connects the slot, at
    the placement given here or, with here=True, at the current poses of the bodies. During a run
    use `svkc.at(t, bind=svkc.Grip(...))`.

    name: spare slot.
    parent, real: names of the two bodies.
    joint: name of the joint, or six Booleans for its freedoms, as for `svkc.VirtualLink`; joints
        with two rotations, such as "universal", are refused, as a slot has no room for their
        coordinates.
    axis: axis of the joint in the frame of the parent, and also in that of the real link. The two
        frames are parallel where the loop is closed and the joint's rotations are zero.
    pos, real_pos: point of the joint in the frames of the parent and of the real link (m).

    Raises ValueError if `name` is not a spare slot, for unknown bodies, for an invalid joint, axis
    or point, and, as a runtime error under jit, if the slot is connected.
    """
    check_state(chain, state)
    index = spare_slot(chain.topology, name)
    state = _check_not_connected(state, index, name)
    slot = jnp.asarray(np.arange(len(chain.link_names)) == index)
    pos, real_pos = (
        as_placement(key, x, state.q.dtype) for key, x in (("pos", pos), ("real_pos", real_pos))
    )
    structure = set_links(
        state.structure,
        slot,
        rows=body_rows(chain.topology, parent, real),
        freedoms=spare_link_freedoms(joint),
        quat=rotation_to_axis(axis),
        pos=pos,
        real_pos=real_pos,
    )
    return State(state.q, state.v, structure)


def _check_not_connected(state: State, slot: int, name: str) -> State:
    """Return the state. Raises ValueError (a runtime error under jit) if a slot is connected."""
    connected = state.structure.connected
    if not is_concrete(connected):
        return eqx.error_if(
            state, connected[slot], "bind: the spare slot is connected; cut or unbind it first"
        )
    if np.asarray(connected)[slot]:
        raise ValueError(f"bind: {name!r} is connected; cut or unbind it first")
    return state
