"""Identification: masses of an arm's links and strength of its wrist, from a run that breaks it.

Writes a picture to the folder named on the command line (default: the current one).
"""

import pathlib
import sys

import diffrax
import equinox as eqx
import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from jax.flatten_util import ravel_pytree

import svkc

# an arm of three links on hinges about y, of which the wrist can break; bodies without joints are
# markers at the ends of links
ARM = """<mujoco><worldbody>
  <body name="upper"><joint name="shoulder" axis="0 1 0"/><geom type="capsule"
    fromto="0 0 0 0 0 -0.5" size="0.04" mass="3"/>
    <body name="fore" pos="0 0 -0.5"><joint name="elbow" axis="0 1 0"/><geom type="capsule"
      fromto="0 0 0 0 0 -0.4" size="0.03" mass="2"/>
      <body name="end of fore" pos="0 0 -0.4"/>
      <body name="tool" pos="0 0 -0.4"><joint name="wrist" axis="0 1 0"/><geom type="capsule"
        fromto="0 0 0 0 0 -0.3" size="0.02" mass="1"/>
        <body name="end of tool" pos="0 0 -0.3"/></body></body></body></worldbody></mujoco>"""
chain = svkc.load(ARM, cuttable="wrist")
links, markers = (
    np.array([chain.body_names.index(name) for name in names])
    for names in (["upper", "fore", "tool"], ["fore", "end of fore", "end of tool"])
)
rows = np.array(chain.topology.body_row)[links]
masses, limit = chain.mass[rows], 50.0  # kg, N: the first guess
start = chain.state({"shoulder": -1.6, "elbow": 0.3, "wrist": 0.2})
ts, noise = jnp.linspace(0, 0.9, 31), 2e-3  # s, m
OPTIONS = {"solver": diffrax.Dopri8(), "rtol": 1e-9, "atol": 1e-11}


def control(t, state, args):
    """Return joint torques (N m): a known one at the shoulder.

    Without a known torque, one could identify only the ratios of masses and strength.
    """
    return jnp.zeros(chain.dofs).at[chain.dof_names.index("shoulder")].set(6 * jnp.sin(4 * t))


@jax.jit
def run(p):
    """Return x and z of the markers (m) [times markers 2], and when the wrist breaks (s).

    p: factors of the masses and of the wrist's strength.
    """
    scale = jnp.ones_like(chain.mass).at[rows].set(p["mass"])
    arm = eqx.tree_at(
        lambda c: (c.mass, c.inertia),
        chain,
        (chain.mass * scale, chain.inertia * scale[:, None, None]),
    )
    events = [
        svkc.when(
            svkc.overload(arm, "wrist", force=limit * p["limit"]), cut="wrist", direction=True
        )
    ]
    traj = svkc.simulate(
        arm, start, ts[-1], ts=ts, events=events, control=control, max_events=1, **OPTIONS
    )
    return (
        jax.vmap(lambda s: svkc.poses(chain, s)[0])(traj.states)[:, markers][:, :, ::2],
        traj.events.time[0],
    )


true = {"mass": jnp.array([2.4, 1.7, 1.3]) / masses, "limit": jnp.asarray(35.0 / limit)}
guess = {"mass": jnp.ones(3), "limit": jnp.ones(())}
observed = run(true)[0] + noise * np.random.default_rng(0).normal(size=(len(ts), 3, 2))
# Levenberg-Marquardt: forward mode because parameters are few; one program returns J and residuals
residuals = lambda p: (run(p)[0] - observed).ravel()
x, tree = ravel_pytree(guess)
derivatives = jax.jit(jax.jacfwd(lambda x: 2 * (residuals(tree(x)),), has_aux=True))
(J, r), damping = derivatives(x), 1e-2
for _ in range(12):
    trial = x - jnp.linalg.solve(J.T @ J + damping * jnp.diag(jnp.sum(J * J, 0)), J.T @ r)
    trial_result = derivatives(trial)
    accepted = bool(jnp.sum(trial_result[1] ** 2) < jnp.sum(r**2))
    x, (J, r), damping = (
        (trial, trial_result, damping / 10) if accepted else (x, (J, r), damping * 10)
    )
estimate = tree(x)
error = tree(noise * jnp.sqrt(jnp.diag(jnp.linalg.inv(J.T @ J))))
for what, p in (("true", true), ("guess", guess), ("found", estimate), ("expected error", error)):
    print(
        f"{what}: masses {np.asarray(masses * p['mass']).round(4)} kg, limit"
        f" {limit * p['limit']:.3f} N"
    )
    if what != "expected error":
        print(
            f"  breaks at {run(p)[1]:.4f} s;"
            f" misses {1e3 * jnp.sqrt(jnp.mean(residuals(p) ** 2)):.2f} mm rms"
        )
folder = pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else ".")
figure, axes = plt.subplots(figsize=(9, 7), layout="constrained")
for i, (name, color) in enumerate(
    (("elbow", "C0"), ("end of forearm", "C1"), ("end of tool", "C2"))
):
    for what, path, style in (
        ("guess", run(guess)[0], "--"),
        ("found", run(estimate)[0], "-"),
        ("observed", observed, "o"),
    ):
        axes.plot(*path[:, i].T, style, color=color, markersize=4, label=f"{name}, {what}")
axes.set(
    aspect="equal",
    xlabel="x (m)",
    ylabel="z (m)",
    title=f"an arm whose wrist breaks, every {float(ts[1]):.2f} s",
)
figure.legend(loc="outside lower center", ncols=3)
figure.savefig(folder / "07_identify.png", dpi=110)
print("wrote", folder / "07_identify.png")
for when, at in (("start", guess), ("end", estimate)):
    print(
        f"derivatives at the {when}: {svkc.check_grad(residuals, at, directions=1, mode='forward')}"
    )
