"""Indices of bodies, joints and virtual links by their names.

Functions raise ValueError, with the nearest names, for an unknown one.
"""

import difflib
from collections.abc import Collection, Sequence
from typing import Any

import jax
import numpy as np

from svkc.model.chain_names import chain_names
from svkc.model.topology import FixedFrame, Topology
from svkc.model.validation import as_array

# at most this many known names are listed in an error
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


def _is_among(name: Any, known: Collection[str]) -> bool:
    """Return whether a value is one of these names."""
    return isinstance(name, str) and name in known


def link_index(top: Topology, name: str) -> int:
    """Return the index of a virtual link in `Structure`'s entries."""
    if _is_among(name, top.joint_names) and name not in top.link_names:
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
    return _joint_slice(top, chain_names(top).q_ranges, joint, links)


def v_slice(top: Topology, joint: str, *, links: bool = False) -> slice:
    """Return the slice in v of a joint of the tree or of a cuttable joint.

    links: whether the name may also be that of a virtual link.
    """
    return _joint_slice(top, chain_names(top).v_ranges, joint, links)


def _joint_slice(top: Topology, ranges: Any, joint: str, links: bool) -> slice:
    """Return the slice of a joint among the ranges (name, start, stop) of all."""
    cuttable = tuple(name for name, _, _ in top.cuttable_joints)
    known = dict.fromkeys(top.joint_names + cuttable + top.link_names * links)
    if not _is_among(joint, known) and _is_among(joint, top.link_names):
        raise ValueError(
            f"no joint {joint!r}; it is a virtual link, whose coordinates follow from those of the"
            " joints"
        )
    if not _is_among(joint, known):
        raise unknown_name("joint", joint, tuple(known))
    return next(slice(start, stop) for name, start, stop in ranges if name == joint)


def body_index(top: Topology, name: str) -> int:
    """Return the index of a body."""
    if not _is_among(name, top.body_names):
        raise unknown_name("body", name, top.body_names)
    return top.body_names.index(name)


def body_or_site(top: Topology, name: str) -> FixedFrame:
    """Return the frame of a body, or of a site of the model; the body's if both have the name."""
    if _is_among(name, top.body_names):
        return FixedFrame(top.body_row[top.body_names.index(name)])
    if _is_among(name, top.site_names):
        return top.site_frames[top.site_names.index(name)]
    kind = "body or site" if top.site_names else "body"
    raise unknown_name(kind, name, top.body_names + top.site_names)


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
