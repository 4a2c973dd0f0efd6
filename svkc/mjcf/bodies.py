"""Bodies, joints and actuators of a MuJoCo model as NumPy arrays, by row of `Topology`."""

import dataclasses
from collections.abc import Collection, Mapping

import numpy as np

from svkc.mjcf.flags import disabled_actuators, is_disabled
from svkc.mjcf.unsupported import is_torque_motor
from svkc.model.annotations import MuJoCo, Numbers
from svkc.model.names import unknown_name
from svkc.model.topology import (
    BALL,
    FIXED,
    FREE,
    HINGE,
    Q_SIZE,
    SLIDE,
    V_SIZE,
    FixedFrame,
    Topology,
)

# rad/s: outside of its range, a joint with its inertia in the load pose is a critically damped
# oscillator of this angular frequency
_LIMIT_RATE = 50.0
# Of the largest inertia: what is below counts as massless. Delassus' matrix is regularized by
# 1.6e-10 of its largest entry, so that accelerations are exact to 1e-11 down to here.
_MASSLESS = 1e-7
JOINT_KINDS = {0: FREE, 1: BALL, 2: SLIDE, 3: HINGE}  # mjtJoint


def name_of(model: MuJoCo, kind: str, index: int) -> str:
    """Return the name of an element ("body", "joint", "site", "equality"), or KIND_INDEX if it has
    none."""
    import mujoco

    name = mujoco.mj_id2name(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), index)
    return name or (f"{kind}_{index}" if index or kind != "body" else "world")


def rotation_matrix(quat: Numbers) -> np.ndarray:
    """Return the rotation matrix [3 3] of a quaternion (wxyz)."""
    import mujoco

    R = np.zeros(9)
    mujoco.mju_quat2Mat(R, np.asarray(quat, float))
    return R.reshape(3, 3)


@dataclasses.dataclass(frozen=True)
class TreeJoint:
    """A joint of the tree.

    name: name of the joint.
    kind: joint kind of `Topology`.
    body: index of the body in the model.
    joint: index of the joint in the model; -1 for the free joint of a body with cuttable joints.
    q: index in q of its first coordinate.
    v: index in v of its first velocity.
    """

    name: str
    kind: int
    body: int
    joint: int
    q: int
    v: int


def tree_joints(model: MuJoCo, cut_bodies: Mapping[int, str]) -> list[TreeJoint]:
    """Return the joints of the tree in the model's order.

    cut_bodies: body -> name of the virtual link that holds the body. A free joint joins such a body
    to the world (paper, Fig. 15).
    """
    out, q, v, with_free_joint = [], 0, 0, set()
    for j in range(model.njnt):
        body = int(model.jnt_bodyid[j])
        if body in with_free_joint:
            continue
        kind, name, joint = JOINT_KINDS[int(model.jnt_type[j])], name_of(model, "joint", j), j
        if body in cut_bodies:
            with_free_joint.add(body)
            kind, name, joint = FREE, f"{cut_bodies[body]}_free", -1
        out.append(TreeJoint(name=name, kind=kind, body=body, joint=joint, q=q, v=v))
        q, v = q + Q_SIZE[kind], v + V_SIZE[kind]
    return out


def tree_rows(
    model: MuJoCo, cut_bodies: Mapping[int, str]
) -> tuple[list[tuple[int, int]], Topology]:
    """Return (body, joint or -1) of each row, and the topology without virtual links.

    There is one row for each joint, and one for each body without joints, sorted by level.
    """
    joints = tree_joints(model, cut_bodies)
    order, depth, last = [(0, -1, -1)], [0], {0: 0}
    own: dict[int, TreeJoint | None] = {0: None}
    for body in range(1, model.nbody):
        parent = 0 if body in cut_bodies else last[int(model.body_parentid[body])]
        for joint in [j for j in joints if j.body == body] or [None]:
            own[len(order)] = joint
            order.append((body, -1 if joint is None else joint.joint, parent))
            depth.append(depth[parent] + 1)
            parent = len(order) - 1
        last[body] = parent
    rank = np.argsort(depth, kind="stable")
    new = np.argsort(rank)
    own_in_rows = [own[int(i)] for i in rank]
    body_row = tuple(int(new[last[i]]) for i in range(model.nbody))
    row_of = {joint.name: int(new[i]) for i, joint in own.items() if joint is not None}
    topology = Topology(
        body_names=tuple(name_of(model, "body", i) for i in range(model.nbody)),
        joint_names=tuple(j.name for j in joints),
        link_names=(),
        parent=tuple(int(new[order[i][2]]) if order[i][2] >= 0 else -1 for i in rank),
        kind=tuple(FIXED if joint is None else joint.kind for joint in own_in_rows),
        q_start=tuple(0 if joint is None else joint.q for joint in own_in_rows),
        v_start=tuple(0 if joint is None else joint.v for joint in own_in_rows),
        nq=sum(Q_SIZE[j.kind] for j in joints),
        nv=sum(V_SIZE[j.kind] for j in joints),
        body_row=body_row,
        joint_row=tuple(row_of[j.name] for j in joints),
        link_freedoms=(),
        link_spare=(),
        massless_dofs=_massless_dofs(model, joints),
        site_names=tuple(name_of(model, "site", i) for i in range(model.nsite)),
        site_frames=_site_frames(model, body_row),
    )
    return [order[i][:2] for i in rank], topology


