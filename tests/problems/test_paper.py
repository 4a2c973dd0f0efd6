"""The paper's examples: section VII-A to the printed digit, attachment in flight, Rodrigues'
integration."""

import importlib.util
import pathlib

import jax
import jax.numpy as jnp
import models
import numpy as np
import pytest
from tolerances import REFERENCE, ROUND_OFF

import svkc
from svkc.scenes.two_links import two_links
from svkc.tree.spatial import quat_exp, quat_multiply


@pytest.fixture(scope="module")
def links():
    """Return chain and state of the two-link scene."""
    return two_links()


def test_printed_matrices(links):
    """(45)-(48): J_C, rank 6, mobility 2, W and S for theta_G = (theta_1, theta_7)."""
    chain, state = links
    assert chain.dof_names == (
        "base.x",
        "base.y",
        "base.z",
        "base.rx",
        "base.ry",
        "base.rz",
        "link1",
        "link1v",
    )
    linear, angular = svkc.loop_jacobian(chain, state)
    J = [[1, 0, 0, 0, 0, -2, -1, 0], [0, 1, 0, 0, 0, 0, 0, 0], [0, 0, 1, 2, 0, 0, 0, 0]]
    J += [[0, 0, 0, 1, 0, 0, 0, 0], [0, 0, 0, 0, 1, 0, 0, 0], [0, 0, 0, 0, 0, 1, 1, -1]]
    np.testing.assert_allclose(np.concatenate([linear[0], angular[0]]), J, atol=1e-15)
    m = svkc.mobility(chain, state)
    assert (int(m.joint_freedoms), int(m.rank), int(m.freedoms)) == (8, 6, 2)
    co = svkc.coordinates(chain, svkc.with_independent(chain, state, "base.x", "link1"))
    W = [[1, 0], [0, 0], [0, 0], [0, 0], [0, 0], [0.5, -0.5], [0, 1]]
    np.testing.assert_allclose(co.W[:7][:, co.independent], W, atol=1e-15)
    np.testing.assert_allclose(
        co.S[co.actuated][:, co.independent], [[0, 1], [0.5, 0.5]], atol=1e-15
    )
    np.testing.assert_allclose(
        co.H[co.dependent][:, co.independent],
        [[0, 0], [0, 0], [0, 0], [0, 0], [0.5, -0.5], [0.5, 0.5]],
        atol=1e-15,
    )


def planar_impact(model, x, theta, v):
    """Return the velocities [base x, y, angle; link angle] after the tip of link 1 is pinned.

    Newton's and Euler's equations for three planar impulses.
    """
    m = model.body_mass[1:]
    inertia = [np.max(i) for i in model.body_inertia[1:]]
    c = [b[1] for b in model.body_ipos[1:]]
    direction = lambda a: np.array([-np.sin(a), np.cos(a)])
    perpendicular = lambda r: np.array([-r[1], r[0]])
    a1, a2 = theta[0], theta[0] + theta[1]
    elbow, tip = direction(a1), direction(a2)
    w1, w2 = v[2], v[2] + v[3]
    u1 = v[:2] + w1 * perpendicular(c[0] * elbow)
    u2 = v[:2] + w1 * perpendicular(elbow) + w2 * perpendicular(c[1] * tip)
    # Unknowns: u1, w1, u2, w2 after the impact, the impulse P of link 1 on the base, and the
    # impulse G of the ground on link 1.
    A, b = np.zeros((10, 10)), np.zeros(10)
    r1, r2, r2e = (1 - c[0]) * elbow, (1 - c[1]) * tip, -c[1] * tip
    A[0:2, 0:2], A[0:2, 6:8], b[0:2] = m[0] * np.eye(2), -np.eye(2), m[0] * u1
    A[2, 2], A[2, 6:8], b[2] = inertia[0], -perpendicular(r1), inertia[0] * w1
    A[3:5, 3:5], A[3:5, 6:8], A[3:5, 8:10], b[3:5] = (
        m[1] * np.eye(2),
        np.eye(2),
        -np.eye(2),
        m[1] * u2,
    )
    A[5, 5], A[5, 6:8], A[5, 8:10], b[5] = (
        inertia[1],
        perpendicular(r2e),
        -perpendicular(r2),
        inertia[1] * w2,
    )
    A[6:8, 0:2], A[6:8, 2], A[6:8, 3:5], A[6:8, 5] = (
        np.eye(2),
        perpendicular(r1),
        -np.eye(2),
        -perpendicular(r2e),
    )
    A[8:10, 3:5], A[8:10, 5] = np.eye(2), perpendicular(r2)
    u1x, u1y, w1, _, _, w2 = np.linalg.solve(A, b)[:6]
    return np.array([*(np.array([u1x, u1y]) - w1 * perpendicular(c[0] * elbow)), w1, w2 - w1])


