"""Points of bodies: against MuJoCo on open chains, against derivatives of poses on closed ones."""

import re

import cases
import jax
import jax.numpy as jnp
import models
import mujoco
import numpy as np
import pytest
from tolerances import DIFFERENCE, REFERENCE, ROUND_OFF

import svkc
from svkc.tree.spatial import quat_conjugate, quat_log, quat_multiply, quat_rotate

# MuJoCo warns so of gymnasium's half_cheetah.xml
pytestmark = pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass' is deprecated")

POINT, FORCE, TORQUE = jnp.array([[0.3, -0.2, 0.5], [20.0, -7.0, 3.0], [0.4, 5.0, -2.0]])


def quantities(chain, state, name):
    """Return all quantities of `POINT` of a body or site."""
    J = svkc.jacobian(chain, state, name, POINT)
    tau = svkc.apply_force(chain, state, name, FORCE, POINT, TORQUE)
    return {
        "linear": J.linear,
        "angular": J.angular,
        "position": svkc.point_position(chain, state, name, POINT),
        "velocity": svkc.point_velocity(chain, state, name, POINT),
        "force": tau,
    }


def mujoco_quantities(model, data, body, pos, R):
    """Return the same of a frame of a body by MuJoCo. pos, R: pose of the frame in the world."""
    point, twist = pos + R @ POINT, np.zeros(6)
    linear, angular, tau = np.zeros((3, model.nv)), np.zeros((3, model.nv)), np.zeros(model.nv)
    mujoco.mj_jac(model, data, linear, angular, point, body)
    wrench = {"force": np.array(FORCE), "torque": np.array(TORQUE)}
    mujoco.mj_applyFT(model, data, **wrench, point=point, body=body, qfrc_target=tau)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, twist, 0)
    velocity = twist[3:] + np.cross(twist[:3], point - data.xpos[body])
    return {
        "linear": linear,
        "angular": angular,
        "position": point,
        "velocity": velocity,
        "force": tau,
    }


def random_motion(chain):
    """Return a random state of an open chain, and MuJoCo's model and data of this state."""
    model, rng = chain.model.model, np.random.default_rng(5)
    data = mujoco.MjData(model)
    mujoco.mj_integratePos(model, data.qpos, rng.normal(size=model.nv), 1.0)
    data.qvel[:] = rng.normal(size=model.nv)
    mujoco.mj_forward(model, data)
    mujoco.mj_subtreeVel(model, data)
    return chain.state(data.qpos, data.qvel), model, data


def assert_equal(computed, expected):
    for name, value in expected.items():
        scale = max(1.0, np.abs(value).max())
        np.testing.assert_allclose(computed[name], value, atol=ROUND_OFF * scale, err_msg=name)


def subtree(model, body):
    """Return the names of a body and of its descendants."""
    bodies = [body]
    for i in range(body + 1, model.nbody):
        if model.body_parentid[i] in bodies:
            bodies.append(i)
    return bodies


