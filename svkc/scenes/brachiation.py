"""Brachiation: the 16-joint figure under three horizontal bars."""

from typing import Any

import numpy as np

from svkc import _deprecated
from svkc.mjcf.load import load
from svkc.model.chain import Chain, State
from svkc.scenes import figure

BAR_RADIUS = 0.02  # m: bars, and the rails that carry them
BAR_SPACING = 0.5  # m: distance between bars


def brachiation(**options: Any) -> tuple[Chain, State]:
    """Return the chain of the 16-joint figure under three bars, and its initial state.

    The bars lie along y, `BAR_SPACING` apart along x, at `figure.BAR_HEIGHT` above the ground.
    Two rails carry them. The virtual links "right_hand_bar1", "left_hand_bar2" and
    "right_hand_bar3" are hinges about the bars. Mobility is 17 with one hand on a bar, 12 with two.
    In the initial state the right hand holds the first bar, and the figure is at rest, rotated
    backwards by 0.9 rad about this bar.

    options: keyword arguments of `svkc.load`.
    """
    spec = figure.figure16()
    for bar in range(3):
        x = bar * BAR_SPACING
        ends = (x, -0.6, figure.BAR_HEIGHT), (x, 0.6, figure.BAR_HEIGHT)
        figure.add_rod(spec, *ends, radius=BAR_RADIUS, name=f"bar{bar + 1}")
    rail = figure.BAR_HEIGHT + 2 * BAR_RADIUS
    for y in (-0.6, 0.6):
        figure.add_rod(
            spec, (-BAR_SPACING / 2, y, rail), (2.5 * BAR_SPACING, y, rail), radius=BAR_RADIUS
        )
    hands = [
        figure.hand_on_bar(
            f"{side}_hand_bar{bar + 1}",
            side,
            x=bar * BAR_SPACING,
            y=sign * figure.HALF_SHOULDER_WIDTH,
            connected=bar == 0,
        )
        for bar, (side, sign) in enumerate((("right", -1), ("left", 1), ("right", -1)))
    ]
    chain = load(spec, virtual_links=hands, **options)
    return chain, hanging_state(chain, angle=0.9)


def hanging_state(chain: Chain, angle: float) -> State:
    """Return a state at rest in which the right hand holds the first bar.

    The left arm is half raised.

    chain: the chain of `brachiation`.
    angle: rotation of the figure about the bar (rad). Positive angles move the hips backwards.
    """
    q = {
        "base": figure.hanging_pose(figure.ARM_LENGTH, angle),
        "right_shoulder_flexion": np.pi - 0.1,
        "right_elbow": 0.1,
        "left_shoulder_flexion": 1.2,
        "left_elbow": 0.6,
    }
    for side in ("right", "left"):
        q |= {f"{side}_hip_flexion": 0.1, f"{side}_knee": 0.3, f"{side}_ankle": -0.5}
    return chain.state(q, hold=False)


def __getattr__(name: str) -> Any:
    """Return the object of a deprecated name, with a `DeprecationWarning`."""
    return _deprecated.resolve(f"scenes.brachiation.{name}")
