"""Walking: left foot, both, right foot, both; feet are caught where they touch the ground and let go where it would have to pull (args: folder).

A controller without memory reads from the structure which feet hold and where, and leads the load from one leg to the other."""

import pathlib
import sys

import equinox as eqx
import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp

import svkc
from svkc.scenes.walking import ANKLE, HIP, SOLE, STRIDE, leg, walking

STEPS, PERIOD, SHARED, RAMP = 5, 0.65, 0.12, 0.6  # steps, s a step, the part of it on both feet, s to get going and to stop
END = RAMP + (STEPS + SHARED / 2) * PERIOD
chain, state = walking()
feet = {side: chain.link_names.index(f"{side}_foot_ground") for side in ("left", "right")}


def progress(t):
    """How many steps are done: the right foot comes down at 1, the left one at 2."""
    starting, stopping = jnp.minimum(t, RAMP), jnp.minimum(END - t, RAMP)
    return (starting**2 - stopping**2 + RAMP**2) / (2 * RAMP * PERIOD) + (jnp.clip(t, RAMP, END - RAMP) - RAMP) / PERIOD


def plan(t, structure):
    """Angles of the 16 joints: hips at one height, a little slower over the foot that stands; feet that hold stay where they are."""
    done = progress(t)
    middle = done - (1 + SHARED) / 2
    hips = STRIDE * middle - 0.007 * jnp.sin(2 * jnp.pi * middle) - SOLE
    swing, joints = 0.3 * jnp.cos(jnp.pi * (done - SHARED / 2)), {}
    for side, odd in (("right", 0), ("left", 1)):
        link, step = feet[side], 2 * jnp.round((middle - odd) / 2) + odd
        u = jnp.clip((done - step - SHARED) / (1 - SHARED), 0, 1.2)
        part = jnp.minimum(u, 1)
        start, stands = structure.pos[link, 0], structure.connected[link]
        ahead = start + ((step + 1) * STRIDE - start) * part**3 * (10 - 15 * part + 6 * part**2)
        above = 0.6 * u**2 * (1 - u) * (1.15 - u)  # comes down with some speed, and would go below the ground
        angles = leg(jnp.where(stands, start, ahead) - SOLE - hips, HIP - ANKLE - jnp.where(stands, 0, above))
        angles["ankle"] -= jnp.where(stands, 0, 6 * part**2 * (1 - part) ** 2)  # toes down on the way
        arm = {"shoulder_flexion": -swing if odd else swing, "elbow": 0.35}
        joints |= {f"{side}_{name}": angle for name, angle in (angles | arm).items()}
    return jnp.stack([jnp.asarray(joints.get(name, 0.0), t.dtype) for name in chain.joint_names[1:]])


def torques_on(foot, state, vdot):
    """Torques for an acceleration with this foot alone on the ground: what moves, moves; the other foot carries nothing."""
    alone = (jnp.arange(len(chain.link_names)) == foot, jnp.asarray(6, jnp.int32))
    state = eqx.tree_at(lambda s: (s.structure.connected, s.structure.rank), state, alone)
    return svkc.actuation(chain, state, vdot).tau


def control(t, state, args):
    """Computed torque: the plan's accelerations as far as the feet allow them, the load led from the rear leg to the front one."""
    at = lambda t: plan(t, state.structure)
    rate = lambda t: jax.jvp(at, (t,), (jnp.ones_like(t),))
    (q, v), (_, a) = jax.jvp(rate, (t,), (jnp.ones_like(t),))
    wanted = a + 200 * (q - state.q[7:]) + 28 * (v - state.v[6:])
    co = svkc.coordinates(chain, state)
    W = co.W[6:]
    gram = W.T @ W + jnp.diag(jnp.where(co.independent, 0.0, 1.0))
    vdot = co.W @ jnp.linalg.solve(gram, W.T @ (wanted - co.bias[6:])) + co.bias
    done, stands, place = progress(t), state.structure.connected, state.structure.pos[:, 0]
    left, right = feet["left"], feet["right"]
    part = jnp.clip((done - jnp.round(done)) / SHARED, 0, 1)
    front = 0.02 + 1.03 * part**2 * (3 - 2 * part)
    on_left = jnp.where(place[left] > place[right], front, 1 - front)
    on_left = jnp.where(stands[left] & stands[right], on_left, jnp.where(stands[left], 1.0, 0.0))
    torques = jax.vmap(torques_on, (0, None, None))(jnp.asarray([left, right]), state, vdot)
    return on_left * torques[0] + (1 - on_left) * torques[1]


events = []
for side in feet:
    link = f"{side}_foot_ground"
    events += [svkc.when(svkc.touch(chain, link, 0.0, axes="z"), connect=link, direction=False, here=True)]
    events += [svkc.when(svkc.leaves(chain, link), cut=link, direction=False)]
traj = svkc.simulate(chain, state, END, ts=jnp.linspace(0, END, 79), events=events, control=control, rtol=1e-6, atol=1e-8)

p = traj.phases
for phase in range(int(p.count)):
    held = " and ".join(side for side in feet if p.connected[phase, feet[side]]) or "no foot"
    print(f"{float(p.start[phase]):.3f} s to {float(p.stop[phase]):.3f} s: {held}, {int(p.joint_freedoms[phase])} joint freedoms, mobility {int(p.freedoms[phase])}")

folder = pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else ".")
print("wrote", svkc.render(chain, traj, folder / "04_walk.png", frames=9))
