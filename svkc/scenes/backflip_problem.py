"""The backflip as a problem of motion optimization. In the third of five phases a loop is closed.

After A. Farr, E. Charbonneau, M. Begon, P. Puchaud (2025), slightly simplified. Phases, bounds of
coordinates and costs are those of that work.
"""

from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import jax.numpy as jnp
import numpy as np

from svkc import optimize
from svkc.model.annotations import Scalar
from svkc.model.chain import Chain
from svkc.optimize.phases import Between
from svkc.scenes.backflip import TOE, TORQUE_LIMITS
from svkc.tree.points import center_of_mass, point_position

# bounds of the coordinates (rad, m)
RANGES: dict[str, tuple[float, float]] = {
    "pelvis_y": (-1, 1), "pelvis_z": (-1, 2), "shoulder": (-0.7, 3.1), "elbow": (0, 2.09),
    "hip": (-0.4, 2.6), "knee": (-2.3, 0.02), "ankle": (-0.7, 0.7),
}  # fmt: skip
# a function g of a point with g >= 0, or (g, lower, upper)
PathConstraint: TypeAlias = (
    Callable[[optimize.Point], Any] | tuple[Callable[[optimize.Point], Any], float, float]
)
LARGEST_RATE = 31.42  # rad/s, m/s: bound of all velocities
START = {"pelvis": -0.3274, "shoulder": 0.2999, "elbow": 0.4935, "hip": 1.7082, "knee": -1.9999}
TUCK_START = [0.135, 0.455, 1.285, 0.481, 1.818, 2.6, -1.658, 0.692]
TUCK_END = [0.107, 0.797, 2.892, 0.216, 1.954, 2.599, -2.058, 0.224]
LANDING_START: list[float] = [0.013, 0.088, 5.804, -0.305, 0, 1.014, -0.97, 0.006]
END = [0.053, 0.091, 6.08, 2.9, -0.17, 0.092, 0.17, 0.20]
PLACE = 0.1  # m: largest horizontal distance of the toe from the origin
FRICTION = 0.5


def _toe(p: optimize.Point) -> Any:
    """Return the position of the toe (m)."""
    return point_position(p.chain, p.state, "feet", TOE)


def _toe_on_ground(p: optimize.Point) -> Any:
    """Return the height of the toe (m)."""
    return _toe(p)[2]


def _toe_forward(p: optimize.Point) -> Any:
    """Return the horizontal coordinate of the toe (m)."""
    return _toe(p)[1]


def _above(place: tuple[Scalar, Scalar, Scalar]) -> Any:
    """Return the function of a point that says how far (m) the centre of mass is in front of a
    place in the frame of the feet."""

    def in_front_of(p):
        point = point_position(p.chain, p.state, "feet", place)
        return center_of_mass(p.chain, p.state).position[1] - point[1]

    return in_front_of


def _friction_cone(p: optimize.Point) -> Any:
    """Return two numbers that are not negative where the ground's force is in the friction cone."""
    _, tangential, normal = p.forces("toe")
    return jnp.stack([FRICTION * normal - tangential, FRICTION * normal + tangential])


def _pull(p: optimize.Point) -> Any:
    """Return two numbers that are not negative where the hands pull the shanks.

    The force acts on the hands. Its forward component must be at least the magnitude of the other.
    """
    _, forward, along = p.forces("tuck")
    return jnp.stack([forward - along, forward + along])


GROUND: list[PathConstraint] = [_friction_cone, (lambda p: p.forces("toe")[2], 0.01, np.inf)]
TUCK_RANGES = [optimize.between("hip", 1.96, 2.6), optimize.between("knee", -2.3, -1.5)]
TUCKED: list[PathConstraint] = [_pull, (lambda p: p.forces("tuck")[1], 0.1, np.inf)]


def _take_off(p: optimize.Point) -> Any:
    """Return the cost at take-off, which rewards vertical velocity of the centre of mass."""
    return 1000 * p.duration - center_of_mass(p.chain, p.state).velocity[2] ** 2


def _running(p: optimize.Point) -> Any:
    """Return the running cost of torque rates and torques."""
    # torques as fractions of the largest torques
    shares = [0.7 * p.torque(joint) / limit for joint, limit in TORQUE_LIMITS.items()]
    return jnp.sum(p.u**2) + 1e4 * sum(share**2 for share in shares)


