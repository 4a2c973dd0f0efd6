"""Models and runs of the page tests: names, times, kinds of geoms, runs of zero duration."""

import jax.numpy as jnp

import svkc

NAME = '</script><b id="x">{{three}}'
CUTS = {0.2: "right_hand_grip", 0.3: "left_hand_grip"}
KINDS = """<mujoco><asset>
  <mesh name="wedge" vertex="0 0 0 .4 0 0 0 .4 0 0 0 .4"/><material name="green" rgba="0 1 0 1"/>
  <hfield name="hill" nrow="2" ncol="3" size="1 2 .5 .1" elevation="0 0 1 0 1 1"/>
</asset><worldbody>
  <geom type="plane" size="0 0 1"/><geom type="hfield" hfield="hill" pos="-3 0 0"/>
  <body name="one" pos="0 0 1"><joint name="turn" axis="1 0 0"/>
    <geom type="sphere" size=".2" material="green"/><geom type="capsule" size=".1 .3" pos="1 0 0"/>
    <geom type="ellipsoid" size=".1 .2 .3" pos="2 0 0" rgba="1 0 0 .5"/><geom type="cylinder"
      size=".1 .3" pos="3 0 0"/>
    <geom type="box" size=".1 .2 .3" pos="4 0 0"/><geom type="mesh" mesh="wedge" pos="5 0 0"/><geom
      type="mesh" mesh="wedge" pos="6 0 0" group="2"/>
    <geom type="sphere" size="9" group="3"/><geom type="sphere" size="8" rgba="1 1 1 0"/>
  </body>
</worldbody></mujoco>"""


def static_run(chain):
    """Return a run of zero duration."""
    return svkc.simulate(chain, chain.state(), 0.0, ts=jnp.zeros(1))


def run_of_every_geom():
    chain = svkc.load(KINDS)
    return chain, svkc.simulate(chain, chain.state({"turn": 0.5}), 0.01, dt=0.01)
