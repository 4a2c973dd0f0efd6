"""Closed configurations by continuation, in numpy, with small equal steps and many geometries at
once. It reads a chain's numbers and shares no code with svkc.

Loops are closed by coincident points and perpendicular axes, without coordinates of their own.
"""

import dataclasses

import numpy as np

HINGE, SLIDE, BALL = 1, 2, 3


def skew(a):
    zero = np.zeros_like(a[..., 0])
    x, y, z = np.moveaxis(a, -1, 0)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*a.shape[:-1], 3, 3)


def rotation(a):
    """Return the rotation by a vector (Rodrigues)."""
    angle = np.linalg.norm(a, axis=-1)[..., None, None]
    K = skew(a)
    safe = np.where(angle < 1e-9, 1, angle)
    s = np.where(angle < 1e-9, 1, np.sin(safe) / safe)
    c = np.where(angle < 1e-9, 0.5, (1 - np.cos(safe)) / safe**2)
    return np.eye(3) + s * K + c * K @ K


def logarithm(R):
    """Return the rotation vector of a rotation below half a turn."""
    w = np.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0]], -1)
    w = np.concatenate([w, (R[..., 1, 0] - R[..., 0, 1])[..., None]], -1) / 2
    s = np.linalg.norm(w, axis=-1)
    angle = np.arctan2(s, (np.trace(R, axis1=-2, axis2=-1) - 1) / 2)
    return w * np.where(s < 1e-9, 1, angle / np.where(s < 1e-9, 1, s))[..., None]


def matrix(q):
    """Return the rotation of unit quaternions wxyz."""
    w, K = q[..., :1, None], skew(q[..., 1:])
    return np.eye(3) + 2 * w * K + 2 * K @ K


