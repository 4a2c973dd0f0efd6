"""A backflip whose hands take the shanks in flight, as numbers: figure, phases, bounds, guesses.

After Farr, Charbonneau, Begon and Puchaud (2025, data: doi 10.5281/zenodo.14546204), simplified.
A planar figure (y forward, z up, angles about x, both sides as one, SI) jumps, takes its shanks,
opens and lands. Coordinates q: pelvis y, z, turn, shoulder, elbow, hip, knee, ankle. Torques tau
act on the five joints. A node is x = (q, v, tau).

A point of the problem is a dictionary of arrays, for the 130 intervals and 135 nodes of all phases
one after the other:

- durations (5,) in s;
- x (135, 21): nodes, one more than intervals in each phase;
- u (130, 5): torque rates in N m/s, constant over an interval;
- a (130, 2, 8): accelerations at the two stages of an interval;
- f (130, 2, 2): forces of the connection at the stages in N, zero where there is none;
- impulse (2,): of the ground on the toe at landing, y and z, in N s.

Forces act on the toe along y and z of the ground, or on the shank along y and z of the shank (the
hand has the opposite one). Ranges of a node that come from several sentences of the statement are
intersected; the elbow, for instance, ends within 0..0.03.
"""

import typing

import numpy as np

GRAVITY = 9.81
TOE, UNDER_COM, HAND, SHIN = (-0.05, -0.15), (-0.03, -0.15), (0.0, -0.41), (0.07, -0.1575)
JOINTS = "shoulder elbow hip knee ankle".split()
TORQUE_LIMIT = np.array([325.531, 138, 981.1876, 735.3286, 343.9806])
TORQUE_RATE_LIMIT, RATE_LIMIT = 1e4, 31.42
JOINT_RANGES = np.array([(-0.7, 3.1), (0, 2.09), (-0.4, 2.6), (-2.3, 0.02), (-0.7, 0.7)])
FREEDOMS, TORQUES, STAGES = 8, 5, 2
NODE = 2 * FREEDOMS + TORQUES


class Segment(typing.NamedTuple):
    """A segment: its frame is at `offset` in its parent, turned by `turn` and by coordinate
    `joint`.

    com: centre of mass in the segment's frame. inertia: about x at the centre of mass.
    """

    name: str
    parent: str | None
    offset: tuple
    turn: float
    joint: int | None
    mass: float
    com: tuple
    inertia: float


# the pelvis slides along axes at (0, 0.8) that are turned by -0.1
PELVIS_PLACE, PELVIS_TURN = (0.0, 0.8), -0.1
SEGMENTS = [
    Segment(*row)
    for row in (
        ("pelvis", None, (0, 0), 0, 2, 11.58, (0, 0.1044), 0.0692),
        ("thorax", "pelvis", (-0.0515404739, 0.1813885235), 0, None, 20.46, (0, 0.1767), 0.5204),
        ("head", "thorax", (0.0435036145, 0.3479414452), 0, None, 5.12, (0, 0.0853), 0.0881),
        ("upper arms", "thorax", (0.023425367, 0.211508031), -1.5715679880691036, 3, 4.72,
         (0.142699958, 0.000110116), 0.0377032548),
        ("forearms", "upper arms", (0.33860196781, 0), 1.57, 4, 2.52,
         (-0.00067614, -0.12639819), 0.0130228857),
        ("hands", "forearms", (0, -0.26587471154), 1.57 - np.pi / 2, None, 1.12,
         (-0.00799285, -0.05143931), 0.00276486351),
        ("thighs", "pelvis", (0, 0), 0, 5, 18.98, (0, -0.2017), 0.3444),
        ("shanks", "thighs", (0, -0.462839073), 0, 6, 8.36, (0, -0.2026), 0.1702),
        ("feet", "shanks", (0, -0.427480971), np.pi / 2, 7, 2.32, (0, -0.0757), 0.0178),
    )
]  # fmt: skip


class Phase(typing.NamedTuple):
    """A phase: what is connected in it ("toe", "shank" or None), its duration's bounds and mesh."""

    name: str
    connection: str | None
    duration: tuple
    intervals: int