def _site_frames(model, body_row: tuple[int, ...]) -> tuple[FixedFrame, ...]:
    """Return the frame of each site in the row of its body."""
    placements = zip(model.site_bodyid, model.site_pos, model.site_quat, strict=True)
    return tuple(
        FixedFrame(body_row[b], tuple(p.tolist()), tuple(q.tolist())) for b, p, q in placements
    )


def _massless_dofs(model: MuJoCo, joints: list[TreeJoint]) -> tuple[int, ...]:
    """Return the coordinates of joints along which their own body has almost no inertia.

    Masses are compared with the largest mass, moments of inertia about joints with the largest.
    """
    # numbers that are not finite have an error of their own, later
    with np.errstate(all="ignore"):
        lightest, inertias = _joint_inertias(model, joints)
    bound = _MASSLESS * np.max(inertias, 0, initial=0)
    return tuple(
        j.v + k
        for j, least in zip(joints, lightest, strict=True)
        for k in range(V_SIZE[j.kind])
        if (least < bound)[int(j.kind == SLIDE or (j.kind == FREE and k < 3))]
    )


def _joint_inertias(model: MuJoCo, joints: list[TreeJoint]) -> tuple[np.ndarray, np.ndarray]:
    """Return the (rotational, linear) inertia of each joint's body, least and largest by axis.

    A body includes the bodies fixed to it. Moments of inertia are about the joint's anchor, of
    free joints about the centre of mass, in the load pose.
    """
    import mujoco

    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    out = np.zeros((2, len(joints), 2))
    for i, j in enumerate(joints):
        fixed = np.flatnonzero(model.body_weldid == model.body_weldid[j.body])
        m, R = model.body_mass[fixed], data.ximat[fixed].reshape(-1, 3, 3)
        com = m @ data.xipos[fixed] / max(m.sum(), mujoco.mjMINVAL)
        r = data.xipos[fixed] - (com if j.kind == FREE else data.xanchor[j.joint])
        own = np.einsum("bij,bj,bkj->ik", R, model.body_inertia[fixed], R)
        inertia = own + np.eye(3) * (m @ np.sum(r * r, 1)) - np.einsum("b,bi,bj", m, r, r)
        axis = data.xaxis[j.joint]
        inertia = np.nan_to_num(inertia)
        axes = np.linalg.eigvalsh(inertia) if j.kind in (BALL, FREE) else [axis @ inertia @ axis]
        out[:, i] = [[np.min(axes), m.sum()], [np.max(axes), m.sum()]]
    return out[0], out[1]


def body_arrays(
    model: MuJoCo, topology: Topology, rows: list[tuple[int, int]]
) -> dict[str, np.ndarray]:
    """Return pos, quat, axis, anchor, mass, com and inertia of each row; see `Chain`."""
    n = len(rows)
    out = {
        "pos": np.zeros((n, 3)),
        "quat": np.tile([1.0, 0, 0, 0], (n, 1)),
        "axis": np.tile([0.0, 0, 1], (n, 1)),
        "anchor": np.zeros((n, 3)),
    }
    out |= {"mass": np.zeros(n), "com": np.zeros((n, 3)), "inertia": np.zeros((n, 3, 3))}
    for i, (body, joint) in enumerate(rows):
        if topology.kind[i] != FREE and joint in (-1, int(model.body_jntadr[body])):
            out["pos"][i], out["quat"][i] = model.body_pos[body], model.body_quat[body]
        if joint >= 0:
            out["axis"][i] = model.jnt_axis[joint]
            if topology.kind[i] in (HINGE, BALL):
                out["anchor"][i] = model.jnt_pos[joint]
        if topology.body_row[body] == i:
            out["mass"][i], out["com"][i], out["inertia"][i] = (
                model.body_mass[body],
                model.body_ipos[body],
                _inertia(model, body),
            )
    return out


