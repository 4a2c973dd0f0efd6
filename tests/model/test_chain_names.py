"""The record of names that results keep: labels of q and v, and ranges of joints in both."""

import jax
import models
import numpy as np
import pytest

import svkc
from svkc.model.topology import Q_SIZE, V_SIZE

TREE = (
    f'<body name="base"><freejoint name="root"/>{models.BAR.format("0 0 1")}'
    '<body name="wrist" pos="0 0 1"><joint name="bend" axis="1 0 0"/>'
    f'<joint name="turn" axis="0 1 0"/>{models.BAR.format("0 0 1")}</body>'
    f'<body name="head"><joint name="neck" type="ball"/>{models.BAR.format("0 1 1")}</body>'
    '<body name="rail"><joint name="slider" type="slide" axis="1 0 0"/>'
    f"{models.BAR.format('0 0 1')}</body></body>"
)


@pytest.fixture(scope="module")
def chain():
    """Return a chain with every joint of the tree, a cuttable joint, a cylinder, a weld and a spare
    slot."""
    links = [svkc.VirtualLink(joint, "world", "head", joint) for joint in ("weld", "cylinder")]
    return svkc.load(models.MJCF.format(TREE), virtual_links=links, cuttable="bend", spare=1)


def test_every_coordinate_has_a_name(chain):
    names = chain.names
    assert names.q == (
        "root.x", "root.y", "root.z", "root.qw", "root.qx", "root.qy", "root.qz",
        "bend_free.x", "bend_free.y", "bend_free.z",
        "bend_free.qw", "bend_free.qx", "bend_free.qy", "bend_free.qz",
        "neck.qw", "neck.qx", "neck.qy", "neck.qz", "slider", "cylinder.rz", "cylinder.z",
        "bend", "turn", "spare_0.qw", "spare_0.qx", "spare_0.qy", "spare_0.qz",
        "spare_0.x", "spare_0.y", "spare_0.z",
    )  # fmt: skip
    assert names.v == chain.dof_names
    linear = [n for n, angular in zip(names.v, names.angular, strict=True) if not angular]
    assert linear == [
        "root.x", "root.y", "root.z", "bend_free.x", "bend_free.y", "bend_free.z", "slider",
        "cylinder.z", "spare_0.x", "spare_0.y", "spare_0.z",
    ]  # fmt: skip
    assert (names.bodies, names.links) == (chain.body_names, chain.link_names)
    assert names.cuttable == ("bend", "turn")


def test_ranges_are_those_of_the_joints(chain):
    top, names = chain.topology, chain.names
    for ranges, widths, starts in (
        (names.q_ranges, Q_SIZE, top.q_start),
        (names.v_ranges, V_SIZE, top.v_start),
    ):
        ranges = {name: slice(start, stop) for name, start, stop in ranges}
        for joint, row in zip(chain.joint_names, top.joint_row, strict=True):
            width = widths[top.kind[row]]
            assert ranges[joint] == slice(starts[row], starts[row] + width), joint
        assert ranges["weld"].start == ranges["weld"].stop
    labels = {name: names.q[start:stop] for name, start, stop in names.q_ranges}
    assert labels["cylinder"] == ("cylinder.rz", "cylinder.z")
    assert (labels["bend"], labels["turn"]) == (("bend",), ("turn",))


def test_names_are_static_and_equal_for_equal_chains(chain):
    """Results keep them through jit and vmap, and no call is traced again."""
    again = jax.tree.map(lambda x: x, chain)
    assert again.names is chain.names
    mobility = svkc.mobility(chain, chain.state())
    assert mobility.names == chain.names
    assert hash(mobility.names) == hash(chain.names)
    doubled = jax.jit(jax.vmap(lambda m: m))(jax.tree.map(lambda x: np.stack([x, x]), mobility))
    assert doubled.names is chain.names
