"""Kinematics, loop gaps, mass matrices and accelerations in numpy, for many chains at once.

It reads a chain's numbers and shares no code with svkc. All joints of the tree and all virtual
joints are known. Every array has a leading axis of samples.
"""

import numpy as np
from references.continuation import logarithm, matrix, rotation, skew

HINGE, SLIDE, BALL, FREE = 1, 2, 3, 4


def multiply(a, b):
    """Return the product of quaternions wxyz."""
    w = a[..., :1] * b[..., :1] - np.sum(a[..., 1:] * b[..., 1:], -1, keepdims=True)
    u = a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:] + np.cross(a[..., 1:], b[..., 1:])
    return np.concatenate([w, u], -1)


def quaternion(a):
    """Return the quaternion of a rotation vector."""
    half = np.linalg.norm(a, axis=-1, keepdims=True) / 2
    return np.concatenate([np.cos(half), np.sinc(half / np.pi) / 2 * a], -1)


def from_matrix(R):
    """Return the quaternion of rotation matrices, as an eigenvector (Bar-Itzhack, 2000)."""
    K = np.zeros((*R.shape[:-2], 4, 4))
    K[..., 0, 0] = np.trace(R, axis1=-2, axis2=-1)
    K[..., 0, 1:] = K[..., 1:, 0] = np.stack(
        [R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], -1
    )
    K[..., 1:, 1:] = R + np.swapaxes(R, -1, -2) - K[..., :1, :1] * np.eye(3)
    return np.linalg.eigh(K)[1][..., -1]


def rows_times(a, x):
    """Return matrices times vectors, sample by sample."""
    return np.einsum("...ij,...j->...i", a, x)


