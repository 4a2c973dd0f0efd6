"""What `print(chain)` shows: tables of the bodies and of the virtual links."""

from typing import Any

import numpy as np

from svkc.model.tables import Block, Table, count, number
from svkc.model.topology import BALL, FIXED, FREE, HINGE, SLIDE, V_SIZE
from svkc.model.virtual_link import JOINTS

_KINDS = {FIXED: "fixed", HINGE: "hinge", SLIDE: "slide", BALL: "ball", FREE: "free"}
_JOINT_OF_FREEDOMS = {freedoms: joint for joint, freedoms in JOINTS.items()}
_FREEDOMS = ("rx", "ry", "rz", "x", "y", "z")


def chain_summary(chain: Any) -> str:
    """Return one line: how many bodies, joints, virtual links and freedoms a chain has."""
    top = chain.topology
    bodies = len(top.body_names) - 1
    parts = [
        f"{bodies} {'body' if bodies == 1 else 'bodies'}",
        count(len(top.joint_names), "joint"),
        count(len(top.link_names), "virtual link"),
        count(chain.gear.shape[-2], "actuator"),
        f"{count(top.nv, 'joint freedom')} in the tree",
        f"{top.dofs} with every virtual link",
    ]
    return f"Chain: {', '.join(parts)}"


def chain_blocks(chain: Any) -> list[Block]:
    """Return a summary, tables of the bodies and of the virtual links, notes on the links, and
    the elements of the model that are left out."""
    bodies = Table(("body", "parent", "joint", "kind", "freedoms", "mass (kg)"), _body_rows(chain))
    left_out = [f"left out: {line}" for line in chain.left_out]
    if not chain.link_names:
        return [chain_summary(chain), bodies, *left_out]
    distances = np.linalg.norm(np.asarray(chain.structure.real_pos), axis=-1)
    rows = _link_rows(chain, distances)
    place = "distance on real to\nits origin (m)"
    titles = "virtual link", "joint", "freedoms", "parent", "real", "connected", place
    notes = [
        f"{name}: real_pos was not given. It was computed from the load pose, where the point"
        f" of the joint on {parent} is {distance} m from the origin of {real}"
        for (name, _, _, parent, real, is_connected, distance), as_loaded in zip(
            rows, chain.topology.link_as_loaded, strict=True
        )
        if as_loaded and is_connected == "no" and distance not in ("-", "0")
    ]
    return [chain_summary(chain), bodies, Table(titles, rows), *notes, *left_out]


def _body_rows(chain: Any) -> list[tuple[str, ...]]:
    """Return a row for each joint of each body, or one for a body that is fixed to its parent."""
    top = chain.topology
    joints = dict(zip(top.joint_row, top.joint_names, strict=True))
    body_of_row = {row: name for name, row in zip(top.body_names, top.body_row, strict=True)}
    rows = []
    for name, last in list(zip(top.body_names, top.body_row, strict=True))[1:]:
        own = [last]
        while top.parent[own[0]] not in body_of_row:
            own.insert(0, top.parent[own[0]])
        parent = body_of_row[top.parent[own[0]]]
        for row in own:
            kind = top.kind[row]
            about = (name, parent) if row == own[0] else ("", "")
            mass = number_or_range(chain.mass[..., last]) if row == own[0] else ""
            joint = joints.get(row, "-")
            rows.append((*about, joint, _KINDS[kind], str(V_SIZE[kind]), mass))
    return rows


def _link_rows(chain: Any, distances: np.ndarray) -> list[tuple[str, ...]]:
    """Return a row for each virtual link.

    distances: [... links] from the real link's origin to the virtual link's place on it (m).
    """
    top, structure = chain.topology, chain.structure
    body_of_row = {row: name for name, row in zip(top.body_names, top.body_row, strict=True)}
    first_lane = lambda x: np.asarray(x).reshape(-1, len(top.link_names))[0]
    connected, parent, real = map(
        first_lane, (structure.connected, structure.parent, structure.real)
    )
    rows = []
    for i, name in enumerate(top.link_names):
        freedoms = top.link_freedoms[i]
        if top.link_spare[i] and parent[i] == real[i]:
            rows.append((name, "spare", "-", "-", "-", "no", "-"))
            continue
        own = ", ".join(n for n, free in zip(_FREEDOMS, freedoms, strict=True) if free)
        ends = body_of_row[int(parent[i])], body_of_row[int(real[i])]
        joint = _JOINT_OF_FREEDOMS.get(freedoms, own)
        about = name, joint, str(sum(freedoms)), *ends, "yes" if connected[i] else "no"
        rows.append((*about, number_or_range(distances[..., i])))
    return rows


def number_or_range(values: Any) -> str:
    """Return a number, or the least and the largest one if a batch has several values."""
    values = np.asarray(values)
    least, largest = number(values.min()), number(values.max())
    return least if least == largest else f"{least} to {largest}"
