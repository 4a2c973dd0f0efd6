"""The example of the paper's section VII-A (Figs. 14 and 18): a free-flying chain of two links."""

from collections.abc import Sequence

from svkc.mjcf.load import load
from svkc.model.chain import Chain, State
from svkc.model.virtual_link import VirtualLink

_ROD = (
    '<geom type="capsule" fromto="0 0 0 0 1 0" size="0.03" mass="{}" contype="0" conaffinity="0"/>'
)
_MJCF = f"""<mujoco model="two_links"><option gravity="{{}}"/><worldbody><body name="base">
<freejoint name="base"/>{_ROD.format(1.0)}
  <body name="link1" pos="0 1 0"><joint name="link1" axis="0 0 1"/>{_ROD.format(0.6)}</body></body>
  </worldbody></mujoco>"""


def two_links(
    gravity: Sequence[float | int] = (0.0, -9.81, 0.0), connected: bool = True
) -> tuple[Chain, State]:
    """Return a free-flying chain of two links, and its state at rest in the pose of Fig. 14.

    Link 1 is on a hinge about z, one metre along y from the free base. Virtual Link 1v, one metre
    further along y, is a hinge about z to the ground. theta_1..6 are the base's coordinates,
    theta_7 is that of Link 1, and theta_8 that of Link 1v, positive about -z as in the paper's J_C
    (45).

    gravity: acceleration of gravity (m/s^2).
    connected: whether Link 1v is connected.
    """
    end = VirtualLink(
        "link1v",
        "link1",
        "world",
        "hinge",
        pos=(0, 1, 0),
        axis=(0, 0, -1),
        real_pos=(0, 2, 0),
        real_quat=(1, 0, 0, 0),
        connected=connected,
        actuated=True,
    )
    chain = load(_MJCF.format(" ".join(map(str, gravity))), virtual_links=[end])
    return chain, chain.state()
