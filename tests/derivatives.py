"""Cases of the derivative tests: (function of parameters, parameters, largest relative error).

`python tests/derivatives.py [CASE ...]` prints the table of docs/derivatives.md, or some rows.
"""

import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import models
import numpy as np
from parameters import (
    FLOATS,
    TIGHT,
    mass_factors,
    model_floats,
    run_outputs,
    with_model_floats,
    with_state_floats,
)
from tolerances import DIFFERENCE

import svkc
import svkc.scenes

ALGEBRA, RUN = 1e-8, DIFFERENCE


def algebra(chain, state):
    """Return the case of all public functions that are not runs, on one state."""
    rng = np.random.default_rng(3)
    vdot = jnp.asarray(rng.normal(size=chain.dofs))

    def f(x):
        c = with_model_floats(chain, x)
        s = with_state_floats(state, x)
        out = {
            "forward": svkc.forward_dynamics(c, s, x["tau"]),
            "inverse": svkc.inverse_dynamics(c, s, vdot),
            "energy": svkc.energy(c, s),
        }
        stepped = svkc.step(c, s, x["tau"], 0.01)
        out |= {"stepped_q": stepped.q, "stepped_v": stepped.v}
        actuation = svkc.actuation(c, s, vdot)
        out |= {"actuation": actuation.tau, "residual": actuation.residual}
        if len(chain.link_names):
            loop_forces = svkc.loop_forces(c, s, x["tau"])
            out |= {
                "loop_force": loop_forces.force,
                "loop_torque": loop_forces.torque,
                "W": svkc.coordinates(c, s).W,
                "margin": svkc.mobility(c, s).margin,
            }
        return out

    x = {
        "q": state.q,
        "v": state.v,
        "tau": jnp.asarray(rng.normal(size=chain.dofs)),
    } | model_floats(chain, "mass", "com", "inertia", "pos", "gravity")
    return f, x | ({"grip": state.structure.real_pos} if len(chain.link_names) else {}), ALGEBRA


def four_bar():
    """Return the four-bar in motion."""
    chain = models.four_bar()
    return algebra(chain, chain.state(v={"crank": 4.0}))


def spatial_loop():
    """Return the spatial R-S-S-R linkage in motion."""
    chain = models.rod_on_balls()
    f, x, _ = algebra(chain, chain.state(v={"crank": 2.0}))
    # differences by the rod's inertia about its axis would be inaccurate: it is too small
    return f, {name: value for name, value in x.items() if name != "inertia"}, ALGEBRA


def over_constrained():
    """Return three parallel bars, whose third loop has only redundant rows."""
    chain = models.parallelogram()
    f, x, _ = algebra(chain, chain.state({"leg0": 0.3}, {"leg0": 1.0}))
    # without parameters whose change would make the redundant rows independent
    return f, {k: v for k, v in x.items() if k not in ("q", "v", "pos", "grip")}, ALGEBRA


def every_float():
    """Return a tree with all kinds of joints, springs, dampers and armature, by all its floats."""
    chain = svkc.load(models.random_tree(6, seed=4))
    rng = np.random.default_rng(4)
    q = svkc.integrate(chain, chain.q_load, jnp.asarray(rng.normal(size=chain.dofs)))
    f, x, _ = algebra(
        chain, svkc.State(q, jnp.asarray(rng.normal(size=chain.dofs)), chain.structure)
    )
    floats = model_floats(chain, *FLOATS)
    assert all(leaf is not None for leaf in floats.values())
    return f, x | floats, ALGEBRA


def at_rest():
    """Return a free body with a ball and a hinge: identity rotations, zero velocity, zero load."""
    ball = models.bar(
        "arm",
        'type="ball"',
        "0.2 0 0.5",
        "0 0 0.1",
        models.bar("fore", models.Y, "0 0 0.4", "0.2 0 0.5"),
    )
    base = f'<body name="base"><freejoint name="base"/>{models.BAR.format("0.3 0 0")}{ball}</body>'
    chain = svkc.load(models.MJCF.format(base))
    state = chain.state()
    f, x, _ = algebra(chain, state)
    return f, x | {"v": jnp.zeros(chain.dofs)}, ALGEBRA


