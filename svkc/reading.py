"""F2: what a MuJoCo model says of bodies, joints and motors, as numpy arrays by row."""

import numpy as np

from svkc.topology import BALL, FIXED, FREE, HINGE, SLIDE, V_SIZE, Topology
from svkc.unsupported import plain_motors

_LIMIT_RATE = 50.0  # rad/s: a joint outside its range is an oscillator of this frequency, critically damped, at its load-pose inertia


def name_of(model, kind: str, index: int) -> str:
    """The name of a body, joint or equality, or kind_index where it has none."""
    import mujoco

    name = mujoco.mj_id2name(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), index)
    return name or (f"{kind}_{index}" if index or kind != "body" else "world")


def rows_of(model) -> tuple[list[tuple[int, int]], Topology]:
    """One row a joint, sorted by level: [(body, joint or -1)] and the topology without virtual links."""
    order, depth, last = [(0, -1, -1)], [0], {0: 0}
    for body in range(1, model.nbody):
        parent = last[int(model.body_parentid[body])]
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        for joint in range(first, first + count) if count else (-1,):
            order.append((body, joint, parent))
            depth.append(depth[parent] + 1)
            parent = len(order) - 1
        last[body] = parent
    rank = np.argsort(depth, kind="stable")
    new = np.argsort(rank)
    kinds = {0: FREE, 1: BALL, 2: SLIDE, 3: HINGE}
    kind = [FIXED if j < 0 else kinds[int(model.jnt_type[j])] for _, j, _ in order]
    topology = Topology(
        body_names=tuple(name_of(model, "body", i) for i in range(model.nbody)),
        joint_names=tuple(name_of(model, "joint", i) for i in range(model.njnt)),
        link_names=(),
        parent=tuple(int(new[order[i][2]]) if order[i][2] >= 0 else -1 for i in rank),
        kind=tuple(kind[i] for i in rank),
        q_start=tuple(int(model.jnt_qposadr[order[i][1]]) if order[i][1] >= 0 else 0 for i in rank),
        v_start=tuple(int(model.jnt_dofadr[order[i][1]]) if order[i][1] >= 0 else 0 for i in rank),
        nq=int(model.nq),
        nv=int(model.nv),
        body_row=tuple(int(new[last[i]]) for i in range(model.nbody)),
        joint_row=tuple(int(new[[o[1] for o in order].index(j)]) for j in range(model.njnt)),
        link_freedoms=(),
        link_spare=(),
    )
    return [order[i][:2] for i in rank], topology


def bodies_of(model, topology, rows) -> dict[str, np.ndarray]:
    """Of each row: frame in the parent, joint axis and anchor, mass, centre of mass, inertia."""
    n = len(rows)
    out = {"pos": np.zeros((n, 3)), "quat": np.tile([1.0, 0, 0, 0], (n, 1)), "axis": np.tile([0.0, 0, 1], (n, 1)), "anchor": np.zeros((n, 3))}
    out |= {"mass": np.zeros(n), "com": np.zeros((n, 3)), "inertia": np.zeros((n, 3, 3))}
    for i, (body, joint) in enumerate(rows):
        if topology.kind[i] != FREE and joint in (-1, int(model.body_jntadr[body])):
            out["pos"][i], out["quat"][i] = model.body_pos[body], model.body_quat[body]
        if joint >= 0:
            out["axis"][i] = model.jnt_axis[joint]
            if topology.kind[i] in (HINGE, BALL):
                out["anchor"][i] = model.jnt_pos[joint]
        if topology.body_row[body] == i:
            out["mass"][i], out["com"][i], out["inertia"][i] = model.body_mass[body], model.body_ipos[body], _inertia(model, body)
    return out


def _inertia(model, body):
    """About the centre of mass, in body axes."""
    import mujoco

    R = np.zeros(9)
    mujoco.mju_quat2Mat(R, model.body_iquat[body])
    R = R.reshape(3, 3)
    return R @ np.diag(model.body_inertia[body]) @ R.T


def joint_forces_of(model, ignored) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stiffness [nv], range [2 nv] (infinite where there is none) and its spring and damper [2 nv]."""
    stiffness, limit, spring = np.zeros(model.nv), np.tile([[-np.inf], [np.inf]], (1, model.nv)), np.zeros((2, model.nv))
    for j in range(model.njnt):
        dofs = slice(int(model.jnt_dofadr[j]), int(model.jnt_dofadr[j]) + V_SIZE[(FREE, BALL, SLIDE, HINGE)[model.jnt_type[j]]])
        if "spring" not in ignored:
            stiffness[dofs] = np.ravel(model.jnt_stiffness[j])[0]
        if model.jnt_limited[j] and model.jnt_type[j] in (2, 3) and "limit" not in ignored:
            limit[:, dofs] = model.jnt_range[j][:, None]
            m = 1 / model.dof_invweight0[dofs] if np.all(model.dof_invweight0[dofs] > 0) else model.dof_M0[dofs]
            spring[:, dofs] = m * _LIMIT_RATE**2, 2 * m * _LIMIT_RATE
    return stiffness, limit, spring


def motors_of(model, ignored):
    """Gear matrix and ranges of the actuators that are plain torques on joints."""
    count = 0 if {"actuator", "all"} & ignored and not plain_motors(model).all() else model.nu
    gear, control, force = np.zeros((count, model.nv)), np.tile([-np.inf, np.inf], (count, 1)), np.tile([-np.inf, np.inf], (count, 1))
    for i in range(count):
        joint = int(model.actuator_trnid[i, 0])
        size = V_SIZE[(FREE, BALL, SLIDE, HINGE)[model.jnt_type[joint]]]
        start = int(model.jnt_dofadr[joint])
        gear[i, start : start + size] = model.actuator_gear[i, :size] * model.actuator_gainprm[i, 0]
        if model.actuator_ctrllimited[i]:
            control[i] = model.actuator_ctrlrange[i]
        if model.actuator_forcelimited[i]:
            force[i] = np.sort(model.actuator_forcerange[i] / model.actuator_gainprm[i, 0])
    return gear, control, force
