"""Cuttable joints (Fig. 15): equal to the plain tree before the cut, two free systems after the
cut; joints that break; slots bound in a run."""

import cases
import equinox as eqx
import jax
import jax.numpy as jnp
import models
import mujoco
import numpy as np
import pytest
from tolerances import REFERENCE, ROUND_OFF

import svkc
from svkc.loops.forward_dynamics import acceleration


def state_of(chain, q):
    rng = np.random.default_rng(1)
    v = {k: rng.normal(size=6 if k == "base" else 3 if k == "tip" else 1) for k in q}
    return chain.state(q, v)


@pytest.fixture(params=cases.params("cuttable"), scope="module")
def case(request):
    """Return the plain tree and the tree with a cuttable joint in equal states, with springs,
    limits and motors."""
    case = cases.CASES[request.param]
    plain, chain = case.build(), case.build(cuttable=case.cuttable)
    return plain, chain, case.cuttable[0], state_of(plain, case.pose), state_of(chain, case.pose)


@pytest.mark.slow
def test_before_the_cut_it_is_the_plain_tree(case):
    """Poses, velocities, energy, mobility, acceleration and 0.3 s of motion agree to 1e-9."""
    plain, chain, _, a, b = case
    for x, y in zip(
        svkc.poses(plain, a) + svkc.velocities(plain, a),
        svkc.poses(chain, b) + svkc.velocities(chain, b),
        strict=True,
    ):
        np.testing.assert_allclose(x, y, atol=1e-13)
    np.testing.assert_allclose(svkc.energy(plain, a), svkc.energy(chain, b), rtol=1e-13)
    assert int(svkc.mobility(plain, a).freedoms) == int(svkc.mobility(chain, b).freedoms)
    # where the plain tree's coordinates stand in this one; the plain tree's arrays are understood
    # too
    at = np.array(chain.topology.model_v)
    tau = np.zeros(chain.dofs)
    tau[at] = np.random.default_rng(0).normal(size=plain.nv)
    vdot = svkc.forward_dynamics(plain, a, jnp.asarray(tau[at]))
    np.testing.assert_allclose(
        svkc.forward_dynamics(chain, b, jnp.asarray(tau))[at],
        vdot,
        atol=REFERENCE * max(1, float(jnp.abs(vdot).max())),
    )
    np.testing.assert_allclose(chain.state(a.q, a.v).v, b.v, atol=ROUND_OFF)
    ends = [
        svkc.simulate(c, s, 0.3, rtol=1e-11, atol=1e-13).final for c, s in ((plain, a), (chain, b))
    ]
    for x, y in zip(svkc.poses(plain, ends[0]), svkc.poses(chain, ends[1]), strict=True):
        np.testing.assert_allclose(x, y, atol=REFERENCE)


@pytest.mark.slow
def test_after_the_cut_there_are_two_systems(case):
    """The state is continuous at the cut; without gravity the momentum of the free part is
    conserved to 1e-12."""
    _, chain, cut, _, state = case
    free = svkc.cut(chain, state, cut)
    assert bool(jnp.all(free.q == state.q))
    assert bool(jnp.all(free.v == state.v))
    lost = svkc.mobility(chain, free).freedoms - svkc.mobility(chain, state).freedoms
    assert int(lost) == 6 - sum(chain.topology.link_freedoms[0])
    weightless = eqx.tree_at(lambda c: c.gravity, chain, jnp.zeros(3))
    traj = svkc.simulate(
        weightless,
        state,
        0.4,
        events=[svkc.at(0.2, cut=cut)],
        ts=jnp.array([0.2, 0.4]),
        rtol=1e-10,
        atol=1e-12,
    )
    part = bodies_beyond_cut(chain)
    at_cut, later = (
        part_momentum(weightless, jax.tree.map(lambda x, i=i: x[i], traj.states), part)
        for i in (0, 1)
    )
    np.testing.assert_allclose(
        later[0], at_cut[0], atol=ROUND_OFF * max(1, np.abs(at_cut[0]).max())
    )
    np.testing.assert_allclose(
        later[1], at_cut[1], atol=REFERENCE * max(1, np.abs(at_cut[1]).max())
    )


