"""Cuttable joints of the tree: a free joint joins the child to the world, and a virtual link with
the original joint holds the child (paper, Fig. 15)."""

import dataclasses

import numpy as np

from svkc.mjcf.bodies import JOINT_KINDS, name_of, rotation_matrix
from svkc.model.annotations import MuJoCo, Names
from svkc.model.names import unknown_name
from svkc.model.topology import BALL, FREE, HINGE, SLIDE, V_SIZE, Topology
from svkc.model.virtual_link import VirtualLink

# indices of a joint's coordinates among the six freedoms of a virtual joint
_FREEDOM_INDICES = {"hinge": (2,), "slide": (5,), "ball": (0, 1, 2), "universal": (0, 1)}


@dataclasses.dataclass(frozen=True)
class CuttableJoint:
    """A cuttable joint.

    link: the virtual link that replaces the joint.
    body: index in the model of the body that the joint holds.
    joints: indices in the model of the joints that the virtual link replaces.
    """

    link: VirtualLink
    body: int
    joints: tuple[int, ...]

    @property
    def freedoms(self) -> tuple[int, ...]:
        """Indices of the joint's coordinates among the six freedoms of the virtual joint."""
        return _FREEDOM_INDICES[self.link.joint]


def cuttable_joints(model: MuJoCo, cuttable: Names) -> list[CuttableJoint]:
    """Return the cuttable joints with these names, one for each body.

    Raises ValueError if a name is unknown, or if no virtual joint has the joint's freedoms.
    """
    names = [name_of(model, "joint", j) for j in range(model.njnt)]
    cuts: dict[int, CuttableJoint] = {}
    for name in cuttable:
        if name not in names:
            raise unknown_name("joint", name, names)
        body = int(model.jnt_bodyid[names.index(name)])
        cuts.setdefault(body, _cuttable_joint(model, name, body))
    return list(cuts.values())


def _cuttable_joint(model, name: str, body: int) -> CuttableJoint:
    """Return the cuttable joint that holds a body; `name` is one of the body's joints."""
    joints = tuple(
        range(
            int(model.body_jntadr[body]),
            int(model.body_jntadr[body]) + int(model.body_jntnum[body]),
        )
    )
    kinds = [JOINT_KINDS[int(model.jnt_type[j])] for j in joints]
    frame, axis = np.eye(3), model.jnt_axis[joints[0]]
    ref = [float(model.qpos0[model.jnt_qposadr[j]]) for j in joints]
    pos, R = np.array(model.body_pos[body]), rotation_matrix(model.body_quat[body])
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
            " joints; a cuttable body has one hinge, slide or ball, or two hinges through one point"
            " at right angles to each other and with ref=0"
        )
    if joint in ("slide", "universal"):
        anchor = anchor * (joint == "universal")
    frame_in_parent = R @ frame
    # the virtual joint's coordinate equals the joint's, which is `ref` in the load pose
    if joint == "hinge":
        frame_in_parent = frame_in_parent @ _rotation_about(axis, -ref[0])
    joint_pos = pos + R @ anchor - (R @ axis * ref[0] if joint == "slide" else 0)
    link = VirtualLink(
        name, name_of(model, "body", int(model.body_parentid[body])), name_of(model, "body", body),
        joint, pos=tuple(joint_pos), quat=tuple(_quaternion(frame_in_parent)),
        real_pos=tuple(anchor), real_quat=tuple(_quaternion(frame)),
        axis=tuple((0.0, 0.0, 1.0) if joint in ("ball", "universal") else axis), connected=True,
    )  # fmt: skip
    return CuttableJoint(link, body, joints)


def check_armature(model: MuJoCo, cuts: list[CuttableJoint], armature: np.ndarray) -> None:
    """Raise ValueError if a cuttable joint has armature [nv], as virtual joints have no inertia."""
    with_armature = set(np.asarray(model.dof_jntid)[armature != 0])
    names = [name_of(model, "joint", j) for cut in cuts for j in cut.joints if j in with_armature]
    if names:
        raise ValueError(
            f"cuttable: got armature on {', '.join(names)}; a cuttable joint cannot have any."
            f" To load without: svkc.load(..., ignore_armature={names})"
        )


def with_cuttable_joints(
    model: MuJoCo, topology: Topology, cuts: list[CuttableJoint], first: int
) -> Topology:
    """Return the topology with link_child, cuttable_joints, model_q and model_v filled.

    first: index of the first virtual link that replaces a cuttable joint.
    """
    slots = {cut.body: (first + i, cut) for i, cut in enumerate(cuts)}
    link_child = [-1] * len(topology.link_names)
    for body, (slot, _) in slots.items():
        link_child[slot] = topology.body_row[body]
    model_q, model_v, records, tree = (
        [],
        [],
        [],
        iter(zip(topology.joint_names, topology.joint_row, strict=True)),
    )
    table, with_free_joint = topology.links, set()
    for j in range(model.njnt):
        body, kind = int(model.jnt_bodyid[j]), JOINT_KINDS[int(model.jnt_type[j])]
        if body in slots:
            slot, cut = slots[body]
            if body not in with_free_joint:
                next(tree)
                with_free_joint.add(body)
            own = cut.freedoms if kind == BALL else (cut.freedoms[cut.joints.index(j)],)
            records.append((name_of(model, "joint", j), slot, own[0]))
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
        cuttable_joints=tuple(records),
        model_q=as_ints(model_q),
        model_v=as_ints(model_v),
    )


def _quaternion(R) -> np.ndarray:
    """Return the unit quaternion (wxyz) of a rotation matrix."""
    import mujoco

    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.asarray(R, float).ravel())
    return quat / np.linalg.norm(quat)


def _rotation_about(axis, angle) -> np.ndarray:
    """Return the rotation matrix of an axis and an angle (rad)."""
    import mujoco

    quat = np.zeros(4)
    mujoco.mju_axisAngle2Quat(quat, np.asarray(axis, float), angle)
    return rotation_matrix(quat)
