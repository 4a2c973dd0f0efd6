"""Gradients through releases: joint torques and release times on the high bar for a long flight.

Writes a picture to the folder named on the command line (default: the current one).
"""

import pathlib
import sys
import tempfile

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import matplotlib.pyplot as plt
import optax

import svkc
from svkc.scenes import high_bar

# without joint ranges, whose steep torques would make the differences of check_grad inaccurate
chain, start = high_bar(ignore="limit")
limb = jnp.diag(svkc.mass_matrix(chain, start))  # kg m^2
DRIVEN = [s + j for s in ("right_", "left_") for j in ("shoulder_flexion", "hip_flexion", "knee")]
PULSES = jnp.linspace(0.1, 0.9, 5)  # s: maximum of each torque pulse
# height of the centre of mass on landing (m); m per (100 N m)^2; optimizer steps
MAT_HEIGHT, TORQUE_COST, STEPS = 1.0, 0.3, 25
OPTIONS = {"rtol": 1e-9, "atol": 1e-11, "dynamics": svkc.dynamics.ArticulatedBodies()}


def control(t, state, torques):
    """Return torques (N m): weak springs to the initial pose, and pulses [driven, 5] of 100 N m."""
    tau = {}
    for joint in chain.joint_names[1:]:  # all but the base
        (q, v), rest = chain.joint(state, joint), chain.joint(start, joint).q
        tau[joint] = limb[chain.v_index(joint)] * (25.0 * (rest - q) - 10.0 * v)
    pulses = 100.0 * torques @ jnp.exp(-(((t - PULSES) / 0.15) ** 2))
    return tau | {joint: tau[joint] + pulses[i] for i, joint in enumerate(DRIVEN)}


def swing(x, t1=1.9, ts=None):
    """Return the run: the right hand releases before 1.4 s, the left hand up to 0.4 s later."""
    right, delay = jax.nn.sigmoid(x["times"]) * jnp.array([1.4, 0.4])
    release = svkc.at(right, cut="right_hand_grip")
    events = [release, svkc.at(delay, cut="left_hand_grip", after=release)]
    options = OPTIONS | {"control": control, "args": x["torques"], "throw": False, "ts": ts}
    return svkc.simulate(chain, start, t1, events=events, **options)


def loss(x):
    """Return a cost of torques minus the distance of the flight, and the distance (m)."""
    # x of the centre of mass at the height of the mat, on its parabola
    (px, _, pz), (vx, _, vz), _ = svkc.center_of_mass(chain, swing(x).final)
    distance = px + vx * (vz + jnp.sqrt(vz**2 + 2 * 9.81 * (pz - MAT_HEIGHT))) / 9.81
    return TORQUE_COST * jnp.mean(x["torques"] ** 2) - distance, distance


times = jax.scipy.special.logit(jnp.array([0.9 / 1.4, 0.25 / 0.4]))
first = x = {"torques": jnp.zeros((6, 5)), "times": times}
gradient, adam = jax.jit(jax.value_and_grad(loss, has_aux=True)), optax.adam(0.07)
memory = adam.init(x)
for _ in range(STEPS):
    updates, memory = adam.update(gradient(x)[1], memory)
    x = optax.apply_updates(x, updates)

figure, panels = plt.subplots(1, 2, figsize=(13, 6), layout="constrained")
for panel, steps, at in zip(panels, (0, STEPS), (first, x)):
    traj, ((_, distance), _) = swing(at, 1.6, jnp.linspace(0, 1.6, 65)), gradient(at)
    right, left = traj.events.time
    title = f"after {steps} steps: lands at {distance:.2f} m, releases at {right:.3f}, {left:.3f} s"
    print(title)
    with tempfile.TemporaryDirectory() as folder:
        panel.imshow(plt.imread(svkc.render(chain, traj, pathlib.Path(folder) / "strobe.png")))
    panel.set(title=title, xticks=[], yticks=[])
folder = pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else ".")
figure.savefig(folder / "05_optimise_release.png", dpi=110)
cost = lambda x: loss(x)[0]  # one function for both checks, so that JAX compiles its gradient once
for when, at in (("start", first), ("end", x)):
    print(f"gradient at the {when}: {svkc.check_grad(cost, at, mode='reverse', directions=1)}")
