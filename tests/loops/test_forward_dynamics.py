"""Forward dynamics of closed chains, compared with an independent KKT solution; loop forces."""

import cases
import jax
import jax.numpy as jnp
import models
import numpy as np
import pytest
from kkt import constrained_acceleration
from references import paper
from tolerances import REFERENCE, ROUND_OFF

import svkc
from svkc.loops.forward_dynamics import acceleration as acceleration_by
from svkc.tree.configuration import configuration_derivative
from svkc.tree.inverse_dynamics import limit_forces


@pytest.fixture(params=cases.params("loops"), scope="module")
def case(request):
    """Return the name of a case, its chain, a moving state and joint torques."""
    return request.param, *cases.CASES[request.param].random_motion()


def test_acceleration_equals_the_kkt_solution(case):
    _, chain, state, tau = case
    tau = tau.at[chain.nv :].set(0)
    expected = constrained_acceleration(chain, state, tau)
    scale = np.abs(expected).max()
    fast = svkc.forward_dynamics(chain, state, tau)
    columns = paper.forward_dynamics_by_unit_vectors(chain, state, tau)
    bodies = acceleration_by(
        chain, state.structure, state.q, state.v, tau, svkc.dynamics.ArticulatedBodies()
    )
    assert np.abs(fast[: chain.nv] - expected).max() < REFERENCE * scale
    assert np.abs(columns - fast).max() < 1e-10 * np.abs(fast).max()
    assert np.abs(bodies - fast).max() < 1e-10 * np.abs(fast).max()


def assert_loops_stay_closed(chain, state, vdot):
    """Assert that the derivative of J_C v along the motion is zero."""
    relative = lambda q, v: svkc.loop_gap_rates(chain, svkc.State(q, v, state.structure))
    _, change = jax.jvp(
        relative, (state.q, state.v), (configuration_derivative(chain, state.q, state.v), vdot)
    )
    assert float(jnp.max(jnp.abs(change))) < REFERENCE * max(1, float(jnp.max(jnp.abs(vdot))))


def test_velocities_and_accelerations_keep_the_loops(case):
    """Gaps, their rates and their accelerations are zero."""
    name, chain, state, tau = case
    assert float(jnp.max(jnp.abs(svkc.loop_gaps(chain, state)))) < ROUND_OFF
    assert float(jnp.max(jnp.abs(svkc.loop_gap_rates(chain, state)))) < ROUND_OFF
    assert_loops_stay_closed(chain, state, svkc.forward_dynamics(chain, state, tau))
    assert int(svkc.mobility(chain, state).freedoms) == cases.CASES[name].freedoms


def test_loop_forces_and_torques_explain_the_acceleration(case):
    """The loop forces do the power that tau lacks, on any velocity of the tree."""
    _, chain, state, tau = case
    force, torque = svkc.loop_forces(chain, state, tau)
    vdot = svkc.forward_dynamics(chain, state, tau)
    missing = svkc.inverse_dynamics(chain, state, vdot) - tau[: chain.nv]
    rng = np.random.default_rng(0)
    v = jnp.asarray(rng.normal(size=chain.nv))
    tree_motion = svkc.State(
        state.q, jnp.concatenate([v, jnp.zeros(chain.dofs - chain.nv)]), state.structure
    )
    relative = svkc.loop_gap_rates(chain, tree_motion)
    power = -jnp.sum(relative[:, :3] * torque) - jnp.sum(relative[:, 3:] * force)
    assert abs(float(missing @ v - power)) < 1e-8 * max(1.0, float(jnp.max(jnp.abs(force))))


