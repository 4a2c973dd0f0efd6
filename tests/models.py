"""Mechanisms of the tests, as MJCF and virtual links.

The table in `cases.py` selects those on which laws are tested.
"""

import re

import numpy as np

import svkc

MJCF = '<mujoco><option gravity="0.3 -0.2 -9.81"/><worldbody>{}</worldbody></mujoco>'
BAR = '<geom type="capsule" fromto="0 0 0 {0}" size="0.03" contype="0" conaffinity="0"/>'


def random_tree(bodies: int, seed: int, kinds=("hinge", "slide", "ball", "free")) -> str:
    """Return the MJCF of a random tree with random shapes and frames.

    Bodies have one or two joints. Some trees have several roots.
    """
    rng = np.random.default_rng(seed)
    children: list[list[int]] = [[] for _ in range(bodies + 1)]
    for i in range(1, bodies + 1):
        children[
            0 if i == 1 or rng.random() < 0.05 else int(rng.integers(max(1, i - 6), i))
        ].append(i)

    def numbers(x):
        return " ".join(f"{v:.6f}" for v in np.atleast_1d(x))

    def joints(i, root):
        kind = rng.choice([k for k in kinds if k != "free" or root])
        if kind == "free":
            return "<freejoint/>"
        count = int(rng.integers(1, 3)) if kind in ("hinge", "slide") else 1
        out = ""
        for k in range(count):
            extra = f'armature="{rng.uniform(0, 0.1):.4f}" damping="{rng.uniform(0, 1):.4f}"'
            stiff = (
                f'stiffness="{rng.uniform(0, 5):.4f}" springref="0.2"' if kind == "hinge" else ""
            )
            out += (
                f'<joint name="j{i}_{k}" type="{kind}" axis="{numbers(rng.normal(size=3))}"'
                f' pos="{numbers(rng.normal(size=3) / 10)}" {extra} {stiff}/>'
            )
        return out

    def body(i, root):
        quat = rng.normal(size=4)
        element = (
            f'<body name="b{i}" pos="{numbers(rng.normal(size=3) / 3)}"'
            f' quat="{numbers(quat / np.linalg.norm(quat))}">{joints(i, root)}'
        )
        size = rng.uniform(0.03, 0.1, 3)
        element += (
            f'<geom type="box" size="{numbers(size)}" pos="{numbers(rng.normal(size=3) / 10)}"'
            ' contype="0" conaffinity="0"/>'
        )
        return element + "".join(body(c, False) for c in children[i]) + "</body>"

    return MJCF.format("".join(body(i, True) for i in children[0]))


def bar(name: str, joint: str, to: str, pos="0 0 0", inside="") -> str:
    """Return the MJCF of a body with one joint of its name and a capsule from its origin to `to`.

    joint: attributes of the joint.
    pos: origin of the body in its parent (m).
    inside: MJCF of child bodies.
    """
    return (
        f'<body name="{name}" pos="{pos}"><joint name="{name}"'
        f" {joint}/>{BAR.format(to)}{inside}</body>"
    )


Y = 'type="hinge" axis="0 1 0" damping="0"'


# a rod on a hinge, and the bodies of a double pendulum
ARM = MJCF.format(bar("arm", Y, "0 0 -1"))
TWO_RODS = bar("upper", Y, "0 0 -1", inside=bar("lower", Y, "0 0 -0.8", "0 0 -1"))

FOUR_BAR = bar(
    "crank",
    Y,
    "0 0 0.4",
    inside=bar("coupler", Y, "1 0 0.2", "0 0 0.4", bar("rocker", Y, "0.2 0 -0.6", "1 0 0.2")),
)


def pin(**changed) -> svkc.VirtualLink:
    """Return the hinge that closes the four-bar, with some fields changed."""
    at = {"pos": (1.2, 0, 0), "axis": (0, 1, 0), "real_pos": (0.2, 0, -0.6), "connected": True}
    return svkc.VirtualLink("pin", "world", "rocker", "hinge", **at | changed)


