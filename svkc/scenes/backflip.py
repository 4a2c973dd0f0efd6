"""A planar gymnast for a backflip in which the hands hold the shanks in flight.

The model is that of A. Farr, E. Charbonneau, M. Begon, P. Puchaud (2025), doi
10.5281/zenodo.14546204. Left and right limbs are merged into one body each. y points forward, z up,
and joints turn about x.
"""

from typing import Any

import numpy as np

from svkc.mjcf.load import load
from svkc.model.chain import Chain, State
from svkc.model.virtual_link import VirtualLink

# limits of both sides together (N m): 70 % of the largest torques
TORQUE_LIMITS = {
    joint: 0.7 * torque
    for joint, torque in (
        ("shoulder", 325.531),
        ("elbow", 138.0),
        ("hip", 981.1876),
        ("knee", 735.3286),
        ("ankle", 343.9806),
    )
}
TOE = (0.0, -0.05, -0.15)  # m, in the frame of the feet
JOINT = '<joint name="{0}" axis="1 0 0"/>'
# name, joint ("": fixed), parent; position y, z (m) and fixed rotation (rad) in the parent; mass
# (kg), centre of mass y, z (m), moment of inertia about x (kg m^2)
SEGMENTS = (
    ("thorax", "", "pelvis", (-0.0515404739, 0.1813885235, 0.0), (20.46, 0.0, 0.1767, 0.5204)),
    ("head", "", "thorax", (0.0435036145, 0.3479414452, 0.0), (5.12, 0.0, 0.0853, 0.0881)),
    ("upper_arms", "shoulder", "thorax", (0.023425367, 0.211508031, -1.5715679880691036),
     (4.72, 0.142699958, 0.000110116, 0.0377032548)),
    ("forearms", "elbow", "upper_arms", (0.33860196781, 0.0, 1.57),
     (2.52, -0.00067614, -0.12639819, 0.0130228857)),
    # after a rotation by -pi/2, the position is along the new y axis
    ("hands", "", "forearms", (0.0, -0.26587471154, 1.57 - np.pi / 2),
     (1.12, -0.00799285, -0.05143931, 0.00276486351)),
    ("thighs", "hip", "pelvis", (0.0, 0.0, 0.0), (18.98, 0.0, -0.2017, 0.3444)),
    ("shanks", "knee", "thighs", (0.0, -0.462839073, 0.0), (8.36, 0.0, -0.2026, 0.1702)),
    ("feet", "ankle", "shanks", (0.0, -0.427480971, np.pi / 2), (2.32, 0.0, -0.0757, 0.0178)),
)  # fmt: skip


def backflip(**options: Any) -> tuple[Chain, State]:
    """Return the chain of the gymnast, and its load pose as a state without connected links.

    The virtual link `toe` is a hinge between toe and ground, `tuck` a hinge between hands and
    shanks below the knees. Coordinates are pelvis_y, pelvis_z, pelvis (rotation), shoulder, elbow,
    hip, knee, ankle.

    options: keyword arguments of `svkc.load`.
    """
    links = [
        VirtualLink("toe", "world", "feet", "hinge", real_pos=TOE, axis=(1, 0, 0)),
        VirtualLink(
            "tuck", "shanks", "forearms", "hinge",
            pos=(0, 0.07, -0.1575), real_pos=(0, 0, -0.41), axis=(1, 0, 0),
        ),
    ]  # fmt: skip
    chain = load(_model(), virtual_links=links, **options)
    return chain, chain.state(connected=())


def _body(name: str, joint: str, place: tuple, inertia: tuple, inside: str) -> str:
    """Return the MJCF of a segment with its descendants, `inside`. Others: as in `SEGMENTS`."""
    y, z, turn = place
    mass, com_y, com_z, moment = inertia
    # moments of inertia about y and z have no effect; MuJoCo requires physically possible values
    return (
        f'<body name="{name}" pos="0 {y} {z}" euler="{turn} 0 0">'
        f"{JOINT.format(joint) * bool(joint)}"
        f'<inertial mass="{mass}" pos="0 {com_y} {com_z}" diaginertia="{moment} {moment} {moment}"'
        f"/>{inside}</body>"
    )


def _model() -> str:
    """Return the gymnast as MJCF."""

    def inside(parent: str) -> str:
        return "".join(
            _body(name, joint, place, inertia, inside(name))
            for name, joint, of, place, inertia in SEGMENTS
            if of == parent
        )

    return (
        '<mujoco><compiler angle="radian"/><worldbody><body name="pelvis" pos="0 0 0.8"'
        ' euler="-0.1 0 0"><joint name="pelvis_y" type="slide" axis="0 1 0"/><joint name="pelvis_z"'
        ' type="slide" axis="0 0 1"/><joint name="pelvis" axis="1 0 0"/><inertial mass="11.58"'
        f' pos="0 0 0.1044" diaginertia="0.0692 0.0692 0.0692"/>{inside("pelvis")}</body>'
        "</worldbody></mujoco>"
    )
