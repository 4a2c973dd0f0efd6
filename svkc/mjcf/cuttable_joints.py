"""Joints of the tree that may be cut (paper, Fig. 15): the child hangs on the base by a free joint,
a virtual link with the joint holds it."""

import dataclasses

import numpy as np

from svkc.mjcf.bodies import JOINT_KINDS, name_of, rotation_matrix
from svkc.model.topology import BALL, FREE, HINGE, SLIDE, V_SIZE, Topology
from svkc.model.virtual_link import VirtualLink

# place of the coordinates of each kind among the six freedoms of a virtual joint
_FREEDOM_INDICES = {"hinge": (2,), "slide": (5,), "ball": (0, 1, 2), "universal": (0, 1)}


@dataclasses.dataclass(frozen=True)
class CuttableJoint:
    """One cuttable joint: the virtual link that takes its place, the body it carries, and the
    model's joints in it."""

    link: VirtualLink
    body: int
    joints: tuple[int, ...]

    @property
    def freedoms(self) -> tuple[int, ...]:
        return _FREEDOM_INDICES[self.link.joint]


def cuttable_joints(model, cuttable) -> list[CuttableJoint]:
    """The cuts asked for by joint names; ValueError: unknown names, joints that no virtual joint is
    like."""
    names = [name_of(model, "joint", j) for j in range(model.njnt)]
    cuts: dict[int, CuttableJoint] = {}
    for name in cuttable:
        if name not in names:
            raise ValueError(f"cuttable: no joint {name!r}; joints: {', '.join(names) or 'none'}")
        body = int(model.jnt_bodyid[names.index(name)])
        cuts.setdefault(body, _cuttable_joint(model, name, body))
    return list(cuts.values())


def _cuttable_joint(model, name: str, body: int) -> CuttableJoint:
    joints = tuple(
        range(
            int(model.body_jntadr[body]),
            int(model.body_jntadr[body]) + int(model.body_jntnum[body]),
        )
    )
    kinds = [JOINT_KINDS[int(model.jnt_type[j])] for j in joints]
    frame, axis = np.eye(3), model.jnt_axis[joints[0]]
    ref = [float(model.qpos0[model.jnt_qposadr[j]]) for j in joints]
    pos, turned = np.array(model.body_pos[body]), rotation_matrix(model.body_quat[body])
    anchor = np.array(model.jnt_pos[joints[0]])
    if (
        kinds == [HINGE, HINGE]
        and abs(axis @ model.jnt_axis[joints[1]]) < 1e-9
        and np.allclose(anchor, model.jnt_pos[joints[1]], atol=1e-12)
        and not any(ref)
    ):
        joint, second = "universal", model.jnt_axis[joints[1]]
        frame, axis = np.stack([axis, second, np.cross(axis, second)], 1), np.array([0.0, 0, 1])
    elif len(kinds) == 1 and kinds[0] in (HINGE, SLIDE, BALL):
        joint = {HINGE: "hinge", SLIDE: "slide", BALL: "ball"}[kinds[0]]
    else:
        raise ValueError(
            f"cuttable: {name!r} belongs to body {name_of(model, 'body', body)!r} with {len(kinds)}"
            " joints; what can be cut is one hinge, slide or ball, or two hinges through one point"
            " at right angles to each other and with ref=0"
        )
    if joint in ("slide", "universal"):
        anchor = anchor * (joint == "universal")
    base = turned @ frame
    # the coordinate reads the joint's own: `ref` in the load pose
    if joint == "hinge":
        base = base @ _rotation_about(axis, -ref[0])
    place = pos + turned @ anchor - (turned @ axis * ref[0] if joint == "slide" else 0)
    link = VirtualLink(
        name, name_of(model, "body", int(model.body_parentid[body])), name_of(model, "body", body),
        joint, pos=tuple(place), quat=tuple(_quaternion(base)), real_pos=tuple(anchor),
        real_quat=tuple(_quaternion(frame)),
        axis=tuple((0.0, 0.0, 1.0) if joint in ("ball", "universal") else axis), connected=True,
    )  # fmt: skip
    return CuttableJoint(link, body, joints)


def check_armature(model, cuts: list[CuttableJoint], armature: np.ndarray) -> None:
    """ValueError where a joint that may be cut has armature [nv], as virtual joints have no
    inertia."""
    turning = set(np.asarray(model.dof_jntid)[armature != 0])
    names = [name_of(model, "joint", j) for cut in cuts for j in cut.joints if j in turning]
    if names:
        raise ValueError(
            f"cuttable: got armature on {', '.join(names)}; a rotor has no place in the tree once"
            f" its joint is cut. To load without: svkc.load(..., ignore_armature={names})"
        )


def with_cuttable_joints(
    model, topology: Topology, cuts: list[CuttableJoint], first: int
) -> Topology:
    """The topology with the cuts' tables: their links start at slot `first`; where the model's own
    qpos and qvel are to be found."""
    slots = {cut.body: (first + i, cut) for i, cut in enumerate(cuts)}
    link_child = [-1] * len(topology.link_names)
    for body, (slot, _) in slots.items():
        link_child[slot] = topology.body_row[body]
    model_q, model_v, cut_joints, tree = (
        [],
        [],
        [],
        iter(zip(topology.joint_names, topology.joint_row, strict=True)),
    )
    table, seen = topology.links, set()
    for j in range(model.njnt):
        body, kind = int(model.jnt_bodyid[j]), JOINT_KINDS[int(model.jnt_type[j])]
        if body in slots:
            slot, cut = slots[body]
            if body not in seen:
                next(tree)
                seen.add(body)
            own = cut.freedoms if kind == BALL else (cut.freedoms[cut.joints.index(j)],)
            cut_joints.append((name_of(model, "joint", j), slot, own[0]))
            model_q += (
                list(table.quat[slot])
                if kind == BALL
                else [int(np.concatenate([table.angle, table.slide], 1)[slot, own[0]])]
            )
            model_v += [int(table.dof[slot, k]) for k in own]
        else:
            _, row = next(tree)
            size_q = {FREE: 7, BALL: 4}.get(kind, 1)
            model_q += range(topology.q_start[row], topology.q_start[row] + size_q)
            model_v += range(topology.v_start[row], topology.v_start[row] + V_SIZE[kind])
    as_ints = lambda x: tuple(int(i) for i in x)
    return dataclasses.replace(
        topology,
        link_child=as_ints(link_child),
        cut_joints=tuple(cut_joints),
        model_q=as_ints(model_q),
        model_v=as_ints(model_v),
    )


def _quaternion(R) -> np.ndarray:
    import mujoco

    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.asarray(R, float).ravel())
    return quat / np.linalg.norm(quat)


def _rotation_about(axis, angle) -> np.ndarray:
    import mujoco

    quat = np.zeros(4)
    mujoco.mju_axisAngle2Quat(quat, np.asarray(axis, float), angle)
    return rotation_matrix(quat)
