"""Conversion of states and chains to and from MuJoCo, and quaternions with the scalar last."""

import os
import pathlib
import re
import runpy
import subprocess
import sys
import types

import equinox as eqx
import jax
import jax.numpy as jnp
import models
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tolerances import REFERENCE, ROUND_OFF

import svkc
from svkc.model.topology import V_SIZE

XML = """<mujoco><worldbody><body name="a" pos="0 0 1"><joint name="a" axis="0 1 0"/><geom
  size="0.1" pos="0.1 0 0"/>
<body name="c" pos="0 0 -0.5"><joint name="c" type="ball"/><geom size="0.1" pos="0 0 -0.2"/></body>
</body>
<body name="b" pos="1 0.2 1" quat="0.8 0 0.6 0"><freejoint name="b"/><geom size="0.1"
  pos="0 0.1 0"/></body></worldbody>
<equality><weld name="w" body1="a" body2="b" active="false"/></equality></mujoco>"""


@pytest.mark.parametrize("cuttable", [(), pytest.param("c", marks=pytest.mark.slow)])
def test_states_survive_conversion_to_mujoco_and_back(cuttable):
    """MuJoCo's poses and velocities equal svkc's, also with a cuttable joint; <equality> elements
    keep whether they are active."""
    chain, rng = svkc.load(XML, cuttable=cuttable), np.random.default_rng(0)
    quat = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_quat(scalar_first=True)
    state = chain.state(
        {"a": 0.4, "c": quat, "b": [1, 2, 3, *quat]},
        {"a": 1.0, "c": rng.normal(size=3), "b": rng.normal(size=6)},
    )
    data = mujoco.MjData(chain.model.model)
    svkc.interop.to_mujoco(chain, state, data)
    mujoco.mj_forward(chain.model.model, data)
    places, quats = svkc.poses(chain, state)
    np.testing.assert_allclose(data.xpos, places, atol=1e-14)
    np.testing.assert_allclose(np.abs(np.sum(data.xquat * np.asarray(quats), 1)), 1, atol=1e-14)
    # [.., 3:] in world axes at the body's origin
    velocity = np.zeros(6)
    mujoco.mj_objectVelocity(
        chain.model.model, data, mujoco.mjtObj.mjOBJ_XBODY, data.body("b").id, velocity, 0
    )
    np.testing.assert_allclose(
        velocity[3:], svkc.velocities(chain, state)[0][chain.body_names.index("b")], atol=1e-13
    )
    assert data.eq_active.tolist() == [0]
    again = svkc.interop.from_mujoco(chain, data)
    np.testing.assert_allclose(again.q, state.q, atol=1e-14)
    np.testing.assert_allclose(again.v, state.v, atol=1e-14)
    data.eq_active[0] = 1
    data.qpos[:] = chain.model.model.qpos0
    held = svkc.interop.from_mujoco(chain, data)
    assert bool(held.structure.connected[chain.link_names.index("w")])
    svkc.interop.to_mujoco(chain, held, data)
    assert data.eq_active.tolist() == [1]


def test_quaternions_scalar_last():
    chain = svkc.load(XML)
    turns = Rotation.from_rotvec([[0.3, -0.2, 0.5], [1.0, 0.1, 0.0]])
    ball, free = turns.as_quat(scalar_first=True)
    q = chain.state({"a": 0.4, "c": ball, "b": [1, 2, 3, *free]}).q
    last = turns.as_quat()
    np.testing.assert_allclose(
        svkc.interop.quaternions_xyzw(chain, q), [0.4, *last[0], 1, 2, 3, *last[1]], atol=1e-15
    )
    plain = svkc.load(models.ARM)
    np.testing.assert_array_equal(svkc.interop.quaternions_xyzw(plain, jnp.array([0.7])), [0.7])


def test_an_equality_without_a_name():
    """An <equality> without a name is a virtual link with a generated name."""
    chain = svkc.load(XML.replace('name="w" ', ""))
    assert chain.link_names == ("equality_0",)
    data = mujoco.MjData(chain.model.model)
    svkc.interop.to_mujoco(chain, chain.state(connected="equality_0"), data)
    assert data.eq_active.tolist() == [1]
    assert bool(svkc.interop.from_mujoco(chain, data).structure.connected[0])