PHASES = (
    Phase(name="push", connection="toe", duration=(0.1, 0.4), intervals=20),
    Phase(name="flight", connection=None, duration=(0.1, 0.3), intervals=20),
    Phase(name="tuck", connection="shank", duration=(0.1, 0.4), intervals=30),
    Phase(name="open", connection=None, duration=(0.1, 0.3), intervals=30),
    Phase(name="landing", connection="toe", duration=(0.2, 1.0), intervals=30),
)
INTERVALS = sum(phase.intervals for phase in PHASES)
NODES = INTERVALS + len(PHASES)
FIRST_INTERVAL = np.cumsum([0, *(phase.intervals for phase in PHASES)])[:-1]
FIRST_NODE = FIRST_INTERVAL + np.arange(len(PHASES))
LAST_NODE = FIRST_NODE + [phase.intervals for phase in PHASES]
SHAPES = {
    "durations": (len(PHASES),),
    "x": (NODES, NODE),
    "u": (INTERVALS, TORQUES),
    "a": (INTERVALS, STAGES, FREEDOMS),
    "f": (INTERVALS, STAGES, 2),
    "impulse": (2,),
}
# the pelvis is where the toe is at the origin; the ankle is in its range
PUSH_START = [-0.24, -0.25, -0.3274, 0.2999, 0.4935, 1.7082, -1.9999, 0.17]
TUCK_START = [0.135, 0.455, 1.285, 0.481, 1.818, 2.6, -1.658, 0.692]
TUCK_END = [0.107, 0.797, 2.892, 0.216, 1.954, 2.599, -2.058, 0.224]
LANDING_START = [0.013, 0.088, 5.804, -0.305, 0, 1.014, -0.97, 0.006]
LANDING_END = [0.053, 0.091, 6.08, 2.9, -0.17, 0.092, 0.17, 0.20]
TURN, ELBOW, HIP, KNEE = 2, 4, 5, 6


def intervals(phase: int) -> slice:
    """Return the indices of a phase's intervals."""
    return slice(FIRST_INTERVAL[phase], FIRST_INTERVAL[phase] + PHASES[phase].intervals)


def nodes(phase: int) -> slice:
    """Return the indices of a phase's nodes."""
    return slice(FIRST_NODE[phase], LAST_NODE[phase] + 1)


def bounds() -> tuple[dict, dict]:
    """Return the least and the greatest point."""
    low = {name: np.full(shape, -np.inf) for name, shape in SHAPES.items()}
    high = {name: np.full(shape, np.inf) for name, shape in SHAPES.items()}
    low["x"], high["x"] = _node_bounds()
    low["durations"], high["durations"] = np.array([phase.duration for phase in PHASES]).T
    low["u"][:], high["u"][:] = -TORQUE_RATE_LIMIT, TORQUE_RATE_LIMIT
    for p, phase in enumerate(PHASES):
        if phase.connection == "toe":
            low["f"][intervals(p), :, 1] = 0.01
        elif phase.connection == "shank":
            high["f"][intervals(p), :, 0] = -0.1
        else:
            low["f"][intervals(p)] = high["f"][intervals(p)] = 0
    take_off = FIRST_INTERVAL[1] - 1, STAGES - 1
    low["f"][take_off], high["f"][take_off] = 0.01, 50
    low["impulse"][1] = 0
    return low, high


def straight_line_guess() -> dict:
    """Return straight lines between poses, at constant speed, without torques.

    Durations are the middle of their bounds. The ground carries the figure's weight.
    """
    result = {name: np.zeros(shape) for name, shape in SHAPES.items()}
    durations = np.mean([phase.duration for phase in PHASES], axis=1)
    result["durations"] = durations
    take_off = np.mean([PUSH_START, TUCK_START], axis=0)
    poses = [PUSH_START, take_off, TUCK_START, TUCK_END, LANDING_START, LANDING_END]
    for p, phase in enumerate(PHASES):
        start, end = np.array(poses[p : p + 2])
        result["x"][nodes(p), :FREEDOMS] = np.linspace(start, end, phase.intervals + 1)
        result["x"][nodes(p), FREEDOMS : 2 * FREEDOMS] = (end - start) / durations[p]
        if phase.connection == "toe":
            result["f"][intervals(p), :, 1] = GRAVITY * sum(segment.mass for segment in SEGMENTS)
    return result


