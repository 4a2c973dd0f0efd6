"""Standing on flat ground: the paper's first example of a varying structure (section V-A)."""

from typing import Any

import jax.numpy as jnp
import mujoco
from jaxtyping import Array

from svkc import _deprecated
from svkc.mjcf.load import load
from svkc.model.annotations import Scalar
from svkc.model.chain import Chain, State
from svkc.model.virtual_link import VirtualLink
from svkc.scenes.figure import figure16

STRIDE = 0.33  # m: distance of the feet along x when both stand
HIP_HEIGHT = 0.906  # m: hips above the ground
HALF_HIP_WIDTH = 0.085  # m: half the distance between the hips, and between the feet
ANKLE_HEIGHT = 0.075  # m: ankle above the ground
SOLE_OFFSET = 0.04  # m: point of the sole that is welded to the ground, ahead of the ankle
THIGH_LENGTH, SHANK_LENGTH = 0.4222, 0.434  # m


def walking(**options: Any) -> tuple[Chain, State]:
    """Return the chain of the 16-joint figure on flat ground, and its initial state.

    The figure stands at rest, the right foot `STRIDE` behind the left one. A weld holds the sole of
    each foot to the ground ("right_foot_ground", "left_foot_ground"). There are 22 joint freedoms.
    Mobility is 11 with both feet on the ground (one row is redundant because the legs move in
    parallel planes), 16 with one foot, 22 with none. A weld carries forces and moments in every
    direction, so that feet neither slide nor tilt.

    options: keyword arguments of `svkc.load`.
    """
    spec = figure16()
    floor = {"pos": [1.55, 0, -0.02], "size": [2.35, 0.6, 0.02], "rgba": [0.75, 0.75, 0.78, 1]}
    spec.worldbody.add_geom(
        name="floor", type=mujoco.mjtGeom.mjGEOM_BOX, contype=0, conaffinity=0, **floor
    )
    feet = [
        VirtualLink(
            f"{side}_foot_ground",
            "world",
            f"{side}_foot",
            joint="weld",
            pos=(x, y, 0),
            real_pos=(SOLE_OFFSET, 0, -ANKLE_HEIGHT),
            real_quat=(1, 0, 0, 0),
            connected=True,
        )
        for side, x, y in (("left", 0, HALF_HIP_WIDTH), ("right", -STRIDE, -HALF_HIP_WIDTH))
    ]
    chain = load(spec, virtual_links=feet, **options)
    hips_x = -0.55 * STRIDE - SOLE_OFFSET
    q = {"base": [hips_x, 0, HIP_HEIGHT, 1, 0, 0, 0]}
    for link, shoulder_flexion in zip(feet, (-0.3, 0.3), strict=True):
        side = link.name.removesuffix("_foot_ground")
        q |= {f"{side}_shoulder_flexion": shoulder_flexion, f"{side}_elbow": 0.35}
        for joint, angle in leg_angles(
            link.pos[0] - SOLE_OFFSET - hips_x, HIP_HEIGHT - ANKLE_HEIGHT
        ).items():
            q[f"{side}_{joint}"] = float(angle)
    return chain, chain.state(q)


def leg_angles(forward: Scalar, down: Scalar) -> dict[str, Array]:
    """Return a leg's joint angles (rad) by name, for an upright trunk and a level foot.

    forward, down: position of the ankle relative to the hip (m). The leg is stretched towards a
        position out of reach.
    """
    squared_distance = forward * forward + down * down
    cos_knee = jnp.clip(
        (squared_distance - THIGH_LENGTH**2 - SHANK_LENGTH**2) / (2 * THIGH_LENGTH * SHANK_LENGTH),
        -0.9999,
        0.9999,
    )
    knee = jnp.arccos(cos_knee)
    hip = jnp.arctan2(forward, down) + jnp.arctan2(
        SHANK_LENGTH * jnp.sin(knee), THIGH_LENGTH + SHANK_LENGTH * cos_knee
    )
    return {"hip_flexion": hip, "knee": knee, "ankle": knee - hip}


def __getattr__(name: str) -> Any:
    """Return the object of a deprecated name, with a `DeprecationWarning`."""
    return _deprecated.resolve(f"scenes.walking.{name}")
