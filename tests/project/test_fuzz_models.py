"""Random arguments of `svkc.load`: models, files and virtual links."""

import jax
import models
import numpy as np
import pytest
from fuzzing import (
    RAISED,
    anything,
    examples,
    or_anything,
    outcome,
    prepared_scenes,  # noqa: F401 (a fixture)
    some_of,
    vectors,
)
from hypothesis import given as over_examples, strategies as st

import svkc

pytestmark = pytest.mark.slow

number = st.one_of(
    st.floats(0.01, 2).map("{:.3f}".format),
    st.sampled_from("0 -1 1e-14 1e-300 1e300 1e160 nan inf -inf 1e999 abc".split()),
    st.floats(-2, 2).map(str),
)
good_number = st.floats(0.05, 2).map("{:.3f}".format)
label = st.one_of(
    st.integers(0, 9).map("b{}".format),
    st.sampled_from(
        ["", "world", "joint_0", "joint_1", "body_1", "b1_free", "a.b", "\u00e9", "a b", "spare_0"]
    ),
    st.text(max_size=3),
)


def escaped(text: str) -> str:
    """Return text in which XML's special characters are character references."""
    return text.translate({ord(c): f"&#{ord(c)};" for c in "<>&\"'"})


@st.composite
def attributes(draw, always: dict, sometimes: dict):
    """Draw the text of XML attributes.

    always: attributes with their values.
    sometimes: strategies of attributes, each of which is drawn one time in eight.
    """
    values = dict(always)
    for name, strategy in sometimes.items():
        if draw(st.integers(0, 7)) == 0:
            values[name] = draw(strategy)
    return "".join(f' {name}="{escaped(value)}"' for name, value in values.items())


number_lists = lambda n: st.lists(
    st.one_of(good_number, good_number, good_number, number), min_size=n, max_size=n
).map(" ".join)


@st.composite
def joints(draw):
    """Draw a joint element."""
    kind = draw(st.sampled_from(["hinge", "slide", "ball", "free", "hinge", "wheel"]))
    sometimes = {
        n: number for n in ("stiffness", "damping", "armature", "ref", "springref", "frictionloss")
    }
    sometimes |= {
        "axis": number_lists(3),
        "pos": number_lists(3),
        "range": number_lists(2),
        "limited": st.sampled_from(["true", "false", "maybe"]),
    }
    always = {"type": kind, "name": draw(label)} if draw(st.booleans()) else {"type": kind}
    return f"<joint{draw(attributes(always, sometimes))}/>"


