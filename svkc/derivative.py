"""F7: derivatives as users meet them: checked against differences, and in the tangent of the configuration."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc.chain import Chain
from svkc.kinematics import integrate


class Check(eqx.Module):
    """What `check_grad` found: the worst entry. `error`: its difference, over the largest entry of its output leaf in either of the two derivatives.

    `output`, `input`: paths of the two leaves; `derivative`, `difference`: both values, along the direction tried; `uncertainty`: what the difference
    itself is good for, over the same size; `modes`: largest difference between forward and reverse mode, over the same size (0 where only one was asked).
    """

    error: float
    output: str
    input: str
    derivative: float
    difference: float
    uncertainty: float
    modes: float

    def __str__(self) -> str:
        return (
            f"worst relative error {self.error:.2e} (the difference is good to {self.uncertainty:.0e}): d{self.output} / d{self.input} is {self.derivative:.12g} "
            f"by differentiation, {self.difference:.12g} by differences; forward and reverse differ by {self.modes:.1e}"
        )


def check_grad(f: Callable, x, mode: str = "both", directions: int = 2, step: float = 1e-2, seed: int = 0) -> Check:
    """The derivative of f at x against central differences, Richardson-extrapolated (Ridders), along random directions; says which entry is worst.

    f: of one argument; x and f(x): any pytrees, of which floats count. For every float leaf of x by itself, `directions` random directions, as long as
    the leaf (one, where it is zero). mode: "forward", "reverse", or "both", which compares the two. step: the first step of the differences, as
    a part of the direction; it is halved seven times and the best estimate taken. float64, or the differences are worth little.
    ValueError: no floats in x, an unknown mode, or f not finite.
    """
    if mode not in ("forward", "reverse", "both"):
        raise ValueError(f"mode: got {mode!r}, expected 'forward', 'reverse' or 'both'")
    free, rest = eqx.partition(jax.tree.map(lambda leaf: jnp.asarray(leaf) if isinstance(leaf, float) else leaf, x), eqx.is_inexact_array)
    named = jax.tree_util.tree_flatten_with_path(free)[0]
    if not named:
        raise ValueError("check_grad: x has no floating-point arrays to differentiate by")

    def outputs(free):
        floats = jax.tree_util.tree_flatten_with_path(eqx.filter(f(eqx.combine(free, rest)), eqx.is_inexact_array))[0]
        return {jax.tree_util.keystr(path): leaf for path, leaf in floats}

    value = jax.jit(outputs)
    base = {name: np.asarray(leaf) for name, leaf in value(free).items()}
    for name, leaf in base.items():
        if not np.isfinite(leaf).all():
            raise ValueError(f"check_grad: f(x){name} is not finite: {leaf}")
    tangents = _by_mode(outputs, free, mode)
    rng, worst = np.random.default_rng(seed), None
    for place, (path, leaf) in enumerate(named):
        for _ in range(directions):
            along = rng.normal(size=leaf.shape)
            along = jnp.asarray(along / np.linalg.norm(along) * (np.linalg.norm(leaf) or 1.0), leaf.dtype) if leaf.size else leaf
            direction = [along if i == place else jnp.zeros_like(other) for i, (_, other) in enumerate(named)]
            direction = jax.tree.unflatten(jax.tree.structure(free), direction)
            difference, doubt = _differences(value, free, direction, step)
            derivative, modes = tangents(direction)
            for name in base:
                found = _compare(derivative[name], difference[name], doubt[name], modes[name], name, f"x{jax.tree_util.keystr(path)}")
                if worst is None or not found.error <= worst.error:
                    worst = eqx.tree_at(lambda c: c.modes, found, max(found.modes, worst.modes if worst else 0.0))
                else:
                    worst = eqx.tree_at(lambda c: c.modes, worst, max(found.modes, worst.modes))
    return worst


def _by_mode(outputs, free, mode):
    """Direction -> the derivative of every output along it, and how much the two modes differ (zeros where one alone is asked)."""
    forward = jax.jit(lambda d: jax.jvp(outputs, (free,), (d,))[1])
    backward = jax.jit(lambda: jax.jacrev(outputs)(free))
    rows = None if mode == "forward" else backward()

    def reverse(direction):
        def along(jacobian, size):
            terms = zip(jax.tree.leaves(jacobian), jax.tree.leaves(direction), strict=True)
            return sum(np.asarray(j).reshape(size, -1) @ np.asarray(d).reshape(-1) for j, d in terms)

        shapes = jax.eval_shape(outputs, free)
        return {name: along(rows[name], s.size).reshape(s.shape) for name, s in shapes.items()}

    def tangents(direction):
        if mode == "reverse":
            back = reverse(direction)
            return back, {name: np.zeros_like(x) for name, x in back.items()}
        ahead = {name: np.asarray(x) for name, x in forward(direction).items()}
        back = reverse(direction) if mode == "both" else ahead
        return ahead, {name: back[name] - x for name, x in ahead.items()}

    return tangents


def _differences(value, free, direction, step):
    """Central differences at eight halved steps, extrapolated to zero; for every entry the estimate that changed least, and by how much."""
    table, best = [], None
    for i in range(8):
        h = step / 2**i
        moved = [value(jax.tree.map(lambda x, d: x + jnp.asarray(s * h, x.dtype) * d, free, direction)) for s in (1, -1)]
        row = [{name: (np.asarray(moved[0][name]) - np.asarray(moved[1][name])) / (2 * h) for name in moved[0]}]
        for k, before in enumerate(table[-1] if table else [], start=1):
            row.append({name: row[-1][name] + (row[-1][name] - before[name]) / (4**k - 1) for name in before})
        if table:
            for better, worse in zip(row[1:], row[:-1], strict=True):
                change = {name: np.maximum(np.abs(better[name] - worse[name]), np.abs(better[name] - table[-1][-1][name])) for name in better}
                if best is None:
                    best = better, change
                closer = {name: change[name] < best[1][name] for name in better}
                pick = lambda new, old: {name: np.where(closer[name], new[name], old[name]) for name in old}
                best = pick(better, best[0]), pick(change, best[1])
        table.append(row)
    return best


def _compare(derivative, difference, doubt, modes, output, input) -> Check:
    size = max(np.abs(derivative).max(initial=0), np.abs(difference).max(initial=0))
    # both nothing: an error within the round-off of differences is none
    size = size if size > 1e-9 or not np.isfinite(size) else 1.0
    off = np.abs(derivative - difference)
    off = np.where(np.isfinite(off), off, np.inf).ravel()
    if not off.size:
        return Check(0.0, output, input, 0.0, 0.0, 0.0, 0.0)
    at = int(np.argmax(off))
    entry = f"{output}[{at}]" if off.size > 1 else output
    pick = lambda x: float(np.asarray(x).ravel()[at])
    return Check(float(off[at] / size), entry, input, pick(derivative), pick(difference), pick(doubt) / size, float(np.abs(modes).max() / size))


def tangent(chain: Chain, q: Float[Array, " q"], gradient: Float[Array, " q"]) -> Float[Array, " dofs"]:
    """A gradient by q as one in the tangent of the configuration: of f(integrate(chain, q, dv)) by dv at dv = 0.

    What an optimiser should step along: q <- integrate(chain, q, -rate * tangent(chain, q, gradient)) keeps quaternions at unit length.
    """
    return jax.vjp(lambda dv: integrate(chain, q, dv), jnp.zeros(chain.dofs, q.dtype))[1](gradient)[0]
