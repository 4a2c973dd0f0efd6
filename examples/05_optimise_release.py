"""Gradients through releases: joint torques and both release times on the high bar, chosen to fly farthest. Writes a picture to the folder given."""

import dataclasses
import os
import pathlib
import sys

# most of the time goes into compiling: less optimisation, sooner done
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0")

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import numpy as np
import optax
from matplotlib.figure import Figure

import svkc
from svkc.scenes import high_bar

chain, start = high_bar()
joints, mass, rest = chain.joint_names[1:], chain.mass.sum(), start.q[7:23]  # all but the free base: q[7:23], v[6:22]
limb = jnp.diag(svkc.mass_matrix(chain, start))[6:22]  # kg m^2: a free limb turns itself
driven = jnp.array([joints.index(f"{side}_{name}") for side in ("right", "left") for name in ("shoulder_flexion", "hip_flexion", "knee")])
bumps = jnp.linspace(0.1, 0.9, 5)  # s: when each torque of a joint is largest
MAT, PRICE, ts = 1.0, 0.3, jnp.linspace(0, 1.9, 77)  # m: height of the centre of mass on landing; m per (100 N m)^2; s


def control(t, state, torques):
    """Weak springs towards the first pose, and for each driven joint a sum of bumps in time (parameters in units of 100 N m)."""
    tau = limb * (25.0 * (rest - state.q[7:23]) - 10.0 * state.v[6:22])
    tau = tau.at[driven].add(100.0 * torques @ jnp.exp(-(((t - bumps) / 0.15) ** 2)))
    return jnp.pad(tau, (6, chain.dofs - 22))  # none at the base, none at the bar


def centre(state):
    """The centre of mass: gravity's potential is linear in gravity."""
    return -jax.grad(lambda g: svkc.potential_energy(dataclasses.replace(chain, gravity=g), state))(chain.gravity) / mass


def releases(times):
    """s: any two numbers to the right hand's release, before 1.4 s, and the left hand's, up to 0.4 s later."""
    right, delay = jax.nn.sigmoid(times) * jnp.array([1.4, 0.4])
    return right, right + delay


def loss(x):
    """Minus the distance flown (m), and a price on torque; with it the run."""
    right, left = releases(x["times"])
    events = [svkc.at(right, cut="right_hand_grip"), svkc.at(left, cut="left_hand_grip")]
    # fixed steps: smooth in x, so that differences can check the gradient closely
    traj = svkc.simulate(chain, start, ts[-1], ts=ts, events=events, control=control, args=x["torques"], dt=0.005, throw=False)
    # the centre of mass falls freely: where it passes the mat's height, before or after the run's end
    (px, _, pz), (vx, _, vz) = centre(traj.final), svkc.momentum(chain, traj.final)[0] / mass
    flight = (vz + jnp.sqrt(vz**2 + 2 * 9.81 * (pz - MAT))) / 9.81
    return -(px + vx * flight) + PRICE * jnp.mean(x["torques"] ** 2), traj


def check(when, x):
    print(f"{when}: {svkc.check_grad(lambda x: loss(x)[0], x, mode='reverse', directions=1)}")


x = {"torques": jnp.zeros((len(driven), len(bumps))), "times": jax.scipy.special.logit(jnp.array([0.9 / 1.4, 0.25 / 0.4]))}
check("gradient at the start", x)
gradient, adam, runs = jax.jit(jax.value_and_grad(loss, has_aux=True)), optax.adam(0.07), []
memory = adam.init(x)
for i in range(25 + 1):
    (value, traj), slope = gradient(x)
    if i in (0, 25):
        right, left = (float(t) for t in releases(x["times"]))
        runs.append((float(PRICE * jnp.mean(x["torques"] ** 2) - value), right, left, traj))
        print(f"after {i} steps: {runs[-1][0]:.3f} m, releases at {right:.3f} and {left:.3f} s, parameters up to {100 * jnp.abs(x['torques']).max():.0f} N m")
        print(" ", traj.report())
    if i < 25:
        change, memory = adam.update(slope, memory)
        x = optax.apply_updates(x, change)
check("gradient at the end", x)

figure = Figure(figsize=(9, 10), layout="constrained")
panels = figure.subplots(2, 1, sharex=True, sharey=True)
for axes, (distance, right, left, traj) in zip(panels, runs, strict=True):
    positions = np.asarray(jax.vmap(lambda s: svkc.poses(chain, s)[0])(traj.states))
    path = np.asarray(jax.vmap(centre)(traj.states))
    down = int(np.argmax((path[:, 2] < MAT) & (ts > left))) or len(ts) - 1
    for i in np.unique(np.linspace(0, down, 10).astype(int)):
        color = "#1f5fa8" if ts[i] < right else "#d9822b" if ts[i] < left else "#2f8f4e"
        for body in range(2, len(chain.body_names)):
            a, b = positions[i, chain.parent[body]], positions[i, body]
            axes.plot([a[0], b[0]], [a[2], b[2]], color=color, alpha=0.25 + 0.6 * i / down, linewidth=4, solid_capstyle="round")
    axes.plot(path[: down + 1, 0], path[: down + 1, 2], "k--", linewidth=1)
    axes.plot(distance, MAT, "kv")
    axes.set(aspect="equal", ylabel="z (m)")
panels[1].set_xlabel("x (m)")
path = pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else ".") / "05_optimise_release.png"
figure.savefig(path, dpi=110)
print("wrote", path)