def bodies_beyond_cut(chain):
    """Return the mask of bodies on the far side of the first cuttable joint."""
    model, inside = chain.model.model, np.zeros(len(chain.body_names), bool)
    inside[chain.topology.body_row.index(chain.topology.link_child[0])] = True
    for body in range(1, len(inside)):
        inside[body] |= inside[model.body_parentid[body]]
    return inside


def part_momentum(chain, state, part):
    """Return linear and angular momentum of some bodies, from poses, velocities and the model's
    inertias, in NumPy."""
    model = chain.model.model
    pos, quat = (np.asarray(x) for x in svkc.poses(chain, state))
    lin, ang = (np.asarray(x) for x in svkc.velocities(chain, state))
    p, L = np.zeros(3), np.zeros(3)
    for b in np.flatnonzero(part):
        R, Ri = np.zeros(9), np.zeros(9)
        mujoco.mju_quat2Mat(R, quat[b])
        mujoco.mju_quat2Mat(Ri, model.body_iquat[b])
        R, Ri = R.reshape(3, 3), R.reshape(3, 3) @ Ri.reshape(3, 3)
        c = R @ model.body_ipos[b]
        u = lin[b] + np.cross(ang[b], c)
        p += model.body_mass[b] * u
        L += np.cross(pos[b] + c, model.body_mass[b] * u) + Ri @ (
            model.body_inertia[b] * (Ri.T @ ang[b])
        )
    return p, L


@pytest.mark.slow
def test_a_link_in_the_middle_of_a_loop():
    """Cut the coupler joint of a four-bar: the loop at the rocker stays closed and the crank swings
    freely. Then connect the joint again."""
    chain = models.four_bar(cuttable="coupler")
    state = chain.state(v={"crank": 2.0})
    plain = models.four_bar()
    np.testing.assert_allclose(
        svkc.poses(plain, plain.state(v={"crank": 2.0}))[0],
        svkc.poses(chain, state)[0],
        atol=ROUND_OFF,
    )
    assert int(svkc.mobility(chain, state).freedoms) == 1
    traj = svkc.simulate(
        chain,
        state,
        0.3,
        events=[svkc.at(0.1, cut="coupler")],
        ts=jnp.linspace(0, 0.3, 7),
        rtol=1e-10,
        atol=1e-12,
    )
    assert traj.phases.freedoms[:2].tolist() == [1, 3]
    assert float(traj.gaps.max()) < ROUND_OFF
    assert float(jnp.abs(traj.phases.energy_drift[:2]).max()) < 1e-8
    before = svkc.kinetic_energy(chain, traj.final)
    again = svkc.connect(chain, traj.final, "coupler", here=True)
    assert int(svkc.mobility(chain, again).freedoms) == 1
    assert float(svkc.kinetic_energy(chain, again)) <= float(before)


