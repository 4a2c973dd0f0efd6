"""Accelerations of closed chains from the KKT equations, in numpy, independent of svkc.

The mass matrix and point Jacobians are MuJoCo's. The rows of a loop are the constraints of its
joint alone. The multipliers are a least-squares solution.
"""

import mujoco
import numpy as np


def _rotation(quat):
    """Return the rotation matrix of a quaternion."""
    R = np.zeros(9)
    mujoco.mju_quat2Mat(R, quat)
    return R.reshape(3, 3)


def constrained_acceleration(chain, state, tau) -> np.ndarray:
    """Return vdot of the tree from [M J'; J 0][vdot; -l] = [tau - bias + passive; -Jdot v].

    tau: joint torques; those of virtual joints are ignored.
    """
    model, s = chain.model.model, state.structure
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = np.asarray(state.q)[: model.nq], np.asarray(state.v)[: model.nv]
    mujoco.mj_forward(model, data)
    M = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, M)
    bodies = {row: body for body, row in enumerate(chain.topology.body_row)}
    J, Jdot_v = [], []
    for i in np.flatnonzero(np.asarray(s.connected)):
        end_kinematics = []
        for row, pos in ((s.parent[i], s.pos[i]), (s.real[i], s.real_pos[i])):
            body = bodies[int(row)]
            point = data.xpos[body] + data.xmat[body].reshape(3, 3) @ np.asarray(pos)
            jac, dot = np.zeros((6, model.nv)), np.zeros((6, model.nv))
            mujoco.mj_jac(model, data, jac[3:], jac[:3], point, body)
            mujoco.mj_jacDot(model, data, dot[3:], dot[:3], point, body)
            end_kinematics.append((jac, dot @ data.qvel, jac @ data.qvel, body))
        (jp, ap, vp, parent), (jr, ar, vr, _) = end_kinematics
        frame = data.xmat[parent].reshape(3, 3) @ _rotation(np.asarray(s.quat[i], float))
        free = np.asarray(s.freedoms[i])
        assert not free[3:].any(), "slides of virtual links are not part of this check"
        w = vp[:3]
        # axes about which the joint cannot rotate are constrained and fixed in the parent
        for k in range(3):
            if not free[k]:
                n = frame[:, k]
                J.append(n @ (jp[:3] - jr[:3]))
                Jdot_v.append(n @ (ap[:3] - ar[:3]) + np.cross(w, n) @ (vp[:3] - vr[:3]))
        J.extend(jp[3:] - jr[3:])
        Jdot_v.extend(ap[3:] - ar[3:])
    J, Jdot_v = np.array(J).reshape(-1, model.nv), np.array(Jdot_v)
    force = np.asarray(tau)[: model.nv] - data.qfrc_bias + data.qfrc_passive
    # scaled by M^(-1/2), least squares give the constraint forces even if rows are redundant
    L = np.linalg.cholesky(M)
    free_acceleration = np.linalg.solve(M, force)
    J_scaled = np.linalg.solve(L, J.T).T
    correction = np.linalg.lstsq(J_scaled, -Jdot_v - J @ free_acceleration, rcond=1e-9)[0]
    return free_acceleration + np.linalg.solve(L.T, correction)
