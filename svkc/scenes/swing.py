"""The swing of the paper's Fig. 21."""

import jax.numpy as jnp
import numpy as np

from svkc.mjcf.load import load
from svkc.model.chain import Chain, State
from svkc.model.virtual_link import VirtualLink
from svkc.scenes.figure import PALM, figure16
from svkc.transitions.events import When, when
from svkc.transitions.guards import touch

# m: pivot above the ground, plate under it; half the distance of the rods; half the depth of the
# plate
PIVOT_HEIGHT, ROD_LENGTH, HALF_WIDTH, PLATE_EDGE = 3.2, 2.0, 0.33, 0.2
HANDS_BELOW_PIVOT, THIGH_ABOVE_PLATE = (
    1.3,
    0.07,
)  # m: hands under the pivot; thigh's axis above the plate


def swing(angle: float = 0.6, **options) -> tuple[Chain, State]:
    """The 16-joint figure sits on a swing: a ball joint between each hand and its rod, a slide
    along the plate at each thigh.

    30 joint freedoms and the swing's own one; the seat gives way where a slide is cut, as when a
    thigh has passed the plate's edge: two fewer after both have. State: at rest, the swing turned
    by `angle` (rad) about its pivot. `options` go to `svkc.load`.
    """
    spec, links = model_and_links()
    chain = load(spec, virtual_links=links, **options)
    return chain, _sitting(chain, angle)


def model_and_links():
    """The model, an `mujoco.MjSpec`, and its virtual links."""
    import mujoco

    spec = figure16()
    look = {"contype": 0, "conaffinity": 0, "rgba": [0.55, 0.4, 0.3, 1]}
    capsule, box = mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_BOX
    body = spec.worldbody.add_body(name="swing", pos=[0, 0, PIVOT_HEIGHT])
    body.add_joint(name="pivot", axis=[0, 1, 0])
    for y in (-HALF_WIDTH, HALF_WIDTH):
        body.add_geom(
            type=capsule, fromto=[0, y, 0, 0, y, -ROD_LENGTH], size=[0.012, 0, 0], mass=2.0, **look
        )
    body.add_geom(
        name="plate",
        type=box,
        pos=[0, 0, -ROD_LENGTH - 0.01],
        size=[PLATE_EDGE, HALF_WIDTH, 0.01],
        mass=3.0,
        **look,
    )
    spec.worldbody.add_geom(
        type=capsule,
        fromto=[0, -0.6, PIVOT_HEIGHT, 0, 0.6, PIVOT_HEIGHT],
        size=[0.03, 0, 0],
        **look,
    )
    quarter = np.sqrt(0.5)
    links = []
    for side, y in (("right", -1), ("left", 1)):
        hand = VirtualLink(
            f"{side}_hand_rod",
            "swing",
            f"{side}_hand",
            "ball",
            pos=(0, y * HALF_WIDTH, -HANDS_BELOW_PIVOT),
            real_pos=(0, 0, -PALM),
            connected=True,
        )
        # sitting, the thigh points forward: its own x axis is up
        thigh = VirtualLink(
            f"{side}_thigh_plate",
            "swing",
            f"{side}_thigh",
            "slide",
            axis=(1, 0, 0),
            pos=(0, y * 0.085, -ROD_LENGTH),
            real_pos=(-THIGH_ABOVE_PLATE, 0, -0.2),
            real_quat=(quarter, 0, quarter, 0),
            connected=True,
        )
        links += [hand, thigh]
    return spec, links


def seat_events(chain: Chain) -> list[When]:
    """The seat gives way: each thigh's slide is cut as the thigh passes the front or the back edge
    of the plate."""

    def beyond(link):
        along = touch(chain, link, 0.0, axes="z")  # the slide's own axis
        return lambda t, state, args: jnp.abs(along(t, state)) - PLATE_EDGE

    return [
        when(beyond(link), cut=link, direction=True)
        for link in ("right_thigh_plate", "left_thigh_plate")
    ]


def _sitting(chain: Chain, angle: float) -> State:
    """Thighs along the plate, trunk upright, hands on the rods."""
    c, s = np.cos(angle), np.sin(angle)
    hips = np.array([-0.17, THIGH_ABOVE_PLATE - ROD_LENGTH])
    place = [c * hips[0] + s * hips[1], 0, PIVOT_HEIGHT - s * hips[0] + c * hips[1]]
    q = {"pivot": angle, "base": [*place, np.cos(angle / 2), 0, np.sin(angle / 2), 0]}
    for side in ("right", "left"):
        q |= {
            f"{side}_hip_flexion": np.pi / 2,
            f"{side}_knee": np.pi / 2,
            f"{side}_shoulder_flexion": 0.7,
        }
        q |= {f"{side}_shoulder_abduction": 0.4, f"{side}_elbow": 1.0}
    # the joints named first are what the hands' loops move, so only the seat is held to what is
    # said
    seated = chain.state(
        {k: x for k, x in q.items() if "shoulder" not in k and "elbow" not in k}, connected=()
    )
    full = np.array(seated.q[: chain.nq])
    for name in ("shoulder_flexion", "shoulder_abduction", "elbow"):
        for side in ("right", "left"):
            full[
                chain.topology.q_start[
                    chain.topology.joint_row[chain.joint_names.index(f"{side}_{name}")]
                ]
            ] = q[f"{side}_{name}"]
    return chain.state(full)