@pytest.mark.slow
def test_springs_ranges_and_motors_go_with_the_joint():
    """A hinge with springs, limits, motors and ref: equal motion while connected, and no force of
    them once cut."""
    xml = """<mujoco><compiler angle="radian"/><worldbody><body name="a"><joint name="a"
      axis="0 1 0" armature="0.05"/><geom type="capsule" fromto="0 0 0 0 0 -1" size="0.05"/>
      <body name="b" pos="0 0 -1" euler="0.2 0 0.1"><joint name="b" axis="0.3 1 0" pos="0.02 0 0"
        ref="0.3" damping="0.2" stiffness="4" springref="0.5"
       range="-0.2 0.6" limited="true"/><geom type="capsule" fromto="0 0 0 0 0 -1"
         size="0.05"/></body></body></worldbody>
      <actuator><motor joint="b" gear="3"/></actuator></mujoco>"""
    plain, chain = svkc.load(xml), svkc.load(xml, cuttable="b")
    a, b = (c.state({"a": 0.4, "b": 0.55}, {"a": 1.0, "b": 2.0}) for c in (plain, chain))
    np.testing.assert_allclose(svkc.energy(plain, a), svkc.energy(chain, b), rtol=1e-13)
    u = jnp.array([0.7])
    tau = jnp.linspace(-1.0, 2.0, chain.dofs)
    usual, bodies = (
        acceleration(chain, b.structure, b.q, b.v, tau, way)
        for way in (svkc.dynamics.CompositeBodies(), svkc.dynamics.ArticulatedBodies())
    )
    np.testing.assert_allclose(bodies, usual, atol=1e-10 * float(jnp.abs(usual).max()))
    motors = {c.dofs: lambda t, s, args, c=c: c.motors(u) for c in (plain, chain)}
    run = lambda c, s, t1: svkc.simulate(c, s, t1, control=motors[c.dofs], rtol=1e-11, atol=1e-13)
    ends = [run(c, s, 0.5) for c, s in ((plain, a), (chain, b))]
    np.testing.assert_allclose(
        svkc.poses(plain, ends[0].final)[0], svkc.poses(chain, ends[1].final)[0], atol=REFERENCE
    )
    np.testing.assert_allclose(ends[0].phases.work, ends[1].phases.work, rtol=1e-8)
    free = svkc.cut(chain, b, "b")
    # its centre of mass falls freely
    alone = run(chain, free, 0.2).final
    com = lambda s: (
        svkc.poses(chain, s)[0][2]
        + svkc.tree.spatial.quat_rotate(
            svkc.poses(chain, s)[1][2], jnp.asarray(chain.model.model.body_ipos[2])
        )
    )
    lin, ang = svkc.velocities(chain, free)
    u0 = lin[2] + jnp.cross(ang[2], com(free) - svkc.poses(chain, free)[0][2])
    np.testing.assert_allclose(
        com(alone), com(free) + 0.2 * u0 + 0.02 * chain.gravity, atol=REFERENCE
    )
    again = svkc.connect(chain, alone, "b", here=True)
    assert float(svkc.kinetic_energy(chain, again)) <= float(svkc.kinetic_energy(chain, alone))


@pytest.mark.slow
def test_a_joint_that_breaks():
    """The pivot of a pendulum breaks at 50 N: the load equals the closed form, then the pendulum
    falls freely."""
    xml = models.ARM.replace('gravity="0.3 -0.2 -9.81"', 'gravity="0 0 -10"')
    chain = svkc.load(xml, cuttable="arm")
    limit = 50.0
    start = chain.state({"arm": 1.5})
    events = [
        svkc.when(svkc.overload(chain, "arm", force=limit), cut="arm", direction=True, stop=True)
    ]
    traj = svkc.simulate(chain, start, 1.0, events=events, rtol=1e-10, atol=1e-12)
    model = chain.model.model
    m, c, inertia = (
        float(model.body_mass[1]),
        float(-model.body_ipos[1, 2]),
        1 / float(model.dof_invweight0[0]),
    )
    angles = np.linspace(1.5, 0, 200001)
    rate2 = 2 * m * 10 * c * (np.cos(angles) - np.cos(1.5)) / inertia
    turn = -m * 10 * c * np.sin(angles) / inertia
    load = m * np.hypot(c * rate2 + 10 * np.cos(angles), c * turn + 10 * np.sin(angles))
    expected = angles[np.argmax(load >= limit)]
    assert abs(float(traj.final.q[-1]) - expected) < 1e-4
    assert int(svkc.mobility(chain, traj.final).freedoms) == 6
    # the moment before
    broken = svkc.State(traj.final.q, traj.final.v, start.structure)
    loop_forces = svkc.loop_forces(chain, broken, jnp.zeros(chain.dofs))
    assert abs(float(jnp.linalg.norm(loop_forces.force[0])) - limit) < 1e-6


ROTORS = models.MJCF.format(
    models.bar(
        "a",
        'type="hinge" axis="0 1 0" armature="0.3"',
        "0 0 -1",
        inside=models.bar("b", 'type="hinge" axis="0 1 0" armature="0.2"', "0 0 -1", "0 0 -1"),
    )
)


