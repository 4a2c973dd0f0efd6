"""Indices of bodies, joints and virtual links by their names.

Raises ValueError, with the names that exist, for an unknown one.
"""

import difflib
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from svkc.model.topology import Q_SIZE, V_SIZE, Topology
from svkc.model.validation import as_array

# an error lists as many of the known names
_MOST_NAMES = 20


def unknown_name(kind: str, name: Any, known: Sequence[str]) -> ValueError:
    """Return the ValueError for an unknown name, with the nearest names and the known ones.

    kind: what is named, in the singular, as "body" or "body or site".
    name: the unknown name.
    known: the known names, of which the error lists the first twenty.
    """
    nearest = difflib.get_close_matches(str(name), known)
    hint = f" did you mean {' or '.join(map(repr, nearest))}?" if nearest else ""
    kinds = " or ".join(f"{k[:-1]}ies" if k[-1] == "y" else f"{k}s" for k in kind.split(" or "))
    shown = [*known[:_MOST_NAMES], *(["..."] if len(known) > _MOST_NAMES else [])]
    return ValueError(f"no {kind} {name!r};{hint} {kinds}: {', '.join(shown) or 'none'}")


def connection_mask(
    top: Topology, connected: Any, default: np.ndarray | jax.Array
) -> np.ndarray | jax.Array:
    """Return the mask [links] of connected virtual links from names, a mask, or None (the default).

    Raises ValueError if `connected` is neither names nor a Boolean mask of this length.
    """
    if connected is None:
        return default
    names = (connected,) if isinstance(connected, str) else connected
    if isinstance(names, (tuple, list, set, frozenset)) and all(isinstance(n, str) for n in names):
        return np.isin(np.arange(len(top.link_names)), [link_index(top, n) for n in names])
    mask = as_array(connected)
    if mask.shape != (len(top.link_names),) or mask.dtype != bool:
        raise ValueError(
            f"connected: expected names of virtual links or {len(top.link_names)} Booleans, got"
            f" {mask.dtype} of shape {mask.shape}"
        )
    return mask


def _is_among(name: Any, known: Sequence[str]) -> bool:
    """Return whether a value is one of these names."""
    return isinstance(name, str) and name in known


def link_index(top: Topology, name: str) -> int:
    """Return the index of a virtual link in `Structure`'s entries."""
    if _is_among(name, top.joint_names):
        raise ValueError(
            f"no virtual link {name!r}, but a joint of the tree; to cut it, load the chain with"
            f" svkc.load(..., cuttable={name!r})"
        )
    if not _is_among(name, top.link_names):
        raise unknown_name("virtual link", name, top.link_names)
    return top.link_names.index(name)


def q_slice(top: Topology, joint: str, *, links: bool = False) -> slice:
    """Return the slice in q of a joint of the tree or of a cuttable joint.

    links: whether the name may also be that of a virtual link.
    """
    for name, link, freedom in top.cuttable_joints:
        if name == joint:
            if _is_ball(top, link):
                return _as_slice(top.links.quat[link])
            of_freedoms = np.concatenate([top.links.angle, top.links.slide], 1)
            return _as_slice(of_freedoms[link, freedom : freedom + 1])
    if _is_among(joint, top.joint_names):
        row = top.joint_row[top.joint_names.index(joint)]
        return slice(top.q_start[row], top.q_start[row] + Q_SIZE[top.kind[row]])
    if not links or not _is_among(joint, top.link_names):
        raise unknown_name("joint", joint, top.joint_names + top.link_names * links)
    link = top.link_names.index(joint)
    freedoms = np.array(top.link_freedoms[link])
    rotations = top.links.quat[link] if _is_ball(top, link) else top.links.angle[link][freedoms[:3]]
    return _as_slice(np.concatenate([rotations, top.links.slide[link][freedoms[3:]]]))


def v_slice(top: Topology, joint: str, *, links: bool = False) -> slice:
    """Return the slice in v of a joint of the tree or of a cuttable joint.

    links: whether the name may also be that of a virtual link.
    """
    for name, link, freedom in top.cuttable_joints:
        if name == joint:
            width = 3 if _is_ball(top, link) else 1
            return _as_slice(top.links.dof[link, freedom : freedom + width])
    if _is_among(joint, top.joint_names):
        row = top.joint_row[top.joint_names.index(joint)]
        return slice(top.v_start[row], top.v_start[row] + V_SIZE[top.kind[row]])
    if not links or not _is_among(joint, top.link_names):
        raise unknown_name("joint", joint, top.joint_names + top.link_names * links)
    link = top.link_names.index(joint)
    return _as_slice(top.links.dof[link][np.array(top.link_freedoms[link])])


def _is_ball(top: Topology, link: int) -> bool:
    """Return whether a virtual joint has three rotations, for which q holds a quaternion."""
    return sum(top.link_freedoms[link][:3]) == 3


def _as_slice(indices: np.ndarray) -> slice:
    """Return successive indices as a slice, of length zero if there are none."""
    return slice(int(indices[0]), int(indices[-1]) + 1) if len(indices) else slice(0, 0)


def body_index(top: Topology, name: str) -> int:
    """Return the index of a body."""
    if not _is_among(name, top.body_names):
        raise unknown_name("body", name, top.body_names)
    return top.body_names.index(name)


def body_rows(top: Topology, *bodies: str) -> list[int]:
    """Return the rows of bodies."""
    return [top.body_row[body_index(top, body)] for body in bodies]


def spare_slot(top: Topology, name: str) -> int:
    """Return the index of a spare slot; raise ValueError for any other virtual link."""
    slot = link_index(top, name)
    if not top.link_spare[slot]:
        spare = [n for n, s in zip(top.link_names, top.link_spare, strict=True) if s]
        raise ValueError(
            f"bind: {name!r} is not a spare slot; spare slots:"
            f" {', '.join(spare) or 'none; load with spare=n'}"
        )
    return slot
