"""The high bar: a figure hangs by two hands, releases one, then the other, and flies.

Writes a picture to the folder named on the command line (default: the current one).
"""

import pathlib
import sys

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp

import svkc
from svkc.scenes import high_bar

chain, state = high_bar()

# three structures in one compiled program: two hands, one hand, none
events = [svkc.at(0.9, cut="right_hand_grip"), svkc.at(1.15, cut="left_hand_grip")]
traj = svkc.simulate(
    chain, state, 1.8, ts=jnp.linspace(0, 1.8, 73), events=events, rtol=1e-8, atol=1e-10
)
print(traj)

# the path of the centre of mass
path = jax.vmap(lambda s: svkc.center_of_mass(chain, s))(traj.states).position
print(f"centre of mass from {path[0].round(2)} to {path[-1].round(2)} m")

folder = pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else ".")
print("wrote", svkc.render(chain, traj, folder / "01_high_bar.png"))
