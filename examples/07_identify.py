"""Identification: masses of an arm's links and strength of its wrist, from a run that breaks it.

Writes a picture to the folder named on the command line (default: the current one).
"""

import pathlib
import sys

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from jax.flatten_util import ravel_pytree

import svkc

# an arm of three links on hinges about y, of which the wrist can break; a marker at each link's end
ROD = '<joint name="{}" axis="0 1 0"/><geom size="0.03" type="capsule" fromto="0 0 0 0 0 {}"/>'
ARM = f"""<mujoco><worldbody>
  <body name="upper">{ROD.format("shoulder", -0.5)}
    <body name="fore" pos="0 0 -0.5">{ROD.format("elbow", -0.4)}
      <body name="tool" pos="0 0 -0.4">{ROD.format("wrist", -0.3)}
</body></body></body></worldbody></mujoco>"""
MARKERS = {"upper": (0.0, 0.0, -0.5), "fore": (0.0, 0.0, -0.4), "tool": (0.0, 0.0, -0.3)}  # m
chain = svkc.load(ARM, cuttable="wrist")
start = chain.state({"shoulder": -1.6, "elbow": 0.3, "wrist": 0.2})
ts, noise = jnp.linspace(0, 0.9, 31), 2e-3  # s, m


def control(t, state, args):
    """Return a known torque (N m). Without, only ratios of masses and strength are identifiable."""
    return {"shoulder": 6 * jnp.sin(4 * t)}


@jax.jit
def run(p):
    """Return x and z of the markers (m) and when the wrist breaks (s), for masses and a limit."""
    arm = chain.replace(mass=dict(zip(MARKERS, p["mass"])), scale_inertia=True)
    events = svkc.when(svkc.overload(arm, "wrist", force=10 * p["limit"]), cut="wrist")
    options = {"control": control, "max_events": 1, "rtol": 1e-9, "atol": 1e-11}
    traj = svkc.simulate(arm, start, ts[-1], ts=ts, events=events, **options)
    at = lambda s: jnp.stack([svkc.point_position(arm, s, b, x) for b, x in MARKERS.items()])
    return jax.vmap(at)(traj.states)[..., ::2], traj.events.time[0]


# masses (kg), and the force at which the wrist breaks (10 N)
true = {"mass": jnp.array([2.4, 1.7, 1.3]), "limit": jnp.asarray(3.5)}
guess = {"mass": jnp.array([3.0, 2.0, 1.0]), "limit": jnp.asarray(5.0)}
observed = run(true)[0] + noise * np.random.default_rng(0).normal(size=(len(ts), 3, 2))
# Levenberg-Marquardt: forward mode because parameters are few; one program returns J and residuals
residuals = lambda p: (run(p)[0] - observed).ravel()
x, tree = ravel_pytree(guess)
derivatives = jax.jit(jax.jacfwd(lambda x: 2 * (residuals(tree(x)),), has_aux=True))
(J, r), damping = derivatives(x), 1e-2
for _ in range(12):
    trial = x - jnp.linalg.solve(J.T @ J + damping * jnp.diag(jnp.sum(J * J, 0)), J.T @ r)
    Jt, rt = derivatives(trial)
    better = bool(jnp.sum(rt**2) < jnp.sum(r**2))
    x, J, r, damping = (trial, Jt, rt, damping / 10) if better else (x, J, r, damping * 10)
estimate, error = tree(x), tree(noise * jnp.sqrt(jnp.diag(jnp.linalg.inv(J.T @ J))))
for what, p in (("true", true), ("guess", guess), ("estimate", estimate), ("its error", error)):
    print(f"{what}: masses {np.asarray(p['mass']).round(4)} kg, limit {10 * p['limit']:.3f} N")
figure, axes = plt.subplots(figsize=(9, 7), layout="constrained")
for i, body in enumerate(MARKERS):
    for what, path, style in (("guess", run(guess)[0], "--"), ("estimate", run(estimate)[0], "-")):
        axes.plot(*path[:, i].T, style, color=f"C{i}", label=f"end of {body}, {what}")
    axes.plot(*observed[:, i].T, "o", color=f"C{i}", markersize=4, label=f"end of {body}, observed")
axes.set(aspect="equal", xlabel="x (m)", ylabel="z (m)")
figure.legend(loc="outside lower center", ncols=3)
folder = pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else ".")
figure.savefig(folder / "07_identify.png", dpi=110)
for when, at in (("start", guess), ("end", estimate)):
    print(f"derivatives at the {when}: {svkc.check_grad(residuals, at, mode='forward')}")
