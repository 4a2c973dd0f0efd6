"""A hopper with a four-bar leg and one motor jumps 40 cm forward, from rest to rest, optimized.

The four-bar is closed all the time. The foot stands, then is free, then lands with an impact at a
place that is optimized. Every interval of the result is simulated from its own first node.

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

RAIL, THIGH, SHANK = 0.08, 0.3, 0.4  # m: between the hinges at the trunk, lengths of the bars
MODEL = f"""<mujoco><worldbody><body name="trunk">
  <joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
  <geom type="box" size="0.12 0.06 0.05" mass="4"/>
  <body name="thigh"><joint name="hip" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0 0 {-THIGH}" size="0.015" mass="0.4"/>
    <body name="shank" pos="0 0 {-THIGH}"><joint name="knee" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 {-SHANK}" size="0.012" mass="0.3"/>
      <geom type="capsule" fromto="0 0 0 {RAIL} 0 0" size="0.012" mass="0.05"/></body></body>
  <body name="rod" pos="{RAIL} 0 0"><joint name="rod" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0 0 {-THIGH}" size="0.008" mass="0.1"/></body>
</body></worldbody></mujoco>"""
KNEE = svkc.VirtualLink(
    "four_bar", parent="shank", real="rod", joint="hinge", pos=(RAIL, 0, 0),
    real_pos=(0, 0, -THIGH), axis=(0, 1, 0), connected=True,
)  # fmt: skip
FOOT = svkc.VirtualLink("foot", parent="world", real="shank", joint="ball", real_pos=(0, 0, -SHANK))
chain = svkc.load(MODEL, virtual_links=[KNEE, FOOT])


def foot(p):
    """Return the position of the foot (m)."""
    return svkc.point_position(p.chain, p.state, "shank", (0, 0, -SHANK))


def pushes(p):
    """Return what is not negative where the ground pushes, within a friction cone of 0.7."""
    along, _, normal = p.forces("foot")
    return jnp.stack([normal, 0.7 * normal - along, 0.7 * normal + along])


def pose(x, angle):
    """Return the coordinates of a stance whose foot is at x, with the thigh at an angle."""
    height = SHANK + THIGH * np.cos(angle)
    return {"x": x + THIGH * np.sin(angle), "z": height, "hip": angle, "knee": -angle, "rod": angle}


def at(pose, *joints):
    """Return bounds that fix joints of a pose, at rest; the loops give all others."""
    fixed = [optimize.between(joint, pose[joint], pose[joint]) for joint in joints]
    return [*fixed, optimize.between("hip", 0, 0, of="velocity")]


first, last = pose(0.0, -1.1), pose(0.4, 1.1)
on_ground = (lambda p: foot(p)[2], 0, 0)
phases = [
    optimize.Phase("push", ("four_bar", "foot"), duration=(0.1, 0.6), intervals=10, here="foot",
                   start=at(first, "x", "z", "hip"), path=[pushes]),
    optimize.Phase("flight", "four_bar", duration=(0.05, 0.6), intervals=10,
                   path=[(lambda p: foot(p)[2], -1e-9, 1)]),
    optimize.Phase("landing", ("four_bar", "foot"), duration=(0.1, 0.6), intervals=10, here="foot",
                   start=[on_ground, lambda p: p.impulse("foot")[2]], end=at(last, "x", "hip"), path=[pushes]),
]  # fmt: skip
problem = optimize.Problem(
    chain, phases, controls=optimize.Torques({"hip": 80.0}),
    running=lambda p: jnp.sum(p.u**2),
    bounds=[optimize.between("hip", -1.3, 1.3)],
)  # fmt: skip
guess = problem.guess([first, pose(0.0, -0.2), pose(0.4, 0.2), last])
motion = problem.solve(guess, solver=optimize.Ipopt(tolerance=1e-6))
print(motion)
print(motion.report())

figure, axis = plt.subplots(figsize=(10, 4), layout="constrained")
starts = np.cumsum([0, *(len(m.q) for m in motion.motion)])
for i, phase in enumerate(phases):
    for k in np.linspace(starts[i], starts[i + 1] - 1, 4).astype(int):
        state = jax.tree.map(lambda x, k=k: x[k], motion.states)
        of = lambda body, *place: svkc.point_position(chain, state, body, place)[::2]
        leg = [of("rod", 0, 0, 0), of("rod", 0, 0, -THIGH), of("shank", 0, 0, 0)]
        leg += [of("thigh", 0, 0, 0), of("rod", 0, 0, 0)]
        shank = [of("shank", 0, 0, 0), of("shank", 0, 0, -SHANK)]
        for line in (leg, shank):
            axis.plot(*np.transpose(line), "o-", color=f"C{i}", ms=3, lw=1 + k / starts[-1])
    axis.plot([], [], color=f"C{i}", label=phase.name)
axis.axhline(0, color="grey", lw=0.8)
axis.set(aspect="equal", xlabel="x (m)", ylabel="z (m)")
axis.legend()
folder = pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else ".")
figure.savefig(folder / "10_hopper.png", dpi=110)
