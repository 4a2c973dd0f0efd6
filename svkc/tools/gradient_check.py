"""Derivatives checked against central differences."""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from svkc.model.validation import check_function, integer, positive_scalar


class Check(eqx.Module):
    """What `check_grad` found: the worst entry. `error`: its difference, over the largest entry of
    its output leaf in either of the two derivatives.

    `output`, `input`: paths of the two leaves; `derivative`, `difference`: both values, along the
    direction tried; `uncertainty`: what the difference itself is good for, over the same size;
    `modes`: largest difference between forward and reverse mode, over the same size (0 where only
    one was asked).
    """

    error: float
    output: str
    input: str
    derivative: float
    difference: float
    uncertainty: float
    modes: float
    mode: str = eqx.field(static=True, default="both")

    def __str__(self) -> str:
        return (
            f"worst relative error {self.error:.2e} (the difference is good to"
            f" {self.uncertainty:.0e}): d {self.output} / d {self.input} is {self.derivative:.12g}"
            f" by differentiation, {self.difference:.12g} by differences"
            + (f"; forward and reverse differ by {self.modes:.1e}" if self.mode == "both" else "")
        )


def check_grad(
    f: Callable, x, mode: str = "both", directions: int = 2, step: float = 0.05, seed: int = 0
) -> Check:
    """The derivative of f at x against central differences, Richardson-extrapolated (Ridders),
    along random directions; says which entry is worst.

    f: of one argument; x and f(x): any pytrees, of which floats count. For every float leaf of x by
    itself, `directions` random directions, as long as the leaf (one, where it is zero). mode:
    "forward", "reverse", or "both", which compares the two. step: the first step of the
    differences, as a part of the direction; it is halved seven times and the best estimate taken.
    float64, or the differences are worth little.
    ValueError: no floats in x, an unknown mode, or f not finite.
    """
    check_function("f", f, optional=False)
    integer("directions", directions, 1)
    positive_scalar("step", step)
    if mode not in ("forward", "reverse", "both"):
        raise ValueError(f"mode: got {mode!r}, expected 'forward', 'reverse' or 'both'")
    free, rest = eqx.partition(
        jax.tree.map(lambda leaf: jnp.asarray(leaf) if isinstance(leaf, float) else leaf, x),
        eqx.is_inexact_array,
    )
    # (without weak types, which would compile the same program again for every parameter)
    free = jax.tree.map(lambda leaf: jnp.asarray(leaf, leaf.dtype), free)
    named = jax.tree_util.tree_flatten_with_path(free)[0]
    if not any(leaf.size for _, leaf in named):
        raise ValueError("check_grad: x has no floating-point arrays to differentiate by")

    value = lambda free: _outputs(f, free, rest)
    base = {name: np.asarray(leaf) for name, leaf in value(free).items()}
    for name, leaf in base.items():
        if not np.isfinite(leaf).all():
            raise ValueError(f"check_grad: f(x){name} is not finite: {leaf}")
    if not any(leaf.size for leaf in base.values()):
        raise ValueError("check_grad: f(x) has no floating-point arrays to be differentiated")
    rng, found = np.random.default_rng(seed), []
    weights = {name: rng.normal(size=leaf.shape) for name, leaf in base.items()}
    gradients = {} if mode == "forward" else _gradients(f, free, rest, weights)
    for place, (path, leaf) in enumerate(named):
        for _ in range(directions if leaf.size else 0):
            direction = _direction(free, place, rng)
            difference, doubt = _differences(value, free, direction, step)
            forward = None if mode == "reverse" else _along(f, free, rest, direction)
            for name, weight in weights.items():
                back = None if mode == "forward" else _inner(gradients[name], direction)
                ahead = None if forward is None else np.asarray(forward[name])
                pair = f"f(x){name}", f"x{jax.tree_util.keystr(path)}"
                found.append(_check(ahead, back, weight, difference[name], doubt[name], pair))
    worst = max(found, key=lambda c: c.error)
    return dataclasses.replace(worst, modes=max(c.modes for c in found), mode=mode)


def _direction(free, place: int, rng: np.random.Generator):
    """Return a random direction of one leaf, as long as the leaf (one, where it is zero)."""
    leaves, shape = jax.tree.flatten(free)
    leaf, along = leaves[place], rng.normal(size=leaves[place].shape)
    along = along / np.linalg.norm(along) * (np.linalg.norm(leaf) or 1.0)
    rest = [jnp.zeros_like(x) for x in leaves]
    return shape.unflatten([*rest[:place], jnp.asarray(along, leaf.dtype), *rest[place + 1 :]])


def _inner(gradient, direction) -> float:
    """Return the derivative along a direction, from the leaves of a gradient."""
    return sum(
        float(jnp.vdot(g, d)) for g, d in zip(gradient, jax.tree.leaves(direction), strict=True)
    )


