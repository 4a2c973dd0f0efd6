"""A soft catch: torques in flight and a catch time that lose the least energy on catching the bar.

Writes a picture to the folder named on the command line (default: the current one).
"""

import pathlib
import sys
import tempfile

import jax

jax.config.update("jax_enable_x64", True)

import diffrax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import optax

import svkc
from svkc.scenes import BAR_HEIGHT, hanging_state, high_bar

# catch time at zero delay (s); velocity of the hands at the catch without torques (m/s)
HANDS, CATCH_TIME, ARRIVAL_VELOCITY = (
    ("right_hand_grip", "left_hand_grip"),
    0.4,
    jnp.array([0.6, 0.0, -1.2]),
)
# joint ranges are left out: the cost of torques keeps the motion of the joints small
chain, _ = high_bar(ignore="limit")

# the figure at the bar, moved back in time along its parabola: without torques the hands arrive at
# the bar, with stretched arms
hanging_start, fall = hanging_state(chain, angle=0.3), chain.gravity
q = hanging_start.q[: chain.nq].at[:3].add(fall * CATCH_TIME**2 / 2 - ARRIVAL_VELOCITY * CATCH_TIME)
start = chain.state(q, {"base": [*(ARRIVAL_VELOCITY - fall * CATCH_TIME), 0, 0, 0]}, connected=())
# kg m^2: inertia that each joint accelerates
limb_inertia = jnp.diag(svkc.mass_matrix(chain, start))[6:22]


def control(t, state, bend):
    """Return joint torques (N m), equal on both sides: linear in time in flight, then zero.

    Joint torques do not change the momentum of the flight.

    bend: accelerations (rad/s^2) at the start and at CATCH_TIME, of arm and leg joints.
    """
    arm, leg = jnp.split(bend[0] + (bend[1] - bend[0]) * t / CATCH_TIME, 2)
    tau = limb_inertia * jnp.concatenate([arm, arm, leg, leg])
    return jnp.pad(jnp.where(state.structure.connected[0], 0.0, tau), (6, 2))


def fly(p, t1, ts=None):
    """Return a run in which both hands are connected to the ground where they are.

    The loss moves these positions to the bar.

    p: the parameters: `bend`, and the delay of the catch (0.01 s).
    t1: end time (s).
    """
    events = [svkc.at(CATCH_TIME + p["delay"] / 100, connect=HANDS, here=True)]
    options = {"solver": diffrax.Dopri8(), "rtol": 1e-9, "atol": 1e-11}
    return svkc.simulate(
        chain, start, t1, ts=ts, events=events, control=control, args=p["bend"], **options
    )


def loss(p):
    """Return the loss and its parts.

    The loss is the energy lost in the catch (J), 1 J for a hand 1 cm off the bar, and a small cost
    of torques. The parts are energy lost (J), impulse on a hand (N s), distance from the bar (cm).
    """
    traj = fly(p, 0.5)
    hand_offset = traj.final.structure.pos[:, ::2] - jnp.array([0.0, BAR_HEIGHT])
    metrics = (
        traj.events.energy_lost[0],
        jnp.linalg.norm(traj.events.impulse[0, 0]),
        100 * jnp.linalg.norm(hand_offset[0]),
    )
    return metrics[0] + 1e4 * jnp.sum(hand_offset**2) + 2e-3 * jnp.sum(p["bend"] ** 2), metrics


# accelerations (rad/s^2) of four arm joints and four leg joints, at the start and at CATCH_TIME;
# delay of the catch (0.01 s)
p = first = {"bend": jnp.zeros((2, 8)), "delay": jnp.zeros(())}
step, adam = jax.jit(jax.value_and_grad(loss, has_aux=True)), optax.adam(0.4)
optimizer_state = adam.init(p)
for i in range(41):
    (value, (lost, impulse, off)), gradient = step(p)
    if i % 10 == 0:
        after = CATCH_TIME + float(p["delay"]) / 100
        print(
            f"{i}: loss {value:.3f}; a catch after {after:.3f} s costs {lost:.2f} J, {impulse:.2f}"
            f" N s a hand, {off:.1f} cm off the bar"
        )
    if i < 40:
        updates, optimizer_state = adam.update(gradient, optimizer_state)
        p = optax.apply_updates(p, updates)
run_flight = jax.jit(lambda p: fly(p, 0.8, jnp.linspace(0, 0.8, 65)))
folder = pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else ".")
figure, panels = plt.subplots(1, 2, figsize=(11, 7.6), layout="constrained")
with tempfile.TemporaryDirectory() as scratch:
    for panel, what, x in zip(panels, ("before", "after"), (first, p)):
        picture = plt.imread(
            svkc.render(chain, run_flight(x), pathlib.Path(scratch) / "strobe.png", frames=6)
        )
        panel.imshow(picture[:, 270:830])  # crop the empty sides
        panel.set_title(what, fontsize=16)
        panel.axis("off")
figure.savefig(folder / "06_soft_catch.png", dpi=110, bbox_inches="tight")
print("wrote", folder / "06_soft_catch.png")
scalar_loss = lambda p: loss(p)[0]
for when, at in (("start", first), ("end", p)):
    print(
        f"gradient at the {when}: {svkc.check_grad(scalar_loss, at, mode='reverse', directions=1)}"
    )
