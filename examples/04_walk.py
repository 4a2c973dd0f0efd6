"""Walking: a foot is connected on touching the ground, and cut when the ground would have to pull.

Writes a picture to the folder named on the command line (default: the current one).
"""

import pathlib
import sys

import equinox as eqx
import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp

import svkc
from svkc.scenes.walking import ANKLE_HEIGHT, HIP_HEIGHT, SOLE_OFFSET, STRIDE, leg_angles, walking

# number of steps; duration of a step (s); fraction of a step with both feet on the ground; duration
# of the acceleration at the start and of the deceleration at the end (s)
STEPS, PERIOD, DOUBLE_SUPPORT, RAMP = 5, 0.65, 0.12, 0.6
END = RAMP + (STEPS + DOUBLE_SUPPORT / 2) * PERIOD
chain, state = walking()
feet = {side: chain.link_names.index(f"{side}_foot_ground") for side in ("left", "right")}


def steps_done(t):
    """Return the planned number of steps at time t: the right foot lands at 1, the left at 2."""
    starting, stopping = jnp.minimum(t, RAMP), jnp.minimum(END - t, RAMP)
    return (starting**2 - stopping**2 + RAMP**2) / (2 * RAMP * PERIOD) + (
        jnp.clip(t, RAMP, END - RAMP) - RAMP
    ) / PERIOD


def planned_angles(t, structure):
    """Return the planned angles (rad) of the 16 joints.

    The hips stay at one height. They are slightly slower above the supporting foot. Supporting feet
    do not move.
    """
    steps, hip_steps = steps_done(t), steps_done(t) - (1 + DOUBLE_SUPPORT) / 2
    hips = STRIDE * hip_steps - 0.007 * jnp.sin(2 * jnp.pi * hip_steps) - SOLE_OFFSET
    swing, joints = 0.3 * jnp.cos(jnp.pi * (steps - DOUBLE_SUPPORT / 2)), {}
    for side, odd in (("right", 0), ("left", 1)):
        link, step = feet[side], 2 * jnp.round((hip_steps - odd) / 2) + odd
        swing_time = jnp.clip((steps - step - DOUBLE_SUPPORT) / (1 - DOUBLE_SUPPORT), 0, 1.2)
        phase, lift_off_x, supports = (
            jnp.minimum(swing_time, 1),
            structure.pos[link, 0],
            structure.connected[link],
        )
        foot_x = lift_off_x + ((step + 1) * STRIDE - lift_off_x) * phase**3 * (
            10 - 15 * phase + 6 * phase**2
        )
        # the plan continues below the ground, so that the foot touches down with some speed
        foot_height = 0.6 * swing_time**2 * (1 - swing_time) * (1.15 - swing_time)
        angles = leg_angles(
            jnp.where(supports, lift_off_x, foot_x) - SOLE_OFFSET - hips,
            HIP_HEIGHT - ANKLE_HEIGHT - jnp.where(supports, 0, foot_height),
        )
        # toes point down in the middle of a step
        angles["ankle"] -= jnp.where(supports, 0, 6 * phase**2 * (1 - phase) ** 2)
        angles |= {"shoulder_flexion": -swing if odd else swing, "elbow": 0.35}
        joints |= {f"{side}_{name}": angle for name, angle in angles.items()}
    return jnp.stack(
        [jnp.asarray(joints.get(name, 0.0), t.dtype) for name in chain.joint_names[1:]]
    )


def torques_on_foot(foot, state, vdot):
    """Return joint torques (N m) for the accelerations vdot, with all load on one foot.

    foot: number of the foot's virtual link.
    """
    single_support = eqx.tree_at(
        lambda s: (s.connected, s.rank),
        state.structure,
        (jnp.arange(2) == foot, jnp.asarray(6, jnp.int32)),
    )
    return svkc.actuation(chain, svkc.State(state.q, state.v, single_support), vdot).tau


def control(t, state, args):
    """Return joint torques (N m) by computed-torque control.

    The accelerations are those nearest to the plan that the supporting feet allow. While both feet
    are on the ground, the load moves from the rear foot to the front foot.
    """
    position_and_velocity = lambda t: jax.jvp(
        lambda t: planned_angles(t, state.structure), (t,), (jnp.ones_like(t),)
    )
    (q, v), (_, a) = jax.jvp(position_and_velocity, (t,), (jnp.ones_like(t),))
    co = svkc.coordinates(chain, state)
    W, desired_acceleration = (
        co.W[6:],
        a + 200 * (q - state.q[7:]) + 28 * (v - state.v[6:]) - co.bias[6:],
    )
    vdot = co.bias + co.W @ jnp.linalg.solve(
        W.T @ W + jnp.diag(jnp.where(co.independent, 0.0, 1.0)), W.T @ desired_acceleration
    )
    (left, right), supports, foot_x = (
        feet.values(),
        state.structure.connected,
        state.structure.pos[:, 0],
    )
    phase = jnp.clip((steps_done(t) - jnp.round(steps_done(t))) / DOUBLE_SUPPORT, 0, 1)
    # fraction of the load on the front foot; it exceeds one at the end: the ground would have to
    # pull the rear foot, so that the guard of this foot releases it
    front = 0.02 + 1.03 * phase**2 * (3 - 2 * phase)
    on_left = jnp.where(
        jnp.all(supports),
        jnp.where(foot_x[left] > foot_x[right], front, 1 - front),
        jnp.where(supports[left], 1.0, 0.0),
    )
    return jnp.stack([on_left, 1 - on_left]) @ jax.vmap(torques_on_foot, (0, None, None))(
        jnp.asarray([left, right]), state, vdot
    )


events = []
for link in chain.link_names:
    events += [
        svkc.when(svkc.touch(chain, link, 0.0, axes="z"), connect=link, direction=False, here=True)
    ]
    events += [svkc.when(svkc.leaves(chain, link), cut=link, direction=False)]
traj = svkc.simulate(
    chain,
    state,
    END,
    ts=jnp.linspace(0, END, 79),
    events=events,
    control=control,
    rtol=1e-6,
    atol=1e-8,
)
p, e = traj.phases, traj.events
for i in range(int(p.count)):
    held = " and ".join(side for side in feet if p.connected[i, feet[side]]) or "no foot"
    print(
        f"from {float(p.start[i]):.4f} s: {held}, {int(p.joint_freedoms[i])} joint freedoms,"
        f" mobility {int(p.freedoms[i])}"
    )
    if i < int(e.count):
        description = f"{('left', 'right')[e.which[i] // 2]} foot {('down', 'up')[e.which[i] % 2]}"
        print(f"  at {float(e.time[i]):.4f} s: {description}, {float(e.energy_lost[i]):.2f} J lost")
folder = pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else ".")
print("wrote", svkc.render(chain, traj, folder / "04_walk.png", frames=9))
