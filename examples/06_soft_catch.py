"""A soft catch: torques in flight and a catch time that lose the least energy on catching the bar.

Writes a picture to the folder named on the command line (default: the current one).
"""

import pathlib
import sys
from tempfile import TemporaryDirectory

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import matplotlib.pyplot as plt
import optax

import svkc
from svkc.scenes import BAR_HEIGHT, hanging_state, high_bar

# catch time at zero delay (s); velocity of the hands at the catch without torques (m/s)
CATCH_TIME, ARRIVAL = 0.4, jnp.array([0.6, 0.0, -1.2])
JOINTS = ["shoulder_flexion", "shoulder_abduction", "elbow", "wrist"]
JOINTS += ["hip_flexion", "hip_abduction", "knee", "ankle"]
chain, _ = high_bar(ignore="limit")  # the cost of torques keeps the motion of the joints small
# the figure at the bar, moved back in time along its parabola
hanging, fall = hanging_state(chain, angle=0.3), chain.gravity
pose = {joint: chain.joint(hanging, joint).q for joint in chain.joint_names}
pose["base"] = pose["base"].at[:3].add(fall * CATCH_TIME**2 / 2 - ARRIVAL * CATCH_TIME)
start = chain.state(pose, {"base": [*(ARRIVAL - fall * CATCH_TIME), 0, 0, 0]}, connected=())
limb = jnp.diag(svkc.mass_matrix(chain, start))  # kg m^2


def control(t, state, bend):
    """Return joint torques (N m) for accelerations `bend` (rad/s^2) at start and end of flight."""
    now = bend[0] + (bend[1] - bend[0]) * t / CATCH_TIME
    now = jnp.where(chain.connected(state, "right_hand_grip"), 0.0, now)
    both = [(side + joint, a) for side in ("right_", "left_") for joint, a in zip(JOINTS, now)]
    return {joint: limb[chain.v_index(joint)] * a for joint, a in both}


def fly(p, t1, ts=None):
    """Return a run in which both hands are connected to the ground where they are."""
    events = svkc.at(CATCH_TIME + p["delay"] / 100, connect=chain.link_names, here=True)
    options = {"rtol": 1e-9, "atol": 1e-11, "control": control, "args": p["bend"]}
    return svkc.simulate(chain, start, t1, ts=ts, events=events, **options)


def loss(p):
    """Return a cost (J), and its energy lost (J), impulse (N s) and distance from the bar (cm)."""
    traj = fly(p, 0.5)
    off = traj.final.structure.pos[:, ::2] - jnp.array([0.0, BAR_HEIGHT])
    lost, impulse = traj.events.energy_lost[0], jnp.linalg.norm(traj.events.impulse[0, 0])
    cost = lost + 1e4 * jnp.sum(off**2) + 2e-3 * jnp.sum(p["bend"] ** 2)
    return cost, (lost, impulse, 100 * jnp.linalg.norm(off[0]))


p = first = {"bend": jnp.zeros((2, 8)), "delay": jnp.zeros(())}
step, adam = jax.jit(jax.value_and_grad(loss, has_aux=True)), optax.adam(0.4)
memory = adam.init(p)
for i in range(41):
    (value, (lost, impulse, off)), gradient = step(p)
    if i % 10 == 0:
        print(f"{i}: loss {value:.3f}; {lost:.2f} J, {impulse:.2f} N s, {off:.1f} cm off the bar")
    updates, memory = adam.update(gradient, memory)
    p, best = optax.apply_updates(p, updates), p
figure, panels = plt.subplots(1, 2, figsize=(11, 7.6), layout="constrained")
for panel, what, x in zip(panels, ("before", "after"), (first, best)):
    with TemporaryDirectory() as folder:
        picture = pathlib.Path(folder) / "strobe.png"
        svkc.render(chain, fly(x, 0.8, jnp.linspace(0, 0.8, 65)), picture, frames=6)
        panel.imshow(plt.imread(picture))
    panel.set(title=what, xticks=[], yticks=[])
folder = pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else ".")
figure.savefig(folder / "06_soft_catch.png", dpi=110, bbox_inches="tight")
cost = lambda p: loss(p)[0]  # one function for both checks, so that JAX compiles its gradient once
for when, at in (("start", first), ("end", best)):
    print(f"gradient at the {when}: {svkc.check_grad(cost, at, mode='reverse', directions=1)}")