TWO = (
    models.bar("a", models.Y, "0 0 -1")
    + '<body name="b" pos="1 0.2 1" quat="0.8 0 0.6 0"><freejoint name="b"/><geom size="0.1" pos="0'
    ' 0.1 0"/></body>'
)
UNNAMED = """<body pos="0.4 0 1"><freejoint/><geom type="box" size="0.2 0.1 0.02" pos="0.1 0 0"/>
</body>
<body pos="0 1 1"><joint axis="1 0 0"/><geom size="0.1"/></body>"""
# any angles, none of them a number of few digits
TURNED, SIDEWAYS = (
    tuple(Rotation.from_rotvec(r).as_quat(scalar_first=True).tolist())
    for r in ([0.3, -0.2, 0.5], [0, 0.7, 0.1])
)
WELDED = svkc.VirtualLink(
    "held",
    "a",
    "b",
    "weld",
    pos=(0.1, 0, -1 / 3),
    quat=TURNED,
    real_pos=(0, -0.1, 1 / 7),
    real_quat=SIDEWAYS,
    connected=True,
)
OPEN = svkc.VirtualLink("open", "world", "a", "ball", pos=(0, 0, -3), real_pos=(0, 0, -1))


def with_cut():
    ball = svkc.VirtualLink(
        "catch", "b", "a", "ball", pos=(0.2, 0, 0), real_pos=(0, 0, -1), connected=True
    )
    return svkc.load(models.MJCF.format(TWO), virtual_links=[ball], cuttable="a")


# chain, and with what its text is loaded
SCENES = {
    "ball": lambda: (models.rod_on_balls(), {}),
    "balls": lambda: (models.stewart(), {}),
    "weld": lambda: (svkc.load(models.MJCF.format(TWO), virtual_links=[WELDED, OPEN]), {}),
    "cuttable": lambda: (with_cut(), {"cuttable": "a"}),
    "equalities": lambda: (svkc.load(XML.replace('active="false"', "")), {}),
    "no names": lambda: (
        svkc.load(
            models.MJCF.format(UNNAMED),
            virtual_links=[svkc.VirtualLink("w", "body_1", "body_2", "weld", connected=True)],
        ),
        {},
    ),
    "spec": lambda: (
        svkc.load(mujoco.MjSpec.from_string(models.MJCF.format(TWO)), virtual_links=[WELDED, OPEN]),
        {},
    ),
    "hinge": lambda: (models.four_bar(), {}),
}


def residual(chain, state):
    """Return the largest of MuJoCo's equality residuals at a state."""
    data = mujoco.MjData(chain.model.model)
    svkc.interop.to_mujoco(chain, state, data)
    mujoco.mj_forward(chain.model.model, data)
    gaps = data.efc_pos[data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY]
    assert len(gaps)
    return np.abs(gaps).max()


@pytest.mark.slow
@pytest.mark.parametrize("scene", SCENES)
def test_a_scene_as_mjcf_and_back(scene):
    """Bodies, joints, links and masses are equal to the last digit, the motion is equal, and
    MuJoCo's equality residuals are zero."""
    chain, options = SCENES[scene]()
    again = svkc.load(chain.to_mjcf(), **options)
    assert (again.body_names, again.joint_names) == (chain.body_names, chain.joint_names)
    for name in (
        "pos",
        "quat",
        "axis",
        "mass",
        "com",
        "inertia",
        "gravity",
        "q_load",
        "armature",
        "damping",
    ):
        a, b = getattr(chain, name), getattr(again, name)
        size = chain.nq if name == "q_load" else chain.nv if name == "damping" else None
        assert (a is None and b is None) or bool(jnp.all(a[:size] == b[:size])), name
    rng = np.random.default_rng(0)
    state = chain.state(None, rng.normal(size=chain.nv))
    # by name they are kept; the links' own velocities may be counted otherwise
    top = chain.topology
    kept = {
        n: state.v[top.v_start[row] : top.v_start[row] + V_SIZE[top.kind[row]]]
        for n, row in zip(top.joint_names, top.joint_row)
    }
    other = again.state(state.q[: chain.nq], kept)
    if scene == "hinge":
        assert again.link_names == tuple(
            name + end for name in chain.link_names for end in ("", "_axis")
        )
    else:
        assert again.link_names == chain.link_names
        assert bool(jnp.all(again.structure.connected == chain.structure.connected))
    assert int(svkc.mobility(again, other).freedoms) == int(svkc.mobility(chain, state).freedoms)
    for x, y in zip(
        svkc.poses(chain, state) + svkc.velocities(chain, state),
        svkc.poses(again, other) + svkc.velocities(again, other),
        strict=True,
    ):
        np.testing.assert_allclose(x, y, atol=1e-11)
    tau = jnp.asarray(rng.normal(size=chain.nv))
    a, b = (
        svkc.forward_dynamics(c, s, tau)[: chain.nv] for c, s in ((chain, state), (again, other))
    )
    np.testing.assert_allclose(a, b, atol=REFERENCE * float(jnp.abs(a).max()))
    assert residual(again, other) < REFERENCE


