"""Closed mechanisms with random geometry, masses and states, for tests/project/test_fuzz_*.py.

Each mechanism has one topology, so that one compiled program serves all samples. A sample is closed
by construction: the placements of its virtual links are computed, in numpy, from random
coordinates.
"""

import dataclasses
import functools
import os
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import models
import numpy as np
from references import rigid_bodies
from references.continuation import matrix, rotation

import svkc

Y = 'axis="0 1 0"'
POINT = '<geom type="box" size="0.1 0.07 0.05" pos="0.05 0.02 0.03" contype="0"/>'


def _body(name, joint, pos, inside=""):
    return f'<body name="{name}" pos="{pos}"><joint name="{name}" {joint}/>{POINT}{inside}</body>'


def _link(name, parent, real, joint, axis=(0, 0, 1), real_pos=(0, 0.1, 0.3)):
    options = dict(pos=(0.1, 0, 0.2), real_pos=real_pos, axis=axis, connected=True)
    return svkc.VirtualLink(name, parent, real, joint, **options)


PLANAR = _body("crank", Y, "0 0 0", _body("rod", Y, "0 0 0.4", _body("rocker", Y, "1 0 0.2")))
SPATIAL = _body(
    "arm",
    'axis="0.2 1 0.3" pos="0.1 0.05 0.1" damping="0.3"',
    "0 0 0.5",
    _body(
        "ball", 'type="ball"', "0.5 0 0.2", _body("slide", 'type="slide" axis="1 0.2 0"', "0.1 0 0")
    ),
) + _body(
    "plate", 'type="free"', "1 0.3 0.5", _body("flap", 'axis="1 0 0.4" stiffness="2"', "0.2 0 0")
)
CUTTABLE = _body(
    "base",
    'axis="0 0 1"',
    "0 0 0",
    _body(
        "elbow",
        'axis="1 0.3 0"',
        "0.4 0 0.1",
        _body(
            "wrist",
            'type="ball"',
            "0.3 0.1 0",
            _body("tool", 'type="slide" axis="0.3 0 1"', "0.2 0 0"),
        ),
    ),
)
MECHANISMS = {
    "four-bar": (PLANAR, [_link("pin", "world", "rocker", "hinge", (0, 1, 0), (0.2, 0, -0.6))], {}),
    "spatial": (
        SPATIAL,
        [_link("cross", "slide", "plate", "universal"), _link("tube", "world", "flap", "cylinder")],
        {},
    ),
    "joints": (
        SPATIAL,
        [
            _link("table", "world", "flap", "planar"),
            _link("socket", "slide", "plate", "ball"),
            _link("rail", "arm", "plate", (True, False, True, True, True, False)),
        ],
        {},
    ),
    "cuttable": (
        CUTTABLE,
        [_link("point", "world", "tool", "ball")],
        {"cuttable": ("elbow", "wrist"), "spare": 1},
    ),
}


ASSEMBLY = _body(
    "a",
    'type="free"',
    "0 0 1",
    _body("limb", Y, "0.3 0 0.1", _body("rod", 'type="slide" axis="1 0.2 0"', "0.2 0 0")),
) + _body("b", 'type="free"', "1 0.3 0.5", _body("arm", 'type="ball" stiffness="1"', "0.2 0 0"))
MECHANISMS["assembly"] = (
    ASSEMBLY,
    [
        _link("weld", "a", "b", "weld"),
        _link("pin", "world", "rod", "hinge"),
        _link("table", "b", "arm", "planar"),
    ],
    {"cuttable": ("limb",), "spare": 2},
)


REQUESTED = int(os.environ.get("SVKC_FUZZ", "0"))
NOW = int(time.time()) % 10**6 * 1000


def seeds(count):
    """Return the seeds of a test: fixed ones, or new ones if SVKC_FUZZ says how many."""
    return range(NOW, NOW + REQUESTED) if REQUESTED else range(count)


@functools.cache
def chain_of(name):
    tree, links, options = MECHANISMS[name]
    return svkc.load(models.MJCF.format(tree), virtual_links=links, **options)


@dataclasses.dataclass
class Sample:
    """A chain with its oracle, and a closed configuration."""

    chain: svkc.Chain
    bodies: rigid_bodies.Bodies
    q: np.ndarray

    def structure(self, state):
        return rigid_bodies.batched(state.structure)


def randomized(chain, rng, planar):
    """Return the chain with random offsets, frames, axes and masses."""
    c = rigid_bodies.batched(chain)
    inside = np.array([1.0, 0, 1]) if planar else np.ones(3)
    noise = lambda x, size: size * rng.normal(size=np.shape(x))
    pos = c.pos[0] + noise(c.pos[0], 0.1) * inside
    pos[0] = 0
    turn = noise(c.pos[0], 0 if planar else 0.3)
    turn[0] = 0
    # rows without a joint of their own keep their frames
    quat = rigid_bodies.multiply(c.quat[0], rigid_bodies.quaternion(turn))
    axis = c.axis[0] + (0 if planar else 1) * noise(c.axis[0], 0.2)
    axis /= np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-9)
    scale = rng.uniform(0.2, 3, size=c.mass.shape[1])
    spin = rotation(noise(c.pos[0], 1.0))
    inertia = scale[:, None, None] * (spin @ c.inertia[0] @ np.swapaxes(spin, 1, 2))
    com = c.com[0] + noise(c.com[0], 0.05)
    new = (pos, quat, axis, c.mass[0] * scale, inertia, com, noise(np.zeros(3), 5.0))
    fields = lambda c: (c.pos, c.quat, c.axis, c.mass, c.inertia, c.com, c.gravity)
    return eqx.tree_at(fields, chain, tuple(jnp.asarray(x) for x in new))