SERIAL = """<mujoco><option gravity="0 -9.81 0"/><worldbody><body name="link1" pos="0 2 0"><joint
  name="ground" axis="0 0 1"/>
  <geom type="capsule" fromto="0 -1 0 0 0 0" size="0.03" mass="0.6" contype="0"/><body name="base"
    pos="0 -1 0"><joint name="elbow" axis="0 0 1"/>
  <geom type="capsule" fromto="0 -1 0 0 0 0" size="0.03" mass="1.0" contype="0"/></body></body>
  </worldbody></mujoco>"""


@pytest.mark.slow
def test_attached_in_flight_it_is_the_serial_chain(links):
    """Fig. 13: flight, the tip pinned to the ground as it passes, then 5 s of the serial chain.

    The positions agree with those of the serial two-joint chain to 1e-9.
    """
    chain, _ = links
    theta, v = np.array([0.5, -0.9]), np.array([0.4, 1.1, 0.7, -1.3])
    along = lambda a: np.array([-np.sin(a), np.cos(a)])
    foot = np.array([0, 2]) - along(theta[0]) - along(theta[0] + theta[1])
    q = {"base": [*foot, 0, np.cos(theta[0] / 2), 0, 0, np.sin(theta[0] / 2)], "link1": theta[1]}
    tol = {"rtol": 1e-12, "atol": 1e-13}
    # Integrate back in time from the contact, then forward.
    before = svkc.simulate(
        chain,
        chain.state(q, {"base": [-v[0], -v[1], 0, 0, 0, -v[2]], "link1": -v[3]}, connected=()),
        0.3,
        **tol,
    ).final
    start = svkc.State(before.q, -before.v, before.structure)
    ts = jnp.linspace(0, 5.3, 54)
    traj = svkc.simulate(chain, start, 5.3, ts=ts, events=[svkc.at(0.3, connect="link1v")], **tol)
    after = planar_impact(chain.model.model, foot, theta, v)
    at_contact = traj.states.v[3]
    np.testing.assert_allclose(at_contact[np.array([0, 1, 5, 6])], after, atol=REFERENCE)
    assert float(traj.events.energy_lost[0]) > 0.1
    assert np.linalg.norm(traj.events.impulse[0]) > 0.1
    serial = svkc.load(SERIAL)
    # The serial chain starts at the ground: its first joint carries link 1, its second the base.
    serial_start = serial.state(
        {"ground": theta[0] + theta[1], "elbow": -theta[1]},
        {"ground": after[2] + after[3], "elbow": -after[3]},
    )
    serial_traj = svkc.simulate(serial, serial_start, 5.0, ts=ts[3:] - 0.3, **tol)
    positions, _ = jax.vmap(lambda s: svkc.poses(chain, s))(traj.states)
    serial_positions, _ = jax.vmap(lambda s: svkc.poses(serial, s))(serial_traj.states)
    np.testing.assert_allclose(
        positions[3:, chain.body_names.index("link1")],
        serial_positions[:, serial.body_names.index("base")],
        atol=REFERENCE,
    )
    assert float(traj.gaps.max()) < ROUND_OFF


FREE_TOP = (
    '<mujoco><option gravity="0 0 0"/><worldbody><body name="top"><freejoint name="top"/><geom'
    ' type="box" size="0.1 0.2 0.3"/></body></worldbody></mujoco>'
)


