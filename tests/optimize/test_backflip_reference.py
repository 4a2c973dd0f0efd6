"""The stored backflip solves its statement, by formulas that share nothing with CasADi's program.

Points of the plane are complex numbers, y + i z; forces come from virtual power.
"""

import pathlib

import backflip
import numpy as np
import pytest
from backflip import FIRST_NODE, FREEDOMS, LAST_NODE, PHASES, SEGMENTS

FILE = pathlib.Path(__file__).parents[1] / "references" / "backflip.npz"
A = np.array([[5, -1], [9, 3]]) / 12
B, C = A[-1], A.sum(1)


class Motion:
    """Positions, velocities and accelerations of all segments; the last axis of q is dropped."""

    def __init__(self, q, v, a):
        axes = np.exp(1j * backflip.PELVIS_TURN) * np.array([1, 1j])
        self.count, zero = q.shape[:-1], np.zeros(q.shape[:-1])
        self.start = complex(*backflip.PELVIS_PLACE) + q[..., :2] @ axes
        origin = (self.start, v[..., :2] @ axes, a[..., :2] @ axes)
        self.slides = axes
        self.frames = {None: (zero + backflip.PELVIS_TURN, zero, zero, origin, [])}
        for s in SEGMENTS:
            angle, rate, turning, _, joints = self.frames[s.parent]
            origin = self.point(s.parent, s.offset) if s.parent else origin
            angle = angle + s.turn
            if s.joint is not None:
                angle, rate = angle + q[..., s.joint], rate + v[..., s.joint]
                turning = turning + a[..., s.joint]
                joints = [*joints, (s.joint, origin[0])]
            self.frames[s.name] = angle, rate, turning, origin, joints

    def point(self, name, place):
        """Return position, velocity and acceleration of a point of a segment."""
        angle, rate, turning, (p, v, a), _ = self.frames[name]
        arm = complex(*place) * np.exp(1j * angle)
        return p + arm, v + 1j * rate * arm, a + (1j * turning - rate**2) * arm

    def jacobian(self, name, place):
        """Return the derivatives of a point's position by all coordinates."""
        position = self.point(name, place)[0]
        result = np.zeros((*self.count, FREEDOMS), complex)
        result[..., :2] = self.slides
        for joint, origin in self.frames[name][4]:
            result[..., joint] = 1j * (position - origin)
        return result

    def generalized_forces(self, gravity=backflip.GRAVITY):
        """Return the generalized forces of the motion."""
        result = np.zeros((*self.count, FREEDOMS))
        for s in SEGMENTS:
            force = s.mass * (self.point(s.name, s.com)[2] + 1j * gravity)
            result += (self.jacobian(s.name, s.com).conj() * force[..., None]).real
            for joint, _ in self.frames[s.name][4]:
                result[..., joint] += s.inertia * self.frames[s.name][2]
        return result

    def toe(self):
        return (*self.point("feet", backflip.TOE), self.jacobian("feet", backflip.TOE))

    def shank(self):
        """Return the gap of shank and hand in the shank's axes, its rates, and its Jacobian."""
        angle, rate, turning, _, joints = self.frames["shanks"]
        shin, hand = (
            self.point(*x) for x in (("shanks", backflip.SHIN), ("forearms", backflip.HAND))
        )
        d, v, a = (x - y for x, y in zip(shin, hand, strict=True))
        back, turns = np.exp(-1j * angle), np.isin(np.arange(FREEDOMS), [j for j, _ in joints])
        J = self.jacobian("shanks", backflip.SHIN) - self.jacobian("forearms", backflip.HAND)
        J = back[..., None] * (J - 1j * turns * d[..., None])
        a = back * (a - 2j * rate * v - (1j * turning + rate**2) * d)
        return back * d, back * (v - 1j * rate * d), a, J

    def center_of_mass(self):
        """Return position and velocity of the centre of mass."""
        moments = [s.mass * np.array(self.point(s.name, s.com)[:2]) for s in SEGMENTS]
        return sum(moments) / sum(s.mass for s in SEGMENTS)


@pytest.fixture(scope="module")
def solution():
    with np.load(FILE) as file:
        return dict(file)


def split(x):
    return np.split(x, [FREEDOMS, 2 * FREEDOMS], axis=-1)


def at_nodes(solution, nodes):
    """Return the motion at nodes, without accelerations."""
    q, v, _ = split(solution["x"][nodes])
    return Motion(q, v, np.zeros_like(q))


