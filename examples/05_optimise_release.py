"""Gradients through releases: joint torques and release times on the high bar for a long flight.

Writes a picture to the folder named on the command line (default: the current one).
"""

import dataclasses
import pathlib
import sys

import jax

jax.config.update("jax_enable_x64", True)

import diffrax
import jax.numpy as jnp
import numpy as np
import optax
from matplotlib.figure import Figure

import svkc
from svkc.scenes import high_bar

# without joint ranges, whose steep torques would make the differences of check_grad inaccurate
chain, start = high_bar(ignore="limit")
# all but the free base: q[7:23], v[6:22]
joints, mass, initial_pose = chain.joint_names[1:], chain.mass.sum(), start.q[7:23]
limb_inertia = jnp.diag(svkc.mass_matrix(chain, start))[6:22]  # kg m^2
driven_joints = jnp.array(
    [
        joints.index(f"{side}_{name}")
        for side in ("right", "left")
        for name in ("shoulder_flexion", "hip_flexion", "knee")
    ]
)
bump_times = jnp.linspace(0.1, 0.9, 5)  # s: maximum of each torque pulse
# height of the center of mass on landing (m); m per (100 N m)^2; optimizer steps; end time (s)
MAT_HEIGHT, TORQUE_COST, STEPS, END = 1.0, 0.3, 25, 1.9
OPTIONS = {
    "solver": diffrax.Dopri8(),
    "rtol": 1e-9,
    "atol": 1e-11,
    "dynamics": svkc.dynamics.ArticulatedBodies(),
}


def control(t, state, torques):
    """Return joint torques (N m): weak springs to the initial pose, and pulses of driven joints.

    torques: amplitudes of the pulses in units of 100 N m, [driven joints, pulses].
    """
    tau = limb_inertia * (25.0 * (initial_pose - state.q[7:23]) - 10.0 * state.v[6:22])
    tau = tau.at[driven_joints].add(100.0 * torques @ jnp.exp(-(((t - bump_times) / 0.15) ** 2)))
    return jnp.pad(tau, (6, chain.dofs - 22))  # no torque at the base and at the bar


def center_of_mass(state):
    """Return the center of mass (m), as the derivative of potential energy by gravity."""
    return (
        -jax.grad(lambda g: svkc.potential_energy(dataclasses.replace(chain, gravity=g), state))(
            chain.gravity
        )
        / mass
    )


def swing(x, ts=None):
    """Return the run and the release times (s) of the right and the left hand.

    The right hand releases before 1.4 s, the left hand at most 0.4 s later.

    x: the parameters: torques, and release times before the sigmoid.
    """
    right, delay = jax.nn.sigmoid(x["times"]) * jnp.array([1.4, 0.4])
    events = [svkc.at(right, cut="right_hand_grip"), svkc.at(right + delay, cut="left_hand_grip")]
    return (
        svkc.simulate(
            chain,
            start,
            END,
            ts=ts,
            events=events,
            control=control,
            args=x["torques"],
            throw=False,
            **OPTIONS,
        ),
        right,
        right + delay,
    )


def loss(x):
    """Return the cost of torques minus the distance of the flight, and the distance (m).

    The distance is x of the center of mass at the height of the mat, on its parabola.
    """
    traj, *_ = swing(x)
    (px, _, pz), (vx, _, vz) = (
        center_of_mass(traj.final),
        svkc.momentum(chain, traj.final)[0] / mass,
    )
    distance = px + vx * (vz + jnp.sqrt(vz**2 + 2 * 9.81 * (pz - MAT_HEIGHT))) / 9.81
    return TORQUE_COST * jnp.mean(x["torques"] ** 2) - distance, distance


first = x = {
    "torques": jnp.zeros((len(driven_joints), len(bump_times))),
    "times": jax.scipy.special.logit(jnp.array([0.9 / 1.4, 0.25 / 0.4])),
}
gradient, adam = jax.jit(jax.value_and_grad(loss, has_aux=True)), optax.adam(0.07)
optimizer_state = adam.init(x)
for _ in range(STEPS):
    updates, optimizer_state = adam.update(gradient(x)[1], optimizer_state)
    x = optax.apply_updates(x, updates)
ts, run_swing, figure = (
    jnp.linspace(0, END, 77),
    jax.jit(swing),
    Figure(figsize=(9, 11), layout="constrained"),
)
for axes, steps, at in zip(figure.subplots(2, 1, sharex=True, sharey=True), (0, STEPS), (first, x)):
    traj, right, left = run_swing(at, ts)
    title = (
        f"after {steps} steps: lands at {(distance := gradient(at)[0][1]):.2f} m, releases at"
        f" {right:.3f} s and {left:.3f} s"
    )
    print(f"{title}; torque parameters up to {100 * jnp.abs(at['torques']).max():.0f} N m")
    positions, path = (
        np.asarray(jax.vmap(f)(traj.states))
        for f in (lambda s: svkc.poses(chain, s)[0], center_of_mass)
    )
    landing_index = int(np.argmax((path[:, 2] < MAT_HEIGHT) & (ts > left))) or len(ts) - 1
    axes.set(aspect="equal", title=title, xlabel="x (m)", ylabel="z (m)")
    for k in np.linspace(0, landing_index, 10).astype(int):
        color = "#1f5fa8" if ts[k] < right else "#d9822b" if ts[k] < left else "#2f8f4e"
        for body in range(2, len(chain.body_names)):
            axes.plot(
                *positions[k, [chain.parent[body], body]][:, ::2].T,
                color=color,
                alpha=0.25 + 0.6 * k / landing_index,
                linewidth=4,
                solid_capstyle="round",
            )
    axes.plot(path[: landing_index + 1, 0], path[: landing_index + 1, 2], "k--", linewidth=1)
    # landing point and bar; blue: two hands on the bar, orange: one, green: none
    axes.plot(distance, MAT_HEIGHT, "kv", 0, 2.6, "ko")
figure.savefig(
    pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else ".") / "05_optimise_release.png", dpi=110
)
scalar_loss = lambda x: loss(x)[0]
for when, at in (("start", first), ("end", x)):
    print(
        f"gradient at the {when}: {svkc.check_grad(scalar_loss, at, mode='reverse', directions=1)}"
    )
