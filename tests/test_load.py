"""Models in: everything read, everything else named."""

import models
import mujoco
import numpy as np
import pytest

import svkc

PENDULUM = models.MJCF.format(models.bar("arm", models.Y, "0 0 -1"))


def test_four_ways_in(tmp_path):
    path = tmp_path / "model.xml"
    path.write_text(PENDULUM)
    sources = [PENDULUM, path, str(path), mujoco.MjSpec.from_string(PENDULUM), mujoco.MjModel.from_xml_string(PENDULUM)]
    for chain in map(svkc.load, sources):
        assert chain.body_names == ("world", "arm")
        assert chain.joint_names == ("arm",)
        assert (chain.nq, chain.nv, chain.dofs) == (1, 1, 1)


def test_pointers():
    chain = models.four_bar()
    names = chain.body_names + chain.link_names
    at = {n: i for i, n in enumerate(names)}
    assert names[chain.parent[at["coupler"]]] == "crank"
    assert names[chain.child[at["crank"]]] == "coupler"
    assert names[chain.child[at["world"]]] == "crank"
    assert names[chain.brother[at["crank"]]] == "pin"
    assert names[chain.real[at["pin"]]] == "rocker"
    assert chain.real[at["crank"]] == -1


def test_equalities_become_virtual_links():
    xml = """<mujoco><worldbody><body name="a" pos="0 0 1"><joint name="a" axis="0 1 0"/><geom size="0.1"/></body>
    <body name="b" pos="1 0.2 1" quat="0.8 0 0.6 0"><freejoint/><geom size="0.1"/></body></worldbody>
    <equality><connect name="c" body1="a" body2="b" anchor="1 0.2 0"/><weld name="w" body1="a" body2="b" active="false"/></equality></mujoco>"""
    chain = svkc.load(xml)
    assert chain.link_names == ("c", "w")
    state = chain.state()
    assert state.structure.connected.tolist() == [True, False]
    assert int(svkc.mobility(chain, state).freedoms) == 7 - 3
    assert int(svkc.mobility(chain, chain.state(connected=["w"])).freedoms) == 7 - 6
    # both hold in the load pose, where MuJoCo wrote them
    np.testing.assert_allclose(chain.state(connected=["c", "w"]).q[: chain.nq], chain.model.model.qpos0, atol=1e-12)


def test_motors():
    xml = models.MJCF.format(models.bar("arm", models.Y, "0 0 -1", inside=models.bar("ball", 'type="ball"', "0 0 -1", "0 0 -1")))
    xml = xml.replace("</mujoco>", '<actuator><motor joint="arm" gear="3" ctrlrange="-1 1"/><motor joint="ball" gear="0 2 1"/></actuator></mujoco>')
    chain = svkc.load(xml)
    data = mujoco.MjData(chain.model.model)
    data.ctrl[:] = 5, 0.5
    mujoco.mj_forward(chain.model.model, data)
    import jax.numpy as jnp

    np.testing.assert_allclose(chain.motors(jnp.array([5, 0.5])), data.qfrc_actuator)
    assert chain.actuated.tolist() == [True, False, True, True]
    assert svkc.load(PENDULUM).actuated.tolist() == [True]
    with pytest.raises(ValueError, match="2 actuators"):
        chain.motors(jnp.zeros(3))


def test_what_is_not_simulated_is_listed_once():
    xml = PENDULUM.replace("<worldbody>", '<option density="1.2"/><worldbody>').replace('name="arm" type="hinge"', 'name="arm" frictionloss="0.1" type="hinge"')
    xml = xml.replace("</mujoco>", '<actuator><position joint="arm" kp="3"/></actuator></mujoco>')
    with pytest.raises(ValueError) as caught:
        svkc.load(xml)
    for word in ("fluid", "friction", "actuator", "ignore=("):
        assert word in str(caught.value)
    chain = svkc.load(xml, ignore=("fluid", "friction", "actuator"))
    assert len(chain.left_out) == 3
    assert svkc.load(xml, ignore="all").nv == 1


def test_limits_and_springs_are_the_models():
    """A spring as MuJoCo has it; a range that holds a pendulum up against gravity."""
    xml = PENDULUM.replace('damping="0"', 'damping="2" range="-0.5 0.5" limited="true"').replace("<mujoco>", '<mujoco><compiler angle="radian"/>')
    chain = svkc.load(xml)
    end = svkc.simulate(chain, chain.state(), 3.0).final
    free = svkc.simulate(svkc.load(xml, ignore="limit"), chain.state(), 3.0).final
    assert abs(float(end.q[0])) < 0.52
    assert np.isfinite(float(free.q[0]))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: svkc.load("<mujoco><worldbody><bod/></worldbody></mujoco>"), "cannot be read"),
        (lambda: svkc.load("/no/such/file.xml"), "no such file"),
        (lambda: svkc.load(3), "expected MJCF or URDF"),
        (lambda: svkc.load(PENDULUM, ignore=("tendons!",)), "ignore"),
        (lambda: svkc.load(PENDULUM, virtual_links=[svkc.VirtualLink("a", "arm", "leg")]), "'leg', not a body"),
        (lambda: svkc.load(PENDULUM, virtual_links=["a"]), "VirtualLink"),
        (lambda: svkc.load(PENDULUM, virtual_links=[svkc.VirtualLink("a", "world", "arm")] * 2), "differ"),
        (lambda: svkc.VirtualLink("a", "world", "arm", "rubber"), "rubber"),
        (lambda: svkc.VirtualLink("a", "world", "arm", quat=(1, 1, 0, 0)), "unit quaternion"),
        (lambda: svkc.VirtualLink("a", "world", "arm", axis=(0, 0, 0)), "axis"),
    ],
)
def test_wrong_models(call, message):
    with pytest.raises(ValueError, match=message):
        call()
