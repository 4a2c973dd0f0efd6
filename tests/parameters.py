"""Parameters of derivatives (floats of a chain and of a state, by name), a run as numbers, and the
error of derivatives against differences."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import svkc
from svkc.tools.central_differences import central_differences

TIGHT = {"rtol": 1e-11, "atol": 1e-13, "solver": diffrax.Dopri8()}
FLOATS = "mass com inertia pos quat axis anchor gravity armature damping stiffness q_spring".split()


def model(chain, *names):
    """Return floats of the model by name; "grip" is the virtual links' placement in their real
    links."""
    return {
        name: chain.structure.real_pos if name == "grip" else getattr(chain, name) for name in names
    }


def changed(chain, x):
    """Return the chain with its floats replaced by those in x."""
    for name in FLOATS:
        if name in x:
            chain = eqx.tree_at(lambda c, name=name: getattr(c, name), chain, x[name])
    if "heavier" in x:
        # bodies whose inertia stays that of a body, for runs
        grown = (chain.mass * x["heavier"], chain.inertia * x["heavier"][:, None, None])
        chain = eqx.tree_at(lambda c: (c.mass, c.inertia), chain, grown)
    return chain


def heavier(chain):
    """Return the parameter that scales mass and inertia, body by body."""
    return {"heavier": jnp.ones(len(chain.mass))}


def start(state, x):
    """Return the state with its floats replaced by those in x."""
    s = state.structure
    if "grip" in x:
        s = eqx.tree_at(lambda s: s.real_pos, s, x["grip"])
    return svkc.State(x.get("q", state.q), x.get("v", state.v), s)


def motion(traj):
    """Return the numbers of a run; rows without an event are zero."""
    e, p = traj.events, traj.phases
    flat = lambda *parts: jnp.concatenate([jnp.ravel(part) for part in parts])
    times = flat(e.time, p.start, p.stop, traj.t_final)
    return {
        "end": flat(traj.final.q, traj.final.v),
        "saved": flat(traj.states.q, traj.states.v),
        "times": jnp.where(jnp.isfinite(times), times, 0),
        "impacts": flat(e.impulse, e.angular_impulse, e.energy_lost),
        "energy": flat(p.energy, p.work),
    }


def worst(program, x, step=0.05) -> float:
    """The largest relative error of derivatives against differences, along a random direction of
    each parameter, where one program has all of it.

    program(x, along): values, and their derivatives along a direction. (`svkc.check_grad` compiles
    the function, too.)
    """
    named = lambda tree: {
        jax.tree_util.keystr(path): np.asarray(leaf)
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree)
    }
    # (without weak types, which would compile it again for every parameter)
    x = jax.tree.map(lambda leaf: jnp.asarray(leaf, leaf.dtype), x)
    rng, errors = np.random.default_rng(0), []
    for name, leaf in x.items():
        along = rng.normal(size=leaf.shape)
        along = jnp.asarray(along / np.linalg.norm(along) * (np.linalg.norm(leaf) or 1.0))
        along = {
            other: along if other == name else jnp.zeros_like(value) for other, value in x.items()
        }
        derivative = named(program(x, along)[1])
        difference, _ = central_differences(
            lambda x, along=along: named(program(x, along)[0]), x, along, step
        )
        for path, expected in difference.items():
            size = max(np.abs(derivative[path]).max(), np.abs(expected).max())
            errors.append(
                np.abs(derivative[path] - expected).max() / (size if size > 1e-9 else 1.0)
            )
    # (of what is no number neither max nor the comparison with a bound would tell)
    return float(np.max(errors)) if np.isfinite(errors).all() else np.inf