def _check(ahead, back: float | None, weight, difference, doubt, pair: tuple[str, str]) -> Check:
    """Compare the derivatives of one output leaf along one direction with the difference.

    ahead: the derivative in forward mode; back: the weighted sum of the derivative's entries in
    reverse mode; None: not asked for.
    """
    if ahead is None:
        # one number for the whole leaf: reverse mode has no more for one pass
        weighed = lambda x: np.asarray(np.sum(weight * x))
        return _compare(np.asarray(back), weighed(difference), weighed(doubt), 0.0, *pair)
    size = np.linalg.norm(weight) * np.linalg.norm(ahead)
    apart = 0.0 if back is None else abs(back - np.sum(weight * ahead))
    return _compare(ahead, difference, doubt, float(apart / (size if size > 1e-9 else 1.0)), *pair)


# (compiled once for a function, however many points it is checked at)
@eqx.filter_jit
def _outputs(f, free, rest):
    """The floats of f(x) by their paths."""
    floats = jax.tree_util.tree_flatten_with_path(
        eqx.filter(f(eqx.combine(free, rest)), eqx.is_inexact_array)
    )[0]
    return {jax.tree_util.keystr(path): leaf for path, leaf in floats}


@eqx.filter_jit
def _along(f, free, rest, direction):
    return jax.jvp(lambda free: _outputs(f, free, rest), (free,), (direction,))[1]


@eqx.filter_jit
def _weighed(f, free, rest, weights):
    return jax.tree.leaves(jax.vjp(lambda free: _outputs(f, free, rest), free)[1](weights)[0])


def _gradients(f, free, rest, weights):
    """For each output leaf, the gradient of its entries summed with random weights."""
    shapes = eqx.filter_eval_shape(_outputs, f, free, rest)
    only = lambda chosen: {
        name: jnp.asarray(w if name == chosen else np.zeros_like(w), shapes[name].dtype)
        for name, w in weights.items()
    }
    return {name: _weighed(f, free, rest, only(name)) for name in weights}


def _differences(value, free, direction, step):
    """Central differences at eight halved steps, extrapolated to zero; for every entry the estimate
    that changed least, and by how much."""
    at = lambda h: value(
        jax.tree.map(lambda x, d: x + jnp.asarray(h, x.dtype) * d, free, direction)
    )
    table, best, change = [], {}, {}
    for h in step / 2.0 ** np.arange(8):
        ahead, behind = at(h), at(-h)
        if not all(np.isfinite(x).all() for x in (*ahead.values(), *behind.values())):
            # so far away f is not defined: begin again, nearer
            table, best, change = [], {}, {}
            continue
        row = [
            {name: (np.asarray(ahead[name]) - np.asarray(behind[name])) / (2 * h) for name in ahead}
        ]
        for k, before in enumerate(table[-1] if table else [], start=1):
            row.append(
                {
                    name: row[-1][name] + (row[-1][name] - before[name]) / (4**k - 1)
                    for name in before
                }
            )
        for k in range(1, len(row)):
            for name, new in row[k].items():
                moved = np.maximum(
                    np.abs(new - row[k - 1][name]), np.abs(new - table[-1][k - 1][name])
                )
                closer = moved < change.get(name, np.inf)
                best[name] = np.where(closer, new, best.get(name, new))
                change[name] = np.where(closer, moved, change.get(name, moved))
        table.append(row)
    # (not finite at every step tried, and so worth nothing)
    nothing = {name: np.full(np.shape(leaf), np.nan) for name, leaf in ahead.items()}
    return nothing | best, nothing | change


def _compare(derivative, difference, doubt, modes: float, output: str, input: str) -> Check:
    """Return the worst entry of one leaf."""
    size = max(
        np.abs(x[np.isfinite(x)]).max(initial=0) for x in map(np.asarray, (derivative, difference))
    )
    # both nothing: what is within the round-off of differences is no error
    size = size if size > 1e-9 else 1.0
    off = np.abs(derivative - difference)
    off = np.where(np.isfinite(off), off, np.inf).ravel()
    modes = modes if np.isfinite(modes) else np.inf
    if not off.size:
        nothing = {"derivative": 0.0, "difference": 0.0, "uncertainty": 0.0}
        return Check(error=0.0, output=output, input=input, **nothing, modes=modes)
    at = int(np.argmax(off))
    pick = lambda x: float(np.ravel(x)[at])
    return Check(
        error=float(off[at] / size),
        output=f"{output}[{at}]" if off.size > 1 else output,
        input=input,
        derivative=pick(derivative),
        difference=pick(difference),
        uncertainty=pick(doubt) / float(size),
        modes=modes,
    )
