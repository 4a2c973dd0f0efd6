"""A run of svkc played in MuJoCo's viewer in real time. Without a display, prints a message.

On macOS, mujoco's viewer needs `mjpython`.
"""

import sys
import threading
import time
import warnings

import glfw  # installed with mujoco
import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import mujoco
import numpy as np

import svkc
from svkc.scenes import high_bar

chain, initial_state = high_bar()
model = chain.model.model  # the MjModel from which the chain was loaded
data = mujoco.MjData(model)

with warnings.catch_warnings(action="ignore"):  # glfw warns before it fails
    if not glfw.init():
        print("no display to open a window on")
        sys.exit()

events = [svkc.at(0.9, cut="right_hand_grip"), svkc.at(1.15, cut="left_hand_grip")]
ts = np.arange(0, 1.8, 1 / 60)
states = jax.device_get(
    svkc.simulate(chain, initial_state, ts[-1], ts=jnp.asarray(ts), events=events).states
)

import mujoco.viewer

threads_before = set(threading.enumerate())
with mujoco.viewer.launch_passive(model, data, show_left_ui=False, show_right_ui=False) as viewer:
    viewer.cam.lookat[:], viewer.cam.distance, viewer.cam.azimuth, viewer.cam.elevation = (
        (0, 0, 2.2),
        6.0,
        90,
        -8,
    )
    begin = time.perf_counter()
    for i, t in enumerate(ts):
        svkc.interop.to_mujoco(chain, jax.tree.map(lambda x, i=i: x[i], states), data)
        mujoco.mj_forward(model, data)  # compute body poses
        viewer.sync()
        if not viewer.is_running():
            break
        time.sleep(max(0.0, begin + t - time.perf_counter()))
    print(f"played {i + 1} of {len(ts)} states")
for thread in set(threading.enumerate()) - threads_before:
    thread.join()  # the window belongs to a thread, which must end before Python does
