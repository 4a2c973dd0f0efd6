"""The table of mechanisms on which laws and comparisons with references are tested.

A case says how a chain is built, in which pose it is tested, and which of its numbers are known.
`models.py` builds the models. Tags select cases by `params(tag)`:

"loops": loops are closed by hinges and balls.
"forces": it is known which loop forces are unique.
"overconstrained": the mechanism moves, although the counting formula gives no freedom.
"tree": no loops.
"cuttable": a tree with cuttable joints.
"floating": no joint but virtual links holds the mechanism to the ground.
"fast": the case is in the fast tier; tests of the other cases are marked slow.
"""

import dataclasses
import functools
import importlib.util
import pathlib
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import models
import numpy as np
import pytest

import svkc
import svkc.scenes

# MJCF files of gymnasium, found without importing the package
ASSETS = pathlib.Path(importlib.util.find_spec("gymnasium").origin).parent / "envs/mujoco/assets"
URDF = """<robot name="arm">
<link name="base"/><link name="upper"><inertial><origin xyz="0 0.02 0.15" rpy="0.1 0.2 0.3"/><mass
  value="2"/>
<inertia ixx="0.02" iyy="0.03" izz="0.015" ixy="0.002" ixz="0.001" iyz="0.003"/></inertial></link>
<link name="lower"><inertial><origin xyz="0 0 0.1"/><mass value="1"/><inertia ixx="0.01" iyy="0.01"
  izz="0.004" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="tool"><inertial><mass value="0.5"/><inertia ixx="0.001" iyy="0.001" izz="0.001" ixy="0"
  ixz="0" iyz="0"/></inertial></link>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><origin
  xyz="0 0 0.4" rpy="0 0.3 0"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="50" velocity="5"/><dynamics damping="0.2"/></joint>
<joint name="elbow" type="continuous"><parent link="upper"/><child link="lower"/><origin
  xyz="0 0 0.3"/><axis xyz="1 1 0"/></joint>
<joint name="wrist" type="prismatic"><parent link="lower"/><child link="tool"/><origin
  xyz="0 0 0.2"/><axis xyz="0 0 1"/>
<limit lower="-0.1" upper="0.1" effort="50" velocity="5"/></joint></robot>"""
FIGURE = str(svkc.scenes.FOLDER / "figure16.xml")


@functools.cache
def high_bar() -> tuple[svkc.Chain, svkc.State]:
    """Return chain and state of the main job, without joint limits, so that energy is conserved."""
    return svkc.scenes.high_bar(ignore=("limit",))


@functools.cache
def flight() -> tuple[svkc.Chain, svkc.State]:
    """Return the high bar, both grips cut, in the initial pose with random velocities."""
    (chain, state), rng = high_bar(), np.random.default_rng(2)
    free = svkc.cut(chain, state, "right_hand_grip", "left_hand_grip")
    v = free.v.at[: chain.nv].set(jnp.asarray(rng.normal(size=chain.nv)))
    return chain, svkc.State(free.q, v, free.structure)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Case:
    """A mechanism of the table.

    build: function of keyword arguments of `svkc.load` that returns the chain.
    tags: names, separated by spaces.
    pose: coordinates of the tree, by joint name, or a function that returns them as an array. None:
        those of the load pose.
    cuttable: names of joints that may be cut. Tests cut the first.
    joint_freedoms, rank, freedoms: N_J, m and N_F of the closed chain.
    counted: N_F by the counting formula of Kutzbach and Gruebler.
    unique: whether the force of each loop is unique.
    """

    build: Callable[..., svkc.Chain]
    tags: str
    pose: Callable[[], jax.Array] | Mapping | None = None
    cuttable: tuple[str, ...] = ()
    joint_freedoms: int | None = None
    rank: int | None = None
    freedoms: int | None = None
    counted: int | None = None
    unique: tuple[bool, ...] | None = None

    def random_motion(self) -> tuple[svkc.Chain, svkc.State, jax.Array]:
        """Return the chain, a state with random velocities that keep the loops, random torques."""
        chain, rng = self.build(), np.random.default_rng(3)
        pose = self.pose() if callable(self.pose) else self.pose
        state = chain.state(pose, rng.normal(size=chain.nv))
        return chain, state, jnp.asarray(rng.normal(size=chain.dofs))


def tree(source: str, tags: str = "tree", **known) -> Case:
    """Return the case of a model that `svkc.load` reads from `source`."""
    return Case(build=functools.partial(svkc.load, source), tags=tags, **known)


CASES = {
    # loops
    "four_bar": Case(
        build=models.four_bar,
        tags="loops forces fast",
        joint_freedoms=4,
        rank=3,
        freedoms=1,
        unique=(False,),
    ),
    "parallelogram": Case(
        build=models.parallelogram,
        tags="loops forces overconstrained",
        joint_freedoms=6,
        rank=5,
        freedoms=1,
        counted=-6,
        unique=(False, False),
    ),
    "rod_on_balls": Case(
        build=models.rod_on_balls, tags="loops forces", freedoms=2, unique=(True,)
    ),
    "stewart": Case(build=models.stewart, tags="loops forces", freedoms=6, unique=(True,) * 5),
    "figure40": Case(build=models.figure40, tags="loops floating", freedoms=40),
    "two_hands": Case(
        build=lambda: high_bar()[0],
        pose=lambda: high_bar()[1].q[: high_bar()[0].nq],
        tags="loops floating",
        freedoms=12,
    ),
    "bennett": Case(
        build=models.bennett,
        tags="overconstrained",
        joint_freedoms=4,
        rank=3,
        freedoms=1,
        counted=-2,
    ),
    "bricard": Case(
        build=models.bricard,
        tags="overconstrained fast",
        joint_freedoms=6,
        rank=5,
        freedoms=1,
        counted=0,
    ),
    "sarrus": Case(
        build=models.sarrus, tags="overconstrained", joint_freedoms=6, rank=5, freedoms=1, counted=0
    ),
    # trees, one of each kind in the fast tier: published models, random trees, a URDF
    **{
        name: tree(str(ASSETS / f"{name}.xml"), "tree fast" if name == "hopper" else "tree")
        for name in ("humanoid", "ant", "half_cheetah", "hopper", "walker2d")
    },
    **{
        f"random_{n}": tree(models.random_tree(n, seed=n), "tree fast" if n == 7 else "tree")
        for n in (2, 7, 25, 60)
    },
    "urdf": tree(URDF, "tree fast"),
    "free_tree": Case(build=models.free_tree, tags="floating fast"),
    "figure40_tree": tree(str(svkc.scenes.FOLDER / "figure40.xml")),
    # trees with cuttable joints
    "arm": tree(
        FIGURE,
        "cuttable fast",
        cuttable=("right_shoulder_flexion",),
        pose={
            "base": [0, 0, 2, 0.8, 0.6, 0, 0],
            "right_shoulder_flexion": 0.6,
            "right_shoulder_abduction": 0.3,
        },
    ),
    "pivot": tree(
        models.MJCF.format(
            models.bar(
                "arm",
                models.Y,
                "0 0 -1",
                inside=models.bar("tip", 'type="ball"', "0 0 -0.5", "0 0 -1"),
            )
        ),
        "cuttable fast",
        cuttable=("arm", "tip"),
        pose={"arm": 0.7, "tip": np.array([0.9, 0.1, 0.3, 0.3])},
    ),
}


def params(tag: str) -> list:
    """Return names of the cases with a tag, as parameters of a test."""
    return [
        name if "fast" in case.tags.split() else pytest.param(name, marks=pytest.mark.slow)
        for name, case in CASES.items()
        if tag in case.tags.split()
    ]