def test_inverse_dynamics_inverts_forward_dynamics_without_joint_limits():
    """Outside of its range, with a spring and a damper: both leave out the torque of the limit,
    which `step` adds."""
    joint = 'type="hinge" axis="0 1 0" range="-20 20" limited="true" stiffness="3" damping="0.5"'
    chain = svkc.load(models.MJCF.format(models.bar("arm", joint, "0 0 -1")))
    tau, dt = jnp.array([0.4]), 1e-8
    state = chain.state([1.0], [0.7])
    vdot = svkc.forward_dynamics(chain, state, tau)
    np.testing.assert_allclose(svkc.inverse_dynamics(chain, state, vdot), tau, atol=ROUND_OFF)
    limit = limit_forces(chain, state.q, state.v)
    assert abs(float(limit[0])) > 1
    # round-off of the difference of velocities: 1e-16 / dt
    vdot = (svkc.step(chain, state, tau, dt).v - state.v) / dt
    np.testing.assert_allclose(svkc.inverse_dynamics(chain, state, vdot), tau + limit, rtol=1e-5)


@pytest.mark.slow
def test_redundant_loop_moves_like_its_minimal_form():
    chain = models.parallelogram()
    both = chain.state(v={"leg0": 0.7})
    one = chain.state(v={"leg0": 0.7}, connected=["pin2"])
    m = svkc.mobility(chain, both)
    assert int(m.freedoms) == 1
    assert int(jnp.sum(m.redundant)) == 12 - int(m.rank)
    tau = jnp.zeros(chain.dofs)
    a, b = svkc.forward_dynamics(chain, both, tau), svkc.forward_dynamics(chain, one, tau)
    # without pin1 the middle leg swings freely, so that each result is compared with its own
    # KKT solution
    leg_joints = np.array([n in ("leg0", "plate", "leg2") for n in chain.joint_names])
    assert float(jnp.abs(svkc.loop_gap_rates(chain, both)).max()) < 1e-13
    expected = constrained_acceleration(chain, one, tau)
    np.testing.assert_allclose(
        np.asarray(b)[: chain.nv][leg_joints], expected[leg_joints], rtol=REFERENCE
    )
    np.testing.assert_allclose(
        np.asarray(a)[: chain.nv],
        constrained_acceleration(chain, both, tau),
        rtol=REFERENCE,
        atol=ROUND_OFF,
    )


JOINTS = [
    "weld",
    "hinge",
    "slide",
    "cylinder",
    "universal",
    "planar",
    "ball",
    "free",
    (True, False, True, False, True, False),
]


@pytest.mark.slow
@pytest.mark.parametrize("joint", JOINTS)
def test_every_kind_of_virtual_joint(joint):
    """Two free bodies connected by the joint have the expected rank and keep the loop closed.

    The joint's coordinates computed from the bodies' poses are those of the state.
    """
    xml = models.MJCF.format(
        '<body name="a" pos="0 0 1"><freejoint/><geom type="box" size="0.1 0.2 0.3"'
        ' contype="0"/></body><body name="b" pos="0.5 0.1 1" quat="0.8 0 0.6 0"><freejoint/><geom'
        ' type="box" size="0.2 0.1 0.15" contype="0"/></body>'
    )
    link = svkc.VirtualLink(
        "j", "a", "b", joint, pos=(0.3, 0, 0), axis=(0.2, 0.3, 1), connected=True
    )
    chain = svkc.load(xml, virtual_links=[link])
    rng = np.random.default_rng(5)
    q = np.array(chain.q_load)
    q[chain.nq :] += 0.2 * rng.normal(size=len(q) - chain.nq)
    state = chain.state(v=rng.normal(size=chain.nv))
    freedoms = chain.dofs - chain.nv
    assert int(svkc.mobility(chain, state).rank) == 6
    assert int(svkc.mobility(chain, state).freedoms) == 6 + freedoms
    assert float(jnp.max(jnp.abs(svkc.loop_gap_rates(chain, state)))) < ROUND_OFF
    tau = jnp.asarray(rng.normal(size=chain.nv))
    assert_loops_stay_closed(chain, state, svkc.forward_dynamics(chain, state, tau))
    if joint not in (
        "weld",
        "universal",
        "cylinder",
        "ball",
        (True, False, True, False, True, False),
    ):
        return
    final = svkc.simulate(chain, state, 0.3, rtol=1e-9, atol=1e-11).final
    assert float(jnp.max(jnp.abs(svkc.loop_gaps(chain, final)))) < ROUND_OFF
    # energy of the two bodies under gravity alone is kept: the joint does no work
    assert abs(float(svkc.energy(chain, final) - svkc.energy(chain, state))) < 1e-6
    from svkc.transitions.placement import joint_coordinates
    from svkc.tree.kinematics import kinematics

    read = joint_coordinates(chain, final.structure, kinematics(chain, final.q), final.q)
    np.testing.assert_allclose(svkc.difference(chain, final.q, read), 0, atol=1e-10)


