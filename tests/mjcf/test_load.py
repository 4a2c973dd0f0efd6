"""Loading of models: supported elements are read, unsupported ones are named in an error."""

import pathlib
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import models
import mujoco
import numpy as np
import pytest
from tolerances import REFERENCE, ROUND_OFF

import svkc

ROOT = pathlib.Path(__file__).parents[2]
MINITAUR = pathlib.Path(__file__).parent / "robots" / "minitaur_v1.urdf"

PENDULUM = models.ARM


def test_all_kinds_of_sources(tmp_path):
    path = tmp_path / "model.xml"
    path.write_text(PENDULUM)
    sources = [
        PENDULUM,
        path,
        str(path),
        mujoco.MjSpec.from_string(PENDULUM),
        mujoco.MjModel.from_xml_string(PENDULUM),
    ]
    for chain in map(svkc.load, sources):
        assert chain.body_names == ("world", "arm")
        assert chain.joint_names == ("arm",)
        assert (chain.nq, chain.nv, chain.dofs) == (1, 1, 1)


def kept_as_is():
    """Return a jitted identity function of a chain, and the list of its traces."""
    traces = []
    return jax.jit(lambda chain: (traces.append(0), chain)[1]), traces


def test_two_loads_of_one_model_are_one_program(tmp_path):
    """Chains from all kinds of sources are equal, have equal hashes, and share one trace."""
    path = tmp_path / "model.xml"
    path.write_text(PENDULUM)
    hinge = {"name": "l", "parent": "world", "real": "arm", "connected": True}
    written = [
        {
            "virtual_links": [svkc.VirtualLink(joint="hinge", axis=(0, 0, 1), **hinge)],
            "ignore": ("limit", "damping"),
        },
        {
            "virtual_links": svkc.VirtualLink(
                joint=np.eye(6, dtype=bool)[2], axis=np.array([0.0, 0.0, 1.0]), **hinge
            ),
            "ignore": iter(["damping", "limit"]),
        },
        {
            "virtual_links": (svkc.VirtualLink(joint="hinge", axis=jnp.array([0, 0, 1]), **hinge),),
            "ignore": ["damping", "limit", "limit"],
        },
    ]
    for sources, arguments in (
        ([PENDULUM, path, str(path), mujoco.MjSpec.from_string(PENDULUM)], [{}]),
        ([PENDULUM], written),
        ([mujoco.MjModel.from_xml_string(PENDULUM) for _ in range(2)], [{}]),
    ):
        same, traces = kept_as_is()
        chains = [svkc.load(source, **options) for source in sources for options in arguments]
        assert len({jax.tree.structure(chain) for chain in chains}) == 1
        for chain in chains:
            same(chain)
        assert len(traces) == 1


def test_chains_of_other_models_keep_their_own():
    """Chains that differ in a number, the text or an argument do not share a trace, and return from
    jit with their own model."""
    link = lambda **where: svkc.VirtualLink("l", "world", "arm", "hinge", **where)
    chains = [
        svkc.load(PENDULUM),
        svkc.load(PENDULUM.replace("-9.81", "-9.8")),
        svkc.load(PENDULUM.replace("<mujoco>", "<mujoco><!-- this --><size nuser_body='1'/>")),
        svkc.load(mujoco.MjModel.from_xml_string(PENDULUM)),
        svkc.load(PENDULUM, ignore="limit"),
        svkc.load(PENDULUM, ignore_armature="arm"),
        svkc.load(PENDULUM, virtual_links=link()),
        svkc.load(PENDULUM, virtual_links=link(connected=True)),
        svkc.load(PENDULUM, virtual_links=link(axis=(0, 1, 0))),
    ]
    assert len({jax.tree.structure(chain) for chain in chains}) == len(chains)
    same, traces = kept_as_is()
    for chain in chains:
        assert same(chain).model.model is chain.model.model
        assert same(chain).model.arguments == chain.model.arguments
    assert len(traces) == len(chains)
    # a MjModel that is changed later does not make its chain another one
    before = hash(jax.tree.structure(chains[0]))
    chains[0].model.model.opt.timestep *= 2
    assert hash(jax.tree.structure(chains[0])) == before
    # numbers of a chain are its leaves: one model, two masses
    heavier = eqx.tree_at(lambda c: c.mass, chains[0], 2 * chains[0].mass)
    both = jax.tree.map(lambda *x: jnp.stack(x), chains[0], heavier)
    np.testing.assert_array_equal(both.mass[1], 2 * both.mass[0])


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