class Bodies:
    """The bodies of a chain. chain: with a leading axis of samples on every array."""

    def __init__(self, chain):
        self.top, self.number = chain.topology, {}
        for name in ("pos", "axis", "mass", "com", "inertia", "gravity", "q_load"):
            self.number[name] = np.asarray(getattr(chain, name), float)
        self.number["quat"] = matrix(np.asarray(chain.quat, float))
        count, rows = self.number["mass"].shape
        shapes = {"anchor": (rows, 3), "armature": (chain.topology.nv,)}
        shapes |= {name: (chain.topology.dofs,) for name in ("damping", "stiffness")}
        for name, shape in shapes.items():
            value = getattr(chain, name)
            self.number[name] = np.zeros((count, *shape)) if value is None else np.asarray(value)
        spring = chain.q_load if chain.q_spring is None else chain.q_spring
        self.number["q_spring"] = np.asarray(spring)
        self.count, self.rows, self.dofs = count, rows, chain.topology.dofs

    def move(self, q, v):
        """Return the configuration after one unit of time with constant joint velocities."""
        out, (scalar_q, scalar_v) = q.copy(), self.top.scalar_coordinates
        out[:, scalar_q] += v[:, scalar_v]
        for at, d in zip(*self.top.quaternion_starts, strict=True):
            out[:, at : at + 4] = multiply(q[:, at : at + 4], quaternion(v[:, d : d + 3]))
        return out

    def change(self, q0, q):
        """Return the constant velocities that move q0 to q within one unit of time."""
        out, (scalar_q, scalar_v) = np.zeros((len(q), self.dofs)), self.top.scalar_coordinates
        out[:, scalar_v] = q[:, scalar_q] - q0[:, scalar_q]
        for at, d in zip(*self.top.quaternion_starts, strict=True):
            before, after = matrix(q0[:, at : at + 4]), matrix(q[:, at : at + 4])
            out[:, d : d + 3] = logarithm(np.swapaxes(before, 1, 2) @ after)
        return out

    def poses(self, q):
        """Return positions and rotations of the rows, and their Jacobians: of the velocity of the
        row's origin, and of its angular velocity, in world axes."""
        n, top, N = len(q), self.top, self.number
        p, R = np.zeros((n, self.rows, 3)), np.tile(np.eye(3), (n, self.rows, 1, 1))
        Jp, Jw = np.zeros((2, n, self.rows, 3, self.dofs))
        for i in range(1, self.rows):
            up, at, d = top.parent[i], top.q_start[i], top.v_start[i]
            R[:, i] = frame = R[:, up] @ N["quat"][:, i]
            anchor, axis = N["anchor"][:, i], rows_times(frame, N["axis"][:, i])
            off = rows_times(R[:, up], N["pos"][:, i])
            own = {}
            if top.kind[i] == HINGE:
                turn = N["axis"][:, i] * (q[:, at] - N["q_load"][:, at])[:, None]
                R[:, i], own = frame @ rotation(turn), {d: axis}
            elif top.kind[i] == BALL:
                R[:, i] = frame @ matrix(q[:, at : at + 4])
                own = {d + k: R[:, i, :, k] for k in range(3)}
            elif top.kind[i] == SLIDE:
                off = off + axis * (q[:, at] - N["q_load"][:, at])[:, None]
                Jp[:, i, :, d] = axis
            elif top.kind[i] == FREE:
                R[:, i], p[:, i] = matrix(q[:, at + 3 : at + 7]), q[:, at : at + 3]
                Jp[:, i, :, d : d + 3], Jw[:, i, :, d + 3 : d + 6] = np.eye(3), R[:, i]
                continue
            lever = -rows_times(R[:, i], anchor)
            off = off + rows_times(frame, anchor) + lever
            p[:, i] = p[:, up] + off
            Jw[:, i] += Jw[:, up]
            Jp[:, i] += Jp[:, up] - skew(off) @ Jw[:, up]
            for k, turning in own.items():
                Jw[:, i, :, k] = turning
                Jp[:, i, :, k] = np.cross(turning, lever)
        return p, R, Jp, Jw

    def loops(self, structure, q, poses=None):
        """Return the gaps of the virtual links [samples links 6] (rotation vector, displacement)
        and their Jacobian; both are zero for links that are not connected."""
        p, R, Jp, Jw = self.poses(q) if poses is None else poses
        s, top, every = structure, self.top, np.arange(len(q))
        table, links = top.links, len(top.link_names)
        gap, J = np.zeros((len(q), links, 6)), np.zeros((len(q), links, 6, self.dofs))
        padded = np.concatenate([q, np.zeros((len(q), 1)), np.ones((len(q), 1))], 1)
        for i in range(links):
            up, real = np.asarray(s.parent)[:, i], np.asarray(s.real)[:, i]
            free = np.asarray(s.freedoms)[:, i]
            R_up, R_real = R[every, up], R[every, real]
            base = R_up @ matrix(np.asarray(s.quat)[:, i])
            lever = rows_times(R_up, np.asarray(s.pos)[:, i])
            lever = lever + rows_times(base, padded[:, table.slide[i]])
            turn, axes = base, []
            if sum(top.link_freedoms[i][:3]) == 3:
                turn = base @ matrix(padded[:, table.quat[i]])
                axes = [turn[:, :, k] for k in range(3)]
            else:
                for k in range(3):
                    axes.append(turn[:, :, k])
                    turn = turn @ rotation(padded[:, table.angle[i, k], None] * np.eye(3)[k])
            real_lever = rows_times(R_real, np.asarray(s.real_pos)[:, i])
            there = R_real @ matrix(np.asarray(s.real_quat)[:, i])
            gap[:, i, :3] = logarithm(turn @ np.swapaxes(there, 1, 2))
            gap[:, i, 3:] = p[every, up] + lever - p[every, real] - real_lever
            J[:, i, :3] = Jw[every, up] - Jw[every, real]
            J[:, i, 3:] = Jp[every, up] - skew(lever) @ Jw[every, up]
            J[:, i, 3:] -= Jp[every, real] - skew(real_lever) @ Jw[every, real]
            for k, d in enumerate(table.dof[i]):
                if d < self.dofs:
                    J[:, i, :3, d] += (axes[k] if k < 3 else 0) * free[:, k, None]
                    J[:, i, 3:, d] += (base[:, :, k - 3] if k >= 3 else 0) * free[:, k, None]
        on = np.asarray(s.connected)
        return gap * on[:, :, None], J * on[:, :, None, None]

    def active(self, structure):
        """Return the mask of the coordinates that can move."""
        mask = self.existing(structure)
        return mask if structure.locked is None else mask & ~np.asarray(structure.locked)

    def existing(self, structure):
        """Return the mask of the coordinates of joints that are not cut."""
        mask = np.ones((self.count, self.dofs), bool)
        for i, dofs in enumerate(self.top.links.dof):
            free = (
                np.asarray(structure.freedoms)[:, i] & np.asarray(structure.connected)[:, i, None]
            )
            for k, d in enumerate(dofs):
                if d < self.dofs:
                    mask[:, d] = free[:, k]
        return mask

    def centres(self, q, poses=None):
        """Return the Jacobians of the centres of mass and of the rotations of the rows, and the
        inertias in world axes."""
        p, R, Jp, Jw = self.poses(q) if poses is None else poses
        com = np.einsum("nrij,nrj->nri", R, self.number["com"])
        inertia = (self.number["inertia"] + np.swapaxes(self.number["inertia"], -1, -2)) / 2
        return p + com, Jp - skew(com) @ Jw, Jw, R @ inertia @ np.swapaxes(R, -1, -2)

    def mass_matrix(self, q):
        """Return the mass matrix over all coordinates: zero for those of virtual joints."""
        _, Jc, Jw, inertia = self.centres(q)
        M = np.einsum("nr,nrij,nrik->njk", self.number["mass"], Jc, Jc)
        M += np.einsum("nrij,nril,nrlk->njk", Jw, inertia, Jw)
        M[:, range(self.top.nv), range(self.top.nv)] += self.number["armature"]
        return M

    def kinetic_energy(self, q, v):
        return np.einsum("ni,nij,nj->n", v, self.mass_matrix(q), v) / 2

    def potential_energy(self, structure, q):
        centre = self.centres(q)[0]
        weight = np.einsum("nr,nri,ni->n", self.number["mass"], centre, self.number["gravity"])
        # the spring of a locked joint stays stretched
        stretch = self.change(self.number["q_spring"], q) * self.existing(structure)
        return np.sum(self.number["stiffness"] * stretch**2, 1) / 2 - weight

    def momentum(self, q, v):
        """Return the momentum of every row, and its angular momentum about the world's origin."""
        centre, Jc, Jw, inertia = self.centres(q)
        p = self.number["mass"][:, :, None] * rows_times(Jc, v[:, None])
        spin = rows_times(inertia, rows_times(Jw, v[:, None]))
        return p, spin + np.cross(centre, p)

    def along(self, function, q, v):
        """Return the derivative of function(q) along v, by differences of fourth order."""
        at = [function(self.move(q, h * v)) for h in (-2e-3, -1e-3, 1e-3, 2e-3)]
        return (at[0] - 8 * at[1] + 8 * at[2] - at[3]) / 12e-3

    def forces(self, structure, q, v, tau):
        """Return the generalized forces without inertia: torques, gravity, springs, dampers, and
        the forces of the velocities."""
        N, active = self.number, self.active(structure)
        _, Jc, Jw, inertia = self.centres(q)
        stretch = self.change(N["q_spring"], q)
        f = tau - N["damping"] * v - N["stiffness"] * stretch
        f = np.where(active, f, 0)
        weight = N["mass"][:, :, None] * N["gravity"][:, None]
        rates = self.along(
            lambda q: np.concatenate(self.centres(q)[1:3], 1) @ v[:, None, :, None], q, v
        )
        linear, angular = rates[:, : self.rows, :, 0], rates[:, self.rows :, :, 0]
        w = rows_times(Jw, v[:, None])
        spin = np.cross(w, rows_times(inertia, w)) + rows_times(inertia, angular)
        f += np.einsum("nrij,nri->nj", Jc, weight - N["mass"][:, :, None] * linear)
        return f - np.einsum("nrij,nri->nj", Jw, spin)

    def motions(self, structure, q):
        """Return an orthonormal basis [samples dofs dofs] of the velocities that the structure
        allows (unused columns are zero), and whether the rank is clear."""
        J = self.loops(structure, q)[1].reshape(len(q), -1, self.dofs)
        fixed = ~self.active(structure)
        rows = np.concatenate([J, np.where(fixed[:, :, None], np.eye(self.dofs), 0)], 1)
        _, s, vt = np.linalg.svd(rows)
        size = np.zeros((len(q), self.dofs))
        size[:, : s.shape[1]] = s / s[:, :1]
        used = size > 1e-8
        clear = ~np.any((size > 1e-12) & (size < 1e-3), 1)
        return np.where(used[:, None], 0, np.swapaxes(vt, 1, 2)), clear

    def acceleration(self, structure, q, v, tau):
        """Return vdot of a closed state, and whether its rank is clear."""
        basis, clear = self.motions(structure, q)
        J = self.loops(structure, q)[1].reshape(len(q), -1, self.dofs)
        J = J * self.active(structure)[:, None]
        flat = lambda q: (self.loops(structure, q)[1].reshape(J.shape) @ v[..., None])[..., 0]
        first = -rows_times(np.linalg.pinv(J, rcond=1e-8), self.along(flat, q, v))
        M, f = self.mass_matrix(q), self.forces(structure, q, v, tau)
        return first + self.projected(basis, M, f - rows_times(M, first)), clear

    def projected(self, basis, M, f):
        """Return the vector x within the basis for which M x - f has no component there."""
        unused = ~np.any(basis, 1)
        reduced = np.swapaxes(basis, 1, 2) @ M @ basis + unused[:, :, None] * np.eye(self.dofs)
        z = np.linalg.solve(reduced, (np.swapaxes(basis, 1, 2) @ f[..., None]))
        return (basis @ z)[..., 0]

    def after_impact(self, structure, q, v):
        """Return the velocity after an inelastic impact with the structure, and whether its rank is
        clear."""
        basis, clear = self.motions(structure, q)
        M = self.mass_matrix(q)
        return self.projected(basis, M, rows_times(M, v)), clear


def batched(chain):
    """Return a chain with numpy arrays with a leading axis of one sample."""
    import jax

    return jax.tree.map(lambda x: np.asarray(x)[None] if hasattr(x, "shape") else x, chain)