def assembly():
    """Return `chain.state` from an open configuration, also by lengths and link placements."""
    chain = models.rod_on_balls()
    near = chain.state({"crank": 0.3})
    # coordinates that leave the loop open by a little; the velocity below opens it as well
    q = near.q[: chain.nq] + 0.02 * jnp.sin(jnp.arange(chain.nq, dtype=float))

    def f(x):
        c = with_model_floats(chain, x)
        c = eqx.tree_at(lambda c: c.structure.real_pos, c, x["grip"])
        state = c.state(x["q"], x["v"])
        return {"q": state.q, "v": state.v}

    start = at_unit(chain, q)
    return (
        f,
        {"q": start, "v": jnp.ones(chain.nv), "pos": chain.pos, "grip": chain.structure.real_pos},
        ALGEBRA,
    )


def at_unit(chain, q):
    """Return the coordinates with quaternions of unit length."""
    full = jnp.concatenate([q, chain.q_load[chain.nq :]])
    return svkc.integrate(chain, full, jnp.zeros(chain.dofs))[: chain.nq]


def impact():
    """Return the velocity after a connect, at the declared placement and at the current poses."""
    box = (
        '<body name="{}" pos="{}"><freejoint name="{}"/><geom type="box" size="0.1 0.2 0.3"'
        ' contype="0"/></body>'
    )
    links = [svkc.VirtualLink("hold", "a", "b", "ball", real_pos=(-0.6, 0.1, 0))]
    chain = svkc.load(
        models.MJCF.format(box.format("a", "0 0 0", "a") + box.format("b", "1 0 0", "b")),
        virtual_links=links,
    )
    rng = np.random.default_rng(5)
    state = chain.state(v=rng.normal(size=12), connected=())

    def f(x):
        after = svkc.connect(
            with_model_floats(chain, x), with_state_floats(state, x), "hold", here=True
        )
        return {
            "q": after.q,
            "v": after.v,
            "energy": svkc.kinetic_energy(with_model_floats(chain, x), after),
        }

    return (
        f,
        {"q": state.q, "v": state.v, "grip": state.structure.real_pos}
        | model_floats(chain, "mass", "com", "inertia"),
        ALGEBRA,
    )


def pendulum_cut():
    """Return two rods, of which the second is cut at an angle of the first and connected again."""
    rods = models.TWO_RODS
    chain = svkc.load(models.MJCF.format(rods), cuttable="lower")
    state = chain.state({"upper": 1.2, "lower": 0.3}, {"upper": 0.1, "lower": 0.2})

    def f(x):
        events = [
            svkc.when(lambda t, s, args: s.q[0] - args, cut="lower"),
            svkc.at(x["again"], connect="lower", here=True),
        ]
        ts = jnp.stack([x["seen"], x["t1"]])
        return run_outputs(
            svkc.simulate(
                with_model_floats(chain, x),
                state,
                x["t1"],
                ts=ts,
                events=events,
                args=x["angle"],
                **TIGHT,
            )
        )

    x = {
        name: jnp.asarray(value)
        for name, value in {"angle": 0.4, "again": 0.55, "t1": 0.7, "seen": 0.5}.items()
    }
    return f, x | model_floats(chain, "com", "gravity") | mass_factors(chain), RUN


def breaking():
    """Return a joint that breaks under its load, and a grip by a spare slot."""
    rods = models.TWO_RODS
    rods += models.bar("other", models.Y, "0 0 -1", "1 0 0")
    chain = svkc.load(models.MJCF.format(rods), cuttable="lower", spare=1)
    state = chain.state({"upper": 1.2, "lower": 0.3})

    def f(x):
        grip = svkc.Grip("upper", "other", "ball", real_pos=x["place"])
        events = [
            svkc.when(svkc.overload(chain, "lower", force=x["limit"]), cut="lower", direction=True),
            svkc.at(x["time"], bind=grip),
        ]
        control = lambda t, s, args: args * jnp.sin(3 * t) * jnp.ones(chain.nv)
        return run_outputs(
            svkc.simulate(
                with_model_floats(chain, x),
                state,
                0.6,
                events=events,
                control=control,
                args=x["torque"],
                **TIGHT,
            )
        )

    x = {
        "limit": jnp.asarray(32.0),
        "time": jnp.asarray(0.45),
        "torque": jnp.asarray(0.5),
        "place": jnp.array([0.1, 0.0, -0.7]),
    }
    return f, x | model_floats(chain, "gravity") | mass_factors(chain), RUN