@pytest.mark.slow
def test_spare_slots_change_nothing():
    numbers = []
    for spare in (0, 1, 4):
        chain = models.four_bar(spare=spare)
        state = chain.state(v={"crank": 1.0})
        vdot = svkc.forward_dynamics(chain, state, jnp.zeros(chain.nv))
        m = svkc.mobility(chain, state)
        assert (int(m.joint_freedoms), int(m.rank), int(m.freedoms)) == (4, 3, 1)
        numbers.append(np.concatenate([state.q[:4], state.v[:4], vdot[:4]]))
    for other in numbers[1:]:
        np.testing.assert_allclose(other, numbers[0], rtol=1e-13, atol=1e-13)


GRIP = svkc.Grip("world", "rocker", joint="ball", real_pos=(0.2, 0, -0.6))


@pytest.fixture(scope="module")
def gripped():
    """Return a four-bar whose pin is a grip in a spare slot, and one with a declared pin.

    The first comes with its states before and after the grip, the second with its state.
    """
    declared = models.four_bar()
    a = declared.state(v={"crank": 1.0})
    chain = svkc.load(models.MJCF.format(models.FOUR_BAR), spare=1)
    open_ = chain.state(v=np.asarray(a.v)[:3])
    bound = svkc.bind(
        chain, open_, "spare_0", GRIP.parent, GRIP.real, joint=GRIP.joint, real_pos=GRIP.real_pos
    )
    return chain, open_, svkc.connect(chain, bound, "spare_0", here=True), declared, a


@pytest.mark.slow
def test_bind_a_spare_slot(gripped):
    """A grip bound at run time moves as a declared link; unbinding empties its slot."""
    chain, _, gripped, declared, a = gripped
    np.testing.assert_allclose(gripped.v[:3], a.v[:3], atol=ROUND_OFF)
    f = svkc.forward_dynamics
    np.testing.assert_allclose(
        f(chain, gripped, jnp.zeros(3))[:3], f(declared, a, jnp.zeros(3))[:3], rtol=REFERENCE
    )
    empty = svkc.unbind(chain, gripped, "spare_0")
    assert empty.structure.connected.tolist() == [False]
    np.testing.assert_array_equal(empty.structure.real, chain.structure.real)
    np.testing.assert_array_equal(empty.v[:3], gripped.v[:3])


@pytest.mark.slow
def test_bind_a_spare_slot_in_a_run(gripped):
    """An event at the start of a run gives the same state as `bind` and `connect`."""
    chain, open_, gripped, *_ = gripped
    traj = svkc.simulate(chain, open_, 1e-3, dt=1e-3, events=[svkc.at(0.0, bind=GRIP)])
    for ours, theirs in zip(
        jax.tree.leaves(jax.tree.map(lambda x: x[0], traj.states)),
        jax.tree.leaves(gripped),
        strict=True,
    ):
        np.testing.assert_allclose(ours, theirs, atol=ROUND_OFF)


@pytest.mark.parametrize("outside", [1e-300, 1e-160, 1e-9])
def test_derivatives_of_joint_ranges_are_finite_just_outside(outside):
    rod = models.bar("rod", models.Y + ' range="0 30" limited="true"', "0 0 1")
    chain = svkc.load(models.MJCF.format(rod))
    force = lambda q: limit_forces(chain, q, jnp.ones(1))
    value, slope = jax.jvp(force, (jnp.array([-outside]),), (jnp.ones(1),))
    assert value.tolist() == slope.tolist() == [0.0]
