"""Derivatives by automatic differentiation, compared with extrapolated central differences."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from svkc.model.validation import check_function, integer, positive_scalar
from svkc.tools.central_differences import central_differences

# Most numbers of a direction, or of weights, that are written out in the text of a check.
WRITTEN_OUT = 6


class GradientCheck(eqx.Module):
    """The result of `check_grad`: the entry of the derivative with the largest error.

    The derivative is that of f(x + h direction) by h, where the direction is added to one leaf.

    error: |derivative - difference|, relative to the largest entry of either one over the output
        leaf; absolute if this is below 1e-9, where differences may be round-off.
    output: path of the output leaf (and entry), such as "f(x)['a'][3]"; of several entries
        "sum(w * f(x)['a'])" in "reverse", which has one derivative for all of them.
    input: path of the input leaf, such as "x.q".
    derivative: of the output along the direction, by differentiation.
    difference: of the output along the direction, by central differences.
    uncertainty: estimated error of the difference, relative to the same number as `error`.
    modes: largest difference between forward and reverse mode in the derivative of a random
        weighted sum of each output leaf, relative to the norm of the weights times that of the
        leaf's derivative. Zero unless `mode` is "both".
    direction: unit direction in the input leaf [shape of the leaf]; 1 for a single number.
    mode: the mode that was checked: "forward", "reverse" or "both".
    weights: the unit vector w of the sum [shape of the output leaf]; None: the output is one entry.
    """

    error: float
    output: str
    input: str
    derivative: float
    difference: float
    uncertainty: float
    modes: float
    direction: Any
    mode: str = eqx.field(static=True, default="both")
    weights: Any = None

    def __str__(self) -> str:
        weights = along = ""
        if self.weights is not None:
            weights = f" (w = {_written(self.weights, 'check.weights')})"
        if np.size(self.direction) > 1:
            along = f" along the unit direction {_written(self.direction, 'check.direction')}"
        return (
            f"worst relative error {self.error:.2e} (the difference is good to"
            f" {self.uncertainty:.0e}): d {self.output}{weights} / d {self.input}{along} is"
            f" {self.derivative:.12g} by differentiation, {self.difference:.12g} by differences"
            + (f"; forward and reverse differ by {self.modes:.1e}" if self.mode == "both" else "")
        )


def _written(numbers: np.ndarray, name: str) -> str:
    """Return a few numbers as text with four digits, or the name of many numbers."""
    if numbers.size > WRITTEN_OUT:
        return name
    return f"[{', '.join(f'{x:.4g}' for x in np.ravel(numbers))}]"


def check_grad(
    f: Callable, x: Any, mode: str = "both", directions: int = 2, step: float = 0.05, seed: int = 0
) -> GradientCheck:
    """Compare the derivative of f at x with central differences and return the worst entry.

    For every floating-point leaf of x, the derivative is taken along random unit directions; along
    1 if the leaf is a single number. In mode "reverse" an output leaf of several entries is
    replaced by its sum with random weights, a unit vector. Differences are extrapolated to step
    zero by Ridders' method. Use float64: in float32 the differences have few correct digits.

    f: function of one argument.
    x: a pytree. Floating-point leaves of x and of f(x) are differentiated, others are ignored.
    mode: "forward", "reverse", or "both", which also compares the two modes with each other.
    directions: number of random directions for each leaf.
    step: first step of the differences, as a multiple of the leaf's 2-norm (of 1 if the leaf is
        zero). It is halved seven times.
    seed: seed of the random directions and weights.

    Raises ValueError if x or f(x) has no floating-point arrays, if f(x) is not finite, or if an
    option is invalid.
    """
    check_function("f", f, "x")
    integer("directions", directions, 1)
    positive_scalar("step", step)
    if mode not in ("forward", "reverse", "both"):
        raise ValueError(f"mode: got {mode!r}, expected 'forward', 'reverse' or 'both'")
    differentiable, static = _partition(x)
    value = lambda free: _outputs(f, free, static)
    base = _finite_outputs(value(differentiable))
    rng, checks = np.random.default_rng(seed), []
    weights = {name: _unit(rng, leaf.shape) for name, leaf in base.items()}
    gradients = {} if mode == "forward" else _reverse_gradients(f, differentiable, static, weights)
    leaves = jax.tree_util.tree_flatten_with_path(differentiable)[0]
    for index, (path, leaf) in enumerate(leaves):
        for _ in range(directions if leaf.size else 0):
            direction, forward = _direction(differentiable, index, rng), None
            difference, uncertainty = central_differences(value, differentiable, direction, step)
            if mode != "reverse":
                forward = _forward_derivative(f, differentiable, static, direction)
            for name, weight in weights.items():
                derivatives = (
                    None if forward is None else np.asarray(forward[name]),
                    _directional_derivative(gradients[name], direction) if gradients else None,
                )
                paths = f"f(x){name}", f"x{jax.tree_util.keystr(path)}"
                estimate = difference[name], uncertainty[name]
                check = _compare_leaf(*derivatives, weight, *estimate, paths)
                checks.append(_per_unit_length(check, jax.tree.leaves(direction)[index]))
    worst = max(checks, key=lambda c: c.error)
    return dataclasses.replace(worst, modes=max(c.modes for c in checks), mode=mode)


def _unit(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Return a random array of 2-norm 1; for a single number 1, so that no sign changes."""
    x = rng.normal(size=shape)
    return np.ones(shape) if x.size == 1 else x / (np.linalg.norm(x) or 1.0)


