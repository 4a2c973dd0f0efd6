"""Walking on flat ground: the paper's first example of a varying structure (section V-A)."""

from typing import Any

import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Float

from svkc import _deprecated
from svkc.mjcf.load import load
from svkc.model.annotations import Scalar
from svkc.model.chain import Chain, State, Structure
from svkc.model.virtual_link import VirtualLink
from svkc.scenes.figure import figure16

STRIDE = 0.33  # m: distance of the feet along x when both stand
HIP_HEIGHT = 0.906  # m: hips above the ground
HALF_HIP_WIDTH = 0.085  # m: half the distance between the hips, and between the feet
ANKLE_HEIGHT = 0.075  # m: ankle above the ground
SOLE_OFFSET = 0.04  # m: point of the sole that is welded to the ground, ahead of the ankle
THIGH_LENGTH, SHANK_LENGTH = 0.4222, 0.434  # m
# the gait: number of steps; duration of a step (s); fraction of a step on both feet;
# duration of the acceleration at the start and of the deceleration at the end (s); its end (s)
STEPS, PERIOD, DOUBLE_SUPPORT, RAMP = 5, 0.65, 0.12, 0.6
GAIT_END = RAMP + (STEPS + DOUBLE_SUPPORT / 2) * PERIOD


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


def steps_done(t: Scalar) -> Float[Array, ""]:
    """Return the planned number of steps at time t (s). The right foot lands first, at 1."""
    starting, stopping = jnp.minimum(t, RAMP), jnp.minimum(GAIT_END - t, RAMP)
    ramps = (starting**2 - stopping**2 + RAMP**2) / (2 * RAMP * PERIOD)
    return ramps + (jnp.clip(t, RAMP, GAIT_END - RAMP) - RAMP) / PERIOD


def planned_angles(chain: Chain, t: Scalar, structure: Structure) -> dict[str, Array]:
    """Return the planned angles (rad) of arms and legs by joint name, of which others stay at zero.

    The hips stay at one height, and are slightly slower above the supporting foot. Supporting feet
    do not move.

    chain: the chain of `walking`.
    t: time (s).
    structure: tells which feet are on the ground, and where.
    """
    steps, hip_steps = steps_done(t), steps_done(t) - (1 + DOUBLE_SUPPORT) / 2
    hips = STRIDE * hip_steps - 0.007 * jnp.sin(2 * jnp.pi * hip_steps) - SOLE_OFFSET
    swing, joints = 0.3 * jnp.cos(jnp.pi * (steps - DOUBLE_SUPPORT / 2)), {}
    for side, odd in (("right", 0), ("left", 1)):
        link = chain.link_names.index(f"{side}_foot_ground")
        lift_off_x, supports = structure.pos[link, 0], structure.connected[link]
        step = 2 * jnp.round((hip_steps - odd) / 2) + odd
        swing_time = jnp.clip((steps - step - DOUBLE_SUPPORT) / (1 - DOUBLE_SUPPORT), 0, 1.2)
        phase = jnp.minimum(swing_time, 1)
        progress = phase**3 * (10 - 15 * phase + 6 * phase**2)
        foot_x = lift_off_x + ((step + 1) * STRIDE - lift_off_x) * progress
        # the plan continues below the ground, so that the foot touches down with some speed
        foot_height = 0.6 * swing_time**2 * (1 - swing_time) * (1.15 - swing_time)
        angles = leg_angles(
            jnp.where(supports, lift_off_x, foot_x) - SOLE_OFFSET - hips,
            HIP_HEIGHT - ANKLE_HEIGHT - jnp.where(supports, 0, foot_height),
        )
        # toes point down in the middle of a step
        angles["ankle"] -= jnp.where(supports, 0, 6 * phase**2 * (1 - phase) ** 2)
        angles |= {"shoulder_flexion": -swing if odd else swing, "elbow": jnp.asarray(0.35)}
        joints |= {f"{side}_{name}": angle for name, angle in angles.items()}
    return joints


def __getattr__(name: str) -> Any:
    """Return the object of a deprecated name, with a `DeprecationWarning`."""
    return _deprecated.resolve(f"scenes.walking.{name}")