def stages(solution, p):
    """Return (h, motion at the stages, torques, next nodes) of a phase."""
    i, n = backflip.intervals(p), np.arange(FIRST_NODE[p], LAST_NODE[p])
    h, u, a = solution["durations"][p] / PHASES[p].intervals, solution["u"][i], solution["a"][i]
    q, v, tau = (x[:, None] for x in split(solution["x"][n]))
    Q = q + h * C[:, None] * v + h**2 * np.einsum("ij,kjd->kid", A @ A, a)
    V = v + h * np.einsum("ij,kjd->kid", A, a)
    torques = tau + h * C[:, None] * u[:, None]
    return h, Motion(Q, V, a), torques, np.concatenate([Q, V, torques], -1)[:, -1]


@pytest.mark.parametrize("p", range(len(PHASES)))
def test_intervals(solution, p):
    """Dynamics, what is held, continuity and cones of forces."""
    _, motion, tau, after = stages(solution, p)
    forces = motion.generalized_forces()
    forces[..., 3:] -= tau
    f = solution["f"][backflip.intervals(p)]
    if connection := PHASES[p].connection:
        _, _, acceleration, J = getattr(motion, connection)()
        forces -= (J.conj() * (f @ [1, 1j])[..., None]).real
        assert np.abs(acceleration).max() < 1e-8
        normal, tangential = (
            (f[..., 1] / 2, f[..., 0]) if connection == "toe" else (-f[..., 0], f[..., 1])
        )
        assert (np.abs(tangential) < normal + 1e-8).all()
    assert np.abs(forces).max() < 1e-7
    nodes = np.arange(FIRST_NODE[p], LAST_NODE[p]) + 1
    np.testing.assert_allclose(solution["x"][nodes], after, rtol=0, atol=1e-9)


def test_between_phases(solution):
    """Coordinates go on, velocities too but for the impact, torques but for take-off."""
    before, after = solution["x"][LAST_NODE[:-1]], solution["x"][FIRST_NODE[1:]]
    jumps = before - after
    jumps[0, 2 * FREEDOMS :] = jumps[3, FREEDOMS : 2 * FREEDOMS] = 0
    assert np.abs(jumps).max() < 1e-10
    gap, speed, _, _ = at_nodes(solution, FIRST_NODE[2]).shank()
    assert max(abs(gap), abs(speed)) < 1e-10
    q, v, _ = split(after[3])
    motion = Motion(q, 0 * v, v - split(before[3])[1])
    impulse = (motion.toe()[3].conj() * (solution["impulse"] @ [1, 1j])).real
    assert np.abs(motion.generalized_forces(gravity=0) - impulse).max() < 1e-8
    assert abs(Motion(q, v, 0 * v).toe()[1]) < 1e-10


def test_ends_and_bounds(solution):
    """The toe is on the ground, the centre of mass above the foot, all numbers in their bounds."""
    for node in (0, FIRST_NODE[4], LAST_NODE[4]):
        toe = at_nodes(solution, node).toe()[0]
        assert abs(toe.imag) < 1e-10
        assert abs(toe.real) < 0.1 + 1e-10
    for node, place in ((0, backflip.UNDER_COM), (LAST_NODE[4], backflip.TOE)):
        motion = at_nodes(solution, node)
        assert abs((motion.center_of_mass()[0] - motion.point("feet", place)[0]).real) < 1e-10
    low, high = backflip.bounds()
    for name in backflip.SHAPES:
        assert (solution[name] >= low[name] - 1e-8).all()
        assert (solution[name] <= high[name] + 1e-8).all()


def test_cost(solution):
    cost = solution["durations"] @ [1000, 10, -10, 10, 100]
    for p in range(len(PHASES)):
        h, _, tau, _ = stages(solution, p)
        effort = ((tau / backflip.TORQUE_LIMIT) ** 2).sum(-1) @ B
        cost += h * ((solution["u"][backflip.intervals(p)] ** 2).sum() + 1e4 * effort.sum())
    end, take_off = (at_nodes(solution, LAST_NODE[p]).center_of_mass() for p in (4, 0))
    v = split(solution["x"][-1])[1]
    cost += 100 * (v @ v + abs(end[1]) ** 2 + end[0].real ** 2) - take_off[1].imag ** 2
    assert cost == pytest.approx(solution["cost"], rel=1e-12)
    assert f"{cost:.5e}" == "5.94416e+06"
