"""A backflip, optimized: the hands take the shanks in flight, and the loop opens before landing.

Five phases with free durations, an impact, and forces that only push or only pull. The result is
checked: every interval is simulated from its own first node.

Writes a picture to the folder named on the command line (default: the current one).
"""

import pathlib
import sys

import jax

jax.config.update("jax_enable_x64", True)

import matplotlib.pyplot as plt
import numpy as np

import svkc
from svkc import optimize
from svkc.scenes.backflip import TOE, backflip
from svkc.scenes.backflip_problem import backflip_guess, backflip_problem

CHAIN = ("forearms", "upper_arms", "thorax", "pelvis", "thighs", "shanks", "feet")

chain, _ = backflip()
problem = backflip_problem(chain)
motion = problem.solve(backflip_guess(problem), solver=optimize.Ipopt(tolerance=1e-6))
print(motion)
print(motion.report())


def outline(state):
    """Return the points of hand, elbow, shoulder, hip, knee, ankle and toe (m)."""
    places = svkc.poses(chain, state).position
    hand = svkc.point_position(chain, state, "forearms", (0, 0, -0.41))
    toe = svkc.point_position(chain, state, "feet", TOE)
    joints = [places[chain.body_index(name)] for name in CHAIN]
    return np.stack([hand, *joints, toe])[:, 1:]


figure, panels = plt.subplots(1, 2, figsize=(13, 5), layout="constrained")
starts = np.cumsum([0, *(len(m.q) for m in motion.motion)])
for i, phase in enumerate(problem.phases):
    for k in np.linspace(starts[i], starts[i + 1] - 1, 5).astype(int):
        y, z = outline(jax.tree.map(lambda x, k=k: x[k], motion.states)).T
        shift = motion.ts[k]
        panels[0].plot(y + 1.5 * shift, z, color=f"C{i}", lw=1)
    panels[0].plot([], [], color=f"C{i}", label=phase.name)
panels[0].set(aspect="equal", xlabel="y (m), moved by 1.5 m/s", ylabel="z (m)")
panels[0].legend()
for i, phase in enumerate(problem.phases):
    for link in phase.connected:
        t, forces = motion.stage_times(phase.name), motion.forces(link, phase.name)
        for axis, style in ((1, "--"), (2, "-")):
            label = f"{link}, {'xyz'[axis]}, {phase.name}"
            panels[1].plot(t, forces[:, axis], style, color=f"C{i}", label=label)
panels[1].set(title="forces on toe and hands", xlabel="time (s)", ylabel="force (N)")
panels[1].grid(alpha=0.3)
panels[1].legend()
folder = pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else ".")
figure.savefig(folder / "09_backflip.png", dpi=110)
