"""A hopper in a vertical plane: a trunk that does not turn, on a four-bar leg with one motor."""

from typing import Any

import numpy as np

from svkc.mjcf.load import load
from svkc.model.annotations import Scalar
from svkc.model.chain import Chain
from svkc.model.virtual_link import VirtualLink

# m: distance of the two hinges at the trunk, and lengths of the bars and of the shank
BASE, BAR, SHANK = 0.08, 0.3, 0.4
FOOT = (0.0, 0.0, -SHANK)  # m, in the shank
MODEL = f"""<mujoco><worldbody><body name="trunk">
  <joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
  <geom type="box" size="0.12 0.06 0.05" mass="4"/>
  <body name="thigh"><joint name="hip" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0 0 {-BAR}" size="0.015" mass="0.4"/>
    <body name="shank" pos="0 0 {-BAR}"><joint name="knee" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 {-SHANK}" size="0.012" mass="0.3"/>
      <geom type="capsule" fromto="0 0 0 {BASE} 0 0" size="0.012" mass="0.05"/></body></body>
  <body name="rod" pos="{BASE} 0 0"><joint name="rod" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0 0 {-BAR}" size="0.008" mass="0.1"/></body>
</body></worldbody></mujoco>"""


def hopper() -> Chain:
    """Return the hopper, with the virtual links "four_bar" and "foot".

    The thigh and a rod of equal length hold the shank upright: "four_bar" closes this
    parallelogram, and is connected. "foot" is a ball joint between the ground and the foot.
    """
    four_bar = VirtualLink(
        "four_bar", parent="shank", real="rod", joint="hinge", pos=(BASE, 0, 0),
        real_pos=(0, 0, -BAR), axis=(0, 1, 0), connected=True,
    )  # fmt: skip
    foot = VirtualLink("foot", parent="world", real="shank", joint="ball", real_pos=FOOT)
    return load(MODEL, virtual_links=[four_bar, foot])


def stance(x: Scalar, angle: Scalar) -> dict[str, Any]:
    """Return the coordinates of a pose whose foot is on the ground.

    x: of the foot (m). angle: of the hip (rad), zero with the thigh vertical.
    """
    place = {"x": x + BAR * np.sin(angle), "z": SHANK + BAR * np.cos(angle)}
    return place | {"hip": angle, "knee": -angle, "rod": angle}
