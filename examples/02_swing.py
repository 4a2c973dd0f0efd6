"""A figure slides off the seat of a swing: each thigh is cut as it passes the edge of the plate.

The hands stay connected. Writes a picture to the folder named on the command line (default: the
current one).
"""

import pathlib
import sys

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp

import svkc
from svkc.scenes.swing import PLATE_EDGE, swing

chain, state = swing()
thighs = ["right_thigh_plate", "left_thigh_plate"]


def distance_beyond_edge(link):
    """Return a guard: the distance (m) by which a thigh on its slide is beyond the plate's edge."""
    along = svkc.touch(chain, link, 0.0, axes="z")
    return lambda t, state, args: jnp.abs(along(t, state)) - PLATE_EDGE


# the figure is symmetric: both guards cross zero at one instant and make one change of structure
events = [svkc.when(distance_beyond_edge(link), cut=link, direction=True) for link in thighs]
traj = svkc.simulate(
    chain, state, 2.0, ts=jnp.linspace(0, 2.0, 81), events=events, rtol=1e-8, atol=1e-10
)
print(traj)

folder = pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else ".")
print("wrote", svkc.render(chain, traj, folder / "02_swing.png"))