def test_ends_of_virtual_links_by_sites():
    """Links declared by bodies equal links declared by sites, also rotated ones; a site without a
    placement is the placement."""
    sites = (
        '<site name="tip" pos="0.1 0.2 -0.3" quat="0.6 0.8 0 0"/>',
        '<site name="foot" pos="0 0.1 0" quat="0.8 0 0.6 0"/>',
    )
    model = models.MJCF.format(
        f'<body name="a"><joint/><geom size="0.1"/>{sites[0]}</body><body name="b" pos="1 0'
        f' 0"><freejoint/><geom size="0.1"/>{sites[1]}</body>'
    )
    by_sites = svkc.load(
        model,
        virtual_links=[
            svkc.VirtualLink("x", "tip", "foot", "hinge", pos=(0, 0, 0.5)),
            svkc.VirtualLink("y", "tip", "b"),
        ],
    ).structure
    # 0.5 along the z of a frame turned about x by the angle of cosine 0.28
    place, turned = (0.1, 0.2 - 0.48, -0.3 - 0.14), (0.6, 0.8, 0, 0)
    links = [
        svkc.VirtualLink("x", "a", "b", "hinge", place, turned, real_pos=(0, 0.1, 0)),
        svkc.VirtualLink("y", "a", "b", "weld", (0.1, 0.2, -0.3), turned),
    ]
    by_bodies = svkc.load(model, virtual_links=links).structure
    assert by_sites.parent.tolist() == by_bodies.parent.tolist()
    assert by_sites.real.tolist() == by_bodies.real.tolist()
    for name in ("pos", "quat", "real_pos", "real_quat"):
        np.testing.assert_allclose(
            getattr(by_sites, name), getattr(by_bodies, name), atol=ROUND_OFF
        )


def test_equalities_become_virtual_links():
    xml = """<mujoco><worldbody><body name="a" pos="0 0 1"><joint name="a" axis="0 1 0"/><geom
      size="0.1"/></body>
    <body name="b" pos="1 0.2 1" quat="0.8 0 0.6 0"><freejoint/><geom size="0.1"/></body>
    </worldbody>
    <equality><connect name="c" body1="a" body2="b" anchor="1 0.2 0"/>
    <weld name="w" body1="a" body2="b" active="false"/></equality></mujoco>"""
    chain = svkc.load(xml)
    assert chain.link_names == ("c", "w")
    state = chain.state()
    assert state.structure.connected.tolist() == [True, False]
    assert int(svkc.mobility(chain, state).freedoms) == 7 - 3
    assert int(svkc.mobility(chain, chain.state(connected=["w"])).freedoms) == 7 - 6
    # both hold in the load pose, where MuJoCo wrote them
    np.testing.assert_allclose(
        chain.state(connected=["c", "w"]).q[: chain.nq], chain.model.model.qpos0, atol=ROUND_OFF
    )


def test_motors():
    xml = models.MJCF.format(
        models.bar(
            "arm", models.Y, "0 0 -1", inside=models.bar("ball", 'type="ball"', "0 0 -1", "0 0 -1")
        )
    )
    xml = xml.replace(
        "</mujoco>",
        '<actuator><motor joint="arm" gear="3" ctrlrange="-1 1"/><motor joint="ball" gear="0 2'
        ' 1"/></actuator></mujoco>',
    )
    chain = svkc.load(xml)
    data = mujoco.MjData(chain.model.model)
    data.ctrl[:] = 5, 0.5
    mujoco.mj_forward(chain.model.model, data)
    np.testing.assert_allclose(chain.motors(jnp.array([5, 0.5])), data.qfrc_actuator)
    assert chain.actuated.tolist() == [True, False, True, True]
    assert svkc.load(PENDULUM).actuated.tolist() == [True]