def four_bar_turning():
    """Return a four-bar driven through more than a turn, which changes independent coordinates."""
    chain = models.four_bar()
    control = lambda t, s, args: jnp.zeros(chain.dofs).at[0].set(args[0] * jnp.cos(args[1] * t))

    def run(x):
        c = with_model_floats(chain, x)
        # the pin may be elsewhere in the plane; out of it the loop would not close
        pin = chain.structure.real_pos.at[:, ::2].add(x["pin"])
        c = eqx.tree_at(lambda c: c.structure.real_pos, c, pin)
        start = c.state({"crank": x["angle"]}, {"crank": x["speed"]})
        return c, svkc.simulate(
            c, start, 1.0, ts=jnp.linspace(0, 1, 9), control=control, args=x["torque"], **TIGHT
        )

    x = {
        "torque": jnp.array([2.0, 3.0]),
        "speed": jnp.asarray(6.0),
        "angle": jnp.asarray(0.1),
        "pin": jnp.zeros((1, 2)),
    }
    x |= model_floats(chain, "gravity") | mass_factors(chain)
    c, traj = run(x)
    dependent = jax.vmap(lambda s: svkc.coordinates(c, s).dependent)(traj.states)
    assert jnp.any(dependent != dependent[:1]), "no coordinate was swapped"
    return lambda x: run_outputs(run(x)[1]), x, RUN


def over_constrained_run():
    """Return three parallel bars that swing; the middle bar is cut and connected again."""
    chain = models.parallelogram()
    state = chain.state({"leg0": 0.3}, {"leg0": 1.0})

    def f(x):
        events = [
            svkc.at(x["time"], cut="pin1"),
            svkc.at(x["time"] + 0.1, connect="pin1", here=True),
        ]
        return run_outputs(
            svkc.simulate(with_model_floats(chain, x), state, 0.5, events=events, **TIGHT)
        )

    return f, {"time": jnp.asarray(0.2)} | model_floats(chain, "gravity") | mass_factors(chain), RUN


def high_bar():
    """Return the high bar with two hands, one, none, one: 24, 23, 22, 23 joint freedoms.

    The times of releases and of the catch are parameters.
    """
    chain, hanging = svkc.scenes.high_bar(ignore="limit")

    def f(x):
        c = with_model_floats(chain, x)
        right, left, again = x["times"]
        events = [
            svkc.at(right, cut="right_hand_grip"),
            svkc.at(left, cut="left_hand_grip"),
            svkc.at(again, connect="left_hand_grip", here=True),
        ]
        control = lambda t, s, args: jnp.concatenate(
            [jnp.zeros(6), args * jnp.sin(4 * t), jnp.zeros(chain.dofs - 22)]
        )
        return run_outputs(
            svkc.simulate(
                c,
                c.state(hanging.q[: c.nq], x["v"]),
                0.5,
                events=events,
                control=control,
                args=x["torque"],
                **TIGHT,
            )
        )

    rng = np.random.default_rng(1)
    x = {
        "times": jnp.array([0.2, 0.3, 0.4]),
        "torque": jnp.asarray(5 * rng.normal(size=16)),
        "v": jnp.zeros(chain.nv),
    }
    return f, x | mass_factors(chain), RUN


