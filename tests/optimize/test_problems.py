"""Problems with a known optimum, order of convergence, and a redundant loop."""

import jax.numpy as jnp
import models
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import svkc
from svkc import optimize

# of the cost, as the statement of the problems asks
KNOWN = 1e-6
BALL = '<geom type="sphere" size="0.1" mass="1" contype="0" conaffinity="0"/>'
SLIDES = "".join(f'<joint name="{n}" type="slide" axis="{a}"/>' for n, a in
                 (("x", "1 0 0"), ("z", "0 0 1")))  # fmt: skip
BEAD = f'<mujoco><worldbody><body name="bead">{SLIDES}{BALL}</body></worldbody></mujoco>'
CART = BEAD.replace('<joint name="z" type="slide" axis="0 0 1"/>', "")


def at(*bounds):
    """Return positions and velocities that are fixed: (joint, position, velocity)."""
    return [
        optimize.between(joint, value, value, of=of)
        for joint, *values in bounds
        for value, of in zip(values, ("position", "velocity"))
        if value is not None
    ]


def test_minimum_time_of_a_double_integrator():
    """From rest to rest over 1 m with at most 1 N on 1 kg takes 2 s, half of it braking."""
    chain = svkc.load(CART)
    phase = optimize.Phase(
        "move", duration=(0.5, 5.0), intervals=4, start=at(("x", 0, 0)), end=at(("x", 1, 0))
    )
    problem = optimize.Problem(
        chain, [phase], controls=optimize.Torques(1.0, constant=True), final=lambda p: p.t
    )
    guess = problem.guess([{"x": 0.0}, {"x": 1.0}])
    check = problem.check(guess)
    assert max(check.derivative_error, check.hessian_error) < 1e-6
    solution = problem.solve(guess, solver=optimize.Ipopt(backend="cyipopt"))
    assert abs(float(solution.cost) - 2) < KNOWN
    assert solution.result == optimize.OUTCOME.successful
    assert solution.violation < KNOWN
    np.testing.assert_allclose(solution.motion[0].blocks.ravel(), [1, 1, -1, -1], atol=1e-5)


@pytest.mark.slow
def test_costs_that_are_python_numbers():
    """The minimum time again, as the integral of 1, with a constraint that is an integer."""
    ends = {"start": at(("x", 0, 0)), "end": [*at(("x", 1, 0)), (lambda p: 1, 0, 2)]}
    phase = optimize.Phase("move", duration=(0.5, 5.0), intervals=4, **ends)
    controls = optimize.Torques(1.0, constant=True)
    options = {"running": lambda p: 1.0, "final": lambda p: 3}
    problem = optimize.Problem(svkc.load(CART), [phase], controls=controls, **options)
    solution = problem.solve(problem.guess([{"x": 0.0}, {"x": 1.0}]))
    assert abs(float(solution.cost) - 5) < KNOWN


@pytest.mark.slow
def test_bounds_on_controls():
    """Least squares of the force to x = 1 with v free: u = 3 (1 - t), which is zero at the end.

    A bound that holds at the end anyway changes nothing there, but does in the whole phase.
    """

    def cost(**changed):
        end = [*at(("x", 1)), *changed.pop("end", [])]
        phase = optimize.Phase("a", duration=1.0, start=at(("x", 0, 0)), end=end, **changed)
        options = {"controls": optimize.Torques(), "running": lambda p: jnp.sum(p.u**2)}
        problem = optimize.Problem(svkc.load(CART), [phase], **options)
        return float(problem.solve(problem.guess([{"x": 0.0}, {"x": 1.0}])).cost)

    np.testing.assert_allclose(cost(), 3, rtol=KNOWN)
    np.testing.assert_allclose(cost(end=[(lambda p: p.u, -1, 1)]), 3, rtol=KNOWN)
    assert cost(bounds=[optimize.between("x", -2.5, 2.5, of="control")]) > 3.01