def test_one_error_names_all_unsupported_elements():
    xml = PENDULUM.replace("<worldbody>", '<option density="1.2"/><worldbody>').replace(
        'name="arm" type="hinge"', 'name="arm" frictionloss="0.1" type="hinge"'
    )
    xml = xml.replace("</mujoco>", '<actuator><position joint="arm" kp="3"/></actuator></mujoco>')
    with pytest.raises(ValueError) as caught:
        svkc.load(xml)
    for word in ("fluid", "friction", "actuator", "ignore=("):
        assert word in str(caught.value)
    chain = svkc.load(xml, ignore=("fluid", "friction", "actuator"))
    assert len(chain.left_out) == 3
    assert svkc.load(xml, ignore="all").nv == 1


def test_ignoring_an_unsupported_actuator_keeps_the_others_in_order():
    """`motors` takes one control for each motor on a joint, in the model's order."""
    rods = models.bar("a", models.Y, "0 0 -1") + models.bar("b", models.Y, "0 0 -1", "1 0 0")
    motors = '<motor joint="b" gear="2"/><position joint="a" kp="3"/><motor joint="a" gear="5"/>'
    text = models.MJCF.format(rods).replace("</mujoco>", f"<actuator>{motors}</actuator></mujoco>")
    for ignore in ("actuator", "all"):
        chain = svkc.load(text, ignore=ignore)
        np.testing.assert_allclose(chain.motors(jnp.array([1.0, 10.0])), [50.0, 2.0])
        with pytest.raises(ValueError, match=r"u: got shape \(3,\), expected \(2,\), .*motor"):
            chain.motors(jnp.zeros(3))


def test_limits_and_springs_equal_those_of_the_model():
    """A spring equals MuJoCo's; a joint limit holds a pendulum against gravity."""
    xml = PENDULUM.replace('damping="0"', 'damping="2" range="-0.5 0.5" limited="true"').replace(
        "<mujoco>", '<mujoco><compiler angle="radian"/>'
    )
    chain = svkc.load(xml)
    end = svkc.simulate(chain, chain.state(), 3.0).final
    free = svkc.simulate(svkc.load(xml, ignore="limit"), chain.state(), 3.0).final
    assert abs(float(end.q[0])) < 0.52
    assert np.isfinite(float(free.q[0]))


GRIPPER = models.MJCF.format(
    models.bar("left", models.Y, "0 0 1") + models.bar("right", models.Y, "0 0 1", "1 0 0")
).replace(
    "</mujoco>",
    '<equality><joint joint1="left" joint2="right"/><connect body1="left" body2="right" anchor="0.5'
    ' 0 1"/></equality></mujoco>',
)


def test_ignored_equalities_are_those_that_are_not_simulated():
    with pytest.raises(
        ValueError, match=r"equality: equality constraints: joint .*\n.*ignore=\('equality',\)"
    ):
        svkc.load(GRIPPER)
    for ignore in ("equality", "all"):
        assert svkc.load(GRIPPER, ignore=ignore).link_names == ("equality_1",)


OFF_TETRAHEDRON = "v 0 0 0\nv 0.3 0 0\nv 0 0.2 0\nv 0 0 0.4\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"
# of that tetrahedron of density 1000 about its centre of mass
MASS, COM = 1000 * 0.3 * 0.2 * 0.4 / 6, np.array([0.3, 0.2, 0.4]) / 4
INERTIA = (
    MASS / 80 * np.array([[3 * 0.2, 0.06, 0.12], [0.06, 3 * 0.25, 0.08], [0.12, 0.08, 3 * 0.13]])
)
INERTIA[np.diag_indices(3)] = (
    MASS * 3 / 80 * np.array([0.2**2 + 0.4**2, 0.3**2 + 0.4**2, 0.3**2 + 0.2**2])
)