def four_bar(**options) -> svkc.Chain:
    """Return crank, coupler and rocker on hinges about y, closed by a hinge.

    3 of the loop's 6 rows are redundant.
    """
    return svkc.load(MJCF.format(FOUR_BAR), virtual_links=[pin()], **options)


def parallelogram(middle: bool = True) -> svkc.Chain:
    """Return three parallel bars under a plate: two loops, of which one is wholly redundant.

    middle: whether the middle bar is connected.
    """
    legs = "".join(
        bar(
            f"leg{i}",
            Y,
            "0 0 1",
            f"{i * 0.7} 0 0",
            bar("plate", Y, "1.4 0 0", "0 0 1") if i == 0 else "",
        )
        for i in (0, 1, 2)
    )
    links = [
        svkc.VirtualLink(
            f"pin{i}",
            "plate",
            f"leg{i}",
            "hinge",
            pos=(i * 0.7, 0, 0),
            real_pos=(0, 0, 1),
            axis=(0, 1, 0),
            connected=middle or i == 2,
        )
        for i in (1, 2)
    ]
    return svkc.load(MJCF.format(legs), virtual_links=links)


def rod_on_balls() -> svkc.Chain:
    """Return a spatial R-S-S-R linkage, whose coupler spins freely between two balls."""
    crank = bar(
        "crank",
        'type="hinge" axis="1 0 0"',
        "0 0 0.3",
        inside=bar("rod", 'type="ball"', "1 0.4 0.1", "0 0 0.3"),
    )
    rocker = bar("rocker", 'type="hinge" axis="0 1 0"', "0 0.2 0.4", "1 0.2 0")
    link = svkc.VirtualLink(
        "far_ball",
        "rocker",
        "rod",
        "ball",
        pos=(0, 0.2, 0.4),
        real_pos=(1, 0.4, 0.1),
        connected=True,
    )
    return svkc.load(MJCF.format(crank + rocker), virtual_links=[link])


def stewart(spread: float = 0.0, motors: str = "") -> svkc.Chain:
    """Return a Stewart platform: six legs of a universal joint (two hinges), a slide and a ball.

    The ball of the first leg is in the tree; the other balls are virtual links.

    spread: angle by which pairs of feet are apart, and pairs of balls closer (rad). Two regular
        hexagons, without spread, leave the plate one freedom when the slides are locked.
    motors: MJCF of the actuators.
    """
    angle = np.deg2rad([0, 60, 120, 180, 240, 300])
    apart = spread * np.array([1, -1, 1, -1, 1, -1])
    foot_angle, top_angle = angle + apart, angle - apart + 0.5
    feet = np.stack([np.cos(foot_angle), np.sin(foot_angle), 0 * angle], 1)
    tops = np.stack([0.5 * np.cos(top_angle), 0.5 * np.sin(top_angle), 0 * angle + 1], 1)
    xml, links = "", []
    for i, (foot, top) in enumerate(zip(feet, tops)):
        axis, length = (top - foot) / np.linalg.norm(top - foot), np.linalg.norm(top - foot)
        z = " ".join(map(str, axis))
        plate = (
            '<body name="plate" pos="0 0 {0}"><joint name="plate" type="ball"/><geom'
            ' type="cylinder" size="0.5 0.03" contype="0" conaffinity="0"/></body>'
        )
        leg = (
            f'<body name="leg{i}" pos="{foot[0]} {foot[1]} 0" zaxis="{z}"><joint name="ux{i}"'
            f' axis="1 0 0"/><joint name="uy{i}" axis="0 1 0"/>{BAR.format("0 0 0.5")}<body'
            f' name="rod{i}"><joint name="slide{i}" type="slide" axis="0 0 1"/><geom type="capsule"'
            f' fromto="0 0 0.5 0 0 {length}" size="0.02" contype="0" conaffinity="0"/>'
        )
        xml += leg + (plate.format(length) if i == 0 else "") + "</body></body>"
        if i:
            links.append(
                svkc.VirtualLink(
                    f"top{i}",
                    "plate",
                    f"rod{i}",
                    "ball",
                    real_pos=(0, 0, length),
                    pos=(0, 0, 0),
                    connected=True,
                )
            )
    # positions of the balls in the plate's frame, from the load pose
    import mujoco

    text = MJCF.format(xml).replace("</mujoco>", motors + "</mujoco>")
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    R, p = data.body("plate").xmat.reshape(3, 3), data.body("plate").xpos
    placed_links = [
        svkc.VirtualLink(
            k.name,
            k.parent,
            k.real,
            "ball",
            pos=tuple(R.T @ (tops[i + 1] - p)),
            real_pos=k.real_pos,
            connected=True,
        )
        for i, k in enumerate(links)
    ]
    return svkc.load(text, virtual_links=placed_links)