@pytest.mark.slow
def test_brachistochrone():
    """The fastest wire is a cycloid, on which the force by the speed is constant: 3.27 1/s.

    The wire's force is normal to the velocity. Its limit keeps the first interval, at whose start
    the velocity is zero, from what the scheme alone allows.
    """
    chain, angle = svkc.load(BEAD), 2.0
    radius = 1 / (angle - np.sin(angle))
    target = {"x": 1.0, "z": -radius * (1 - np.cos(angle))}
    phase = optimize.Phase(
        "fall",
        duration=(0.3, 1.5),
        intervals=40,
        start=at(("x", 0, 0), ("z", 0, 0)),
        end=at(*((joint, value) for joint, value in target.items())),
        final=lambda p: p.duration,
    )

    def wire(t, state, u, args):
        return {"x": -u[0] * state.v[1], "z": u[0] * state.v[0]}

    problem = optimize.Problem(
        chain, [phase], controls=optimize.Parametrized(1, wire, limit=3.4), scheme=optimize.Radau(3)
    )
    solution = problem.solve(problem.guess([{}, target]))
    assert abs(float(solution.cost) - angle * np.sqrt(radius / 9.81)) < KNOWN


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["cyipopt", "casadi"])
def test_linear_quadratic_regulator(backend):
    """The cost of x'' = u is that of Riccati's equation."""
    if backend == "casadi":
        pytest.importorskip("casadi")
    chain, A, B = svkc.load(CART), np.array([[0.0, 1.0], [0, 0]]), np.array([[0.0], [1]])
    phase = optimize.Phase("regulate", duration=1.0, start=at(("x", 1, 0.5)))
    problem = optimize.Problem(
        chain,
        [phase],
        controls=optimize.Torques(),
        scheme=optimize.Radau(3),
        running=lambda p: p.state.q[0] ** 2 + p.state.v[0] ** 2 + p.u[0] ** 2,
    )
    solution = problem.solve(
        problem.guess([{"x": 1.0}, {"x": 1.0}]), solver=optimize.Ipopt(backend=backend)
    )
    slope = lambda t, P: (
        A.T @ P.reshape(2, 2) + P.reshape(2, 2) @ A - P.reshape(2, 2) @ B @ B.T @ P.reshape(2, 2)
        + np.eye(2)
    ).ravel()  # fmt: skip
    P = solve_ivp(slope, (0, 1), np.zeros(4), rtol=1e-11, atol=1e-12).y[:, -1].reshape(2, 2)
    x = np.array([1, 0.5])
    assert abs(float(solution.cost) - x @ P @ x) < KNOWN


@pytest.mark.slow
@pytest.mark.parametrize(("stages", "order", "meshes"), [(2, 3, (3, 6, 12)), (3, 5, (2, 4))])
def test_order_of_convergence_on_a_closed_loop(stages, order, meshes):
    """Without controls the solution is the motion; its error falls by 2^(2 s - 1) per halving."""
    chain, link = models.four_bar(), models.four_bar().link_names[0]
    state = chain.state(v={"crank": 2.0})
    end = svkc.simulate(chain, state, 0.3, rtol=1e-11, atol=1e-12).final
    fixed = [
        *(optimize.between(j, *2 * [float(chain.joint(state, j).q)]) for j in ["crank"]),
        *(optimize.between(j, *2 * [float(chain.joint(state, j).v)], of="velocity")
          for j in ["crank"]),
    ]  # fmt: skip
    errors = []
    for intervals in meshes:
        phase = optimize.Phase("fall", link, duration=0.3, intervals=intervals, start=fixed)
        problem = optimize.Problem(
            chain,
            [phase],
            controls=optimize.Torques(joints=()),
            scheme=optimize.Radau(stages),
            running=lambda p: 0.0 * p.t,
        )
        solver = optimize.Ipopt(tolerance=1e-12)
        motion = problem.solve(problem.guess([state, end]), solver=solver).motion[0]
        errors.append(np.abs(motion.q[-1] - end.q[: chain.nq]).max())
    rates = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.all(rates > order - 0.6), (errors, rates)


