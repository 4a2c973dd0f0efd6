"""States to and from MuJoCo, and quaternions with the scalar last."""

import jax.numpy as jnp
import models
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import svkc

XML = """<mujoco><worldbody><body name="a" pos="0 0 1"><joint name="a" axis="0 1 0"/><geom size="0.1" pos="0.1 0 0"/>
<body name="c" pos="0 0 -0.5"><joint name="c" type="ball"/><geom size="0.1" pos="0 0 -0.2"/></body></body>
<body name="b" pos="1 0.2 1" quat="0.8 0 0.6 0"><freejoint name="b"/><geom size="0.1" pos="0 0.1 0"/></body></worldbody>
<equality><weld name="w" body1="a" body2="b" active="false"/></equality></mujoco>"""


@pytest.mark.parametrize("cuttable", [(), "c"])
def test_there_and_back(cuttable):
    """MuJoCo puts the bodies where svkc has them and moves them so; with a joint that may be cut as well; <equality> as they hold."""
    chain, rng = svkc.load(XML, cuttable=cuttable), np.random.default_rng(0)
    quat = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_quat(scalar_first=True)
    state = chain.state({"a": 0.4, "c": quat, "b": [1, 2, 3, *quat]}, {"a": 1.0, "c": rng.normal(size=3), "b": rng.normal(size=6)})
    data = mujoco.MjData(chain.model.model)
    svkc.to_mujoco(chain, state, data)
    mujoco.mj_forward(chain.model.model, data)
    places, quats = svkc.poses(chain, state)
    np.testing.assert_allclose(data.xpos, places, atol=1e-14)
    np.testing.assert_allclose(np.abs(np.sum(data.xquat * np.asarray(quats), 1)), 1, atol=1e-14)
    # [.., 3:] in world axes at the body's origin
    velocity = np.zeros(6)
    mujoco.mj_objectVelocity(chain.model.model, data, mujoco.mjtObj.mjOBJ_XBODY, data.body("b").id, velocity, 0)
    np.testing.assert_allclose(velocity[3:], svkc.velocities(chain, state)[0][chain.body_names.index("b")], atol=1e-13)
    assert data.eq_active.tolist() == [0]
    again = svkc.from_mujoco(chain, data)
    np.testing.assert_allclose(again.q, state.q, atol=1e-14)
    np.testing.assert_allclose(again.v, state.v, atol=1e-14)
    data.eq_active[0] = 1
    data.qpos[:] = chain.model.model.qpos0
    held = svkc.from_mujoco(chain, data)
    assert bool(held.structure.connected[chain.link_names.index("w")])
    svkc.to_mujoco(chain, held, data)
    assert data.eq_active.tolist() == [1]


def test_data_of_another_model():
    chain = svkc.load(XML)
    other = mujoco.MjData(mujoco.MjModel.from_xml_string(models.MJCF.format(models.bar("arm", models.Y, "0 0 -1"))))
    for call in (lambda: svkc.to_mujoco(chain, chain.state(), other), lambda: svkc.from_mujoco(chain, other)):
        with pytest.raises(ValueError, match="data: got 1 qpos and 1 qvel, the chain's model has 12 and 10"):
            call()


def test_scalar_last():
    chain = svkc.load(XML)
    turns = Rotation.from_rotvec([[0.3, -0.2, 0.5], [1.0, 0.1, 0.0]])
    ball, free = turns.as_quat(scalar_first=True)
    q = chain.state({"a": 0.4, "c": ball, "b": [1, 2, 3, *free]}).q
    last = turns.as_quat()
    np.testing.assert_allclose(svkc.xyzw(chain, q), [0.4, *last[0], 1, 2, 3, *last[1]], atol=1e-15)
    plain = svkc.load(models.MJCF.format(models.bar("arm", models.Y, "0 0 -1")))
    np.testing.assert_array_equal(svkc.xyzw(plain, jnp.array([0.7])), [0.7])
