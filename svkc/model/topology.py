"""What never changes about a chain: rows, levels, joint kinds, places of coordinates."""

import dataclasses
import functools

import numpy as np

FIXED, HINGE, SLIDE, BALL, FREE = range(5)
Q_SIZE = (0, 1, 1, 4, 7)
V_SIZE = (0, 1, 1, 3, 6)


@dataclasses.dataclass(frozen=True)
class Topology:
    """Everything about a chain that never changes and that the compiler may specialise on. Rows are
    links, sorted by level, row 0 the world.

    A body with several joints takes one row a joint, the last of them the body itself; the others
    have no mass.
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
    # what follows tells of joints of the tree that may be cut: the child's row of such a link, else
    # -1; (joint, link, freedom) of each joint
    link_child: tuple[int, ...] = ()
    cut_joints: tuple[tuple[str, int, int], ...] = ()
    # where the model's own qpos and qvel stand in q and v
    model_q: tuple[int, ...] = ()
    model_v: tuple[int, ...] = ()
    link_actuated: tuple[bool, ...] = ()

    @functools.cached_property
    def _hash(self) -> int:
        return hash(tuple(getattr(self, f.name) for f in dataclasses.fields(self)))

    def __hash__(self) -> int:
        return self._hash

    @functools.cached_property
    def levels(self) -> tuple[tuple[int, int], ...]:
        """(first row, last row + 1) of each level of the tree, the world's first."""
        depth = np.zeros(len(self.parent), int)
        for i in range(1, len(depth)):
            depth[i] = depth[self.parent[i]] + 1
        edges = np.searchsorted(depth, np.arange(depth.max() + 2))
        return tuple((int(a), int(b)) for a, b in zip(edges[:-1], edges[1:], strict=True))

    @functools.cached_property
    def root(self) -> np.ndarray:
        """The child of the world that each row hangs on; 0 for the world."""
        root = np.arange(len(self.parent))
        for i in range(1, len(root)):
            root[i] = i if self.parent[i] == 0 else root[self.parent[i]]
        return root

    @functools.cached_property
    def dof_row(self) -> np.ndarray:
        """The row whose joint each coordinate of the tree belongs to."""
        row = np.zeros(self.nv, int)
        for i, (kind, start) in enumerate(zip(self.kind, self.v_start, strict=True)):
            row[start : start + V_SIZE[kind]] = i
        return row

    @functools.cached_property
    def ancestor_mask(self) -> np.ndarray:
        """[rows, rows] Boolean: the column is the row itself or one of its ancestors."""
        table = np.eye(len(self.parent), dtype=bool)
        for i in range(1, len(table)):
            table[i] |= table[self.parent[i]]
        return table

    def rows_of_kind(self, *kinds: int) -> np.ndarray:
        """The rows whose joint is one of these kinds."""
        return np.flatnonzero(np.isin(self.kind, kinds))

    @functools.cached_property
    def links(self) -> "LinkTables":
        """Where the virtual links' coordinates stand in q and v."""
        return LinkTables.of(self)

    @property
    def nq_all(self) -> int:
        """Length of State.q: the tree's coordinates, then the virtual links'."""
        return self.links.nq_all

    @property
    def dofs(self) -> int:
        """Length of State.v: N_J with every virtual link connected."""
        return self.links.dofs

    @functools.cached_property
    def quaternion_starts(self) -> tuple[np.ndarray, np.ndarray]:
        """(first index in q, first index in v) of every rotation kept as a quaternion, virtual
        links' included."""
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

    @functools.cached_property
    def dof_names(self) -> tuple[str, ...]:
        """A name for each joint coordinate: the joint's, with .x .y .z for slides and .rx .ry .rz
        for turns where it has several."""
        names = [""] * self.dofs
        turns, slides = (".rx", ".ry", ".rz"), (".x", ".y", ".z")
        endings = {HINGE: ("",), SLIDE: ("",), BALL: turns, FREE: slides + turns}
        for name, row in zip(self.joint_names, self.joint_row, strict=True):
            for k, ending in enumerate(endings[self.kind[row]]):
                names[self.v_start[row] + k] = name + ending
        for name, dofs in zip(self.link_names, self.links.dof, strict=True):
            own = [
                (d, ending) for d, ending in zip(dofs, turns + slides, strict=True) if d < self.dofs
            ]
            for d, ending in own:
                names[d] = name + (ending if len(own) > 1 else "")
        for name, link, freedom in self.cut_joints:
            if sum(self.link_freedoms[link]) < 3:
                names[self.links.dof[link, freedom]] = name
        return tuple(names)

    @functools.cached_property
    def scalar_coordinates(self) -> tuple[np.ndarray, np.ndarray]:
        """(index in q, index in v) of every coordinate whose rate is its velocity."""
        quat_q, quat_v = self.quaternion_starts
        q = np.setdiff1d(np.arange(self.nq_all), (quat_q[:, None] + np.arange(4)).ravel())
        v = np.setdiff1d(np.arange(self.dofs), (quat_v[:, None] + np.arange(3)).ravel())
        return q, v


@dataclasses.dataclass(frozen=True, eq=False)
class LinkTables:
    """Index tables of the virtual joints: x, y, z turns, then x, y, z slides; an index past the end
    reads a constant.

    Three rotations are one quaternion. A spare slot has room for all six freedoms; its mask in the
    Structure says which it uses.
    """

    nq_all: int
    dofs: int
    angle: np.ndarray  # [L 3] into (q, 0, 1)
    slide: np.ndarray  # [L 3] into (q, 0, 1)
    quat: np.ndarray  # [L 4] into (q, 0, 1)
    dof: np.ndarray  # [L 6] into (v, 0)

    @classmethod
    def of(cls, topology: Topology) -> "LinkTables":
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