def _per_unit_length(check: GradientCheck, direction) -> GradientCheck:
    """Return the check with derivatives along a direction divided by the length of the direction,
    and with the unit direction."""
    length = float(np.linalg.norm(direction))
    return dataclasses.replace(
        check,
        derivative=check.derivative / length,
        difference=check.difference / length,
        direction=np.asarray(direction) / length,
    )


def _partition(x):
    """Return x as (floating-point arrays, the rest). Raise ValueError if x has no such arrays."""
    differentiable, static = eqx.partition(
        jax.tree.map(lambda leaf: jnp.asarray(leaf) if isinstance(leaf, float) else leaf, x),
        eqx.is_inexact_array,
    )
    # Weakly typed numbers would compile the program once more.
    differentiable = jax.tree.map(lambda leaf: jnp.asarray(leaf, leaf.dtype), differentiable)
    if not any(leaf.size for leaf in jax.tree.leaves(differentiable)):
        raise ValueError("check_grad: x has no floating-point arrays to differentiate by")
    return differentiable, static


def _finite_outputs(outputs) -> dict[str, np.ndarray]:
    """Return the leaves as numpy arrays. Raise ValueError if all are empty or one is not finite."""
    base = {name: np.asarray(leaf) for name, leaf in outputs.items()}
    for name, leaf in base.items():
        if not np.isfinite(leaf).all():
            raise ValueError(f"check_grad: f(x){name} is not finite: {leaf}")
    if not any(leaf.size for leaf in base.values()):
        raise ValueError("check_grad: f(x) has no floating-point arrays to be differentiated")
    return base


def _direction(differentiable, index: int, rng: np.random.Generator):
    """Return a random direction in one leaf, with the 2-norm of this leaf (1 if that is zero)."""
    leaves, structure = jax.tree.flatten(differentiable)
    leaf = leaves[index]
    along = _unit(rng, leaf.shape) * (np.linalg.norm(leaf) or 1.0)
    zeros = [jnp.zeros_like(x) for x in leaves]
    return structure.unflatten(
        [*zeros[:index], jnp.asarray(along, leaf.dtype), *zeros[index + 1 :]]
    )


def _directional_derivative(gradient, direction) -> float:
    """Return the inner product of a gradient (a list of leaves) and a direction."""
    return sum(
        float(jnp.vdot(g, d)) for g, d in zip(gradient, jax.tree.leaves(direction), strict=True)
    )


