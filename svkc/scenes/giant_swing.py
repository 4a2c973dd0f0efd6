"""A giant swing on the high bar: the 16-joint figure, with slides and hinges as its base."""

from typing import Any

import numpy as np

from svkc.mjcf.load import load
from svkc.model.annotations import Scalar
from svkc.model.chain import Chain
from svkc.scenes.figure import BAR_HEIGHT, add_rod, figure16, hand_on_bar
from svkc.scenes.high_bar import HALF_GRIP_WIDTH, stretched_pose

SIDES = ("right", "left")
# bounds (degrees) and largest torque (N m) of the joints of each side
JOINTS: dict[str, tuple[float, float, float]] = {
    "shoulder_flexion": (-60, 190, 150), "shoulder_abduction": (-20, 180, 100),
    "elbow": (0, 150, 80), "wrist": (-40, 40, 30), "hip_flexion": (-40, 120, 150),
    "hip_abduction": (-30, 45, 100), "knee": (0, 135, 100), "ankle": (-60, 20, 40),
}  # fmt: skip


def giant_swing() -> Chain:
    """Return the figure, with the virtual links "right_hand_grip" and "left_hand_grip".

    Each hand holds the bar by a hinge, as in `svkc.scenes.high_bar`. Three slides and three hinges
    take the place of the free joint: "x", "y", "z", "pitch", "roll", "yaw". The pitch angle is not
    wrapped at 2 pi. Chains of hinges and slides are optimized much faster, because their
    derivatives have closed forms. The joints have no limits, whose torques are stiff: bounds of
    the problem replace them.
    """
    import mujoco

    spec = figure16()
    torso = spec.body("torso")
    spec.delete(spec.joint("base"))
    torso.pos = np.zeros(3)
    kinds = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
    axes = {"x": 0, "y": 1, "z": 2, "pitch": 1, "roll": 0, "yaw": 2}
    for k, (name, axis) in enumerate(axes.items()):
        torso.add_joint(name=name, type=kinds[k // 3], axis=np.eye(3)[axis])
    for joint in spec.joints:
        joint.limited = mujoco.mjtLimited.mjLIMITED_FALSE
    add_rod(spec, (0, -1.2, BAR_HEIGHT), (0, 1.2, BAR_HEIGHT), radius=0.014, name="bar")
    hands = [
        hand_on_bar(f"{side}_hand_grip", side, x=0.0, y=y, connected=True)
        for side, y in zip(SIDES, (-HALF_GRIP_WIDTH, HALF_GRIP_WIDTH), strict=True)
    ]
    return load(spec, virtual_links=hands)


def hanging(angle: Scalar) -> dict[str, Any]:
    """Return the coordinates of a stretched pose in which both hands hold the bar.

    angle: rotation of the figure about the bar (rad): 0 hangs, pi is a handstand.
    """
    base, joints = stretched_pose(float(angle))
    return {"x": base[0], "z": base[2], "pitch": angle, **joints}
