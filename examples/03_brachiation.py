"""Brachiation: a figure travels hand over hand along three bars.

Guards decide when a hand catches or releases a bar. Writes a picture to the folder named on the
command line (default: the current one).
"""

import pathlib
import sys

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp

import svkc
from svkc.scenes.brachiation import brachiation

chain, state = brachiation()
joints = chain.joint_names[1:]  # all but the free base: q[7:23], v[6:22]
to_bar2, to_bar3 = (
    svkc.touch(chain, link, 0.0, axes="xy") for link in ("left_hand_bar2", "right_hand_bar3")
)


def per_joint(side="", **numbers):
    """Return a number for each joint whose name ends with a keyword, and zero for other joints.

    side: beginning of the names of these joints. Empty: both sides.
    numbers: the end of a joint's name, and its number.
    """
    return jnp.array(
        [
            sum(
                (x for end, x in numbers.items() if name.startswith(side) and name.endswith(end)),
                0.0,
            )
            for name in joints
        ]
    )


right_arm, left_arm = (
    per_joint(side, shoulder_flexion=1, shoulder_abduction=1, elbow=1, wrist=1) > 0
    for side in ("right", "left")
)
hanging_pose = per_joint(shoulder_flexion=3.0, shoulder_abduction=-0.1, elbow=0.85, wrist=0.2)
free_pose = per_joint(shoulder_flexion=1.2, elbow=0.6, hip_flexion=0.3, knee=0.4, ankle=-0.5)
pump_amplitude = per_joint(hip_flexion=0.9, knee=0.6)
# kg m^2: an arm that holds a bar moves the whole body, a free limb only itself
load_inertia = per_joint(shoulder_flexion=3.0, elbow=3.0, shoulder_abduction=20.0, wrist=10.0)
limb_inertia = jnp.diag(svkc.mass_matrix(chain, state))[6:]


@jax.jit
def control(t, state, args):
    """Return joint torques (N m).

    A PD controller keeps arms that hold a bar bent, and raises the legs while the hips move
    forwards (v[0], m/s). A spring pulls the free hand to the next bar.
    """
    bar1, bar2, bar3 = state.structure.connected
    q, v = state.q[7:23], state.v[6:22]
    holds = (right_arm & (bar1 | bar3)) | (left_arm & bar2)
    goal = jnp.where(holds, hanging_pose, free_pose) + pump_amplitude * jnp.tanh(2.0 * state.v[0])
    rate = jnp.where(holds, 8.0, 9.0)
    tau = jnp.where(holds, load_inertia, limb_inertia) * (rate * rate * (goal - q) - 2.0 * rate * v)

    def spring_energy(dv):
        moved = svkc.State(svkc.integrate(chain, state.q, dv), state.v, state.structure)
        distance = jnp.where(bar1, to_bar2(t, moved), to_bar3(t, moved))
        return 150.0 * jnp.sqrt(distance**2 + 0.01)

    reach_torque = -jax.grad(spring_energy)(jnp.zeros_like(state.v))[6:22] - 8.0 * limb_inertia * v
    reaching = (left_arm & bar1 & ~bar2) | (right_arm & bar2 & ~bar1 & ~bar3)
    # no torque at the base and at the bars
    return jnp.pad(jnp.where(reaching, reach_torque, tau), (6, chain.dofs - 22))


def swings_forward(bar):
    """Return a guard: the velocity of the hips along x (m/s), while this bar and bar 2 are held.

    Otherwise the guard is one, so that it does not cross zero.
    """
    return lambda t, state, args: jnp.where(
        jnp.all(state.structure.connected[jnp.array([bar - 1, 1])]), state.v[0], 1.0
    )


events = [
    svkc.when(
        svkc.touch(chain, "left_hand_bar2", 0.05, axes="xy"),
        connect="left_hand_bar2",
        here=True,
        direction=False,
    ),
    svkc.when(swings_forward(bar=1), cut="right_hand_bar1", direction=True),
    svkc.when(
        svkc.touch(chain, "right_hand_bar3", 0.05, axes="xy"),
        connect="right_hand_bar3",
        here=True,
        direction=False,
    ),
    svkc.when(swings_forward(bar=3), cut="left_hand_bar2", direction=True),
]
ts = jnp.linspace(0, 4.5, 181)
traj = svkc.simulate(
    chain, state, 4.5, ts=ts, events=events, control=control, rtol=1e-6, atol=1e-8, max_events=5
)

p = traj.phases
for phase in range(int(p.count)):
    held = ", ".join(
        link for link, on in zip(chain.link_names, p.connected[phase], strict=True) if on
    )
    print(
        f"{float(p.start[phase]):.3f} s to {float(p.stop[phase]):.3f} s: {held}; mobility"
        f" {int(p.freedoms[phase])}, {int(p.accepted[phase])} steps"
    )
torque = jnp.abs(jax.vmap(lambda t, s: control(t, s, None))(ts, traj.states)).max()
first, second = traj.events.energy_lost[0], traj.events.energy_lost[2]
print(
    f"the catches cost {first:.1f} J and {second:.1f} J; largest torque {torque:.0f} N m; largest"
    f" loop gap {float(traj.report().gap):.1e} m"
)

folder = pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else ".")
print("wrote", svkc.render(chain, traj, folder / "03_brachiation.png", frames=7))
