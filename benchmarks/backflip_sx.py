"""The backflip's functions in CasADi's SX: kinematics, inverse dynamics, one interval.

Collocation by Radau IIA with two stages and inverse dynamics: accelerations and forces at stages
are unknowns (see `backflip`).
"""

import backflip
import casadi as ca
import numpy as np
from backflip import FREEDOMS, STAGES, TORQUES

A, AA = np.array([[5, -1], [9, 3]]) / 12, np.array([[2, -1], [9, 0]]) / 18
B, C = A[-1], A.sum(1)
ROW_UNIT = 100.0  # of dynamics and of what is connected


def turned(angle, point):
    """Return a point of the plane, turned."""
    cos, sin = ca.cos(angle), ca.sin(angle)
    return ca.vertcat(cos * point[0] - sin * point[1], sin * point[0] + cos * point[1])


def quarter(point):
    """Return a point of the plane, turned by a quarter."""
    return ca.vertcat(-point[1], point[0])


def moment(arm, force):
    """Return the moment about x of a force."""
    return arm[0] * force[1] - arm[1] * force[0]


BODIES = backflip.segment_motions()
SLIDES = ca.DM(backflip.turned(backflip.PELVIS_TURN, np.eye(2)))


def frames(q) -> dict:
    """Return the angle and the origin of each moving body, by name."""
    result = {}
    for body in BODIES:
        if body.parent is None:
            angle, origin = backflip.PELVIS_TURN, ca.DM(backflip.PELVIS_PLACE) + SLIDES @ q[:2]
        else:
            angle, origin = result[body.parent]
            origin = origin + turned(angle, body.offset)
        result[body.name] = angle + body.turn + q[body.joint], origin
    return result


def point(q, body: str, place):
    """Return the position of a point of a body."""
    angle, origin = frames(q)[body]
    return origin + turned(angle, place)


def gap(q, connection: str):
    """Return the position of the toe, or of the shank relative to the hand in the shank's axes."""
    if connection == "toe":
        return point(q, "feet", backflip.TOE)
    angle, _ = frames(q)["shanks"]
    return turned(-angle, point(q, "shanks", backflip.SHIN) - point(q, "forearms", backflip.HAND))


def center_of_mass(q):
    """Return the position of the figure's centre of mass."""
    masses = [body.mass for body in BODIES]
    points = [point(q, body.name, body.com) for body in BODIES]
    return sum(m * p for m, p in zip(masses, points, strict=True)) / sum(masses)


def inverse_dynamics(q, v, a, gravity=backflip.GRAVITY):
    """Return the generalized forces of an acceleration, by Newton and Euler."""
    motion, forces = {}, {}
    for body in BODIES:
        if body.parent is None:
            angle, rate, turning = backflip.PELVIS_TURN, 0, 0
            linear = SLIDES @ a[:2] + ca.vertcat(0, gravity)
        else:
            angle, rate, turning, linear = motion[body.parent]
            arm = turned(angle, body.offset)
            linear = linear + turning * quarter(arm) - rate**2 * arm
        angle, rate = angle + body.turn + q[body.joint], rate + v[body.joint]
        turning = turning + a[body.joint]
        motion[body.name] = angle, rate, turning, linear
        arm = turned(angle, body.com)
        force = body.mass * (linear + turning * quarter(arm) - rate**2 * arm)
        forces[body.name] = force, body.inertia * turning + moment(arm, force)
    result = [None] * FREEDOMS
    for body in reversed(BODIES):
        force, torque = forces[body.name]
        result[body.joint] = torque
        if body.parent is None:
            result[:2] = ca.vertsplit(SLIDES.T @ force)
        else:
            arm = turned(motion[body.parent][0], body.offset)
            parent_force, parent_torque = forces[body.parent]
            forces[body.parent] = parent_force + force, parent_torque + torque + moment(arm, force)
    return ca.vertcat(*result)


def stage_function(connection: str | None) -> ca.Function:
    """Return a function of (q, v, a, tau, f): rows of the dynamics and of what is connected."""
    q, v, a = (ca.SX.sym(name, FREEDOMS) for name in "qva")
    tau, f = ca.SX.sym("tau", TORQUES), ca.SX.sym("f", 2 if connection else 0)
    dynamics = inverse_dynamics(q, v, a) - ca.vertcat(ca.SX(3, 1), tau)
    rows = []
    if connection:
        distance = gap(q, connection)
        dynamics -= ca.jtimes(distance, q, f, True)
        speed = ca.jtimes(distance, q, v)
        rows = [ca.jtimes(speed, q, v) + ca.jtimes(speed, v, a)]
    return ca.Function("stage", [q, v, a, tau, f], [ca.vertcat(dynamics, *rows) / ROW_UNIT])


def interval_function(connection: str | None) -> ca.Function:
    """Return a function of (h, x, u, a, f) of an interval of length h.

    It returns rows of both stages, the next node, and the integral of the cost.
    """
    h, x = ca.SX.sym("h"), ca.SX.sym("x", backflip.NODE)
    u, a = ca.SX.sym("u", TORQUES), ca.SX.sym("a", FREEDOMS, STAGES)
    f = ca.SX.sym("f", 2 if connection else 0, STAGES)
    q, v, tau = ca.vertsplit(x, [0, FREEDOMS, 2 * FREEDOMS, backflip.NODE])
    stage, rows, cost = stage_function(connection), [], h * ca.sumsqr(u)
    for i in range(STAGES):
        Q = q + h * C[i] * v + h**2 * (a @ AA[i])
        V, stage_tau = v + h * (a @ A[i]), tau + h * C[i] * u
        rows.append(stage(Q, V, a[:, i], stage_tau, f[:, i]))
        cost += 1e4 * h * B[i] * ca.sumsqr(stage_tau / backflip.TORQUE_LIMIT)
    after = ca.vertcat(Q, V, stage_tau)
    return ca.Function("interval", [h, x, u, a, f], [ca.vertcat(*rows), after, cost])


def point_functions() -> dict[str, ca.Function]:
    """Return functions of (q, v): position and velocity of the toe, of the shank relative to the
    hand, and of the centre of mass.
    """
    q, v = ca.SX.sym("q", FREEDOMS), ca.SX.sym("v", FREEDOMS)
    points = {name: gap(q, name) for name in ("toe", "shank")} | {"com": center_of_mass(q)}
    return {
        name: ca.Function("point", [q, v], [place, ca.jtimes(place, q, v)])
        for name, place in points.items()
    }


def impact_function() -> ca.Function:
    """Return a function of (q, v, V, L): rows of an impact at the toe by L, from v to V."""
    q, v, after = (ca.SX.sym(name, FREEDOMS) for name in "qvV")
    impulse, toe = ca.SX.sym("L", 2), gap(q, "toe")
    jump = inverse_dynamics(q, ca.SX(FREEDOMS, 1), after - v, gravity=0)
    rows = (jump - ca.jtimes(toe, q, impulse, True)) / ROW_UNIT
    return ca.Function("impact", [q, v, after, impulse], [rows])
