"""Ten topologies of one to three loops, planar and spatial, with 200 geometries each."""

import functools
import pathlib

import equinox as eqx
import jax.numpy as jnp
import models
import numpy as np
from references import continuation

import svkc

_BODY = (
    '<body name="{0}" pos="{2}"><joint name="{0}" {1}/><geom size="0.02" contype="0"/>{3}</body>'
)
Y, SLIDE, BALL = 'axis="0 1 0"', 'type="slide" axis="1 0 0"', 'type="ball"'


def _chain(*bodies, inside=""):
    """Return MJCF of bodies (name, joint, offset), each on the one before."""
    for name, joint, offset in reversed(bodies):
        inside = _BODY.format(name, joint, offset, inside)
    return inside


def _pin(name, parent, real, real_pos, joint="hinge"):
    axis = (0, 1, 0)
    return svkc.VirtualLink(
        name, parent, real, joint, pos=None, axis=axis, real_pos=real_pos, connected=True
    )


FOUR = (("crank", Y, "0 0 0"), ("rod", Y, "0 0 0.4"), ("rocker", Y, "1 0 0.2"))
END = (0.2, 0, -0.6)


def _leg(i, x):
    return _chain((f"crank{i}", Y, f"{x} 0 0"), (f"shin{i}", Y, "0.1 0 0.5"))


def _axes(count, seed):
    rng = np.random.default_rng(seed)
    rows = []
    for i in range(count):
        axis, offset = rng.normal(size=3), 0.4 * rng.normal(size=3)
        rows.append((f"j{i}", f'axis="{axis[0]} {axis[1]} {axis[2]}"', " ".join(map(str, offset))))
    return _chain(*rows)


# MJCF of the tree, loops (parent, real, place on the real link, joint), and the names
TOPOLOGIES = {
    "four-bar": (_chain(*FOUR), [("world", "rocker", END, "hinge")], ["crank"]),
    "slider-crank": (
        _chain(("crank", Y, "0 0 0"), ("rod", Y, "0 0 0.4")) + _chain(("block", SLIDE, "1.2 0 0")),
        [("block", "rod", (1.2, 0, -0.4), "hinge")],
        ["crank"],
    ),
    "five-bar": (
        _leg(0, 0) + _leg(1, 1),
        [("shin1", "shin0", (0.4, 0, 0.4), "hinge")],
        ["crank0", "crank1"],
    ),
    "five-bar, one name": (
        _leg(0, 0) + _leg(1, 1),
        [("shin1", "shin0", (0.4, 0, 0.4), "hinge")],
        ["crank0"],
    ),
    "six-bar": (
        _chain(*FOUR[:2], (*FOUR[2][:2], FOUR[2][2]))
        + _chain(("link", Y, "1.8 0 0"), ("arm", Y, "0 0 0.5")),
        [("world", "rocker", END, "hinge"), ("rocker", "arm", (-0.5, 0, 0.1), "hinge")],
        ["crank"],
    ),
    "platform": (
        _chain(
            ("crank0", Y, "0 0 0"),
            ("shin0", Y, "-0.2 0 0.5"),
            ("plate", Y, "0.3 0 0.5"),
        )
        + _leg(1, 1)
        + _leg(2, 0.6),
        [("plate", "shin1", (-0.4, 0, 0.5), "hinge"), ("plate", "shin2", (0.1, 0, 0.6), "hinge")],
        ["crank0", "crank1", "crank2"],
    ),
    "three loops": (
        _chain(*FOUR)
        + _chain(("a", Y, "1.8 0 0"), ("b", Y, "0 0 0.5"))
        + _chain(("c", Y, "2.6 0 0"), ("d", Y, "0 0 0.5")),
        [
            ("world", "rocker", END, "hinge"),
            ("rocker", "b", (-0.5, 0, 0.1), "hinge"),
            ("a", "d", (-0.6, 0, -0.2), "hinge"),
        ],
        ["crank"],
    ),
    "crank and rocker in space": (
        _chain(("crank", 'axis="0 0 1"', "0 0 0"), ("rod", BALL, "0.3 0 0"))
        + _chain(("rocker", Y, "1 0.5 0")),
        [("rocker", "rod", (0.7, 0.6, 0.7), "ball")],
        ["crank"],
    ),
    "seven hinges in space": (_axes(7, 1), [("world", "j6", (0.3, 0.2, 0.1), "weld")], ["j0"]),
    "two loops in space": (
        _axes(8, 3) + _chain(("x", 'axis="1 0.3 0"', "0.5 0.5 0"), ("y", Y, "0 0.4 0.3")),
        [("world", "j7", (0.3, 0.2, 0.1), "ball"), ("j3", "y", (0.1, 0.3, 0.2), "ball")],
        ["j0", "j2"],
    ),
}


