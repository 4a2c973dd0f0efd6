"""Rows of bodies, joints and virtual links by their names."""

import jax
import numpy as np

from svkc.model.chain import Chain
from svkc.model.topology import V_SIZE
from svkc.model.validation import as_array


def connection_mask(chain: Chain, connected) -> np.ndarray | jax.Array:
    """[links] Boolean from names, a mask, or None (as the model says)."""
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
    """The slot of a virtual link; ValueError naming those there are."""
    if not isinstance(name, str) or name not in chain.link_names:
        raise ValueError(
            f"no virtual link {name!r}; virtual links: {', '.join(chain.link_names) or 'none'}"
        )
    return chain.link_names.index(name)


def joint_slice(chain: Chain, name: str, widths, starts) -> slice:
    """Where a joint of the tree, or one that may be cut, stands in q (sizes=Q_SIZE) or v;
    ValueError naming those there are."""
    top = chain.topology
    for joint, link, freedom in top.cut_joints:
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


def body_rows(chain: Chain, *bodies: str) -> list[int]:
    """Rows of bodies by name; ValueError naming those there are."""
    for body in bodies:
        if not isinstance(body, str) or body not in chain.body_names:
            raise ValueError(f"bind: no body {body!r}; bodies: {', '.join(chain.body_names)}")
    return [chain.topology.body_row[chain.body_names.index(b)] for b in bodies]


def spare_slot(chain: Chain, name: str) -> int:
    """The slot of a spare link; ValueError for any other link."""
    slot = link_index(chain, name)
    if not chain.topology.link_spare[slot]:
        spare = [n for n, s in zip(chain.link_names, chain.topology.link_spare, strict=True) if s]
        raise ValueError(
            f"bind: {name!r} is not a spare slot; spare slots:"
            f" {', '.join(spare) or 'none; load with spare=n'}"
        )
    return slot