def _compare_leaf(
    forward, reverse: float | None, weight, difference, uncertainty, paths: tuple[str, str]
) -> GradientCheck:
    """Compare the derivatives of one output leaf along one direction with the difference.

    forward: the leaf's derivative in forward mode, or None.
    reverse: sum of the derivative's entries times `weight`, in reverse mode, or None.
    paths: of the output leaf and of the input leaf.
    """
    if forward is None:
        # One pass of reverse mode gives one number for all entries of the leaf.
        weighted_sum = lambda x: np.asarray(np.sum(weight * x))
        sums = np.asarray(reverse), weighted_sum(difference), weighted_sum(uncertainty)
        if weight.size == 1:
            return _worst_entry(*sums, 0.0, *paths)
        check = _worst_entry(*sums, 0.0, f"sum(w * {paths[0]})", paths[1])
        return dataclasses.replace(check, weights=weight)
    scale = np.linalg.norm(weight) * np.linalg.norm(forward)
    mode_difference = 0.0 if reverse is None else abs(reverse - np.sum(weight * forward))
    return _worst_entry(
        forward,
        difference,
        uncertainty,
        float(mode_difference / (scale if scale > 1e-9 else 1.0)),
        *paths,
    )


# Compiled once for each function, however many points it is checked at.
@eqx.filter_jit
def _outputs(f, differentiable, static):
    """Return the floating-point leaves of f(x), by path."""
    floats = jax.tree_util.tree_flatten_with_path(
        eqx.filter(f(eqx.combine(differentiable, static)), eqx.is_inexact_array)
    )[0]
    return {jax.tree_util.keystr(path): leaf for path, leaf in floats}


@eqx.filter_jit
def _forward_derivative(f, differentiable, static, direction):
    """Return the directional derivative of `_outputs` in forward mode."""
    return jax.jvp(lambda free: _outputs(f, free, static), (differentiable,), (direction,))[1]


@eqx.filter_jit
def _weighted_gradient(f, differentiable, static, weights):
    """Return the gradient of the weighted sum of `_outputs`, as a list of leaves."""
    return jax.tree.leaves(
        jax.vjp(lambda free: _outputs(f, free, static), differentiable)[1](weights)[0]
    )


def _reverse_gradients(f, differentiable, static, weights):
    """Return, for each output leaf, the gradient of the weighted sum of its entries."""
    shapes = eqx.filter_eval_shape(_outputs, f, differentiable, static)
    weights_of = lambda output: {
        name: jnp.asarray(w if name == output else np.zeros_like(w), shapes[name].dtype)
        for name, w in weights.items()
    }
    return {
        name: _weighted_gradient(f, differentiable, static, weights_of(name)) for name in weights
    }


def _worst_entry(
    derivative, difference, uncertainty, modes: float, output: str, input: str
) -> GradientCheck:
    """Return the entry of one leaf whose derivative differs most from the difference."""
    scale = max(
        np.abs(x[np.isfinite(x)]).max(initial=0) for x in map(np.asarray, (derivative, difference))
    )
    # Where both are about zero, round-off of the differences is not an error.
    scale = scale if scale > 1e-9 else 1.0
    errors = np.abs(derivative - difference)
    errors = np.where(np.isfinite(errors), errors, np.inf).ravel()
    modes = modes if np.isfinite(modes) else np.inf
    if not errors.size:
        return GradientCheck(
            error=0.0,
            output=output,
            input=input,
            derivative=0.0,
            difference=0.0,
            uncertainty=0.0,
            modes=modes,
            direction=None,
        )
    worst = int(np.argmax(errors))
    entry = lambda x: float(np.ravel(x)[worst])
    return GradientCheck(
        error=float(errors[worst] / scale),
        output=f"{output}[{worst}]" if errors.size > 1 else output,
        input=input,
        derivative=entry(derivative),
        difference=entry(difference),
        uncertainty=entry(uncertainty) / float(scale),
        modes=modes,
        direction=None,
    )