@pytest.mark.slow
def test_rodrigues_euler_is_of_first_order():
    """(39)-(44) on a tumbling free top: half the step has half the error."""
    chain = svkc.load(FREE_TOP)
    state = chain.state(v=np.array([0, 0, 0, 3.0, 0.1, 2.0]))
    exact = svkc.simulate(chain, state, 1.0, rtol=1e-12, atol=1e-13).final
    errors = []
    for dt in (4e-3, 2e-3, 1e-3):
        final = svkc.simulate(
            chain, state, 1.0, dt=dt, solver=svkc.integrators.RodriguesEuler()
        ).final
        errors.append(
            [
                float(jnp.abs(svkc.difference(chain, exact.q, final.q)).max()),
                float(jnp.abs(final.v - exact.v).max()),
            ]
        )
    ratios = np.array(errors)[:-1] / np.array(errors)[1:]
    assert np.all((ratios > 1.85) & (ratios < 2.15)), ratios


@pytest.mark.slow
def test_rodrigues_euler_keeps_quaternions_at_unit_length():
    """After 1e5 steps of a tumbling top the quaternion's norm is one up to round-off.

    Rodrigues' formula alone loses no more than accumulated round-off.
    """
    chain = svkc.load(FREE_TOP)
    state = chain.state(v=np.array([0, 0, 0, 3.0, 0.1, 2.0]))
    traj = svkc.simulate(
        chain, state, 100.0, dt=1e-3, solver=svkc.integrators.RodriguesEuler(), max_steps=100001
    )
    assert int(traj.report().accepted) == 100000
    assert abs(float(jnp.linalg.norm(traj.final.q[3:7])) - 1) < 5e-16
    rotation = quat_exp(jnp.array([3e-3, 1e-4, 2e-3]))
    product = jax.lax.fori_loop(
        0, 100000, lambda i, q: quat_multiply(q, rotation), jnp.array([1.0, 0, 0, 0])
    )
    assert abs(float(jnp.linalg.norm(product)) - 1) < 100000 * 2.3e-16


@pytest.fixture(scope="module")
def benchmark():
    """Return the module benchmarks/joints.py, which builds both figures."""
    spec = importlib.util.spec_from_file_location(
        "joints", pathlib.Path(__file__).parents[2] / "benchmarks" / "joints.py"
    )
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_the_figure_of_40_freedoms(benchmark):
    """Fig. 16: 17 links, 4 hinges and 12 balls move as 41 links of one freedom each."""
    spec, balls = benchmark.hinges_for_balls()
    chains = {"balls": svkc.load(str(benchmark.FIGURE)), "hinges": svkc.load(spec)}
    links = {name: len(chain.topology.parent) - 1 for name, chain in chains.items()}
    assert (links, len(balls), chains["balls"].nv) == ({"balls": 17, "hinges": 41}, 12, 46)
    assert abs(float(chains["balls"].mass.sum()) - 73) < 0.01
    states = benchmark.matching_states(chains, balls, np.random.default_rng(2))
    ends = [
        svkc.simulate(chain, state, 0.2, rtol=1e-10, atol=1e-12).final
        for chain, state in zip(chains.values(), states, strict=True)
    ]
    places = [svkc.poses(chain, end)[0] for chain, end in zip(chains.values(), ends, strict=True)]
    np.testing.assert_allclose(places[0], places[1], atol=REFERENCE)


@pytest.mark.slow
def test_rodrigues_euler_on_the_figure():
    """With balls in a tree, two of them virtual: first order, closed loops, unit quaternions."""
    chain = models.figure40()
    rng = np.random.default_rng(1)
    state = chain.state(v=rng.normal(size=chain.nv))
    run = lambda dt: svkc.simulate(
        chain, state, 0.1, dt=dt, solver=svkc.integrators.RodriguesEuler()
    )
    fine, coarse = run(5e-4), run(1e-3)
    exact = svkc.simulate(chain, state, 0.1, rtol=1e-9, atol=1e-11).final
    error = [
        float(jnp.abs(svkc.difference(chain, exact.q, traj.final.q)).max())
        for traj in (coarse, fine)
    ]
    assert 1.8 < error[0] / error[1] < 2.2
    assert float(fine.gaps.max()) < REFERENCE
    at = chain.topology.quaternion_starts[0][:, None] + np.arange(4)
    np.testing.assert_allclose(jnp.linalg.norm(fine.final.q[at], axis=1), 1, atol=1e-15)
