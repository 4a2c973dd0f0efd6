"""Identification: what the links of an arm weigh, and what its wrist can carry, from one run in which it breaks. Writes a picture to the folder given."""

import pathlib
import sys

import equinox as eqx
import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optimistix as optx

import svkc

# an arm of three links that swings about y; the wrist is a joint that can break; a body without a joint marks the end of a link
ARM = """<mujoco><worldbody>
  <body name="upper"><joint name="shoulder" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.04" mass="3"/>
    <body name="fore" pos="0 0 -0.5"><joint name="elbow" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.03" mass="2"/>
      <body name="end of fore" pos="0 0 -0.4"/>
      <body name="tool" pos="0 0 -0.4"><joint name="wrist" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="1"/>
        <body name="end of tool" pos="0 0 -0.3"/></body></body></body></worldbody></mujoco>"""
chain = svkc.load(ARM, cuttable="wrist")
links, seen = (np.array([chain.body_names.index(name) for name in names]) for names in (["upper", "fore", "tool"], ["fore", "end of fore", "end of tool"]))
rows = np.array(chain.topology.body_row)[links]
masses, limit = chain.mass[rows], 50.0  # kg, N: as drawn, and the first guess
start = chain.state({"shoulder": -1.6, "elbow": 0.3, "wrist": 0.2})
ts = jnp.linspace(0, 0.9, 31)


def control(t, state, args):
    """A known torque (N m) at the shoulder: without one only ratios could be found, as masses and limit could all be twice as large."""
    return jnp.zeros(chain.dofs).at[chain.dof_names.index("shoulder")].set(6 * jnp.sin(4 * t))


@jax.jit
def run(p):
    """The run with masses and limit times these factors: the tool comes off when the wrist carries too much."""
    scale = jnp.ones_like(chain.mass).at[rows].set(p["mass"])
    arm = eqx.tree_at(lambda c: (c.mass, c.inertia), chain, (chain.mass * scale, chain.inertia * scale[:, None, None]))
    events = [svkc.when(svkc.overload(arm, "wrist", force=limit * p["limit"]), cut="wrist", direction=True)]
    return svkc.simulate(arm, start, ts[-1], ts=ts, events=events, control=control, rtol=1e-9, atol=1e-11, max_events=1)


def markers(traj):
    """[times, markers, x and z]: where the ends of the three links are (m)."""
    return jax.vmap(lambda s: svkc.poses(chain, s)[0])(traj.states)[:, seen][:, :, ::2]


def misses(p, observed):
    """How far the run's markers are from those observed (m)."""
    return markers(run(p)) - observed


def show(what, p):
    m, rms = np.asarray(masses * p["mass"]), 1e3 * float(jnp.sqrt(jnp.mean(misses(p, observed) ** 2)))
    print(f"{what}: masses {m.round(4)} kg, limit {limit * float(p['limit']):.3f} N, breaks at {float(run(p).events.time[0]):.4f} s; misses {rms:.2f} mm rms")


true = {"mass": jnp.array([2.4, 1.7, 1.3]) / masses, "limit": jnp.asarray(35.0 / limit)}
guess = {"mass": jnp.ones(3), "limit": jnp.ones(())}
exact = markers(run(true))
observed = exact + 2e-3 * np.random.default_rng(0).normal(size=exact.shape)
import time
t0 = time.time()
show("true", true)
show("guess", guess)
print(time.time()-t0)
fit = optx.least_squares(misses, optx.LevenbergMarquardt(rtol=1e-6, atol=1e-6), guess, args=observed, max_steps=50)
print(time.time()-t0, fit.stats)
show("found", fit.value)
# of the misses, not of the sum of their squares, which is flat where it is least
for what, p in (("guess", guess), ("found", fit.value)):
    print(f"derivatives at the {what}:", svkc.check_grad(lambda p: misses(p, observed), p, directions=1))
    print(time.time()-t0)
