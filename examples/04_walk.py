"""Walking: a foot is connected on touching the ground, and cut when the ground would have to pull.

Computed-torque control follows a planned gait. Writes a picture to the folder named on the command
line (default: the current one).
"""

import pathlib
import sys
from dataclasses import replace

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp

import svkc
from svkc.scenes.walking import DOUBLE_SUPPORT, GAIT_END, planned_angles, steps_done, walking

chain, state = walking()
joints = chain.joint_names[1:]  # all but the base
dofs = jnp.array([chain.v_index(joint).start for joint in joints])
left, right = (chain.link_names.index(f"{side}_foot_ground") for side in ("left", "right"))


def plan(t, structure):
    """Return the planned angles (rad) of the joints."""
    angles = planned_angles(chain, t, structure)
    return jnp.stack([angles.get(joint, jnp.zeros(())) for joint in joints])


def torques_on_foot(foot, state, vdot):
    """Return joint torques (N m) for the accelerations vdot, with all load on one foot."""
    on_one_foot = replace(state.structure, connected=jnp.arange(2) == foot, rank=jnp.int32(6))
    return svkc.actuation(chain, replace(state, structure=on_one_foot), vdot).tau


def control(t, state, args):
    """Return joint torques (N m) by computed-torque control.

    The accelerations are those nearest to the plan that the supporting feet allow. While both feet
    are on the ground, the load moves from the rear foot to the front foot.
    """
    path = lambda t: plan(t, state.structure)
    rate = lambda t: jax.jvp(path, (t,), (jnp.ones_like(t),))
    (q, v), (_, a) = jax.jvp(rate, (t,), (jnp.ones_like(t),))
    now = [chain.joint(state, joint) for joint in joints]
    error, error_rate = q - jnp.stack([j.q for j in now]), v - jnp.stack([j.v for j in now])
    co = svkc.coordinates(chain, state)
    W, desired = co.W[dofs], a + 200 * error + 28 * error_rate - co.bias[dofs]
    unused = jnp.diag(jnp.where(co.independent, 0.0, 1.0))
    vdot = co.bias + co.W @ jnp.linalg.solve(W.T @ W + unused, W.T @ desired)
    phase = jnp.clip((steps_done(t) - jnp.round(steps_done(t))) / DOUBLE_SUPPORT, 0, 1)
    # fraction of the load on the front foot; it exceeds one at the end: the ground would have to
    # pull the rear foot, so that the guard of this foot releases it
    front = 0.02 + 1.03 * phase**2 * (3 - 2 * phase)
    supports, (x, _, _) = state.structure.connected, state.structure.pos.T
    shared = jnp.where(x[left] > x[right], front, 1 - front)
    on_left = jnp.where(jnp.all(supports), shared, jnp.where(supports[left], 1.0, 0.0))
    on_feet = jax.vmap(torques_on_foot, (0, None, None))(jnp.array([left, right]), state, vdot)
    return jnp.stack([on_left, 1 - on_left]) @ on_feet


events = []
for link in chain.link_names:
    lands = svkc.touch(chain, link, 0.0, axes="z")
    events += [svkc.when(lands, connect=link, direction=False, here=True)]
    events += [svkc.when(svkc.leaves(chain, link), cut=link, direction=False)]
options = {"ts": jnp.linspace(0, GAIT_END, 79), "rtol": 1e-6, "atol": 1e-8}
traj = svkc.simulate(chain, state, GAIT_END, events=events, control=control, **options)
print(traj)
folder = pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else ".")
print("wrote", svkc.render(chain, traj, folder / "04_walk.png", frames=9))
