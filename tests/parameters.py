"""Parameters and outputs of the derivative tests, and the error of derivatives.

Parameters are floats of a chain and of a state, by name. Outputs are the numbers of a run.
"""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import svkc
from svkc.tools.central_differences import central_differences

TIGHT = {"rtol": 1e-11, "atol": 1e-13, "solver": diffrax.Dopri8()}
FLOATS = "mass com inertia pos quat axis anchor gravity armature damping stiffness q_spring".split()


def model_floats(chain, *names):
    """Return floats of the chain by name.

    names: fields of the chain, or "grip" for the links' positions in their real links.
    """
    return {
        name: chain.structure.real_pos if name == "grip" else getattr(chain, name) for name in names
    }


def with_model_floats(chain, x):
    """Return the chain with its floats replaced by those in x."""
    for name in FLOATS:
        if name in x:
            chain = eqx.tree_at(lambda c, name=name: getattr(c, name), chain, x[name])
    if "mass_factors" in x:
        # one factor for mass and inertia keeps the inertia physical
        scaled = (chain.mass * x["mass_factors"], chain.inertia * x["mass_factors"][:, None, None])
        chain = eqx.tree_at(lambda c: (c.mass, c.inertia), chain, scaled)
    return chain


def mass_factors(chain):
    """Return the parameter that scales mass and inertia of each body, with factors of one."""
    return {"mass_factors": jnp.ones(len(chain.mass))}


def with_state_floats(state, x):
    """Return the state with its floats replaced by those in x."""
    s = state.structure
    if "grip" in x:
        s = eqx.tree_at(lambda s: s.real_pos, s, x["grip"])
    return svkc.State(x.get("q", state.q), x.get("v", state.v), s)


def run_outputs(traj):
    """Return the numbers of a run by name. Times and impacts of unused rows are zero."""
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


def worst_relative_error(program, x, step=0.05) -> float:
    """Return the largest relative error of derivatives against central differences.

    Derivatives are taken along a random direction of each parameter. If a number is not finite, the
    error is infinite. One program returns values and derivatives; `svkc.check_grad` would compile
    two.

    program: function (x, along) that returns values at x and their derivatives along a direction.
    step: first step of the extrapolated differences.
    """
    named = lambda tree: {
        jax.tree_util.keystr(path): np.asarray(leaf)
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree)
    }
    # weak types would compile the program again for every parameter
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
    # infinite instead of NaN, so that the comparison with a bound fails
    return float(np.max(errors)) if np.isfinite(errors).all() else np.inf
