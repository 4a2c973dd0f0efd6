"""The swing of the paper's Fig. 21."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from svkc import _deprecated
from svkc.mjcf.load import load
from svkc.model.annotations import MuJoCo
from svkc.model.chain import Chain, State
from svkc.model.virtual_link import VirtualLink
from svkc.scenes.figure import PALM, figure16
from svkc.transitions.events import When, when
from svkc.transitions.guards import touch

PIVOT_HEIGHT = 3.2  # m: pivot above the ground
ROD_LENGTH = 2.0  # m: plate below the pivot
HALF_WIDTH = 0.33  # m: half the distance between the rods
PLATE_EDGE = 0.2  # m: half the depth of the plate
HANDS_BELOW_PIVOT = 1.3  # m: hands below the pivot, along the rods
THIGH_ABOVE_PLATE = 0.07  # m: axis of a thigh above the plate


def swing(angle: float = 0.6, **options: Any) -> tuple[Chain, State]:
    """Return the chain of the 16-joint figure on a swing, and its initial state, at rest.

    Each hand holds a rod by a ball joint. Each thigh is on the plate by a slide. There are 31 joint
    freedoms: 22 of the figure, 6 of the hands, 2 of the slides, and the swing's pivot. The seat is
    lost as the slides are cut, which leaves 29.

    angle: rotation of the swing about its pivot (rad).
    options: keyword arguments of `svkc.load`.
    """
    spec, links = model_and_links()
    chain = load(spec, virtual_links=links, **options)
    return chain, _sitting_state(chain, angle)


def model_and_links() -> tuple[MuJoCo, list[VirtualLink]]:
    """Return the swing and the figure as a `mujoco.MjSpec`, and the virtual links between them."""
    import mujoco

    spec = figure16()
    appearance = {"contype": 0, "conaffinity": 0, "rgba": [0.55, 0.4, 0.3, 1]}
    capsule, box = mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_BOX
    body = spec.worldbody.add_body(name="swing", pos=[0, 0, PIVOT_HEIGHT])
    body.add_joint(name="pivot", axis=[0, 1, 0])
    for y in (-HALF_WIDTH, HALF_WIDTH):
        body.add_geom(
            type=capsule,
            fromto=[0, y, 0, 0, y, -ROD_LENGTH],
            size=[0.012, 0, 0],
            mass=2.0,
            **appearance,
        )
    body.add_geom(
        name="plate",
        type=box,
        pos=[0, 0, -ROD_LENGTH - 0.01],
        size=[PLATE_EDGE, HALF_WIDTH, 0.01],
        mass=3.0,
        **appearance,
    )
    spec.worldbody.add_geom(
        type=capsule,
        fromto=[0, -0.6, PIVOT_HEIGHT, 0, 0.6, PIVOT_HEIGHT],
        size=[0.03, 0, 0],
        **appearance,
    )
    return spec, _links()


def _links() -> list[VirtualLink]:
    """Return the virtual links of hands and thighs."""
    cos_45 = np.sqrt(0.5)
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
        # the thigh of the sitting figure points forward, so that its x axis points up
        thigh = VirtualLink(
            f"{side}_thigh_plate",
            "swing",
            f"{side}_thigh",
            "slide",
            axis=(1, 0, 0),
            pos=(0, y * 0.085, -ROD_LENGTH),
            real_pos=(-THIGH_ABOVE_PLATE, 0, -0.2),
            real_quat=(cos_45, 0, cos_45, 0),
            connected=True,
        )
        links += [hand, thigh]
    return links


def seat_events(chain: Chain) -> list[When]:
    """Return events that cut each thigh's slide as the thigh passes an edge of the plate.

    chain: the chain of `swing`.
    """

    def distance_beyond_edge(link):
        slide_position = touch(chain, link, 0.0, axes="z")  # z is the axis of the slide
        return lambda t, state, args: jnp.abs(slide_position(t, state)) - PLATE_EDGE

    return [
        when(distance_beyond_edge(link), cut=link, direction=True)
        for link in ("right_thigh_plate", "left_thigh_plate")
    ]


def _sitting_state(chain: Chain, angle: float) -> State:
    """Return the state with thighs along the plate, a leaning trunk, and hands on the rods."""
    c, s = np.cos(angle), np.sin(angle)
    hips = np.array([-0.28, THIGH_ABOVE_PLATE - ROD_LENGTH])
    position = [c * hips[0] + s * hips[1], 0, PIVOT_HEIGHT - s * hips[0] + c * hips[1]]
    lean = 0.35  # rad
    pitch = (angle - lean) / 2
    seat = {"pivot": angle, "base": [*position, np.cos(pitch), 0, np.sin(pitch), 0]}
    arms = {}
    for side in ("right", "left"):
        seat |= {f"{side}_hip_flexion": np.pi / 2 - lean, f"{side}_knee": np.pi / 2}
        arms |= {
            f"{side}_shoulder_flexion": 0.9,
            f"{side}_shoulder_abduction": 0.4,
            f"{side}_elbow": 1.1,
        }
    # the arms are not named, so that closing the hands' loops moves them
    open_state = chain.state(seat | arms, connected=())
    return chain.state(seat, connected=chain.link_names, near=open_state)


def __getattr__(name: str) -> Any:
    """Return the object of a deprecated name, with a `DeprecationWarning`."""
    return _deprecated.resolve(f"scenes.swing.{name}")
