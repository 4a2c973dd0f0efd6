"""Coordinates, torques and parameters by name."""

import cases
import jax
import jax.numpy as jnp
import models
import numpy as np
import pytest
from tolerances import ROUND_OFF

import svkc

# MuJoCo warns so of gymnasium's half_cheetah.xml
pytestmark = pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass' is deprecated")

NAMES = [
    name if "fast" in case.tags.split() else pytest.param(name, marks=pytest.mark.slow)
    for name, case in cases.CASES.items()
]


@pytest.mark.parametrize("name", NAMES)
def test_joints_and_links_partition_the_coordinates(name):
    """The slices of all joints and virtual links are disjoint, and cover q and v."""
    chain = cases.CASES[name].build()
    top = chain.topology
    cuttable = {joint: link for joint, link, _ in top.cuttable_joints}
    named = [*chain.joint_names, *cuttable]
    named += [n for i, n in enumerate(chain.link_names) if i not in cuttable.values()]
    for index, size in ((chain.q_index, top.nq_all), (chain.v_index, chain.dofs)):
        covered = np.concatenate([np.arange(size)[index(n)] for n in named])
        np.testing.assert_array_equal(np.sort(covered), np.arange(size))
    for n in named:
        coordinates = chain.dof_names[chain.v_index(n)]
        assert all(c == n or c.startswith(f"{n}.") for c in coordinates), (n, coordinates)


def test_joints_are_named_in_states_of_any_shape():
    chain = cases.CASES["arm"].build(cuttable=cases.CASES["arm"].cuttable)
    q = {"base": [0, 0, 2, 0.8, 0.6, 0, 0], "right_shoulder_flexion": 0.6, "left_elbow": 0.4}
    state = chain.state(q, {"left_elbow": 1.5})
    for joint, value in q.items():
        np.testing.assert_allclose(chain.joint(state, joint).q, value, atol=ROUND_OFF)
    elbow = jax.jit(lambda s: chain.joint(s, "left_elbow"))(state)
    assert elbow.q.shape == ()
    assert float(elbow.v) == pytest.approx(1.5)
    lanes = jax.tree.map(lambda x: jnp.stack([x] * 3)[None], state)
    assert chain.joint(lanes, "left_elbow").v.shape == (1, 3)
    assert chain.joint(lanes, "base").q.shape == (1, 3, 7)
    assert chain.body_index("world") == 0
    assert chain.body_names[chain.body_index("torso")] == "torso"


def test_a_virtual_link_has_the_coordinates_of_its_joint():
    chain = models.four_bar()
    state = chain.state({"crank": 0.3})
    assert chain.joint(state, "pin").q.shape == ()
    assert bool(chain.connected(state, "pin"))
    lanes = jax.tree.map(lambda x: jnp.stack([x, x]), svkc.cut(chain, state, "pin"))
    np.testing.assert_array_equal(chain.connected(lanes, "pin"), [False, False])
    assert chain.q_index("pin") == slice(chain.nq, chain.topology.nq_all)
    welded = svkc.load(models.ARM, virtual_links=[svkc.VirtualLink("w", "world", "arm")])
    assert chain.dofs - chain.nv == 1
    assert welded.joint(welded.state(), "w").q.shape == (0,)


@pytest.mark.slow
def test_torques_by_name_are_those_of_the_array():
    chain = cases.CASES["pivot"].build()
    state = chain.state({"arm": 0.7})
    tau = chain.torques({"tip": [0.1, 0.2, 0.3], "arm": 2.0})
    expected = np.zeros(chain.dofs)
    expected[chain.v_index("arm")], expected[chain.v_index("tip")] = 2.0, [0.1, 0.2, 0.3]
    np.testing.assert_array_equal(tau, expected)
    np.testing.assert_array_equal(chain.torques({}), np.zeros(chain.dofs))
    named = {"tip": jnp.array([0.1, 0.2, 0.3]), "arm": 2.0}
    for of in (
        lambda t: svkc.forward_dynamics(chain, state, t),
        lambda t: svkc.step(chain, state, t, 0.01).v,
    ):
        np.testing.assert_array_equal(of(named), of(tau))
        np.testing.assert_array_equal(jax.jit(of)(named), jax.jit(of)(tau))
    by_name = jax.grad(lambda t: svkc.forward_dynamics(chain, state, t).sum())(named)
    by_array = jax.grad(lambda t: svkc.forward_dynamics(chain, state, t).sum())(tau)
    np.testing.assert_allclose(by_name["arm"], by_array[chain.v_index("arm")][0], rtol=1e-14)


