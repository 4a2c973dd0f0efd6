"""Indices of bodies, joints and virtual links by their names.

Raises ValueError, with the names that exist, for an unknown one.
"""

import difflib
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from svkc.model.chain import Chain
from svkc.model.topology import V_SIZE, FixedFrame
from svkc.model.validation import as_array

# number of known names in an error
_LONGEST_LIST = 20


def unknown_name(kind: str, name: Any, known: Sequence[str]) -> ValueError:
    """Return the ValueError for an unknown name, with the nearest names and the known ones.

    kind: what is named, in the singular, as "body" or "body or site".
    name: the unknown name.
    known: the known names, of which the error lists the first twenty.
    """
    nearest = difflib.get_close_matches(str(name), known)
    hint = f" did you mean {' or '.join(map(repr, nearest))}?" if nearest else ""
    kinds = " or ".join(f"{k[:-1]}ies" if k[-1] == "y" else f"{k}s" for k in kind.split(" or "))
    names = [*known[:_LONGEST_LIST], *(["..."] if len(known) > _LONGEST_LIST else [])]
    return ValueError(f"no {kind} {name!r};{hint} {kinds}: {', '.join(names) or 'none'}")


def connection_mask(chain: Chain, connected: Any) -> np.ndarray | jax.Array:
    """Return the mask [links] of connected virtual links from names, a mask, or None (the model's).

    Raises ValueError if `connected` is neither names nor a Boolean mask of this length.
    """
    if connected is None:
        return chain.structure.connected
    names = (connected,) if isinstance(connected, str) else connected
    if isinstance(names, (tuple, list, set, frozenset)) and all(isinstance(n, str) for n in names):
        return np.isin(chain.link_names, [chain.link_names[link_index(chain, n)] for n in names])
    mask = as_array(connected)
    if mask.shape != (len(chain.link_names),) or mask.dtype != bool:
        raise ValueError(
            f"connected: expected names of virtual links or {len(chain.link_names)} Booleans, got"
            f" {mask.dtype} of shape {mask.shape}"
        )
    return mask


def link_index(chain: Chain, name: str) -> int:
    """Return the index of a virtual link in `Structure`'s entries."""
    if isinstance(name, str) and name in chain.joint_names:
        raise ValueError(
            f"no virtual link {name!r}, but a joint of the tree; to cut it, load the chain with"
            f" svkc.load(..., cuttable={name!r})"
        )
    if not isinstance(name, str) or name not in chain.link_names:
        raise ValueError(
            f"no virtual link {name!r}; virtual links: {', '.join(chain.link_names) or 'none'}"
        )
    return chain.link_names.index(name)


def joint_slice(chain: Chain, name: str, widths: Any, starts: Any) -> slice:
    """Return the slice of a joint in q or v, for a joint of the tree or a cuttable one.

    widths: number of coordinates by joint kind: `Q_SIZE` for q, `V_SIZE` for v.
    starts: first index of each row: `Topology.q_start` or `Topology.v_start`.
    """
    top = chain.topology
    for joint, link, freedom in top.cuttable_joints:
        if joint == name:
            ball = sum(top.link_freedoms[link][:3]) == 3
            if widths is V_SIZE:
                first = top.links.dof[link, freedom]
                return slice(int(first), int(first) + (3 if ball else 1))
            first = (
                top.links.quat[link, 0]
                if ball
                else np.concatenate([top.links.angle, top.links.slide], 1)[link, freedom]
            )
            return slice(int(first), int(first) + (4 if ball else 1))
    if not isinstance(name, str) or name not in top.joint_names:
        raise ValueError(f"no joint {name!r}; joints: {', '.join(top.joint_names)}")
    row = top.joint_row[top.joint_names.index(name)]
    return slice(starts[row], starts[row] + widths[top.kind[row]])


def body_or_site(chain: Chain, name: Any) -> FixedFrame:
    """Return the frame of a body, or of a site of the model; the body's if both have the name."""
    top = chain.topology
    if isinstance(name, str) and name in top.body_names:
        return FixedFrame(top.body_row[top.body_names.index(name)])
    if isinstance(name, str) and name in top.site_names:
        return top.site_frames[top.site_names.index(name)]
    kind = "body or site" if top.site_names else "body"
    raise unknown_name(kind, name, top.body_names + top.site_names)


def body_rows(chain: Chain, *bodies: str) -> list[int]:
    """Return the rows of bodies."""
    for body in bodies:
        if not isinstance(body, str) or body not in chain.body_names:
            raise ValueError(f"bind: no body {body!r}; bodies: {', '.join(chain.body_names)}")
    return [chain.topology.body_row[chain.body_names.index(b)] for b in bodies]


def spare_slot(chain: Chain, name: str) -> int:
    """Return the index of a spare slot; raise ValueError for any other virtual link."""
    slot = link_index(chain, name)
    if not chain.topology.link_spare[slot]:
        spare = [n for n, s in zip(chain.link_names, chain.topology.link_spare, strict=True) if s]
        raise ValueError(
            f"bind: {name!r} is not a spare slot; spare slots:"
            f" {', '.join(spare) or 'none; load with spare=n'}"
        )
    return slot
