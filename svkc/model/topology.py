"""The static part of a chain: rows, levels, joint kinds, indices of coordinates."""

import dataclasses
import functools
from typing import NamedTuple

import numpy as np

# joint kinds; numbers of coordinates q and velocities v of each
FIXED, HINGE, SLIDE, BALL, FREE = range(5)
Q_SIZE = (0, 1, 1, 4, 7)
V_SIZE = (0, 1, 1, 3, 6)


class FixedFrame(NamedTuple):
    """A frame fixed in a row: of a site of the model, or of a body.

    row: the row.
    pos: origin in the row's frame (m).
    quat: orientation in the row's frame (wxyz).
    """

    row: int
    pos: tuple[float, ...] = (0.0, 0.0, 0.0)
    quat: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)


@dataclasses.dataclass(frozen=True)
class Topology:
    """Everything about a chain that is static, so that the compiler specialises on it.

    Rows are sorted by level; row 0 is the world. A body with several joints has one row for each
    joint. The last of these rows is the body; the others have no mass.

    body_names: names of the bodies, the world first.
    joint_names: names of the tree's joints.
    link_names: names of the virtual links.
    parent: parent row of each row; -1 for the world.
    kind: joint kind of each row.
    q_start: index in q of the first coordinate of each row.
    v_start: index in v of the first velocity of each row.
    nq: number of the tree's coordinates.
    nv: number of the tree's velocities.
    body_row: row of each body.
    joint_row: row of each joint of the tree.
    link_freedoms: six Booleans for each virtual link: rotations, then translations.
    link_spare: whether each virtual link is a spare slot.
    link_child: row of the child body of each virtual link that is a cuttable joint, else -1.
    cuttable_joints: (name, virtual link, first freedom) of each cuttable joint.
    model_q: index in q of each entry of the model's qpos.
    model_v: index in v of each entry of the model's qvel.
    link_actuated: whether a motor drives the coordinates of each virtual link.
    massless_dofs: the tree's coordinates along which the joint's own body has almost no inertia.
    link_as_loaded: whether the place of each virtual link on its real link was not declared, but is
        where its parent is in the load pose. (Without a place on a site it is the site's origin.)
    site_names: names of the model's sites.
    site_frames: frame of each site.
    """

    body_names: tuple[str, ...]
    joint_names: tuple[str, ...]
    link_names: tuple[str, ...]
    parent: tuple[int, ...]
    kind: tuple[int, ...]
    q_start: tuple[int, ...]
    v_start: tuple[int, ...]
    nq: int
    nv: int
    body_row: tuple[int, ...]
    joint_row: tuple[int, ...]
    link_freedoms: tuple[tuple[bool, ...], ...]
    link_spare: tuple[bool, ...]
    link_child: tuple[int, ...] = ()
    cuttable_joints: tuple[tuple[str, int, int], ...] = ()
    model_q: tuple[int, ...] = ()
    model_v: tuple[int, ...] = ()
    link_actuated: tuple[bool, ...] = ()
    massless_dofs: tuple[int, ...] = ()
    link_as_loaded: tuple[bool, ...] = ()
    site_names: tuple[str, ...] = ()
    site_frames: tuple[FixedFrame, ...] = ()

    @functools.cached_property
    def _hash(self) -> int:
        return hash(tuple(getattr(self, f.name) for f in dataclasses.fields(self)))

    def __hash__(self) -> int:
        return self._hash

    @functools.cached_property
    def levels(self) -> tuple[tuple[int, int], ...]:
        """(first row, last row + 1) of each level of the tree; the first level is the world."""
        depth = np.zeros(len(self.parent), int)
        for i in range(1, len(depth)):
            depth[i] = depth[self.parent[i]] + 1
        edges = np.searchsorted(depth, np.arange(depth.max() + 2))
        return tuple((int(a), int(b)) for a, b in zip(edges[:-1], edges[1:], strict=True))

    @functools.cached_property
    def root(self) -> np.ndarray:
        """For each row, itself or its ancestor that is a child of the world; 0 for the world."""
        root = np.arange(len(self.parent))
        for i in range(1, len(root)):
            root[i] = i if self.parent[i] == 0 else root[self.parent[i]]
        return root

    @functools.cached_property
    def dof_row(self) -> np.ndarray:
        """The row of each of the tree's velocities."""
        row = np.zeros(self.nv, int)
        for i, (kind, start) in enumerate(zip(self.kind, self.v_start, strict=True)):
            row[start : start + V_SIZE[kind]] = i
        return row

    @functools.cached_property
    def ancestor_mask(self) -> np.ndarray:
        """Mask [rows, rows]: whether the column is the row or one of its ancestors."""
        table = np.eye(len(self.parent), dtype=bool)
        for i in range(1, len(table)):
            table[i] |= table[self.parent[i]]
        return table

    def rows_of_kind(self, *kinds: int) -> np.ndarray:
        """Return the rows whose joint is of one of these kinds."""
        return np.flatnonzero(np.isin(self.kind, kinds))

    @functools.cached_property
    def links(self) -> "LinkTables":
        """Indices of the virtual links' coordinates in q and v."""
        return LinkTables.of(self)

    @property
    def nq_all(self) -> int:
        """Length of `State.q`: the tree's coordinates, then the virtual links'."""
        return self.links.nq_all

    @property
    def dofs(self) -> int:
        """Length of `State.v`: the paper's N_J with every virtual link connected."""
        return self.links.dofs

    @functools.cached_property
    def quaternion_starts(self) -> tuple[np.ndarray, np.ndarray]:
        """(first index in q, first index in v) of every quaternion, virtual links' included."""
        offset_q, offset_v = (0, 0, 0, 0, 3), (0, 0, 0, 0, 3)
        rows = self.rows_of_kind(BALL, FREE)
        q = [self.q_start[i] + offset_q[self.kind[i]] for i in rows] + [
            int(i[0]) for i in self.links.quat if i[0] < self.nq_all
        ]
        v = [self.v_start[i] + offset_v[self.kind[i]] for i in rows]
        v += [
            int(d[0])
            for i, d in zip(self.links.quat, self.links.dof, strict=True)
            if i[0] < self.nq_all
        ]
        return np.array(q, int), np.array(v, int)

    def link_dof_mask(self, links: np.ndarray) -> np.ndarray:
        """Return the mask [dofs] of the joint coordinates of the virtual links in a mask."""
        table, mask = self.links.dof[links], np.zeros(self.dofs, bool)
        mask[table[table < self.dofs]] = True
        return mask

    @functools.cached_property
    def scalar_coordinates(self) -> tuple[np.ndarray, np.ndarray]:
        """(index in q, index in v) of every coordinate that is not part of a quaternion.

        The derivative of such a coordinate by time is its velocity.
        """
        quat_q, quat_v = self.quaternion_starts
        q = np.setdiff1d(np.arange(self.nq_all), (quat_q[:, None] + np.arange(4)).ravel())
        v = np.setdiff1d(np.arange(self.dofs), (quat_v[:, None] + np.arange(3)).ravel())
        return q, v