def _inertia(model, body):
    """Return the inertia about the centre of mass in the body's axes."""
    R = rotation_matrix(model.body_iquat[body])
    return R @ np.diag(model.body_inertia[body]) @ R.T


def characteristic_length(bodies: dict[str, np.ndarray], topology: Topology) -> float:
    """Return the root mean square of nonzero offsets (m) of joints and centres of mass, or 1."""
    below_roots = bodies["pos"][np.array(topology.parent) > 0]
    offsets = np.linalg.norm(np.concatenate([below_roots, bodies["com"]]), axis=1)
    offsets = offsets[offsets > 1e-12]
    return np.sqrt(np.mean(offsets**2)) if len(offsets) else 1.0


def springs_and_limits(
    model: MuJoCo, ignored: set[str], topology: Topology
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return stiffness [dofs], limit [2 dofs] and limit_spring [2 dofs]; see `Chain`."""
    n, model_v = topology.dofs, np.array(topology.model_v, int)
    with_limits = "limit" not in ignored and not is_disabled(model, "limit", "constraint")
    stiffness, limit, spring = np.zeros(n), np.tile([[-np.inf], [np.inf]], (1, n)), np.zeros((2, n))
    for j in range(model.njnt):
        own = slice(
            int(model.jnt_dofadr[j]),
            int(model.jnt_dofadr[j]) + V_SIZE[JOINT_KINDS[int(model.jnt_type[j])]],
        )
        dofs = model_v[own]
        if "spring" not in ignored and not is_disabled(model, "spring"):
            stiffness[dofs] = np.ravel(model.jnt_stiffness[j])[0]
        if with_limits and model.jnt_limited[j] and model.jnt_type[j] in (2, 3):
            limit[:, dofs] = model.jnt_range[j][:, None]
            m = (
                1 / model.dof_invweight0[own]
                if np.all(model.dof_invweight0[own] > 0)
                else model.dof_M0[own]
            )
            spring[:, dofs] = m * _LIMIT_RATE**2, 2 * m * _LIMIT_RATE
    return stiffness, limit, spring


def joint_armature(model: MuJoCo, ignored: Collection[str], without: tuple[str, ...]) -> np.ndarray:
    """Return the model's armature [nv], zero for the joints in `without`.

    Raises ValueError if there is no such joint.
    """
    names = [name_of(model, "joint", j) for j in range(model.njnt)]
    armature = np.zeros(model.nv) if "armature" in ignored else np.array(model.dof_armature)
    for name in without:
        if name not in names:
            raise unknown_name("joint", name, names)
        armature[model.dof_jntid == names.index(name)] = 0
    return armature


def scatter_to_dofs(topology: Topology, values: np.ndarray) -> np.ndarray:
    """Return values per dof of the model [model.nv] as [dofs], zero for other virtual joints."""
    out = np.zeros(topology.dofs)
    out[np.array(topology.model_v, int)] = np.ravel(values)
    return out


def actuator_arrays(model: MuJoCo, topology: Topology) -> tuple[np.ndarray, ...]:
    """Return gear, control_range, force_range; see `Chain`.

    Actuators that svkc cannot simulate have no row. `left_out_elements` has checked that they are
    ignored. Rows of actuators that the model disables are zero.
    """
    motors, disabled = np.flatnonzero(is_torque_motor(model)), disabled_actuators(model)
    count, model_v = len(motors), np.array(topology.model_v, int)
    gear, control, force = (
        np.zeros((count, topology.dofs)),
        np.tile([-np.inf, np.inf], (count, 1)),
        np.tile([-np.inf, np.inf], (count, 1)),
    )
    for i, motor in enumerate(motors):
        joint = int(model.actuator_trnid[motor, 0])
        size, start = V_SIZE[JOINT_KINDS[int(model.jnt_type[joint])]], int(model.jnt_dofadr[joint])
        # an actuator may have several outputs and controls, but a motor has one of each
        ratio = model.actuator_gear[model.actuator_outadr[motor], :size]
        gear[i, model_v[start : start + size]] = (
            ratio * model.actuator_gainprm[motor, 0] * ~disabled[motor]
        )
        at = model.actuator_ctrladr[motor]
        if model.actuator_ctrllimited[at] and not is_disabled(model, "clampctrl"):
            control[i] = model.actuator_ctrlrange[at]
        if model.actuator_forcelimited[motor]:
            force[i] = np.sort(model.actuator_forcerange[motor] / model.actuator_gainprm[motor, 0])
    return gear, control, force
