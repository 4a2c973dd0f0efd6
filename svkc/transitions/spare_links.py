"""Spare virtual links: run-time data that says between which two bodies, where and how."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from svkc.model.chain import Chain, State, Structure
from svkc.model.checked_jit import check_state
from svkc.model.names import body_rows, spare_slot
from svkc.model.validation import finite_array
from svkc.model.virtual_link import joint_freedoms


def _hashable(x):
    return tuple(x) if np.iterable(x) else x


class Grip(eqx.Module):
    """A joint to be made between two bodies with a spare slot (`svkc.load(..., spare=n)`), where
    they are: `bind=` of an event.

    parent, real: body names; joint: any but universal and pairs of turns, for whose coordinates a
    slot has no room; axis: of the joint, in the parent; real_pos (m): the point in the real link,
    differentiable; slot: name of the slot, None: the first that is free.
    """

    parent: str = eqx.field(static=True)
    real: str = eqx.field(static=True)
    joint: Any = eqx.field(static=True, default="weld")
    axis: Any = eqx.field(static=True, default=(0.0, 0.0, 1.0), converter=_hashable)
    real_pos: Any = (0.0, 0.0, 0.0)
    slot: str | None = eqx.field(static=True, default=None)


def spare_link_freedoms(joint) -> tuple[bool, ...]:
    """The joint's six Booleans; ValueError for those a spare slot has no coordinates for."""
    freedoms = joint_freedoms(joint)
    if sum(freedoms[:3]) == 2:
        raise ValueError(
            f"bind: a spare slot has no coordinates for {joint!r}; declare the link when loading"
        )
    return freedoms


def rotation_to_axis(axis) -> np.ndarray:
    """The shortest turn of z onto an axis, wxyz; ValueError for no axis."""
    axis = np.asarray(finite_array("bind: axis", axis), float)
    if axis.shape != (3,) or not 0 < np.linalg.norm(axis) < np.inf:
        raise ValueError(f"bind: axis: expected three numbers that are not all zero, got {axis}")
    x, y, z = axis / np.linalg.norm(axis)
    quat = np.array([1 + z, -y, x, 0.0]) if z > -1 + 1e-12 else np.array([0.0, 1, 0, 0])
    return quat / np.linalg.norm(quat)


def as_placement(name: str, value, dtype):
    """A place: three numbers, finite where that can be seen."""
    place = finite_array(f"bind: {name}", value, dtype)
    if place.shape != (3,):
        raise ValueError(f"bind: {name}: expected three numbers (m), got shape {place.shape}")
    return place


def set_links(
    structure: Structure, at: Bool[Array, " links"], *, rows, freedoms, quat, pos, real_pos
) -> Structure:
    """The structure with the links in the mask `at` between two rows, by such a joint, at such a
    place."""
    dtype = structure.pos.dtype
    wide = at[:, None]
    return eqx.tree_at(
        lambda s: (s.parent, s.real, s.freedoms, s.quat, s.pos, s.real_pos),
        structure,
        (
            jnp.where(at, jnp.asarray(rows[0], structure.parent.dtype), structure.parent),
            jnp.where(at, jnp.asarray(rows[1], structure.real.dtype), structure.real),
            jnp.where(wide, np.array(freedoms)[None], structure.freedoms),
            jnp.where(wide, jnp.asarray(quat, dtype)[None], structure.quat),
            jnp.where(wide, jnp.asarray(pos, dtype)[None], structure.pos),
            jnp.where(wide, jnp.asarray(real_pos, dtype)[None], structure.real_pos),
        ),
    )


def bound_between(
    chain: Chain, structure: Structure, parent: str, real: str
) -> Bool[Array, " links"]:
    """Spare slots that are bound between these two bodies and connected."""
    p, r = body_rows(chain, parent, real)
    return (
        jnp.asarray(np.array(chain.topology.link_spare, bool))
        & structure.connected
        & (structure.parent == p)
        & (structure.real == r)
    )


def bind_grip(
    chain: Chain, structure: Structure, grip: Grip
) -> tuple[Structure, Bool[Array, " links"], Bool[Array, ""]]:
    """The structure with a slot bound as wished, the slot to connect (none where the two bodies are
    held already), and whether none was free."""
    spare = jnp.asarray(np.array(chain.topology.link_spare, bool))
    rows = body_rows(chain, grip.parent, grip.real)
    if grip.slot is None:
        free = spare & ~structure.connected & (structure.parent == 0) & (structure.real == 0)
        slot = free & (jnp.cumsum(free, dtype=jnp.int32) == 1)
    else:
        slot = (jnp.arange(spare.shape[0]) == spare_slot(chain, grip.slot)) & ~structure.connected
    held = jnp.any(bound_between(chain, structure, grip.parent, grip.real))
    slot = slot & ~held
    bound = set_links(
        structure,
        slot,
        rows=rows,
        freedoms=spare_link_freedoms(grip.joint),
        quat=rotation_to_axis(grip.axis),
        pos=jnp.zeros(3, structure.pos.dtype),
        real_pos=grip.real_pos,
    )
    return bound, slot, ~held & ~jnp.any(slot)


def cleared(structure: Structure, slots: Bool[Array, " links"]) -> Structure:
    """The structure with these slots bound to nothing."""
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
    joint="weld",
    axis=(0.0, 0.0, 1.0),
    pos=(0.0, 0.0, 0.0),
    real_pos=(0.0, 0.0, 0.0),
) -> State:
    """A spare slot put between two bodies, not connected yet: run-time data, no retrace. Connect it
    with here=True, or at this placement.

    joint: any but universal and pairs of turns, whose coordinates a spare slot has no room for.
    axis: of the joint, in the parent. pos, real_pos (m): in the two bodies. ValueError: not a spare
    slot, unknown bodies. In a run: `svkc.at(t, bind=svkc.Grip(...))`.
    """
    check_state(chain, state)
    at = jnp.asarray(np.arange(len(chain.link_names)) == spare_slot(chain, name))
    pos, real_pos = (
        as_placement(what, x, state.q.dtype) for what, x in (("pos", pos), ("real_pos", real_pos))
    )
    structure = set_links(
        state.structure,
        at,
        rows=body_rows(chain, parent, real),
        freedoms=spare_link_freedoms(joint),
        quat=rotation_to_axis(axis),
        pos=pos,
        real_pos=real_pos,
    )
    return State(state.q, state.v, structure)