@dataclasses.dataclass
class Linkage:
    """Numbers of a chain for `count` geometries: rows of the tree, placements, and loops."""

    parent: tuple
    kind: tuple
    start: tuple
    dofs: int
    pos: np.ndarray
    quat: np.ndarray
    axis: np.ndarray
    length: np.ndarray
    links: list

    @classmethod
    def of(cls, chain, pos, link_pos, length):
        """Return the linkage of a chain with other offsets of rows [count rows 3] and links."""
        top, s, count = chain.topology, chain.structure, len(pos)
        links = [
            (
                int(s.parent[i]),
                int(s.real[i]),
                link_pos[:, i],
                matrix(np.asarray(s.quat[i])),
                np.broadcast_to(np.asarray(s.real_pos[i]), (count, 3)),
                matrix(np.asarray(s.real_quat[i])),
                tuple(top.link_freedoms[i]),
            )
            for i in range(len(top.link_names))
        ]
        return cls(
            parent=top.parent,
            kind=top.kind,
            start=top.v_start,
            dofs=top.nv,
            pos=pos,
            quat=matrix(np.asarray(chain.quat)),
            axis=np.asarray(chain.axis),
            length=length,
            links=links,
        )

    def scale(self):
        """Return the length of each coordinate's unit [count dofs]: 1 for angles."""
        out = np.ones((len(self.pos), self.dofs))
        for kind, start in zip(self.kind, self.start, strict=True):
            if kind == SLIDE:
                out[:, start] = self.length
        return out

    def rest(self):
        """Return the load pose: scalars of each coordinate, rotations of each row."""
        count, rows = self.pos.shape[:2]
        return np.zeros((count, self.dofs)), np.tile(np.eye(3), (count, rows, 1, 1))

    def add(self, q, dv):
        """Return the configuration moved by dv."""
        turns = q[1].copy()
        for i, kind in enumerate(self.kind):
            if kind == BALL:
                turns[:, i] = turns[:, i] @ rotation(dv[:, self.start[i] : self.start[i] + 3])
        return q[0] + dv, turns

    def change(self, q0, q):
        """Return what moves q0 to q."""
        out = q[0] - q0[0]
        for i, kind in enumerate(self.kind):
            if kind == BALL:
                turn = np.swapaxes(q0[1][:, i], -1, -2) @ q[1][:, i]
                out[:, self.start[i] : self.start[i] + 3] = logarithm(turn)
        return out

    def bodies(self, q):
        """Return places, rotations, and the Jacobians of both (of the world's velocity at the
        origin of each row, and of its angular velocity)."""
        count, rows = self.pos.shape[:2]
        p, R = np.zeros((count, rows, 3)), np.tile(np.eye(3), (count, rows, 1, 1))
        Jp, Jw = np.zeros((2, count, rows, 3, self.dofs))
        for i in range(1, rows):
            up, at = self.parent[i], self.start[i]
            off = np.einsum("nij,nj->ni", R[:, up], self.pos[:, i])
            frame = R[:, up] @ self.quat[i]
            axis = frame @ self.axis[i]
            if self.kind[i] == SLIDE:
                off = off + axis * q[0][:, at : at + 1]
            p[:, i] = p[:, up] + off
            Jw[:, i] = Jw[:, up]
            Jp[:, i] = Jp[:, up] - skew(off) @ Jw[:, up]
            R[:, i] = frame
            if self.kind[i] == HINGE:
                R[:, i] = frame @ rotation(self.axis[i] * q[0][:, at : at + 1])
                Jw[:, i, :, at] = axis
            elif self.kind[i] == SLIDE:
                Jp[:, i, :, at] = axis
            elif self.kind[i] == BALL:
                R[:, i] = frame @ q[1][:, i]
                Jw[:, i, :, at : at + 3] = R[:, i]
        return p, R, Jp, Jw

    def loops(self, q):
        """Return the residuals of all loops, their Jacobian, and the turn of each virtual hinge."""
        p, R, Jp, Jw = self.bodies(q)
        parts, slopes, turns = [], [], []
        for up, real, pos, quat, real_pos, real_quat, freedoms in self.links:
            a = np.einsum("nij,nj->ni", R[:, up], pos)
            b = np.einsum("nij,nj->ni", R[:, real], real_pos)
            parts.append((p[:, up] + a - p[:, real] - b) / self.length[:, None])
            slope = Jp[:, up] - skew(a) @ Jw[:, up] - Jp[:, real] + skew(b) @ Jw[:, real]
            slopes.append(slope / self.length[:, None, None])
            A, B = R[:, up] @ quat, R[:, real] @ real_quat
            turn = np.swapaxes(A, -1, -2) @ B
            turns.append(np.arctan2(turn[:, 1, 0], turn[:, 0, 0]))
            pairs = {0: ((2, 0), (2, 1), (0, 1)), 1: ((2, 0), (2, 1)), 3: ()}[sum(freedoms[:3])]
            for i, j in pairs:
                u, w = A[..., i], B[..., j]
                parts.append(np.sum(u * w, -1)[:, None])
                cross = np.cross(u, w)
                slopes.append(np.einsum("ni,nij->nj", cross, Jw[:, up] - Jw[:, real])[:, None])
        return np.concatenate(parts, 1), np.concatenate(slopes, 1), np.stack(turns, 1)