def test_a_comment_names_links_without_an_mjcf_form():
    """A comment lists other joints, motors on virtual joints, spare slots and cuttable joints, as
    calls that declare them."""
    screw = svkc.VirtualLink(
        "rail--1",
        "world",
        "b",
        "slide",
        axis=(1, 0, 0),
        pos=(1, 0.2, -1),
        connected=True,
        actuated=True,
    )
    driven = svkc.VirtualLink("wrist", "a", "b", "ball", actuated=True)
    scene = models.MJCF.format(TWO).replace("<mujoco>", "<mujoco><!-- by hand -->")
    chain = svkc.load(scene, virtual_links=[screw, driven], cuttable="a", spare=2)
    chain = eqx.tree_at(
        lambda c: c.structure.connected, chain, jnp.array([True, True, True, False, False])
    )
    text = chain.to_mjcf()
    comment = re.search("<!--(.*?)-->", text, re.S).group(1)
    for words in (
        "by hand",
        "no <equality> is like svkc.VirtualLink('rail- -1'",
        "motors on the virtual joint of svkc.VirtualLink('wrist'",
    ):
        assert words in comment, comment
    for words in ("2 spare slots, svkc.load(..., spare=2)", "svkc.load(..., cuttable=['a'])"):
        assert words in comment, comment
    link = eval(re.search(r"no <equality> is like (.*)", comment).group(1), {"svkc": svkc})
    again = svkc.load(text, virtual_links=[link])
    assert again.link_names == ("wrist", "rail- -1")
    assert again.structure.connected.tolist() == [True, True]
    np.testing.assert_allclose(again.structure.real_pos[1], chain.structure.real_pos[0], atol=1e-15)


def test_new_sites_get_unused_names():
    """Names of new sites and equalities differ from the scene's names."""
    hinges = [
        svkc.VirtualLink(name, "a", "b", "hinge", connected=True) for name in ("pin", "pin_axis")
    ]
    scene = models.MJCF.format(TWO).replace(
        '<freejoint name="b"/>', '<freejoint name="b"/><site name="pin_real"/>'
    )
    again = svkc.load(svkc.load(scene, virtual_links=hinges).to_mjcf())
    assert again.link_names == ("pin", "pin_axis_", "pin_axis", "pin_axis_axis")


VIEWER = pathlib.Path(__file__).parents[2] / "examples" / "08_mujoco_viewer.py"


@pytest.mark.slow
def test_the_viewer_without_a_display():
    """The example prints that there is no display, and exits without an error."""
    if not sys.platform.startswith("linux"):
        pytest.skip("other systems have a display")
    env = {
        name: value
        for name, value in os.environ.items()
        if name not in ("DISPLAY", "WAYLAND_DISPLAY")
    }
    done = subprocess.run(
        [sys.executable, VIEWER], capture_output=True, text=True, timeout=300, check=False, env=env
    )
    assert (done.returncode, done.stdout) == (0, "no display to open a window on\n"), done.stderr


@pytest.mark.slow
def test_the_viewer_is_shown_every_state(monkeypatch, capsys):
    """The example with a fake window: at each saved time the bodies have svkc's poses."""
    glfw, shown = pytest.importorskip("glfw"), []

    class Window:
        def __init__(self, model, data, **kw):
            self.data, self.cam = data, mujoco.MjvCamera()

        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def sync(self):
            shown.append(self.data.xpos.copy())

        def is_running(self):
            return True

    viewer = types.ModuleType("mujoco.viewer")
    viewer.launch_passive = Window
    monkeypatch.setattr(glfw, "init", lambda: True)
    monkeypatch.setattr(mujoco, "viewer", viewer, raising=False)
    monkeypatch.setitem(sys.modules, "mujoco.viewer", viewer)
    monkeypatch.setattr("time.sleep", lambda _: None)
    done = runpy.run_path(str(VIEWER))
    assert "played 108 of 108 states" in capsys.readouterr().out
    places = jax.vmap(lambda s: svkc.poses(done["chain"], s)[0])(
        jax.tree.map(jnp.asarray, done["states"])
    )
    np.testing.assert_allclose(shown, places, atol=ROUND_OFF)
    assert np.ptp(places, 0).max() > 1
    # no longer than an example may be, and of public names alone
    text = VIEWER.read_text()
    assert len(text.splitlines()) < 80
    assert "from svkc." not in text.replace("from svkc.scenes", "")