def noisy_guess(seed: int) -> dict:
    """Return the straight-line guess with coordinates moved at random by a tenth of their range.

    The noise is uniform over a fifth of each range, a tenth to both sides.
    """
    result, (low, high) = straight_line_guess(), _node_bounds()
    ranges = (high - low)[:, :FREEDOMS]
    result["x"][:, :FREEDOMS] += (
        np.random.default_rng(seed).uniform(-0.1, 0.1, ranges.shape) * ranges
    )
    return result


def _node_bounds() -> tuple[np.ndarray, np.ndarray]:
    """Return the least and the greatest value of every node, each of shape (135, 21)."""
    low, high = np.empty((2, NODES, NODE))
    low[:, :2], high[:, :2] = (-1, -1), (1, 2)
    low[:, 3:FREEDOMS], high[:, 3:FREEDOMS] = JOINT_RANGES.T
    high[:, FREEDOMS : 2 * FREEDOMS] = RATE_LIMIT
    high[:, 2 * FREEDOMS :] = 0.7 * TORQUE_LIMIT
    low[:, FREEDOMS:] = -high[:, FREEDOMS:]
    pi = np.pi
    turns = (
        (-pi, pi), (-pi, 1.5 * pi), (-pi, 2 * pi),
        (0.75 * pi, 2 * pi + 0.5), (0.5 * pi, 2 * pi + 1.66),
    )  # fmt: skip
    for p, turn in enumerate(turns):
        low[nodes(p), TURN], high[nodes(p), TURN] = turn

    def narrow(node, coordinates, least, most):
        """Intersect bounds of nodes with a range."""
        low[node, coordinates] = np.maximum(low[node, coordinates], least)
        high[node, coordinates] = np.minimum(high[node, coordinates], most)

    start, end, turning = 0, LAST_NODE[-1], slice(TURN, KNEE + 1)
    pose = np.array(PUSH_START)[turning]
    narrow(start, turning, pose - 0.3, pose + 0.3)
    narrow(start, KNEE, -2, -0.7)
    narrow(start, TURN, -pi, 0.5)
    narrow(start, HIP, -0.4, 2)
    low[start, FREEDOMS : 2 * FREEDOMS] = high[start, FREEDOMS : 2 * FREEDOMS] = 0
    narrow(nodes(2), HIP, 1.96, 2.6)
    narrow(nodes(2), KNEE, -2.3, -1.5)
    narrow(LAST_NODE[2], TURN, 0.75 * pi, 1.5 * pi)
    narrow(FIRST_NODE[4], HIP, 0.014, 1.514)
    narrow(FIRST_NODE[4], KNEE, -1.97, -0.87)
    pose = np.array(LANDING_END)
    narrow(end, slice(FREEDOMS), pose - 0.2, pose + 0.2)
    narrow(end, ELBOW, 0, pi / 2)
    narrow(end, HIP, 0, 2.9)
    narrow(end, KNEE, 0, np.inf)
    return low, high


def turned(angle: float, points: np.ndarray) -> np.ndarray:
    """Return points of the plane, columns of an array, turned."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin], [sin, cos]]) @ points


def segment_motions() -> list[Segment]:
    """Return one body for each segment with a joint and those that are fixed to it."""
    frames, groups = {None: (None, np.zeros(2), 0.0)}, {}
    for segment in SEGMENTS:
        owner, place, turn = frames[segment.parent]
        place, turn = place + turned(turn, segment.offset), turn + segment.turn
        if segment.joint is not None:
            groups[segment.name] = segment._replace(parent=owner, offset=place, turn=turn), []
            owner, place, turn = segment.name, np.zeros(2), 0.0
        frames[segment.name] = owner, place, turn
        groups[owner][1].append((segment.mass, place + turned(turn, segment.com), segment.inertia))
    return [_composite(body, parts) for body, parts in groups.values()]


def _composite(body: Segment, parts: list) -> Segment:
    """Return a body with the mass, centre of mass and inertia of its parts."""
    mass = sum(m for m, _, _ in parts)
    com = sum(m * c for m, c, _ in parts) / mass
    inertia = sum(i + m * (c - com) @ (c - com) for m, c, i in parts)
    return body._replace(mass=mass, com=com, inertia=inertia)
