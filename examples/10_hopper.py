"""A hopper with a four-bar leg and one motor jumps 40 cm forward, from rest to rest, optimized.

The four-bar stays closed. The foot stands, is then free, and lands with an impact 40 cm further on,
where the end pose has it. Every interval of the result is simulated from its own first node.

Writes a picture to the folder named on the command line (default: the current one).
"""

import pathlib
import sys

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import svkc
from svkc import optimize
from svkc.scenes.hopper import BAR, FOOT, hopper, stance

chain = hopper()
first, last = stance(0.0, -1.1), stance(0.4, 1.1)


def height(p):
    """Return the height of the foot (m)."""
    return svkc.point_position(p.chain, p.state, "shank", FOOT)[2]


def pushes(p):
    """Return numbers that are not negative where the ground pushes, with a friction of 0.7."""
    along, _, normal = p.forces("foot")
    return jnp.stack([normal, 0.7 * normal - along, 0.7 * normal + along])


def at_rest(pose, *joints):
    """Return bounds that fix as many joints of a pose as are independent: the loops give others."""
    fixed = [optimize.between(joint, pose[joint], pose[joint]) for joint in joints]
    return [*fixed, optimize.between("hip", 0, 0, of="velocity")]


on_ground = {"connected": ("four_bar", "foot"), "here": "foot", "path": [pushes]}
landing = [(height, 0, 0), lambda p: p.impulse("foot")[2]]
# in flight the foot is above the ground, up to round-off, and below 1 m
phases = [
    optimize.Phase("push", duration=(0.1, 0.6), intervals=10,
                   start=at_rest(first, "x", "z", "hip"), **on_ground),
    optimize.Phase("flight", "four_bar", duration=(0.05, 0.6), intervals=10,
                   path=[(height, -1e-9, 1)]),
    optimize.Phase("landing", duration=(0.1, 0.6), intervals=10, start=landing,
                   end=at_rest(last, "x", "hip"), **on_ground),
]  # fmt: skip
problem = optimize.Problem(
    chain, phases, controls=optimize.Torques({"hip": 80.0}),
    running=lambda p: jnp.sum(p.u**2), bounds=[optimize.between("hip", -1.3, 1.3)],
)  # fmt: skip
guess = problem.guess([first, stance(0.0, -0.2), stance(0.4, 0.2), last])
motion = problem.solve(guess, solver=optimize.Ipopt(tolerance=1e-6))
print(motion)
print(motion.report())

figure, axis = plt.subplots(figsize=(10, 4), layout="constrained")
starts = np.cumsum([0, *(len(m.q) for m in motion.motion)])
CORNERS = [("rod", (0, 0, 0)), ("rod", (0, 0, -BAR)), ("shank", (0, 0, 0)), ("shank", FOOT),
           ("shank", (0, 0, 0)), ("thigh", (0, 0, 0)), ("rod", (0, 0, 0))]  # fmt: skip
for i, phase in enumerate(phases):
    for k in np.linspace(starts[i], starts[i + 1] - 1, 4).astype(int):
        state = jax.tree.map(lambda x, k=k: x[k], motion.states)
        points = [svkc.point_position(chain, state, *corner)[::2] for corner in CORNERS]
        label = phase.name if k == starts[i] else None
        axis.plot(*np.transpose(points), "o-", color=f"C{i}", ms=3, lw=1 + i / 2, label=label)
axis.set(aspect="equal", xlabel="x (m)", ylabel="z (m)")
axis.legend()
folder = pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else ".")
figure.savefig(folder / "10_hopper.png", dpi=110)
