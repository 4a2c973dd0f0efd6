"""The high bar of the paper's Fig. 20."""

from typing import Any

import numpy as np

from svkc.mjcf.load import load
from svkc.model.chain import Chain, State
from svkc.scenes.figure import (
    ARM_LENGTH,
    BAR_HEIGHT,
    HALF_SHOULDER_WIDTH,
    add_rod,
    figure16,
    hand_on_bar,
    hanging_pose,
)

HALF_GRIP_WIDTH = 0.30  # m: half the distance between the hands


def high_bar(**options: Any) -> tuple[Chain, State]:
    """Return the chain of the high bar of the paper's Fig. 20, and its initial state.

    The 16-joint figure holds the bar with both hands. Each hand has a hinge about the bar (virtual
    links "right_hand_grip", "left_hand_grip"). There are 24 joint freedoms with both hands on the
    bar, 23 with one, 22 in flight. The initial state is at rest, rotated backwards by 1.7 rad about
    the bar.

    options: keyword arguments of `svkc.load`.
    """
    spec = figure16()
    add_rod(spec, (0, -1.2, BAR_HEIGHT), (0, 1.2, BAR_HEIGHT), radius=0.014, name="bar")
    for y in (-1.2, 1.2):
        add_rod(spec, (0, y, 0), (0, y, BAR_HEIGHT), radius=0.03)
    hands = [
        hand_on_bar(f"{side}_hand_grip", side, x=0.0, y=y, connected=True)
        for side, y in (("right", -HALF_GRIP_WIDTH), ("left", HALF_GRIP_WIDTH))
    ]
    chain = load(spec, virtual_links=hands, **options)
    return chain, hanging_state(chain, angle=1.7)


def hanging_state(chain: Chain, angle: float) -> State:
    """Return a state at rest in which both hands hold the bar.

    chain: the chain of `high_bar`.
    angle: rotation of the figure about the bar (rad). Positive angles move the hips backwards.
    """
    base, joints = stretched_pose(angle)
    return chain.state({"base": base, **joints}, hold=False)


def stretched_pose(angle: float) -> tuple[list[float], dict[str, Any]]:
    """Return position (m) and quaternion of the base, and the joint angles, of `hanging_state`.

    angle: as of `hanging_state`.
    """
    abduction = np.arcsin((HALF_GRIP_WIDTH - HALF_SHOULDER_WIDTH) / ARM_LENGTH)
    joints = {}
    for side in ("right", "left"):
        joints |= {
            f"{side}_shoulder_flexion": np.pi - 0.1,
            f"{side}_shoulder_abduction": abduction,
            f"{side}_wrist": -abduction,
            f"{side}_elbow": 0.1,
            f"{side}_knee": 0.1,
            f"{side}_hip_flexion": 0.1,
            f"{side}_ankle": -0.5,
        }
    return hanging_pose(ARM_LENGTH * np.cos(abduction), angle), joints
