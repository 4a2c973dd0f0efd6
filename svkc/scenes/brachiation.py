"""Brachiation: the 16-joint figure under three horizontal bars."""

import numpy as np

from svkc.mjcf.load import load
from svkc.model.chain import Chain, State
from svkc.model.virtual_link import VirtualLink
from svkc.scenes import BAR_HEIGHT, FOLDER, PALM

RADIUS = 0.02  # m: of bars and of the rails that carry them
SPACING = 0.5  # m: from bar to bar
HAND = 0.18  # m: from the middle to each hand, along the bars; half the shoulders' width


def brachiation(**options) -> tuple[Chain, State]:
    """The 16-joint figure under three bars, hanging from the first by its right hand, swung back
    and at rest.

    Bars along y under two rails, `SPACING` apart along x, `BAR_HEIGHT` above the ground. Virtual
    links "right_hand_bar1" (holds),
    "left_hand_bar2", "right_hand_bar3": hinges about the bars. Mobility 17 with one hand on a bar,
    12 with two. `options` go to `svkc.load`.
    """
    import mujoco

    spec = mujoco.MjSpec.from_file(str(FOLDER / "figure16.xml"))
    steel = {"contype": 0, "conaffinity": 0, "rgba": [0.6, 0.6, 0.65, 1]}
    capsule = mujoco.mjtGeom.mjGEOM_CAPSULE
    for bar in range(3):
        x = bar * SPACING
        spec.worldbody.add_geom(
            name=f"bar{bar + 1}",
            type=capsule,
            fromto=[x, -0.6, BAR_HEIGHT, x, 0.6, BAR_HEIGHT],
            size=[RADIUS, 0, 0],
            **steel,
        )
    rail = BAR_HEIGHT + 2 * RADIUS
    for y in (-0.6, 0.6):
        spec.worldbody.add_geom(
            type=capsule,
            fromto=[-SPACING / 2, y, rail, 2.5 * SPACING, y, rail],
            size=[RADIUS, 0, 0],
            **steel,
        )
    hands = [
        VirtualLink(
            f"{side}_hand_bar{bar + 1}",
            "world",
            f"{side}_hand",
            joint="hinge",
            axis=(0, 1, 0),
            pos=(bar * SPACING, y, BAR_HEIGHT),
            real_pos=(0, 0, -PALM),
            real_quat=(1, 0, 0, 0),
            connected=bar == 0,
        )
        for bar, (side, y) in enumerate((("right", -HAND), ("left", HAND), ("right", -HAND)))
    ]
    chain = load(spec, virtual_links=hands, **options)
    return chain, swung_back(chain, angle=0.9)


def swung_back(chain: Chain, angle: float) -> State:
    """Hanging from the first bar by the right hand, the whole figure turned back by `angle` (rad)
    about the bar, at rest, the left arm half way up."""
    below = 0.2817 + 0.2689 + PALM + 0.5155
    base = [
        -below * np.sin(angle),
        0,
        BAR_HEIGHT - below * np.cos(angle),
        np.cos(angle / 2),
        0,
        np.sin(angle / 2),
        0,
    ]
    q = {
        "base": base,
        "right_shoulder_flexion": np.pi - 0.1,
        "right_elbow": 0.1,
        "left_shoulder_flexion": 1.2,
        "left_elbow": 0.6,
    }
    for side in ("right", "left"):
        q |= {f"{side}_hip_flexion": 0.1, f"{side}_knee": 0.3, f"{side}_ankle": -0.5}
    return chain.state(q)