def stationary(linkage, q0, q, fixed, target, *, residual, iterations):
    """Return q after Newton's method on the conditions of least change from q0, with the
    coordinates in `fixed` at `target` and the loops' residuals as given; and the last step's
    size."""
    scale, n = linkage.scale(), linkage.dofs
    step = np.full(len(scale), np.inf)
    for _ in range(iterations):
        c, J, _ = linkage.loops(q)
        J, d = J * scale[:, None], linkage.change(q0, q) / scale
        free = np.where(fixed, 0.0, 1.0)
        Jf = J * free[:, None]
        pull = np.where(fixed, 0, d)
        inverse = np.linalg.pinv(np.swapaxes(Jf, 1, 2), rcond=1e-7)
        force = -np.einsum("nij,nj->ni", inverse, pull)
        hessian = np.zeros((len(q[0]), n, n))
        for k in range(n):
            for sign in (1, -1):
                y = np.zeros_like(scale)
                y[:, k] = sign * 1e-5
                there = linkage.add(q, scale * y)
                slope = linkage.change(q0, there) / scale
                slope = slope + np.einsum(
                    "ni,nij->nj", force, linkage.loops(there)[1] * scale[:, None]
                )
                hessian[:, :, k] += sign * slope / 2e-5
        moved = np.where(fixed, (target - q[0]) / scale, 0)
        closing = np.linalg.pinv(Jf, rcond=1e-7)
        y = moved - np.einsum(
            "nij,nj->ni", closing, c - residual + np.einsum("nij,nj->ni", J, moved)
        )
        # the rest within the loops' null space
        project = np.eye(n) - closing @ Jf
        project = project * free[:, None] * free[:, :, None]
        slope = pull + np.einsum("nij,ni->nj", Jf, force) + np.einsum("nij,nj->ni", hessian, y)
        reduced = project @ hessian @ project + np.eye(n) - project
        z = -np.linalg.solve(reduced, (project @ slope[..., None]))[..., 0]
        y = y + np.einsum("nij,nj->ni", project, z)
        step = np.max(np.abs(y), 1)
        y = y * np.minimum(1, 0.5 / np.maximum(step, 1e-300))[:, None]
        q = linkage.add(q, scale * np.nan_to_num(y))
    return q, step


def subset(linkage, which):
    """Return the linkage with some of its geometries."""
    links = [
        (*link[:2], link[2][which], link[3], link[4][which], *link[5:]) for link in linkage.links
    ]
    return dataclasses.replace(
        linkage, pos=linkage.pos[which], length=linkage.length[which], links=links
    )


def continued(linkage, named, target, steps):
    """Return `followed`, with ten times as many steps and twice as many iterations in each for the
    geometries that need them."""
    q, turns, ok = followed(linkage, named, target, steps)
    if not ok.all():
        some = np.flatnonzero(~ok)
        finer = followed(subset(linkage, some), named, target[some], 10 * steps, iterations=6)
        q[0][some], q[1][some], turns[some], ok[some] = *finer[0], *finer[1:]
    return q, turns, ok


def followed(linkage, named, target, steps, iterations=3):
    """Return the configuration [count dofs] with the named coordinates at the target, the turns of
    the virtual hinges without jumps, and whether it was reached.

    steps: of each of both legs, the one that closes the load pose and the one that moves names.
    iterations: of Newton's method in each step of the second leg.
    """
    q0 = linkage.rest()
    c0, _, turns = linkage.loops(q0)
    q, ok = q0, np.ones(len(c0), bool)
    names = np.zeros_like(q0[0], bool)
    for s in 5 * np.arange(1, steps // 5 + 1) / steps:
        q, step = stationary(linkage, q0, q, names, q[0], residual=(1 - s) * c0, iterations=4)
        turns = turns + np.angle(np.exp(1j * (linkage.loops(q)[2] - turns)))
        ok &= step < 1e-6
    names[:, named] = True
    first = q[0].copy()
    # near a fold a configuration moves as the square root of s: small steps at both ends
    u = np.arange(1, steps + 1) / steps
    for s in u * u * (3 - 2 * u):
        before = q
        goal = np.where(names, first + s * (target - first), 0)
        q, step = stationary(linkage, q0, q, names, goal, residual=0 * c0, iterations=iterations)
        turns = turns + np.angle(np.exp(1j * (linkage.loops(q)[2] - turns)))
        ok &= (step < 1e-6) & (np.max(np.abs(linkage.change(before, q)), 1) < 0.3)
    q, step = stationary(
        linkage, q0, q, names, np.where(names, target, 0), residual=0 * c0, iterations=3
    )
    ok &= (step < 1e-10) & (np.max(np.abs(linkage.loops(q)[0]), 1) < 1e-10)
    return q, turns, ok
