"""Models and runs of the page tests: names, times, kinds of geoms, runs of zero duration."""

import jax.numpy as jnp
import mujoco
import numpy as np

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


def sphere_of_faces(number: int) -> mujoco.MjSpec:
    """Return a model with two geoms of one mesh, a sphere of about `number` faces."""
    spec = mujoco.MjSpec()
    vertices, faces = sphere(number)
    spec.add_mesh(name="sphere", uservert=vertices.ravel(), userface=faces.ravel())
    body = spec.worldbody.add_body(name="ball")
    body.add_joint(name="turn", axis=[0, 1, 0])
    for x in (0, 1):
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="sphere", pos=[x, 0, 0])
    return spec


def sphere(number: int) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and about `number` faces of the unit sphere, closed."""
    rows = int(np.sqrt(number / 4))
    theta, phi = np.meshgrid(
        np.linspace(0, np.pi, rows + 1), np.linspace(0, 2 * np.pi, 2 * rows, endpoint=False)
    )
    points = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    vertex = np.arange(theta.size).reshape(theta.shape)
    vertex[:, 0], vertex[:, -1] = vertex[0, 0], vertex[0, -1]
    after = np.roll(vertex, -1, 0)
    a, b, c, d = (x.ravel() for x in (vertex[:, :-1], vertex[:, 1:], after[:, 1:], after[:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
    return points.reshape(-1, 3), faces[np.all(faces != np.roll(faces, 1, -1), -1)]