def random_q(chain, rng, size):
    """Return random coordinates around those of the load pose."""
    bodies = rigid_bodies.Bodies(rigid_bodies.batched(chain))
    return bodies.move(np.asarray(chain.q_load)[None], size * rng.normal(size=(1, chain.dofs)))[0]


def closed(chain, q):
    """Return the chain with its virtual links placed where they are closed at q."""
    bodies = rigid_bodies.Bodies(rigid_bodies.batched(chain))
    top, q = chain.topology, np.array(q)
    s = jax.tree.map(np.array, chain.structure)
    # bodies of cuttable joints first: their coordinates follow from those of the joint
    order = sorted(range(len(top.link_names)), key=lambda i: top.link_child[i] < 0)
    padded = lambda: np.concatenate([q, [0, 1]])
    for i in order:
        if top.link_spare[i]:
            continue
        p, R, *_ = bodies.poses(q[None])
        p, R = p[0], R[0]
        up, real, table = s.parent[i], s.real[i], top.links
        if sum(top.link_freedoms[i][:3]) == 3:
            turn = matrix(padded()[table.quat[i]])
        else:
            x, y, z = (rotation(padded()[table.angle[i, k]] * np.eye(3)[k]) for k in range(3))
            turn = x @ y @ z
        slide, there = padded()[table.slide[i]], matrix(s.real_quat[i])
        if top.link_child[i] >= 0:
            base = R[up] @ matrix(s.quat[i])
            R_real = base @ turn @ there.T
            place = p[up] + R[up] @ s.pos[i] + base @ slide - R_real @ s.real_pos[i]
            at = top.q_start[top.link_child[i]]
            q[at : at + 3], q[at + 3 : at + 7] = place, rigid_bodies.from_matrix(R_real)
            continue
        base = R[real] @ there @ turn.T
        s.quat[i] = rigid_bodies.from_matrix(R[up].T @ base)
        s.pos[i] = R[up].T @ (p[real] + R[real] @ s.real_pos[i] - base @ slide - p[up])
    placed = eqx.tree_at(
        lambda c: (c.structure.pos, c.structure.quat),
        chain,
        (jnp.asarray(s.pos), jnp.asarray(s.quat)),
    )
    return placed, q


def with_cuttable_joints(sample, structure, q):
    """Return q with the coordinates of connected cuttable joints computed from the poses of their
    bodies."""
    chain, bodies, q = sample.chain, sample.bodies, np.array(q)
    top, s = chain.topology, jax.tree.map(np.array, structure)
    p, R, *_ = (x[0] for x in bodies.poses(q[None]))
    for i in np.flatnonzero((np.array(top.link_child) >= 0) & s.connected):
        up, real, table = s.parent[i], s.real[i], top.links
        base = R[up] @ matrix(s.quat[i])
        turn = base.T @ R[real] @ matrix(s.real_quat[i])
        x, y, z, *slides = top.link_freedoms[i]
        place = base.T @ (p[real] + R[real] @ s.real_pos[i] - p[up] - R[up] @ s.pos[i])
        if x and y and z:
            q[table.quat[i]] = rigid_bodies.from_matrix(turn)
        angles = (
            np.arctan2(*((-turn[1, 2], turn[2, 2]) if z else (turn[2, 1], turn[1, 1]))),
            np.arctan2(turn[0, 2], turn[2, 2] if z else turn[0, 0]),
            np.arctan2(*((-turn[0, 1], turn[0, 0]) if x else (turn[1, 0], turn[1, 1]))),
        )
        for k, free in enumerate((x, y, z)):
            if free and not (x and y and z):
                q[table.angle[i, k]] = angles[k]
        for k in np.flatnonzero(slides):
            q[table.slide[i, k]] = place[k]
    return q


def sample(name, rng, size=0.4):
    """Return a random sample of a mechanism."""
    chain = randomized(chain_of(name), rng, planar=name == "four-bar")
    # the load pose of free bodies belongs to the model
    chain, q = closed(chain, random_q(chain, rng, size))
    return Sample(chain, rigid_bodies.Bodies(rigid_bodies.batched(chain)), q)


def random_structure(chain, rng):
    """Return the structure with some links cut and some coordinates locked, at times."""
    connected = np.array(chain.structure.connected)
    if rng.random() < 0.3:
        connected &= rng.random(len(connected)) < 0.6
    structure = eqx.tree_at(lambda s: s.connected, chain.structure, jnp.asarray(connected))
    if rng.random() > 0.15:
        return structure
    locked = jnp.asarray(rng.random(chain.dofs) < 0.15)
    return eqx.tree_at(lambda s: s.locked, structure, locked, is_leaf=lambda x: x is None)
