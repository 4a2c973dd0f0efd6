"""A giant swing, optimized: one hand lets go of the bar and catches it again.

A figure of 22 freedoms starts at rest, 31 degrees past the handstand. It turns once around the bar,
through the handstand, to the same angle. One hand lets go while the figure is above the bar. Every
interval of the result is simulated from its own first node, and the whole motion with feedback.

Writes a picture to the folder named on the command line (default: the current one).
"""

import pathlib
import sys

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import numpy as np

import svkc
from svkc import optimize
from svkc.scenes import BAR_HEIGHT, HALF_GRIP_WIDTH, PALM
from svkc.scenes.giant_swing import JOINTS, SIDES, giant_swing, hanging

chain = giant_swing()
between, turn = optimize.between, 2 * np.pi
names = {name: [f"{side}_{name}" for side in SIDES] for name in JOINTS}
motors = {joint: JOINTS[name][2] for name, pair in names.items() for joint in pair}
driven = np.array([chain.v_index(joint).start for joint in motors])
bounds = [between(pair, *np.radians(JOINTS[name][:2])) for name, pair in names.items()]
bounds += [between(["roll", "yaw"], -1, 1), between(list(motors), -15, 15, of="velocity")]


def distance(p):
    """Return the distance (m) of the right palm from its place on the bar."""
    palm = svkc.point_position(p.chain, p.state, "right_hand", (0, 0, -PALM))
    return jnp.linalg.norm(palm - jnp.array([0, -HALF_GRIP_WIDTH, BAR_HEIGHT]))


def running(p):
    """Return the running cost of torques and of joint velocities."""
    return jnp.sum((p.u / 100) ** 2) + 0.01 * jnp.sum(p.state.v[driven] ** 2)


# with both hands on the bar, these velocities determine all others
legs = [
    joint for name in ("hip_flexion", "hip_abduction", "knee", "ankle") for joint in names[name]
]
right_arm = ["right_shoulder_flexion", "right_shoulder_abduction", "right_elbow"]
rest = between(["pitch", *right_arm, *legs], 0, 0, of="velocity")
last = between("pitch", 2.6 - turn, 2.6 - turn)
both = ("right_hand_grip", "left_hand_grip")
phases = [
    optimize.Phase("down", both, duration=(0.3, 1.5), intervals=24,
                   start=[between("pitch", 2.6, 2.6), rest], end=[between("pitch", 0.8, 0.8)]),
    optimize.Phase("up", both, duration=(0.2, 1.0), intervals=16),
    optimize.Phase("release", "left_hand_grip", duration=(0.1, 0.5), intervals=8,
                   end=[(distance, 0.15, 1)]),
    optimize.Phase("return", "left_hand_grip", duration=(0.1, 0.5), intervals=8),
    optimize.Phase("catch", both, duration=(0.1, 1.0), intervals=16, impact=False, end=[last]),
]  # fmt: skip
problem = optimize.Problem(
    chain, phases, controls=optimize.Torques(motors), running=running, bounds=bounds
)
guess = problem.guess([hanging(angle) for angle in (2.6, 0.8, -1.2, -2.0, -2.8, -3.34)])
motion = problem.solve(guess, solver=optimize.Ipopt(tolerance=1e-5))
print(motion)
print(motion.report())

folder = pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else ".")
traj = motion.trajectory()
print("wrote", svkc.render(chain, traj, folder / "11_giant_swing.png", frames=12))