LEG = (
    '<body name="{0}_thigh" pos="{1} 0 0"><joint name="{0}_hip" axis="0 1 0"/><geom type="capsule"'
    ' fromto="0 0 0 0 0 -0.4" size="0.05" contype="0"/><body name="{0}_shank" pos="0 0 -0.4"><joint'
    ' name="{0}_knee" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.04"'
    ' contype="0"/></body></body>'
)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [optimize.Ipopt(), optimize.InteriorPoint()])
def test_redundant_loops_are_solved(solver):
    """A planar figure whose feet are both welded squats: 12 rows of links, 6 independent ones."""
    turn = '<joint name="turn" axis="0 1 0"/>'
    legs = LEG.format("left", -0.2) + LEG.format("right", 0.2)
    text = (
        f'<mujoco><worldbody><body name="hips" pos="0 0 0.8">{SLIDES}{turn}{BALL}{legs}</body>'
        "</worldbody></mujoco>"
    )
    feet = [
        svkc.VirtualLink(f"{s}_foot", "world", f"{s}_shank", "hinge", pos=(x, 0, 0),
                         real_pos=(0, 0, -0.4), axis=(0, 1, 0))
        for s, x in (("left", -0.2), ("right", 0.2))
    ]  # fmt: skip
    chain = svkc.load(text, virtual_links=feet)
    low = {"z": -0.2, "left_hip": 0.7, "left_knee": -1.4, "right_hip": 0.7, "right_knee": -1.4}
    high = {"z": -0.05, "left_hip": 0.4, "left_knee": -0.8, "right_hip": 0.4, "right_knee": -0.8}
    rest = optimize.between(chain.joint_names, 0, 0, of="velocity")
    phase = optimize.Phase(
        "squat",
        [f.name for f in feet],
        duration=(0.2, 1.0),
        intervals=8,
        start=[optimize.between("z", -0.05, -0.05), rest],
        end=[optimize.between("z", -0.2, -0.2)],
        path=[lambda p: p.forces("left_foot")[2]],
    )
    joints = [j for j in chain.joint_names if "hip" in j or "knee" in j]
    problem = optimize.Problem(
        chain,
        [phase],
        controls=optimize.Torques(joints=joints),
        running=lambda p: jnp.sum(p.u**2),
    )
    solution = problem.solve(problem.guess([high, low]), solver=solver)
    assert solution.violation < 1e-6
    of_phase = solution.forces("left_foot", "squat")
    np.testing.assert_array_equal(of_phase, solution.forces("left_foot"))
    weight = 9.81 * float(np.sum(chain.mass))
    total = solution.forces("left_foot")[:, 2] + solution.forces("right_foot")[:, 2]
    assert 0.3 * weight < np.mean(total) < 2 * weight


@pytest.mark.slow
def test_free_bodies_turn_through_quaternions():
    """A free box turns about its axis of largest inertia by a half turn, at constant speed."""
    chain = svkc.load(models.TWO_BOXES.replace("0.3 -0.2 -9.81", "0 0 0"))
    start = chain.state(connected=()) if chain.link_names else chain.state()
    quat = np.array([np.cos(0.75), 0, 0, np.sin(0.75)])
    end = start.q.at[3:7].set(quat)
    phase = optimize.Phase("turn", duration=1.0, intervals=6, start=[
        lambda p: (p.state.q[:7] - start.q[:7], 0, 0)], end=[
        lambda p: (p.state.q[4:7] - quat[1:], 0, 0)])  # fmt: skip
    problem = optimize.Problem(
        chain, [phase], controls=optimize.Torques(joints=["a"]), running=lambda p: p.u @ p.u,
        scheme=optimize.Radau(3),
    )  # fmt: skip
    solution = problem.solve(problem.guess([start, svkc.State(end, start.v, start.structure)]))
    assert float(solution.cost) < KNOWN
    np.testing.assert_allclose(solution.motion[0].v[:, 5], 1.5, atol=1e-4)


def test_limits_of_joints_with_several_coordinates():
    """A joint's name stands for all of its coordinates; several limits name the driven joints."""
    hinge = models.bar("hinge", models.Y, "0 0 1")
    arm = models.MJCF.format(models.bar("ball", 'type="ball"', "0 0 1", inside=hinge))
    chain = svkc.load(arm)
    torques = optimize.Torques(limit={"ball": 5.0, "hinge": (-1.0, 2.0)}).for_chain(chain)
    assert torques.names(chain) == ["ball.rx", "ball.ry", "ball.rz", "hinge"]
    np.testing.assert_array_equal(torques.limits(chain)[0], [[-5, -5, -5, -1], [5, 5, 5, 2]])
    rates = optimize.TorqueRates(torque={"hinge": 2.0}, limit={"ball": 4.0}).for_chain(chain)
    assert rates.names(chain) == ["hinge", "ball.rx", "ball.ry", "ball.rz"]
    np.testing.assert_array_equal(rates.limits(chain)[0][1], [2, np.inf, np.inf, np.inf])
    np.testing.assert_array_equal(rates.limits(chain)[1][1], [np.inf, 4, 4, 4])
    misspelt = optimize.Torques(joints=["hinge"], limit={"hing": 2.0}).for_chain(chain)
    with pytest.raises(ValueError, match="no driven joint 'hing'; did you mean 'hinge'"):
        misspelt.limits(chain)