def swing():
    """Return the swing, whose slides are cut by two guards at two distances.

    The torques are symmetric. Asymmetric ones would turn the pelvis on the plate, which the loops
    of the two slides allow to first order only.
    """
    from svkc.scenes.swing import PLATE_EDGE, swing

    chain, seated = swing(ignore="limit")
    back = -jnp.array([jnp.cos(0.6), 0, -jnp.sin(0.6), 0, 0, 0])
    state = chain.state(seated.q[: chain.nq], {"base": back, "pivot": 0.0})
    sides = ("right", "left")
    parts = [
        name.removeprefix("right_").removeprefix("left_")
        for name in (*chain.body_names, *chain.link_names)
    ]
    index = np.array([sorted(set(parts)).index(part) for part in parts])

    def slid(side, number):
        along = svkc.touch(chain, f"{side}_thigh_plate", 0.0, axes="z")
        return svkc.when(
            lambda t, s, args: jnp.abs(along(t, s)) - args[1] - 0.002 * number,
            cut=f"{side}_thigh_plate",
            direction=True,
        )

    def f(x):
        arm, leg = jnp.split(x["torque"], 2)
        torque = jnp.concatenate([jnp.zeros(6), arm, arm, leg, leg, jnp.zeros(chain.dofs - 22)])
        c = with_model_floats(chain, {"mass_factors": x["mass_factors"][index]})
        events = [slid(side, number) for number, side in enumerate(sides)]
        return run_outputs(
            svkc.simulate(
                c,
                state,
                x["t1"],
                events=events,
                control=lambda t, s, args: args[0],
                args=(torque, x["edge"]),
                **TIGHT,
            )
        )

    x = {"t1": jnp.asarray(0.15), "torque": jnp.ones(8), "edge": jnp.asarray(PLATE_EDGE)}
    return f, x | {"mass_factors": jnp.ones(index.max() + 1)}, RUN


def brachiation():
    """Return a figure that hangs by one hand, catches the next bar, and releases the first."""
    from svkc.scenes.brachiation import brachiation

    chain, state = brachiation(ignore="limit")
    held = {
        "right_shoulder_flexion": 3.0,
        "right_elbow": 0.85,
        "left_shoulder_flexion": 2.4,
        "left_elbow": 0.1,
    }
    held |= {"left_hip_flexion": 0.8, "right_hip_flexion": 0.8}
    pose = jnp.array([held.get(name, 0.0) for name in chain.joint_names[1:]])
    strong = jnp.array(
        [
            60.0 if any(part in name for part in ("shoulder", "elbow", "hip")) else 5.0
            for name in chain.joint_names[1:]
        ]
    )

    def control(t, s, args):
        return jnp.pad(strong * (args - s.q[7:23]) - strong / 15 * s.v[6:22], (6, chain.dofs - 22))

    def f(x):
        near = svkc.touch(chain, "left_hand_bar2", x["reach"], axes="xy")
        events = [
            svkc.when(near, connect="left_hand_bar2", here=True, direction=False),
            svkc.at(x["release"], cut="right_hand_bar1"),
        ]
        return run_outputs(
            svkc.simulate(
                chain, state, 0.8, events=events, control=control, args=x["pose"], **TIGHT
            )
        )

    return f, {"reach": jnp.asarray(0.45), "release": jnp.asarray(0.72), "pose": pose}, RUN


ALGEBRAIC = {
    case.__name__: case
    for case in (four_bar, spatial_loop, over_constrained, every_float, at_rest, assembly, impact)
}
RUNS = {
    case.__name__: case
    for case in (
        pendulum_cut,
        breaking,
        four_bar_turning,
        over_constrained_run,
        high_bar,
        swing,
        brachiation,
    )
}
CASES = ALGEBRAIC | RUNS


def main(names):
    """Print the worst relative error of each case, in both modes, along random directions."""
    print(
        "| case | parameters | worst relative error | of | difference good to | forward against"
        " reverse |\n|---|---|---|---|---|---|"
    )
    for name in names or CASES:
        f, x, _ = CASES[name]()
        check = svkc.check_grad(f, x, directions=1)
        worst = f"{check.output[5:]} by {check.input[1:]}".replace("'", "")
        print(
            f"| {name} | {', '.join(x)} | {check.error:.1e} | {worst} | {check.uncertainty:.0e} |"
            f" {check.modes:.0e} |",
            flush=True,
        )


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main(sys.argv[1:])
