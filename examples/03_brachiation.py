"""Brachiation: a figure travels hand over hand along three bars; guards decide when.

Writes a picture to the folder named on the command line (default: the current one).
"""

import pathlib
import sys

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp

import svkc
from svkc.scenes import BAR_HEIGHT, PALM
from svkc.scenes.brachiation import BAR_SPACING, brachiation

chain, state = brachiation()
HANGING = {"shoulder_flexion": 3.0, "shoulder_abduction": -0.1, "elbow": 0.85, "wrist": 0.2}  # rad
FREE = {"shoulder_flexion": 1.2, "elbow": 0.6, "hip_flexion": 0.3, "knee": 0.4, "ankle": -0.5}
PUMPED = {"hip_flexion": 0.9, "knee": 0.6}  # rad: raised legs while the hips move forwards
# kg m^2: an arm that holds a bar moves the whole body, a free limb only itself
BODY = {"shoulder_flexion": 3.0, "elbow": 3.0, "shoulder_abduction": 20.0, "wrist": 10.0}
limb = jnp.diag(svkc.mass_matrix(chain, state))
bars = [jnp.array([i * BAR_SPACING, 0.0, BAR_HEIGHT]) for i in range(3)]  # m


def pull(state, side, bar):
    """Return the torques (N m) by which joints pull a hand to a bar, up to 150 N."""
    hand, palm = f"{side}_hand", (0.0, 0.0, -PALM)
    gap = jnp.array([1.0, 0.0, 1.0]) * (bar - svkc.point_position(chain, state, hand, palm))
    return svkc.apply_force(chain, state, hand, 150.0 * gap / jnp.sqrt(gap @ gap + 0.01), palm)


def control(t, state, args):
    """Return joint torques (N m): a PD controller, and the spring at a hand that reaches."""
    bar1, bar2, bar3 = state.structure.connected
    holds = {"right": bar1 | bar3, "left": bar2}
    reaches = {"right": bar2 & ~bar1 & ~bar3, "left": bar1 & ~bar2}
    pulls = {"right": pull(state, "right", bars[2]), "left": pull(state, "left", bars[1])}
    forwards = jnp.tanh(2.0 * svkc.point_velocity(chain, state, "torso")[0])
    torques = {}
    for joint in chain.joint_names[1:]:  # all but the base
        (side, part), (q, v) = joint.split("_", 1), chain.joint(state, joint)
        dof = chain.v_index(joint)
        goal = FREE.get(part, 0.0) + PUMPED.get(part, 0.0) * forwards
        tau = limb[dof] * (81.0 * (goal - q) - 18.0 * v)
        if part in HANGING:
            tau = jnp.where(reaches[side], pulls[side][dof] - 8.0 * limb[dof] * v, tau)
            held = BODY[part] * (64.0 * (HANGING[part] - q) - 16.0 * v)
            tau = jnp.where(holds[side], held, tau)
        torques[joint] = tau
    return torques


def swings_forward(bar):
    """Return a guard: the velocity of the hips (m/s) while this bar and bar 2 are held, or 1."""
    return lambda t, state, args: jnp.where(
        jnp.all(state.structure.connected[jnp.array([bar - 1, 1])]),
        svkc.point_velocity(chain, state, "torso")[0],
        1.0,
    )


catch = lambda link: svkc.when(
    svkc.touch(chain, link, 0.05, axes="xy"), connect=link, here=True, direction=False
)
events = [
    catch("left_hand_bar2"),
    svkc.when(swings_forward(bar=1), cut="right_hand_bar1", direction=True),
    catch("right_hand_bar3"),
    svkc.when(swings_forward(bar=3), cut="left_hand_bar2", direction=True),
]
options = {"ts": jnp.linspace(0, 4.5, 181), "rtol": 1e-6, "atol": 1e-8, "max_events": 5}
traj = svkc.simulate(chain, state, 4.5, events=events, control=control, **options)
print(traj)
folder = pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else ".")
print("wrote", svkc.render(chain, traj, folder / "03_brachiation.png", frames=7))