def five_bar() -> svkc.Chain:
    """Return two arms of two links whose ends are joined by a hinge: mobility 2."""
    left = bar("left_arm", Y, "0 0 0.5", "-0.3 0 0", bar("left_fore", Y, "0.3 0 0.5", "0 0 0.5"))
    right = bar("right_arm", Y, "0 0 0.5", "0.3 0 0", bar("right_fore", Y, "-0.3 0 0.5", "0 0 0.5"))
    link = svkc.VirtualLink(
        "tip",
        "left_fore",
        "right_fore",
        "hinge",
        pos=(0.3, 0, 0.5),
        real_pos=(-0.3, 0, 0.5),
        axis=(0, 1, 0),
        connected=True,
    )
    return svkc.load(MJCF.format(left + right), virtual_links=[link])


def dh_loop(theta, length, twist, joint_prefix="j") -> svkc.Chain:
    """Return a loop of hinges with Denavit-Hartenberg parameters.

    theta: rotation of each joint about z in the load pose (rad).
    length: distance along x to the next joint (m).
    twist: rotation about x to the next joint (rad).
    joint_prefix: beginning of the names of bodies and joints.
    """
    half_angle = lambda angle: np.array([np.cos(angle / 2), np.sin(angle / 2)])
    about_x = lambda angle: (half_angle(angle)[0], half_angle(angle)[1], 0, 0)
    xml = ""
    for i in reversed(range(len(theta) - 1)):
        # Rot_x(twist of the previous link) Rot_z(theta)
        (cx, sx), (cz, sz) = half_angle(twist[i - 1] if i else 0), half_angle(theta[i])
        quat = f"{cx * cz} {sx * cz} {-sx * sz} {cx * sz}"
        pos = f"{length[i - 1] if i else 0} 0 0"
        hinge = (
            f'<body name="{joint_prefix}{i}" pos="{pos}" quat="{quat}">'
            f'<joint name="{joint_prefix}{i}" axis="0 0 1"/>'
        )
        xml = (
            hinge
            + f'<geom type="capsule" fromto="0 0 0 {length[i]} 0 0.01" size="0.03" contype="0"/>'
            + xml
            + "</body>"
        )
    last = len(theta) - 2
    end = svkc.VirtualLink(
        "last", f"{joint_prefix}{last}", "world", "hinge", pos=(length[last], 0, 0),
        quat=about_x(twist[last]), real_pos=(-length[-1], 0, 0), real_quat=about_x(-twist[-1]),
        connected=True,
    )  # fmt: skip
    return svkc.load(MJCF.format(xml), virtual_links=[end])


def figure40() -> svkc.Chain:
    """Return the 40-freedom figure with both hands held to the ground by balls: mobility 40."""
    chain = svkc.load(str(svkc.scenes.FOLDER / "figure40.xml"))
    place = np.asarray(svkc.poses(chain, chain.state())[0])
    grips = [
        svkc.VirtualLink(
            f"{s}_grip",
            "world",
            f"{s}_hand",
            "ball",
            pos=tuple(place[chain.body_names.index(f"{s}_hand")]),
            connected=True,
        )
        for s in ("right", "left")
    ]
    return svkc.load(str(svkc.scenes.FOLDER / "figure40.xml"), virtual_links=grips)