@st.composite
def bodies(draw, budget: int):
    """Draw a body element with joints, geoms or inertials, and child bodies.

    budget: halved at each level; a body with a budget of 1 has no children.
    """
    joint_elements = "".join(draw(st.lists(joints(), max_size=3)))
    geoms = st.builds(
        "<geom{}/>".format,
        attributes(
            {"size": "0.1 0.1 0.1"},
            {
                "size": number_lists(3),
                "mass": number,
                "density": number,
                "type": st.sampled_from(["box", "sphere", "mesh"]),
            },
        ),
    )
    inertials = st.builds(
        "<inertial{}/>".format,
        attributes(
            {"pos": "0 0 0", "mass": "1", "diaginertia": "1 1 1"},
            {"mass": number, "diaginertia": number_lists(3), "pos": number_lists(3)},
        ),
    )
    mass_elements = "".join(draw(st.lists(st.one_of(geoms, geoms, inertials), max_size=2)))
    children = draw(st.integers(0, 2)) if budget > 1 else 0
    child_elements = "".join(draw(bodies(budget // 2)) for _ in range(children))
    name_attribute = {"name": draw(label)} if draw(st.booleans()) else {}
    body_attributes = draw(
        attributes(
            name_attribute, {"pos": number_lists(3), "quat": number_lists(4), "gravcomp": number}
        )
    )
    return f"<body{body_attributes}>{joint_elements}{mass_elements}{child_elements}</body>"


EXTRAS = [
    "",
    "",
    "",
    "<actuator><motor joint='b1' gear='1e300'/></actuator>",
    "<equality><weld body1='b1' body2='b2'/><connect body1='b0' anchor='0 0 nan'/></equality>",
    "<equality><connect body1='b1' body2='b2' anchor='1 2 3'/></equality>",
    "<option gravity='0 0 1e400' density='3'/>",
    "<option gravity='nan 0 0'/>",
    "<tendon><fixed><joint joint='b1' coef='1'/></fixed></tendon>",
    "<include file='nowhere.xml'/>",
    "<compiler angle='grad'/>",
    "<size memory='-1'/>",
    "<option timestep='nan'/>",
]


@st.composite
def model_texts(draw):
    """Draw MJCF, URDF, corrupted MJCF, or any text."""
    kind = draw(st.integers(0, 9))
    elements = "".join(draw(st.lists(bodies(draw(st.integers(1, 6))), max_size=2)))
    text = f"<mujoco>{draw(st.sampled_from(EXTRAS))}<worldbody>{elements}</worldbody></mujoco>"
    if kind == 0:
        links = "".join(
            f"<link name='{escaped(draw(label))}'><inertial><mass value='{draw(number)}'/><inertia"
            f" ixx='1' iyy='1' izz='{draw(number)}'/></inertial></link>"
            for _ in range(2)
        )
        kind = draw(st.sampled_from(["revolute", "fixed", "floating", "x"]))
        text = (
            f"<robot name='r'>{links}<joint name='j' type='{kind}'><parent link='b1'/><child"
            " link='b2'/></joint></robot>"
        )
    elif kind == 1:
        text = text[: draw(st.integers(0, len(text)))]
    elif kind == 2:
        start = draw(st.integers(0, len(text)))
        text = text[:start] + draw(st.text(max_size=4)) + text[start + draw(st.integers(0, 6)) :]
    elif kind == 3:
        text = draw(st.text(max_size=30))
    return text


def load_options(link):
    """Return a strategy of keyword arguments of `svkc.load`.

    link: strategy of a virtual link.
    """
    return some_of(
        virtual_links=or_anything(st.lists(link, max_size=2)),
        cuttable=or_anything(st.lists(label, max_size=2)),
        ignore_armature=or_anything(st.lists(label, max_size=2)),
        spare=or_anything(st.integers(-1, 3)),
        ignore=or_anything(
            st.one_of(
                st.just("all"),
                st.lists(st.sampled_from(["all", "equality", "limit", "nothing"]), max_size=2),
            ),
            6,
        ),
    )


link_arguments = some_of(
    name=or_anything(label),
    parent=or_anything(st.sampled_from(["world", "b1", "crank", ""])),
    real=or_anything(st.sampled_from(["b2", "rocker"])),
    joint=or_anything(
        st.one_of(
            st.sampled_from(["weld", "hinge", "free", "planar", "screw"]),
            st.lists(st.booleans(), min_size=5, max_size=6),
        )
    ),
    pos=or_anything(vectors(3)),
    quat=or_anything(st.just((1, 0, 0, 0))),
    real_pos=or_anything(vectors(3)),
    real_quat=or_anything(st.just((0, 1, 0, 0))),
    axis=or_anything(vectors(3)),
    connected=or_anything(st.booleans()),
    actuated=or_anything(st.booleans()),
)


def make_link(fields):
    """Return a virtual link with these fields, or RAISED."""
    return outcome(
        lambda: svkc.VirtualLink(**({"name": "x", "parent": "world", "real": "rocker"} | fields))
    )


links = link_arguments.map(make_link)


def check_chain(chain):
    """Assert that a chain's numbers are valid, its names unique and its pointers complete."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(chain):
        assert not np.isnan(leaf).any(), path
        assert np.isfinite(leaf).all() or jax.tree_util.keystr(path) in (
            ".control_range",
            ".force_range",
            ".limit",
        ), path
    assert len(set(chain.dof_names)) <= len(chain.dof_names) == chain.dofs
    assert len(set(chain.body_names)) == len(chain.body_names)
    assert len(set(chain.joint_names)) == len(chain.joint_names)
    assert (
        len(chain.parent)
        == len(chain.child)
        == len(chain.brother)
        == len(chain.real)
        == len(chain.body_names) + len(chain.link_names)
    )


@examples(0.5)
@over_examples(
    st.one_of(model_texts(), model_texts(), model_texts(), model_texts(), anything),
    load_options(links),
)
def test_models(source, options):
    chain = outcome(lambda: svkc.load(source, **options))
    if chain is not RAISED:
        check_chain(chain)


@examples(0.02)
@over_examples(st.binary(max_size=60), st.booleans())
def test_files_of_random_bytes(tmp_path_factory, data, folder):
    path = tmp_path_factory.mktemp("models") / "model.xml"
    path.mkdir() if folder else path.write_bytes(data)
    outcome(lambda: svkc.load(path))


@examples(0.1)
@over_examples(st.lists(links, max_size=2), load_options(links))
def test_virtual_links(declared, options):
    chain = outcome(
        lambda: svkc.load(
            models.MJCF.format(models.FOUR_BAR), **options | {"virtual_links": declared}
        )
    )
    if chain is not RAISED:
        check_chain(chain)
