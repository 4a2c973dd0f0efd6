"""Parts that several scenes use: the 16-joint figure, rods, hands on bars, the hanging pose."""

import pathlib
from collections.abc import Sequence

import numpy as np

from svkc.model.annotations import MuJoCo
from svkc.model.virtual_link import VirtualLink

FOLDER = pathlib.Path(__file__).parent
BAR_HEIGHT = 2.6  # m: bars above the ground
HALF_SHOULDER_WIDTH = 0.18  # m: half the distance between the shoulders
SHOULDER_ABOVE_HIPS = 0.5155  # m: the shoulders above the hips
ARM_LENGTH = 0.2817 + 0.2689  # m: from the shoulder to the wrist
PALM = 0.0681  # m: from the wrist to the palm's center


def figure16() -> MuJoCo:
    """Return the model of the 16-joint figure, a `mujoco.MjSpec`."""
    import mujoco

    return mujoco.MjSpec.from_file(str(FOLDER / "figure16.xml"))


def add_rod(
    spec: MuJoCo,
    start: Sequence[float | int],
    end: Sequence[float | int],
    radius: float,
    name: str = "",
) -> None:
    """Add a rod between two points of the ground frame (m) to a `mujoco.MjSpec`.

    radius: m.
    """
    import mujoco

    spec.worldbody.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=[*start, *end],
        size=[radius, 0, 0],
        contype=0,
        conaffinity=0,
        rgba=[0.6, 0.6, 0.65, 1],
    )


def hand_on_bar(name: str, side: str, *, x: float, y: float, connected: bool) -> VirtualLink:
    """Return a virtual link by which a palm holds a bar along y: a hinge about the bar.

    name: name of the virtual link.
    side: "right" or "left".
    x, y: position of the palm (m). Its height is `BAR_HEIGHT`.
    connected: whether the link is connected in the initial state.
    """
    return VirtualLink(
        name,
        "world",
        f"{side}_hand",
        joint="hinge",
        axis=(0, 1, 0),
        pos=(x, y, BAR_HEIGHT),
        real_pos=(0, 0, -PALM),
        real_quat=(1, 0, 0, 0),
        connected=connected,
    )


def hanging_pose(arm: float, angle: float) -> list[float]:
    """Return position (m) and quaternion of the base for a figure that hangs from a bar.

    The bar is along y, at `BAR_HEIGHT` above the origin.

    arm: vertical distance from wrists to shoulders at angle zero (m).
    angle: rotation of the figure about the bar (rad). Positive angles move the hips backwards.
    """
    distance = arm + PALM + SHOULDER_ABOVE_HIPS
    quaternion = [np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0]
    return [-distance * np.sin(angle), 0.0, BAR_HEIGHT - distance * np.cos(angle), *quaternion]