@functools.cache
def linkage(name):
    """Return the chain of a topology, closed where it is loaded, and the names."""
    tree, loops, names = TOPOLOGIES[name]
    text = models.MJCF.format(tree)
    poses = svkc.poses(plain := svkc.load(text), plain.state())
    body = lambda b: plain.body_names.index(b)
    links = []
    for i, (parent, real, place, joint) in enumerate(loops):
        # all frames are parallel as they are loaded
        at = np.asarray(poses[0][body(real)] - poses[0][body(parent)]) + place
        links.append(
            svkc.VirtualLink(
                f"loop{i}",
                parent,
                real,
                joint,
                pos=tuple(map(float, at)),
                axis=(0, 1, 0) if joint == "hinge" else (0, 0, 1),
                real_pos=place,
                connected=True,
            )
        )
    return svkc.load(text, virtual_links=links), names


def geometries(name, count=200):
    """Return offsets of rows and of links, and targets of the names, near those of the model; all
    in the plane of a planar linkage."""
    chain, names = linkage(name)
    rng = np.random.default_rng(len(name))
    planar = name in list(TOPOLOGIES)[:7]
    inside = np.array([1, 0, 1]) if planar else np.ones(3)
    shape = (count, *chain.pos.shape)
    pos = np.asarray(chain.pos) + 0.03 * rng.normal(size=shape) * inside
    pos[:, 0] = chain.pos[0]
    at = np.asarray(chain.structure.pos)
    link_pos = at + 0.03 * rng.normal(size=(count, *at.shape)) * inside
    target = rng.uniform(-0.8, 0.8, size=(count, len(names)))
    return pos, link_pos, target


def changed(chain, pos, link_pos):
    """Return the chain with another geometry."""
    return eqx.tree_at(
        lambda c: (c.pos, c.structure.pos), chain, (jnp.asarray(pos), jnp.asarray(link_pos))
    )


REFERENCE = pathlib.Path(__file__).parent / "references" / "continuation.npz"
FIELDS = ("scalars", "balls", "turns", "reached")


def recompute(name, count=200):
    """Return the fields of `expected`, computed by `references/continuation.py`."""
    chain, names = linkage(name)
    pos, link_pos, target = (x[:count] for x in geometries(name))
    reference = continuation.Linkage.of(chain, pos, link_pos, np.full(count, float(chain.length)))
    top = chain.topology
    named = [top.v_start[top.joint_row[top.joint_names.index(joint)]] for joint in names]
    goal = np.zeros((count, chain.nv))
    goal[:, named] = target
    (scalars, rotations), turns, reached = continuation.continued(reference, named, goal, 100)
    balls = rotations[:, list(top.rows_of_kind(continuation.BALL))]
    parts = (scalars, balls, turns)
    blank = [np.where(reached.reshape(-1, *[1] * (x.ndim - 1)), x, 0) for x in parts]
    return *blank, reached


def expected(name, count):
    """Return the reference for the first geometries, from its file.

    These are coordinates of hinges and slides [count dofs], rotations of balls [count balls 3 3],
    turns of the virtual hinges [count links], and whether the geometry was reached. Numbers of
    geometries that were not reached are 0. `python tests/linkages.py` writes the file (half an
    hour).
    """
    with np.load(REFERENCE) as file:
        return [file[f"{name}: {field}"][:count] for field in FIELDS]


if __name__ == "__main__":
    arrays = {}
    for name in TOPOLOGIES:
        for field, value in zip(FIELDS, recompute(name), strict=True):
            arrays[f"{name}: {field}"] = value
    np.savez_compressed(REFERENCE, **arrays)