@pytest.mark.slow
def test_mesh_include_and_defaults(tmp_path):
    """A scene of two files with default classes, a mesh and a weld; its MJCF text loads from any
    folder."""
    (tmp_path / "parts" / "shapes").mkdir(parents=True)
    (tmp_path / "parts" / "shapes" / "wedge.obj").write_text(OFF_TETRAHEDRON)
    (tmp_path / "parts" / "arm.xml").write_text(
        """<mujoco><compiler meshdir="parts/shapes" angle="radian"/>
        <default><joint damping="0.1"/><geom contype="0" conaffinity="0"/><default class="stiff">
        <joint stiffness="5" armature="0.01"/></default></default>
        <asset><mesh name="wedge" file="wedge.obj"/></asset>
        <worldbody><body name="arm" pos="0 0 1"><joint name="arm" axis="0 1 0"/><geom type="mesh"
          mesh="wedge"/>
        <body name="hand" pos="0.3 0 0" childclass="stiff"><joint name="hand" axis="0 1 0"/><geom
          type="sphere" size="0.05"/></body></body></worldbody>
        </mujoco>"""
    )
    (tmp_path / "scene.xml").write_text(
        """<mujoco><include file="parts/arm.xml"/><worldbody><body name="cup" pos="0.3 0 1">
        <freejoint/><geom size="0.05" mass="1"/></body></worldbody>
        <equality><weld name="hold" body1="hand" body2="cup"/></equality></mujoco>"""
    )
    first = svkc.load(tmp_path / "scene.xml")
    for chain in (first, svkc.load(first.to_mjcf())):
        assert chain.body_names == ("world", "arm", "hand", "cup")
        assert chain.link_names == ("hold",)
        row = chain.topology.body_row[1]
        np.testing.assert_allclose(chain.mass[row], MASS, rtol=1e-6)
        np.testing.assert_allclose(chain.com[row], COM, rtol=1e-6)
        np.testing.assert_allclose(chain.inertia[row], INERTIA, rtol=1e-5)
        assert chain.damping[:2].tolist() == [0.1, 0.1]
        assert chain.stiffness[:2].tolist() == [0.0, 5.0]
        assert chain.armature[:2].tolist() == [0.0, 0.01]
        assert int(svkc.mobility(chain, chain.state()).freedoms) == 2


@pytest.mark.parametrize(
    ("written", "stands"),
    [
        ("wedge.obj", "arm/urdf/wedge.obj"),
        ("../wedge.obj", "arm/wedge.obj"),
        ("package://arm/meshes/wedge.obj", "arm/meshes/wedge.obj"),
        ("package://shapes/wedge.obj", "shapes/wedge.obj"),
        ("package://other/meshes/wedge.obj", "arm/meshes/wedge.obj"),
        ("package://other/meshes/wedge.obj", "arm/urdf/wedge.obj"),
    ],
)
def test_urdf_with_a_mesh(tmp_path, written, stands):
    """A URDF by path: meshes resolve, also package:// ones; links behind fixed joints stay bodies;
    its MJCF text loads."""
    for file in (tmp_path / stands, tmp_path / "arm" / "urdf" / "arm.urdf"):
        file.parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / stands).write_text(OFF_TETRAHEDRON)
    file.write_text(
        f"""<robot name="arm"><link name="base"/>
        <link name="fore"><inertial><origin xyz="0.1 0 0"/><mass value="2"/><inertia ixx="0.01"
          iyy="0.02" izz="0.025" ixy="0" ixz="0" iyz="0"/></inertial>
        <collision><geometry><mesh filename="{written}" scale="2 2 2"/></geometry></collision>
        </link>
        <link name="tip"/>
        <joint name="turn" type="revolute"><parent link="base"/><child link="fore"/><origin
          xyz="0 0 1"/><axis xyz="0 1 0"/>
        <limit lower="-1" upper="1" effort="10" velocity="1"/></joint>
        <joint name="weld" type="fixed"><parent link="fore"/><child link="tip"/>
        <origin xyz="0.5 0 0"/></joint></robot>"""
    )
    grip = svkc.VirtualLink("grip", "world", "tip", "hinge", pos=(0.5, 0, 1), axis=(0, 1, 0))
    first = svkc.load(file, virtual_links=[grip], ignore="all")
    assert first.model.model.nmesh == 1
    for chain in (first, svkc.load(first.to_mjcf(), ignore="all")):
        assert chain.joint_names == ("turn",)
        assert {"fore", "tip"} < set(chain.body_names)
        row = chain.topology.body_row[chain.body_names.index("fore")]
        assert float(chain.mass[row]) == 2.0
        np.testing.assert_allclose(chain.inertia[row], np.diag([0.01, 0.02, 0.025]), atol=ROUND_OFF)
        np.testing.assert_allclose(chain.limit[:, 0], [-1, 1])


