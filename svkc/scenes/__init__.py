"""The scenes that ship: MJCF files and a few lines of Python each."""

import pathlib

import numpy as np

from svkc.mjcf.load import load
from svkc.model.chain import Chain, State
from svkc.model.virtual_link import VirtualLink

FOLDER = pathlib.Path(__file__).parent
BAR_HEIGHT, GRIP = 2.6, 0.30  # m: the bar above the ground; half the distance between the hands
PALM = 0.0681  # m: from the wrist to the palm's centre


def high_bar(**options) -> tuple[Chain, State]:
    """The high bar of the paper's Fig. 20: the 16-joint figure, a hinge about the bar at each hand,
    and a swing to start with.

    24 joint freedoms with both hands on the bar, 23 with one, 22 in flight. `options` go to
    `svkc.load`.
    """
    import mujoco

    spec = mujoco.MjSpec.from_file(str(FOLDER / "figure16.xml"))
    steel = {"contype": 0, "conaffinity": 0, "rgba": [0.6, 0.6, 0.65, 1]}
    capsule = mujoco.mjtGeom.mjGEOM_CAPSULE
    spec.worldbody.add_geom(
        name="bar",
        type=capsule,
        fromto=[0, -1.2, BAR_HEIGHT, 0, 1.2, BAR_HEIGHT],
        size=[0.014, 0, 0],
        **steel,
    )
    for y in (-1.2, 1.2):
        spec.worldbody.add_geom(
            type=capsule, fromto=[0, y, 0, 0, y, BAR_HEIGHT], size=[0.03, 0, 0], **steel
        )
    hands = [
        VirtualLink(
            f"{side}_hand_grip",
            "world",
            f"{side}_hand",
            joint="hinge",
            axis=(0, 1, 0),
            pos=(0, y, BAR_HEIGHT),
            real_pos=(0, 0, -PALM),
            real_quat=(1, 0, 0, 0),
            connected=True,
        )
        for side, y in (("right", -GRIP), ("left", GRIP))
    ]
    chain = load(spec, virtual_links=hands, **options)
    return chain, swinging(chain, angle=1.7)


def swinging(chain: Chain, angle: float) -> State:
    """Hanging from the bar by both hands, the whole figure turned by `angle` (rad) about the bar,
    at rest."""
    arm = 0.2817 + 0.2689
    spread = np.arcsin((GRIP - 0.18) / arm)
    below = arm * np.cos(spread) + PALM + 0.5155
    base = [
        -below * np.sin(angle),
        0,
        BAR_HEIGHT - below * np.cos(angle),
        np.cos(angle / 2),
        0,
        np.sin(angle / 2),
        0,
    ]
    q = {"base": base}
    for side in ("right", "left"):
        q |= {
            f"{side}_shoulder_flexion": np.pi - 0.1,
            f"{side}_shoulder_abduction": spread,
            f"{side}_wrist": -spread,
        }
        q |= {
            f"{side}_elbow": 0.1,
            f"{side}_knee": 0.1,
            f"{side}_hip_flexion": 0.1,
            f"{side}_ankle": -0.5,
        }
    return chain.state(q)
