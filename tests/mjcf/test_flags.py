"""What a model's <option> disables, and elements whose numbers change what they are."""

import dataclasses

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from tolerances import ROUND_OFF

import svkc

ROD = '<geom type="capsule" fromto="0 0 0 0 0 -.4" size=".02"/>'
TWO_RODS = """<mujoco><option {option}><flag {flags}/></option><worldbody>
  <body name="a"><joint name="a" axis="0 1 0" stiffness="3" springref="60" damping="2"
    range="-10 10"/>{rod}
    <body name="b" pos="0 0 -.4"><joint name="b" axis="0 1 0"/>{rod}</body></body>
  <body name="c" pos="0 0.1 0"><joint name="c" axis="0 1 0"/>{rod}</body>
</worldbody>
<equality><connect name="pin" body1="b" body2="c" anchor="0 0.1 -.4" active="true"/></equality>
<actuator><motor joint="a" gear="5" ctrlrange="-1 1" group="1"/><motor joint="b"/></actuator>
</mujoco>"""


def load(flags="", option=""):
    return svkc.load(TWO_RODS.format(flags=flags, option=option, rod=ROD))


def test_each_flag():
    """Springs, dampers, ranges, links and control ranges are left out where MuJoCo does so."""
    chain = load()
    assert float(chain.stiffness[0]) == 3
    assert float(chain.damping[0]) == 2
    assert np.isfinite(chain.limit[:, 0]).all()
    assert chain.structure.connected.tolist() == [True]
    np.testing.assert_array_equal(chain.motors([3.0, 3.0])[:2], [5, 3])
    assert load('spring="disable"').stiffness is None
    assert load('damper="disable"').damping is None
    for flag in ("limit", "constraint"):
        assert load(f'{flag}="disable"').limit is None
    for flag in ("equality", "constraint"):
        assert load(f'{flag}="disable"').structure.connected.tolist() == [False]
    assert not load('gravity="disable"').gravity.any()
    assert "collision" in chain.left_out[0]
    assert not load('contact="disable"').left_out
    np.testing.assert_array_equal(load('clampctrl="disable"').motors([3.0, 3.0])[:2], [15, 3])
    assert not load('actuation="disable"').motors([1.0, 1.0]).any()
    # what is disabled need not be ignored
    rubbing = TWO_RODS.replace('name="b" axis', 'name="b" frictionloss="1" axis')
    for flag in ("frictionloss", "constraint"):
        svkc.load(rubbing.format(flags=f'{flag}="disable"', option="", rod=ROD))
    with pytest.raises(ValueError, match="friction: joint friction loss"):
        svkc.load(rubbing.format(flags="", option="", rod=ROD))
    without_group = load(option='actuatorgroupdisable="1"')
    np.testing.assert_array_equal(without_group.motors([1.0, 1.0])[:2], [0, 1])


@pytest.mark.slow
def test_accelerations_with_flags_equal_those_of_mujoco():
    for flags in ('spring="disable"', 'damper="disable"'):
        # without the loop, which is soft in MuJoCo
        chain = load(f'{flags} equality="disable" limit="disable" contact="disable"')
        data = mujoco.MjData(chain.model.model)
        data.qvel[:] = 1.0, -0.5, 0.3
        mujoco.mj_forward(chain.model.model, data)
        state = chain.state(v=np.array(data.qvel), connected=())
        vdot = svkc.forward_dynamics(chain, state, jnp.zeros(chain.dofs))
        np.testing.assert_allclose(vdot[:3], data.qacc, rtol=1e-9)


def test_links_of_a_model_that_disables_equalities_survive_conversion():
    chain = load('equality="disable"')
    chain = chain.replace(gravity=[0, 0, -1.0])
    connected = svkc.connect(chain, chain.state(), "pin").structure
    again = svkc.load(
        svkc.load(dataclasses.replace(chain, structure=connected).to_mjcf()).to_mjcf()
    )
    assert again.structure.connected.tolist() == [True]
    assert load('equality="disable"').structure.connected.tolist() == [False]


WELD = """<mujoco><worldbody><body name="a" pos="0 0 1"><freejoint/><geom size=".1"/></body>
  <body name="b" pos=".5 0 1"><joint axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 .4"
    size=".02"/></body>
</worldbody><equality><weld name="w" body1="b" body2="a" {}/></equality></mujoco>"""


@pytest.mark.parametrize(
    ("attributes", "freedoms"),
    [
        ('torquescale="0" anchor="0.1 0 0"', 4),
        pytest.param('anchor="0.1 0 0" torquescale="0.5"', 1, marks=pytest.mark.slow),
    ],
)
def test_a_weld_without_torque_is_a_ball(attributes, freedoms):
    chain = svkc.load(WELD.format(attributes))
    model, data = chain.model.model, mujoco.MjData(chain.model.model)
    mujoco.mj_forward(model, data)
    rank = np.linalg.matrix_rank(np.reshape(data.efc_J, (data.nefc, model.nv)))
    assert model.nv - rank == freedoms
    state = chain.state()
    assert int(svkc.mobility(chain, state).freedoms) == freedoms
    # nothing moves: the link holds the bodies where they are
    np.testing.assert_allclose(state.q[:8], model.qpos0, atol=ROUND_OFF)


MOTORS = """<mujoco><worldbody><body name="a"><joint name="ball" type="ball"/>{rod}
  <body name="b" pos="0 0 -.4"><joint name="hinge" axis="0 1 0"/>{rod}</body></body></worldbody>
  {more}<actuator>{first}<motor joint="hinge" gear="2" ctrlrange="-1 1" {delay}/></actuator>
</mujoco>"""


def test_motors_after_an_actuator_with_several_controls():
    first = '<orientation joint="ball" kp="1"/>'
    text = MOTORS.format(rod=ROD, first=first, more="", delay="")
    chain = svkc.load(text, ignore="actuator")
    np.testing.assert_array_equal(chain.motors([3.0]), [0, 0, 0, 2])
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    data.ctrl[-1] = 3
    mujoco.mj_forward(model, data)
    assert data.qfrc_actuator[-1] == 2


def test_delays_and_polynomial_tendons_are_refused():
    delayed = MOTORS.format(rod=ROD, first="", more="", delay='delay="0.1" nsample="60"')
    with pytest.raises(ValueError, match="actuator: 1 actuators"):
        svkc.load(delayed)
    for numbers in ('stiffness="0 100"', 'damping="0 1"'):
        tendon = f'<tendon><fixed {numbers}><joint joint="hinge" coef="1"/></fixed></tendon>'
        with pytest.raises(ValueError, match="tendon: 1 tendons with"):
            svkc.load(MOTORS.format(rod=ROD, first="", more=tendon, delay=""))
