"""What derivatives are checked on: a function of parameters for each case, its parameters, and the relative error it is held to."""

import equinox as eqx
import jax.numpy as jnp
import models
import numpy as np

import svkc

TIGHT = {"rtol": 1e-11, "atol": 1e-13}
ALGEBRA = 1e-8


def model(chain, *names):
    """Floats of the model by name, "grip": where its virtual links take hold of their real links."""
    return {name: chain.structure.real_pos if name == "grip" else getattr(chain, name) for name in names}


def changed(chain, x):
    """The chain with the floats in x that are its own."""
    for name in ("mass", "com", "inertia", "pos", "gravity", "armature", "damping"):
        if name in x:
            chain = eqx.tree_at(lambda c, name=name: getattr(c, name), chain, x[name])
    return chain


def start(state, x):
    s = state.structure
    if "grip" in x:
        s = eqx.tree_at(lambda s: s.real_pos, s, x["grip"])
    return svkc.State(x.get("q", state.q), x.get("v", state.v), s)


def algebra(chain, state):
    """Everything that is not a run, on one state."""
    rng = np.random.default_rng(3)
    moving = jnp.asarray(rng.normal(size=chain.dofs))

    def f(x):
        c = changed(chain, x)
        s = start(state, x)
        out = {"forward": svkc.forward_dynamics(c, s, x["tau"]), "inverse": svkc.inverse_dynamics(c, s, moving), "energy": svkc.energy(c, s)}
        driven = svkc.actuation(c, s, moving)
        out |= {"actuation": driven.tau, "residual": driven.residual}
        if len(chain.link_names):
            carried = svkc.loop_forces(c, s, x["tau"])
            out |= {"loop_force": carried.force, "loop_torque": carried.torque, "W": svkc.coordinates(c, s).W, "margin": svkc.mobility(c, s).margin}
        return out

    x = {"q": state.q, "v": state.v, "tau": jnp.asarray(rng.normal(size=chain.dofs))} | model(chain, "mass", "com", "inertia", "pos", "gravity")
    return f, x | ({"grip": state.structure.real_pos} if len(chain.link_names) else {}), ALGEBRA


def four_bar():
    chain = models.four_bar()
    return algebra(chain, chain.state(v={"crank": 4.0}))


def spatial_loop():
    chain = models.rod_on_balls()
    f, x, _ = algebra(chain, chain.state(v={"crank": 2.0}))
    # the rod's inertia about itself is too small for differences
    return f, {name: value for name, value in x.items() if name != "inertia"}, ALGEBRA


def over_constrained():
    """Three parallel bars: the third loop is redundant as a whole."""
    chain = models.parallelogram()
    f, x, _ = algebra(chain, chain.state({"leg0": 0.3}, {"leg0": 1.0}))
    # what keeps the redundant rows redundant: no single place may move
    return f, {k: v for k, v in x.items() if k not in ("q", "v", "pos", "grip")}, ALGEBRA


def at_rest():
    """Identity rotations, no velocity, no load: a free body with a ball and a hinge."""
    ball = models.bar("arm", 'type="ball"', "0.2 0 0.5", "0 0 0.1", models.bar("fore", models.Y, "0 0 0.4", "0.2 0 0.5"))
    base = f'<body name="base"><freejoint name="base"/>{models.BAR.format("0.3 0 0")}{ball}</body>'
    chain = svkc.load(models.MJCF.format(base))
    state = chain.state()
    f, x, _ = algebra(chain, state)
    return f, x | {"v": jnp.zeros(chain.dofs)}, ALGEBRA


def assembly():
    """Newton's method onto the loops, from a configuration that is off them; lengths and grips of the model too."""
    chain = models.rod_on_balls()
    near = chain.state({"crank": 0.3})
    # as the user gives it: a little off, and a velocity that does not agree
    q = near.q[: chain.nq] + 0.02 * jnp.sin(jnp.arange(chain.nq, dtype=float))

    def f(x):
        c = changed(chain, x)
        c = eqx.tree_at(lambda c: c.structure.real_pos, c, x["grip"])
        state = c.state(x["q"], x["v"])
        return {"q": state.q, "v": state.v}

    start = at_unit(chain, q)
    return f, {"q": start, "v": jnp.ones(chain.nv), "pos": chain.pos, "grip": chain.structure.real_pos}, ALGEBRA


def at_unit(chain, q):
    """With quaternions of unit length, as the loader asks for."""
    full = jnp.concatenate([q, chain.q_load[chain.nq :]])
    return svkc.integrate(chain, full, jnp.zeros(chain.dofs))[: chain.nq]


def impact():
    """The velocity after a connect, declared and where it is."""
    box = '<body name="{}" pos="{}"><freejoint name="{}"/><geom type="box" size="0.1 0.2 0.3" contype="0"/></body>'
    links = [svkc.VirtualLink("hold", "a", "b", "ball", real_pos=(-0.6, 0.1, 0))]
    chain = svkc.load(models.MJCF.format(box.format("a", "0 0 0", "a") + box.format("b", "1 0 0", "b")), virtual_links=links)
    rng = np.random.default_rng(5)
    state = chain.state(v=rng.normal(size=12), connected=())

    def f(x):
        after = svkc.connect(changed(chain, x), start(state, x), "hold", here=True)
        return {"q": after.q, "v": after.v, "energy": svkc.kinetic_energy(changed(chain, x), after)}

    return f, {"q": state.q, "v": state.v, "grip": state.structure.real_pos} | model(chain, "mass", "com", "inertia"), ALGEBRA


CASES = {case.__name__: case for case in (four_bar, spatial_loop, over_constrained, at_rest, assembly, impact)}
