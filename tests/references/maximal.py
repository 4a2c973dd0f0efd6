"""Reference problems, whose bodies have poses in the ground frame, as chains.

A spanning tree of the joints becomes MJCF. The other joints become virtual links.
"""

import numpy as np

import svkc

JOINTS = {"revolute": "hinge", "prismatic": "slide", "spherical": "ball", "universal": "universal"}


def _numbers(x) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(x))


def _quat(R) -> np.ndarray:
    """Return the quaternion of a rotation matrix, as an eigenvector (Bar-Itzhack, 2000)."""
    R = np.asarray(R)
    K = np.zeros((4, 4))
    K[0, 0] = np.trace(R)
    K[0, 1:] = K[1:, 0] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    K[1:, 1:] = R + R.T - np.trace(R) * np.eye(3)
    return np.linalg.eigh(K)[1][:, -1]


class Body:
    """Initial pose and velocity of a body in the ground frame.

    specs: the body's entry in a reference problem. None: the ground, which is at rest.
    """

    def __init__(self, specs=None):
        specs = specs or {}
        self.position, self.rotation = (
            np.asarray(specs.get("com_world0", np.zeros(3))),
            np.asarray(specs.get("R0", np.eye(3))),
        )
        self.v, self.omega = (
            np.asarray(specs.get("v0", np.zeros(3))),
            np.asarray(specs.get("omega0_world", np.zeros(3))),
        )

    def velocity(self, point):
        return self.v + np.cross(self.omega, point - self.position)


def load(problem: dict, **options) -> tuple[svkc.Chain, svkc.State]:
    """Return the chain and the initial state of a problem.

    The origins of body frames are the centers of mass. A joint of the tree has the name of its
    child, a virtual link those of parent and child.

    problem: contents of a data file of the reference problems.
    options: keyword arguments of `svkc.load`.
    """
    text, bodies, tree, loops = mjcf(problem)
    chain = svkc.load(text, virtual_links=[_link(joint, bodies) for joint in loops], **options)
    return chain, chain.state(v={name: _joint_rate(joint, bodies) for name, joint in tree.items()})


def mjcf(problem: dict) -> tuple[str, dict, dict, list]:
    """Return the spanning tree as MJCF, its bodies and joints by name, and the loop joints."""
    specs = {body["name"]: body for body in problem["bodies"]}
    bodies = {"ground": Body()} | {name: Body(body) for name, body in specs.items()}
    tree, loops = {}, []
    for joint in problem["joints"]:
        in_tree = (
            joint["child"] not in tree
            and joint["type"] != "universal"
            and (joint["parent"] == "ground" or joint["parent"] in tree)
        )
        tree.update({joint["child"]: joint}) if in_tree else loops.append(joint)

    def element(name):
        joint, body, mass = tree[name], bodies[name], specs[name]
        parent, point = bodies[joint["parent"]], np.asarray(joint["point_world0"])
        inertia = np.asarray(mass["inertia_com_body"])
        kind, axis = (
            JOINTS[joint["type"]],
            body.rotation.T @ np.asarray(joint.get("axis_world0", (0, 0, 1))),
        )
        position = parent.rotation.T @ (body.position - parent.position)
        anchor = body.rotation.T @ (point - body.position)
        children = "".join(
            element(child) for child, other in tree.items() if other["parent"] == name
        )
        return (
            f'<body name="{name}" pos="{_numbers(position)}"'
            f' quat="{_numbers(_quat(parent.rotation.T @ body.rotation))}">'
            f'<joint name="{name}" type="{kind}"'
            f' pos="{_numbers(anchor)}" axis="{_numbers(axis)}"/>'
            f'<inertial pos="0 0 0" mass="{mass["mass"]!r}"'
            f' fullinertia="{_numbers([*np.diag(inertia), *inertia[np.triu_indices(3, 1)]])}"/>'
            f"{children}</body>"
        )

    text = (
        '<mujoco><compiler balanceinertia="false" inertiafromgeom="false"/><option'
        f' gravity="{_numbers(problem["gravity"])}"/><worldbody>'
    )
    text += (
        "".join(element(name) for name, joint in tree.items() if joint["parent"] == "ground")
        + "</worldbody></mujoco>"
    )
    return text, bodies, tree, loops


def _joint_rate(joint, bodies):
    """Return the initial velocity of a tree joint (rad/s or m/s), from those of its bodies."""
    parent, child, point = (
        bodies[joint["parent"]],
        bodies[joint["child"]],
        np.asarray(joint["point_world0"]),
    )
    if joint["type"] == "spherical":
        return child.rotation.T @ (child.omega - parent.omega)
    velocity = (
        child.omega - parent.omega
        if joint["type"] == "revolute"
        else child.velocity(point) - parent.velocity(point)
    )
    axis = np.asarray(joint["axis_world0"])
    return float(axis @ velocity / np.linalg.norm(axis))


def _link(joint, bodies):
    """Return a loop joint as a connected virtual link."""
    parent, point = bodies[joint["parent"]], np.asarray(joint["point_world0"])
    names = ["world" if joint[end] == "ground" else joint[end] for end in ("parent", "child")]
    options = {"pos": parent.rotation.T @ (point - parent.position)}
    if joint["type"] == "universal":
        # the universal joint's x is the axis in the parent, its rotated y that in the child
        x, y = np.asarray(joint["axis_parent_world0"]), np.asarray(joint["axis_child_world0"])
        options["quat"] = _quat(parent.rotation.T @ np.stack([x, y, np.cross(x, y)], 1))
    elif "axis_world0" in joint:
        options["axis"] = parent.rotation.T @ np.asarray(joint["axis_world0"])
    return svkc.VirtualLink(
        f"{names[0]}_{names[1]}",
        *names,
        JOINTS[joint["type"]],
        connected=True,
        **{name: tuple(value) for name, value in options.items()},
    )