@pytest.mark.slow
def test_a_scene_written_in_python():
    """A five-bar as a mujoco.MjSpec with an attached spec and a virtual link; loading does not
    modify the spec."""

    def arm(side):
        spec = mujoco.MjSpec()
        upper = spec.worldbody.add_body(name="upper")
        upper.add_joint(name="shoulder", axis=[0, 1, 0])
        fore = upper.add_body(name="fore", pos=[0, 0, 0.5])
        fore.add_joint(name="elbow", axis=[0, 1, 0])
        for body, end in ((upper, [0, 0, 0.5]), (fore, [-0.3 * side, 0, 0.5])):
            body.add_geom(
                type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[0, 0, 0, *end], size=[0.03, 0, 0]
            )
        return spec

    spec = mujoco.MjSpec()
    spec.option.gravity = [0.3, -0.2, -9.81]
    for name, side in (("left", -1), ("right", 1)):
        spec.attach(
            arm(side), prefix=f"{name}_", frame=spec.worldbody.add_frame(pos=[0.3 * side, 0, 0])
        )
    before = spec.to_xml()
    tip = svkc.VirtualLink(
        "tip",
        "left_fore",
        "right_fore",
        "hinge",
        pos=(0.3, 0, 0.5),
        real_pos=(-0.3, 0, 0.5),
        axis=(0, 1, 0),
        connected=True,
    )
    chain, by_text = svkc.load(spec, virtual_links=[tip]), models.five_bar()
    assert spec.to_xml() == before
    assert int(svkc.mobility(chain, chain.state()).freedoms) == 2
    tau = jnp.arange(float(chain.nv))
    expected = svkc.forward_dynamics(by_text, by_text.state(), tau)
    np.testing.assert_allclose(
        svkc.forward_dynamics(chain, chain.state(), tau),
        expected,
        atol=REFERENCE * float(jnp.abs(expected).max()),
    )
    # a change of the caller's afterwards is not the chain's
    spec.worldbody.add_body(name="late").add_geom(size=[0.1, 0, 0])
    assert svkc.load(chain.to_mjcf()).body_names == chain.body_names


@pytest.mark.slow
def test_the_example_of_the_gallery_runs():
    page = (ROOT / "docs" / "gallery.md").read_text()
    code, names = re.search(r"```python\n(.*?)```", page, re.S).group(1), {"print": lambda x: None}
    exec(code, names)
    assert int(svkc.mobility(names["chain"], names["chain"].state()).freedoms) == 2
    for picture in re.findall(r"\]\((.*?\.png)\)", page):
        assert (ROOT / "docs" / picture).stat().st_size < 150_000


@pytest.mark.slow
def test_a_robot_from_a_public_collection():
    """Minitaur's URDF with loops as virtual links: its axes are parallel to five digits only, so
    that balls that slide along them leave each leg two freedoms."""
    feet = {}
    for slide in (False, True):
        feet[slide] = [
            svkc.VirtualLink(
                f"foot_{leg}",
                f"lower_leg_{leg}R_link",
                f"lower_leg_{leg}L_link",
                (True, True, True, False, slide, False),
                pos=(0, 0.005, 0.2),
                real_pos=(0, 0.01, 0.2),
                connected=True,
            )
            for leg in ("front_left", "back_left", "front_right", "back_right")
        ]
    angles = {"motor": -np.pi / 2, "knee": 2.1834}
    sign = lambda name: -1 if "right" in name else 1
    for slide, freedoms, least in ((False, 4, 1e-5), (True, 8, 0.1)):
        chain = svkc.load(MINITAUR, virtual_links=feet[slide])
        assert (len(chain.body_names), chain.nv) == (28, 16)
        state = chain.state(
            {name: sign(name) * angles[name.split("_")[0]] for name in chain.joint_names},
            hold=False,
        )
        mobility = svkc.mobility(chain, state)
        assert int(mobility.freedoms) == freedoms
        assert least < float(mobility.margin) < 10 * least
        again = svkc.load(chain.to_mjcf())
        assert (again.body_names, again.joint_names) == (chain.body_names, chain.joint_names)
        assert len(again.link_names) == (0 if slide else 4)