def _final(p: optimize.Point) -> Any:
    """Return the cost at the end of the motion, which penalizes velocities and imbalance."""
    position, velocity, _ = center_of_mass(p.chain, p.state)
    rates = p.state.v[: p.chain.nv]
    return 100 * (rates @ rates + velocity @ velocity + position[1] ** 2)


def _around(pose: Mapping[str, Scalar], distance: Scalar) -> list[Between]:
    """Return bounds that keep coordinates within a distance (rad, m) of a pose."""
    return [optimize.between(j, x - distance, x + distance) for j, x in pose.items()]


def _turn(lower: Scalar, upper: Scalar) -> list[Between]:
    """Return bounds on the rotation of the pelvis. lower, upper: in half turns."""
    return [optimize.between("pelvis", lower * np.pi, upper * np.pi)]


def _phases(chain: Chain, project: bool) -> list[optimize.Phase]:
    """Return the phases. project: whether nodes are projected onto their loops."""
    between, by_time = optimize.between, lambda cost: lambda p: cost * p.duration
    rest = between(chain.joint_names, 0, 0, of="velocity")
    on_ground, in_place = (_toe_on_ground, 0, 0), (_toe_forward, -PLACE, PLACE)
    start = [
        rest, *_around(START, 0.3), between("knee", -2, -0.7), between("pelvis", -np.pi, 0.5),
        between("hip", -0.4, 2), on_ground, in_place, (_above((0.0, -0.03, -0.15)), 0, 0),
    ]  # fmt: skip
    touch = [
        between("hip", 0.014, 1.514), between("knee", -1.97, -0.87), on_ground, in_place,
        lambda p: p.impulse("toe")[2],
    ]  # fmt: skip
    end = [
        *_around(dict(zip(chain.joint_names, END, strict=True)), 0.2),
        between("elbow", 0, np.pi / 2), between("hip", 0, 2.9), between("knee", 0, 1),
        (_above(TOE), 0, 0),
    ]  # fmt: skip
    # the projection keeps the toe where it landed
    end += [] if project else [on_ground, in_place]
    return [
        optimize.Phase("push", "toe", duration=(0.1, 0.4), intervals=20,
                       bounds=_turn(-1, 1), path=GROUND,
                       here=True, start=start, final=_take_off,
                       end=[(lambda p: p.forces("toe")[1:], 0.01, 50)]),
        optimize.Phase("flight", (), duration=(0.1, 0.3), intervals=20,
                       bounds=_turn(-1, 1.5), final=by_time(10),
                       continuous_torques=False),
        optimize.Phase("tuck", "tuck", duration=(0.1, 0.4), intervals=30,
                       path=TUCKED, impact=False,
                       bounds=[*_turn(-1, 2), *TUCK_RANGES],
                       end=_turn(0.75, 1.5), final=by_time(-10)),
        optimize.Phase("open", (), duration=(0.1, 0.3), intervals=30,
                       bounds=_turn(0.75, 2 + 0.5 / np.pi),
                       final=by_time(10)),
        optimize.Phase("landing", "toe", duration=(0.2, 1.0), intervals=30,
                       bounds=_turn(0.5, 2 + 1.66 / np.pi),
                       path=GROUND, here=True, start=touch, end=end, final=by_time(100)),
    ]  # fmt: skip


def backflip_problem(chain: Chain, *, project: bool = True, **options: Any) -> optimize.Problem:
    """Return the problem of the backflip.

    chain: of `svkc.scenes.backflip.backflip`.
    project: as of `svkc.optimize.Problem`; options: its further keyword arguments.
    """
    between = optimize.between
    rates = between(chain.joint_names, -LARGEST_RATE, LARGEST_RATE, of="velocity")
    return optimize.Problem(
        chain,
        _phases(chain, project),
        controls=optimize.TorqueRates(limit=1e4, torque=TORQUE_LIMITS),
        running=_running,
        final=_final,
        bounds=[*(between(joint, *ends) for joint, ends in RANGES.items()), rates],
        project=project,
        **options,
    )


def backflip_guess(problem: optimize.Problem, **options: Any) -> optimize.Guess:
    """Return the guess of straight lines between the poses of the original problem.

    options: keyword arguments of `Problem.guess`.
    """
    start = START | {"pelvis_y": -0.24, "pelvis_z": -0.25, "ankle": 0.17}
    return problem.guess([start, None, TUCK_START, TUCK_END, LANDING_START, END], **options)