@pytest.mark.slow
def test_control_and_loop_forces_take_torques_by_name():
    chain = models.four_bar()
    state = chain.state({"crank": 0.3})
    of_names = lambda t, state, args: {"crank": args * jnp.cos(t)}
    of_array = lambda t, state, args: jnp.zeros(3).at[chain.v_index("crank")].set(args * jnp.cos(t))
    runs = [
        svkc.simulate(chain, state, 0.1, control=control, args=jnp.asarray(20.0), dt=0.01)
        for control in (of_names, of_array)
    ]
    np.testing.assert_array_equal(runs[0].final.v, runs[1].final.v)
    assert float(jnp.abs(runs[0].work[-1, 0])) > 0.1
    forces = [svkc.loop_forces(chain, state, tau) for tau in ({"crank": 3.0}, [3.0, 0, 0])]
    np.testing.assert_array_equal(forces[0].force, forces[1].force)
    force, torque = forces[0].wrench("pin")
    np.testing.assert_array_equal(
        jnp.stack([force, torque]), [forces[0].force[0], forces[0].torque[0]]
    )
    with pytest.raises(ValueError, match="no virtual link 'pim'; did you mean 'pin'"):
        forces[0].wrench("pim")


MODEL = """<mujoco><compiler angle="radian"/><worldbody>
  <body name="base"><joint name="slide" type="slide" axis="1 0 0"/>
    <joint name="turn" axis="0 0 1" {turn}/>
    <inertial pos="0 0 0.1" mass="{mass}" diaginertia="{inertia}"/>
    <body name="tip" pos="{pos}"><joint name="bend" axis="{axis}" {bend}/>
      <geom size="0.1"/></body></body></worldbody></mujoco>"""
BEFORE = {
    "turn": 'damping="0.1" range="-1 1" stiffness="2" springref="0.1"',
    "mass": "2",
    "inertia": "0.1 0.2 0.25",
    "pos": "0 0 0.5",
    "axis": "0 1 0",
    "bend": "",
}


@pytest.mark.parametrize(
    ("changed", "replaced"),
    [
        ({"mass": "3"}, {"mass": {"base": 3.0}}),
        ({"inertia": "0.3 0.3 0.4"}, {"inertia": {"base": [0.3, 0.3, 0.4]}}),
        (
            {"mass": "3", "inertia": "0.15 0.3 0.375"},
            {"mass": {"base": 3.0}, "scale_inertia": True},
        ),
        ({"axis": "0 0.6 0.8"}, {"axis": {"bend": [0, 1.2, 1.6]}}),
        ({"bend": 'damping="0.4"'}, {"damping": {"bend": 0.4}}),
        ({"bend": 'armature="0.4"'}, {"armature": {"bend": 0.4}}),
        ({"bend": 'stiffness="3"'}, {"stiffness": {"bend": 3.0}}),
        (
            {"bend": 'stiffness="3" springref="0.2"'},
            {"stiffness": {"bend": 3.0}, "q_spring": {"bend": 0.2}},
        ),
        (
            {"turn": 'damping="0.1" range="-2 3" stiffness="2" springref="0.1"'},
            {"limit": {"turn": [-2, 3]}},
        ),
    ],
)
def test_replaced_parameters_are_those_of_the_changed_model(changed, replaced):
    """A chain with replaced parameters is the chain of a model with these parameters."""
    chain = svkc.load(MODEL.format(**BEFORE)).replace(**replaced)
    expected = svkc.load(MODEL.format(**(BEFORE | changed)))
    for name in ("mass", "com", "inertia", "axis", "damping", "armature", "stiffness", "q_spring"):
        got, want = getattr(chain, name), getattr(expected, name)
        assert (got is None) == (want is None), name
        if got is not None:
            np.testing.assert_allclose(got, want, atol=1e-15, err_msg=name)
    np.testing.assert_array_equal(chain.limit, expected.limit)


def test_a_body_is_placed_by_its_first_joint():
    """A body with several joints has one row for each; its placement is that of the first row."""
    chain = svkc.load(MODEL.format(**BEFORE))
    moved = chain.replace(pos={"tip": [0.3, 0, 0.5], "base": [0, 1.0, 0]})
    before, after = (svkc.poses(c, c.state({"slide": 0.2})).position for c in (chain, moved))
    np.testing.assert_allclose(after - before, [[0, 0, 0], [0, 1, 0], [0.3, 1, 0]], atol=1e-15)
    base = moved.body("base")
    np.testing.assert_allclose(base.pos, [0, 1, 0])
    np.testing.assert_allclose(jnp.diag(base.inertia), [0.1, 0.2, 0.25], rtol=1e-12)
    assert float(base.mass) == 2.0


def test_parameters_by_name_have_derivatives():
    chain = models.four_bar()
    state = chain.state({"crank": 0.3})

    def first_acceleration(mass):
        heavier = chain.replace(mass={"coupler": mass}, scale_inertia=True)
        return svkc.forward_dynamics(heavier, state, {"crank": 1.0})[0]

    at = chain.body("coupler").mass
    for mode in ("forward", "reverse"):
        assert svkc.check_grad(first_acceleration, at, mode=mode).error < 1e-6
