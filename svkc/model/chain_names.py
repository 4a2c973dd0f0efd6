"""The names of a chain's bodies, joints and coordinates, which results keep without the chain."""

import dataclasses
import functools

import numpy as np

from svkc.model.topology import BALL, FIXED, FREE, HINGE, SLIDE, Topology

_ROTATIONS, _TRANSLATIONS = (".rx", ".ry", ".rz"), (".x", ".y", ".z")
_QUATERNION = (".qw", ".qx", ".qy", ".qz")
_Q_SUFFIXES = {
    FIXED: (),
    HINGE: ("",),
    SLIDE: ("",),
    BALL: _QUATERNION,
    FREE: _TRANSLATIONS + _QUATERNION,
}
_V_SUFFIXES = _Q_SUFFIXES | {BALL: _ROTATIONS, FREE: _TRANSLATIONS + _ROTATIONS}
_LINK_SUFFIXES = _ROTATIONS + _TRANSLATIONS


@dataclasses.dataclass(frozen=True)
class ChainNames:
    """Names of the bodies, joints, virtual links and coordinates of a chain.

    The record is static and hashable: results keep it as a static field.

    bodies: names of the bodies, the world first.
    joints: names of the tree's joints.
    links: names of the virtual links.
    q: name of each entry of `State.q`: that of its joint or virtual link. One with several
        coordinates appends .x, .y, .z (translations, m), .qw, .qx, .qy, .qz (quaternion), or .rx,
        .ry, .rz (angles, rad).
    v: name of each entry of `State.v`; with several coordinates, .x, .y, .z and .rx, .ry, .rz.
    angular: whether each entry of `State.v` is an angular velocity (rad/s), not a linear one (m/s).
    cuttable: names of the cuttable joints, each that of a coordinate or of a virtual link.
    q_ranges, v_ranges: (name, start, stop) in q and v of each joint and each virtual link; a
        cuttable joint is both.
    """

    bodies: tuple[str, ...]
    joints: tuple[str, ...]
    links: tuple[str, ...]
    q: tuple[str, ...]
    v: tuple[str, ...]
    angular: tuple[bool, ...]
    q_ranges: tuple[tuple[str, int, int], ...]
    v_ranges: tuple[tuple[str, int, int], ...]
    cuttable: tuple[str, ...] = ()


@functools.lru_cache(maxsize=256)
def chain_names(topology: Topology) -> ChainNames:
    """Return the names of a chain; the same object for equal topologies."""
    top, tables = topology, topology.links
    q_table = np.concatenate([tables.angle, tables.slide, tables.quat], 1)
    q, q_ranges = _coordinates(
        top, top.q_start, _Q_SUFFIXES, q_table, _LINK_SUFFIXES + _QUATERNION, size=top.nq_all
    )
    v, v_ranges = _coordinates(
        top, top.v_start, _V_SUFFIXES, tables.dof, _LINK_SUFFIXES, size=top.dofs
    )
    linear = [top.links.dof[:, 3:].ravel()] + [
        np.arange(top.v_start[row], top.v_start[row] + (3 if top.kind[row] == FREE else 1))
        for row in top.rows_of_kind(SLIDE, FREE)
    ]
    angular = ~np.isin(np.arange(top.dofs), np.concatenate(linear))
    return ChainNames(
        bodies=top.body_names,
        cuttable=tuple(name for name, _, _ in top.cuttable_joints),
        joints=top.joint_names,
        links=top.link_names,
        q=q,
        v=v,
        angular=tuple(angular.tolist()),
        q_ranges=q_ranges,
        v_ranges=v_ranges,
    )


def _coordinates(
    top: Topology, starts, suffixes: dict, table: np.ndarray, link_suffixes, *, size: int
) -> tuple[tuple[str, ...], tuple[tuple[str, int, int], ...]]:
    """Return the names of the entries of q or of v, and the range of each joint and virtual link.

    starts: first index of each row. suffixes: those of a joint's coordinates, by joint kind.
    table: [links k] indices of the virtual links' coordinates; `size` or more: none.
    link_suffixes: [k] those of the virtual links' coordinates. size: length of q or v.
    """
    names, ranges = [""] * size, {}
    for name, row in zip(top.joint_names, top.joint_row, strict=True):
        own = suffixes[top.kind[row]]
        ranges[name] = starts[row], starts[row] + len(own)
        for k, suffix in enumerate(own):
            names[starts[row] + k] = name + suffix
    for name, indices in zip(top.link_names, table.tolist(), strict=True):
        own = [(i, s) for i, s in zip(indices, link_suffixes, strict=True) if i < size]
        first = min((i for i, _ in own), default=size)
        ranges.setdefault(name, (first, first + len(own)))
        for i, suffix in own:
            names[i] = name + (suffix if len(own) > 1 else "")
    for name, link, freedom in top.cuttable_joints:
        if sum(top.link_freedoms[link]) < 3:
            index = int(table[link, freedom])
            names[index] = name
            ranges[name] = index, index + 1
    return tuple(names), tuple((name, *both) for name, both in ranges.items())