@dataclasses.dataclass(frozen=True, eq=False)
class LinkTables:
    """Indices of the virtual joints' coordinates in q and v.

    A joint with three rotations has a quaternion, otherwise one angle for each rotation. A freedom
    that the joint lacks has an index past the end of q or v, where constants are appended. A spare
    slot has all six freedoms; `Structure.freedoms` says which are in use.

    nq_all: length of q.
    dofs: length of v.
    angle: [links 3] rotations about x, y, z, into (q, 0, 1).
    slide: [links 3] translations along x, y, z, into (q, 0, 1).
    quat: [links 4] quaternions, into (q, 0, 1).
    dof: [links 6] rotations, then translations, into (v, 0).
    """

    nq_all: int
    dofs: int
    angle: np.ndarray
    slide: np.ndarray
    quat: np.ndarray
    dof: np.ndarray

    @classmethod
    def of(cls, topology: Topology) -> "LinkTables":
        """Return the tables for a topology with its virtual links."""
        count = len(topology.link_names)
        q, v = topology.nq, topology.nv
        angle, slide, quat, dof = (np.full((count, k), -1) for k in (3, 3, 4, 6))
        for i, freedoms in enumerate(topology.link_freedoms):
            if sum(freedoms[:3]) == 3:
                quat[i] = np.arange(q, q + 4)
                q += 4
            else:
                for k in np.flatnonzero(freedoms[:3]):
                    angle[i, k], q = q, q + 1
            for k in np.flatnonzero(freedoms[3:]):
                slide[i, k], q = q, q + 1
            for k in np.flatnonzero(freedoms):
                dof[i, k], v = v, v + 1
        angle[angle < 0] = q
        slide[slide < 0] = q
        quat[quat[:, 0] < 0] = [q + 1, q, q, q]
        dof[dof < 0] = v
        return cls(q, v, angle, slide, quat, dof)
