"""Brachiation: the 16-joint figure under three horizontal bars."""

import numpy as np

from svkc.mjcf.load import load
from svkc.model.chain import Chain, State
from svkc.scenes.figure import (
    ARM_LENGTH,
    BAR_HEIGHT,
    add_rod,
    figure16,
    hand_on_bar,
    hanging_base_pose,
)

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
    spec = figure16()
    for bar in range(3):
        x = bar * SPACING
        ends = (x, -0.6, BAR_HEIGHT), (x, 0.6, BAR_HEIGHT)
        add_rod(spec, *ends, radius=RADIUS, name=f"bar{bar + 1}")
    rail = BAR_HEIGHT + 2 * RADIUS
    for y in (-0.6, 0.6):
        add_rod(spec, (-SPACING / 2, y, rail), (2.5 * SPACING, y, rail), radius=RADIUS)
    hands = [
        hand_on_bar(f"{side}_hand_bar{bar + 1}", side, x=bar * SPACING, y=y, connected=bar == 0)
        for bar, (side, y) in enumerate((("right", -HAND), ("left", HAND), ("right", -HAND)))
    ]
    chain = load(spec, virtual_links=hands, **options)
    return chain, hanging_state(chain, angle=0.9)


def hanging_state(chain: Chain, angle: float) -> State:
    """Hanging from the first bar by the right hand, the whole figure turned back by `angle` (rad)
    about the bar, at rest, the left arm half way up."""
    q = {
        "base": hanging_base_pose(ARM_LENGTH, angle),
        "right_shoulder_flexion": np.pi - 0.1,
        "right_elbow": 0.1,
        "left_shoulder_flexion": 1.2,
        "left_elbow": 0.6,
    }
    for side in ("right", "left"):
        q |= {f"{side}_hip_flexion": 0.1, f"{side}_knee": 0.3, f"{side}_ankle": -0.5}
    return chain.state(q)