def bennett(theta=0.9) -> svkc.Chain:
    """Return Bennett's linkage: four skew hinges with sin(alpha) / a = sin(beta) / b.

    theta: rotation of the first joint in the load pose (rad).
    """
    alpha, a, b = np.deg2rad(30.0), 0.5, 0.8
    beta = np.arcsin(np.sin(alpha) * b / a)
    theta_2 = 2 * np.arctan(
        np.sin((beta + alpha) / 2) / np.sin((beta - alpha) / 2) / np.tan(theta / 2)
    )
    return dh_loop((theta, theta_2, -theta, -theta_2), (a, b, a, b), (alpha, beta, alpha, beta))


def bricard(theta=np.pi / 3) -> svkc.Chain:
    """Return Bricard's linkage: six hinges, equal links, alternating twists of 90 and -90 degrees.

    Angles t and u of successive joints satisfy cos t + cos u + cos t cos u = 0.

    theta: t in the load pose (rad).
    """
    theta_2 = np.arccos(-np.cos(theta) / (1 + np.cos(theta)))
    quarter_turn = np.pi / 2
    return dh_loop((theta, theta_2) * 3, (0.5,) * 6, (quarter_turn, -quarter_turn) * 3)


def sarrus() -> svkc.Chain:
    """Return Sarrus' linkage: two legs of three parallel hinges each, at right angles.

    The plate moves along a vertical line.
    """
    X = 'type="hinge" axis="1 0 0"'
    leg_x = bar(
        "a1",
        Y,
        "0.5 0 0.5",
        "1 0 0",
        bar("a2", Y, "-0.5 0 0.5", "0.5 0 0.5", bar("plate", Y, "-1 0 0.01", "-0.5 0 0.5")),
    )
    leg_y = bar("b1", X, "0 0.5 0.5", "0 1 0", bar("b2", X, "0 -0.5 0.5", "0 0.5 0.5"))
    link = svkc.VirtualLink(
        "top",
        "plate",
        "b2",
        "hinge",
        axis=(1, 0, 0),
        pos=(-1, 1, 0),
        real_pos=(0, -0.5, 0.5),
        connected=True,
    )
    return svkc.load(MJCF.format(leg_x + leg_y), virtual_links=[link])


BOX = '<geom type="box" size="{}" contype="0"/>'
TWO_BOXES = MJCF.format(
    f'<body name="a"><freejoint name="a"/>{BOX.format("0.1 0.2 0.3")}</body><body name="b" pos="1 0'
    f' 0"><freejoint name="b"/>{BOX.format("0.3 0.1 0.2")}</body>'
)


def two_boxes(joint: str) -> svkc.Chain:
    """Return two free boxes with a disconnected virtual joint between them."""
    where = {"pos": (0.4, 0.1, 0), "real_pos": (-0.6, 0.1, 0), "axis": (0.2, 0.5, 1)}
    return svkc.load(TWO_BOXES, virtual_links=[svkc.VirtualLink("grip", "a", "b", joint, **where)])


def box_with_a_limb() -> svkc.Chain:
    """Return two free boxes without gravity, one with a cuttable limb.

    A disconnected weld is between the boxes. There is one spare slot.
    """
    limb = bar("limb", Y, "0.4 0 0", "0.1 0 0") + '</body><body name="b"'
    text = TWO_BOXES.replace("0.3 -0.2 -9.81", "0 0 0").replace('</body><body name="b"', limb)
    weld = svkc.VirtualLink("weld", "a", "b", "weld", real_pos=(-0.6, 0.1, 0))
    return svkc.load(text, virtual_links=[weld], cuttable="limb", spare=1)


def free_tree() -> svkc.Chain:
    """Return a random tree of eight bodies without gravity, whose root is a free body."""
    text = random_tree(8, seed=4, kinds=("free", "ball", "hinge"))
    first = re.compile(r'<body name="b1"([^>]*)>(<joint[^>]*/>)*')
    text = first.sub(r'<body name="b1"\1><freejoint/>', text, count=1)
    return svkc.load(text.replace('gravity="0.3 -0.2 -9.81"', 'gravity="0 0 0"'))