def test_armature_is_left_out_joint_by_joint():
    """The mass matrix is MuJoCo's without the armature of the named joints; a cuttable joint has
    none."""
    model = mujoco.MjModel.from_xml_string(ROTORS)
    data, M = mujoco.MjData(model), np.zeros((2, 2))
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, M)
    for ignored, left_out in ((["a"], [0.3, 0]), ("b", [0, 0.2]), (["b", "a"], [0.3, 0.2])):
        chain = svkc.load(ROTORS, ignore_armature=ignored)
        np.testing.assert_allclose(
            svkc.mass_matrix(chain, chain.state()), M - np.diag(left_out), atol=1e-13
        )
    assert chain.armature is None
    with pytest.raises(ValueError, match=r"armature on a; .*ignore_armature=\['a'\]\)"):
        svkc.load(ROTORS, cuttable="a", ignore_armature="b")
    chain = svkc.load(ROTORS, cuttable="a", ignore_armature=["a"])
    assert chain.armature.tolist() == [0, 0, 0, 0, 0, 0, 0.2]
    assert svkc.load(ROTORS, cuttable="a", ignore="armature").armature is None
    with pytest.raises(ValueError, match="no joint 'nose'; joints: a, b"):
        svkc.load(ROTORS, ignore_armature="nose")


SPARE = models.MJCF.format(
    models.bar("arm", models.Y, "0 0 -1")
    + '<body name="ball" pos="0.8 0 -0.6"><freejoint name="ball"/><geom size="0.1"'
    ' contype="0"/></body>'
)


@pytest.fixture(scope="module")
def gripped():
    """Return a chain with one spare slot, a state, and a run with six binds and unbinds at given
    times; times after the end do not happen."""
    chain = svkc.load(SPARE, spare=1)
    state = chain.state({"arm": -0.9})

    def run(times, **kw):
        events = [
            svkc.at(times[0], bind=svkc.Grip("arm", "ball", joint="hinge", axis=(0, 1, 0))),
            svkc.at(times[1], unbind=("arm", "ball")),
            svkc.at(times[2], bind=svkc.Grip("world", "ball", joint="ball", real_pos=(0, 0, 0.1))),
            svkc.at(times[3], bind=svkc.Grip("world", "ball")),
            svkc.at(times[4], unbind="spare_0"),
            svkc.at(times[5], bind=svkc.Grip("world", "arm", slot="spare_0")),
        ]
        return svkc.simulate(
            chain,
            state,
            0.6,
            ts=jnp.linspace(0, 0.6, 13),
            events=events,
            rtol=1e-9,
            atol=1e-11,
            **kw,
        )

    return chain, state, run


@pytest.mark.slow
def test_grips_bound_during_a_run(gripped):
    """One spare slot, three consecutive grips between bodies that the model does not join, in one
    program."""
    chain, state, run = gripped
    traj = run((0.1, 0.2, 0.3, 0.35, 0.4, 0.5))
    # what is gripped already stays as it is: no change at 0.35
    assert traj.phases.freedoms[:7].tolist() == [7, 2, 7, 4, 4, 7, 6]
    assert float(traj.gaps.max()) < ROUND_OFF
    assert np.all(np.asarray(traj.events.energy_lost) >= 0)
    assert float(traj.events.energy_lost[3]) == 0
    assert np.linalg.norm(traj.events.impulse[0, 0]) > 0.1
    # the same, by hand
    held = svkc.simulate(chain, state, 0.1, rtol=1e-9, atol=1e-11).final
    by_hand = svkc.connect(
        chain,
        svkc.bind(chain, held, "spare_0", "arm", "ball", joint="hinge", axis=(0, 1, 0)),
        "spare_0",
        here=True,
    )
    np.testing.assert_allclose(
        svkc.simulate(chain, by_hand, 0.1, rtol=1e-9, atol=1e-11).final.v[:7],
        traj.states.v[4, :7],
        atol=1e-7,
    )
    unbound = svkc.unbind(chain, by_hand, "spare_0")
    assert int(svkc.mobility(chain, unbound).freedoms) == 7


@pytest.mark.slow
def test_no_slot_left(gripped):
    """Without a free slot the run ends with `no_slot`, and the existing grip stays connected."""
    _, _, run = gripped
    times = (0.1, 9.0, 0.2, 9.0, 9.0, 9.0)
    traj = run(times, throw=False)
    assert traj.result == svkc.RESULTS.no_slot
    assert float(traj.t_final) == 0.2
    assert traj.final.structure.connected.tolist() == [True]
    with pytest.raises(RuntimeError, match="every spare slot was bound"):
        run(times)