@pytest.mark.parametrize("name", cases.params("tree"))
def test_open_chains_against_mujoco(name):
    chain = cases.CASES[name].build()
    state, model, data = random_motion(chain)
    bodies = sorted({1, model.nbody // 2, model.nbody - 1})
    parts = {body: [chain.body_names[i] for i in subtree(model, body)] for body in bodies}

    @jax.jit
    def compute(state):
        center = lambda body: svkc.center_of_mass(chain, state, parts[body])
        return {
            body: (quantities(chain, state, chain.body_names[body]), center(body))
            for body in bodies
        }

    for body, (computed, center) in compute(state).items():
        R = data.xmat[body].reshape(3, 3)
        assert_equal(computed, mujoco_quantities(model, data, body, data.xpos[body], R))
        expected = {
            "position": data.subtree_com[body],
            "velocity": data.subtree_linvel[body],
            "mass": model.body_subtreemass[body],
        }
        assert_equal(center._asdict(), expected)


def with_sites(text):
    """Return a MJCF with a site beside each geom; the first has the name of the last body."""
    count = iter(range(100))
    site = lambda _: (
        f'<site name="{((i := next(count)) and f"site{i}") or "b7"}" pos="0.1 {i} -0.2"'
        f' quat="0.5 {i} 0.3 -0.4"/><geom'
    )
    return re.sub("<geom", site, text)


@pytest.mark.slow
def test_sites_against_mujoco():
    chain = svkc.load(with_sites(models.random_tree(7, seed=7)))
    state, model, data = random_motion(chain)
    for site in (1, 6):
        body, R = model.site_bodyid[site], data.site_xmat[site].reshape(3, 3)
        expected = mujoco_quantities(model, data, body, data.site_xpos[site], R)
        assert_equal(quantities(chain, state, f"site{site}"), expected)
    linear = np.zeros((3, model.nv))
    mujoco.mj_jacSite(model, data, linear, None, 6)
    computed = svkc.jacobian(chain, state, "site6").linear
    np.testing.assert_allclose(computed, linear, atol=10 * ROUND_OFF)
    # the name of a site and of a body is the body's
    R = data.xmat[7].reshape(3, 3)
    expected = mujoco_quantities(model, data, 7, data.xpos[7], R)
    assert_equal(quantities(chain, state, "b7"), expected)


@pytest.mark.parametrize("name", [*cases.params("loops"), *cases.params("cuttable")])
def test_jacobian_is_the_derivative_of_the_pose(name):
    """Of every coordinate, those of virtual joints included."""
    case = cases.CASES[name]
    chain = case.build(cuttable=case.cuttable) if case.cuttable else case.build()
    pose = case.pose() if callable(case.pose) else case.pose
    state = chain.state(pose, 0.3 * np.random.default_rng(1).normal(size=chain.nv))
    body = len(chain.body_names) - 1
    body_name = chain.body_names[body]

    def displacement(dv, state):
        moved = svkc.State(svkc.integrate(chain, state.q, dv), state.v, state.structure)
        positions, quats = svkc.poses(chain, moved)
        at_rest = jax.lax.stop_gradient(svkc.poses(chain, state).quaternion[body])
        turn = quat_log(quat_multiply(quats[body], quat_conjugate(at_rest)))
        return positions[body] + quat_rotate(quats[body], POINT), turn

    @jax.jit
    def compute(state):
        zero = jnp.zeros(chain.dofs)
        bodies = chain.body_names[1:]
        motion = lambda q: svkc.center_of_mass(
            chain, svkc.State(q, state.v, state.structure), bodies
        )
        rate = jax.jvp(lambda t: svkc.integrate(chain, state.q, t * state.v), (0.0,), (1.0,))[1]
        center, derivative = jax.jvp(motion, (state.q,), (rate,))
        return (
            quantities(chain, state, body_name),
            jax.jacfwd(displacement)(zero, state),
            (center.velocity, derivative.position),
        )

    computed, (linear, angular), (center_velocity, center_rate) = compute(state)
    expected = {
        "linear": linear,
        "angular": angular,
        "velocity": linear @ state.v,
        "force": linear.T @ FORCE + angular.T @ TORQUE,
    }
    assert_equal(computed, expected)
    np.testing.assert_allclose(center_velocity, center_rate, atol=ROUND_OFF)
    power = FORCE @ computed["velocity"] + TORQUE @ (angular @ state.v)
    scale = 1 + np.abs(computed["force"]) @ np.abs(state.v)
    np.testing.assert_allclose(computed["force"] @ state.v, power, atol=ROUND_OFF * scale)


@pytest.mark.parametrize("name", cases.params("tree"))
def test_external_forces_accelerate_as_in_mujoco(name):
    chain = cases.CASES[name].build()
    state, model, data = random_motion(chain)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    body = model.nbody - 1
    data.xfrc_applied[body] = np.concatenate([FORCE, TORQUE])
    mujoco.mj_forward(model, data)
    # MuJoCo's force acts at the centre of mass
    tau = svkc.apply_force(
        chain, state, chain.body_names[body], FORCE, model.body_ipos[body], TORQUE
    )
    vdot = svkc.forward_dynamics(chain, state, tau)
    np.testing.assert_allclose(vdot, data.qacc, atol=ROUND_OFF * np.abs(data.qacc).max())


def test_a_force_at_the_centre_of_mass_moves_a_free_body():
    """Along a parabola: x = x0 + (g + F / m) t^2 / 2, under gravity and a force of a control."""
    chain = svkc.load(models.TWO_BOXES)
    control = lambda t, state, args: svkc.apply_force(chain, state, "a", args)
    traj = svkc.simulate(chain, chain.state(), 0.5, control=control, args=FORCE)
    rise = svkc.center_of_mass(chain, traj.final, "a")
    expected = (chain.gravity + FORCE / rise.mass) * 0.5**2 / 2
    np.testing.assert_allclose(rise.position, expected, atol=REFERENCE)
    np.testing.assert_allclose(rise.velocity, 4 * expected, atol=REFERENCE)


@pytest.mark.slow
def test_derivatives_against_differences():
    chain = cases.CASES["free_tree"].build()
    state, *_ = random_motion(chain)
    names = ("b8", "b1")

    def f(x):
        moved = svkc.State(svkc.integrate(chain, state.q, x["dv"]), x["v"], state.structure)
        body = names[0]
        return (
            svkc.jacobian(chain, moved, body, x["point"]),
            svkc.point_velocity(chain, moved, body, x["point"]),
            svkc.apply_force(chain, moved, body, x["force"], x["point"], x["torque"]),
            svkc.center_of_mass(chain, moved, names),
        )

    x = {"dv": jnp.zeros(chain.dofs), "v": state.v}
    x |= {"point": POINT, "force": FORCE, "torque": TORQUE}
    assert svkc.check_grad(f, x, directions=2).error < DIFFERENCE


def test_batches_and_bodies_at_rest():
    chain = cases.CASES["urdf"].build()
    state, *_ = random_motion(chain)
    points = jnp.asarray(np.random.default_rng(0).normal(size=(3, 3)))
    batch = jax.vmap(lambda p: svkc.point_velocity(chain, state, "lower", p))(points)
    for point, velocity in zip(points, batch, strict=True):
        J = svkc.jacobian(chain, state, "lower", point)
        np.testing.assert_allclose(J.linear @ state.v, velocity, atol=ROUND_OFF)
    assert not np.any(svkc.jacobian(chain, state, "world").linear)
    of_all = svkc.center_of_mass(chain, state)
    momentum = svkc.momentum(chain, state).linear
    np.testing.assert_allclose(of_all.mass * of_all.velocity, momentum, atol=ROUND_OFF)


def test_derivatives_of_poses_and_velocities_hold_no_scatter():
    """A scatter would keep an attempted step whose control differentiates poses from being one
    kernel.
    """
    chain, state, _ = cases.CASES["two_hands"].random_motion()

    def total(q):
        moved = svkc.State(q, state.v, state.structure)
        return sum(map(jnp.sum, (*svkc.poses(chain, moved), *svkc.velocities(chain, moved))))

    assert "scatter" not in str(jax.make_jaxpr(jax.grad(total))(state.q))
