"""How far two evaluations of one function may differ by round-off alone.

The difference is relative to the largest entry of each output. The bound is

    CONFIDENCE * sqrt(roundings) * condition * (u + u of the reference)

roundings: the longest path of dependent roundings. Rounding errors of either sign add up like the
    square root of their number (Higham and Mary, A new approach to probabilistic rounding error
    analysis, SIAM J. Sci. Comput. 2019): the probability of a larger error is at most
    2 exp(-CONFIDENCE^2 / 2) for each entry.
condition: the change of the outputs per relative change of all inputs, by random perturbations.
u: half the distance from 1 to the next number of the precision.
"""

import math
import re
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

CONFIDENCE = 5.0
# relative perturbation, and how many random ones
PERTURBATION, SAMPLES = 1e-8, 3
ROUNDED = set(
    "add atan2 cbrt cosine divide exponential exponential_minus_one log log_plus_one logistic"
    " multiply power rsqrt sine sqrt subtract tan tanh".split()
)


def relative_difference(outputs, reference) -> float:
    """Return the largest difference, relative to the largest entry of the same output.

    outputs, reference: pytrees of arrays. A result that is not finite differs by infinity.
    """
    largest = 0.0
    pairs = zip(jax.tree.leaves(outputs), jax.tree.leaves(reference), strict=True)
    for x, y in ((np.asarray(a, float), np.asarray(b, float)) for a, b in pairs):
        difference = float(np.max(np.abs(x - y)) / np.max(np.abs(y)))
        largest = max(largest, difference if math.isfinite(difference) else math.inf)
    return largest


def count_roundings(function: Callable, inputs) -> int:
    """Return the number of roundings on the longest path of dependent operations of a program.

    A sum of n terms counts n, the most that any order of summation needs.
    Raises ValueError for a loop, whose number of turns is not known, and for a library's call.
    """
    module = jax.jit(function).lower(inputs).compiler_ir("stablehlo")
    assert module is not None
    functions = {f.name.value: f for f in module.body.operations}
    main = functions["main"].regions[0].blocks[0]
    return max(_depths_of_results(main, [0] * len(main.arguments), functions))


def _depths_of_results(block, depths: list[int], functions: dict) -> list[int]:
    """Return the roundings before each result of a block, from those before each argument."""
    depth_of = dict(zip(block.arguments, depths, strict=True))
    for op in block.operations:
        before, name = [depth_of[v] for v in op.operands], op.operation.name
        if name == "func.return":
            return before
        if name == "func.call":
            callee = functions[op.attributes["callee"].value].regions[0].blocks[0]
            depths = _depths_of_results(callee, before, functions)
        else:
            depths = [max(before, default=0) + _roundings_of(op, name)] * len(op.results)
        depth_of |= zip(op.results, depths, strict=True)
    raise ValueError("count_roundings: a block without a return")


def _roundings_of(op, name: str) -> int:
    """Return the roundings on the longest path through one operation."""
    kind = name.split(".")[-1]
    if kind in ("while", "case", "custom_call"):
        raise ValueError(f"count_roundings: the roundings of {name} are not known")
    if not re.search(r"x?f(32|64)>", str(op.results[0].type)):
        return 0
    if kind == "reduce":
        return math.prod(op.operands[0].type.shape[i] for i in op.attributes["dimensions"])
    if kind == "dot_general":
        contracted = str(op.attributes["dot_dimension_numbers"]).split("lhs_contracting")[1]
        axes = map(int, re.findall(r"\d+", contracted[: contracted.index("]")]))
        return math.prod(op.operands[0].type.shape[i] for i in axes)
    return int(kind in ROUNDED or name.startswith("chlo."))


def condition(function: Callable, inputs) -> float:
    """Return the relative change of the outputs per relative change of all inputs.

    The largest of `SAMPLES` random perturbations. Each entry changes in proportion to the largest
    entry of its array.

    function: of one pytree, in float64.
    """
    reference, largest = function(inputs), 0.0
    for sample in range(SAMPLES):
        random = np.random.default_rng(sample)
        perturbed = jax.tree.map(lambda x, random=random: _perturb(x, random), inputs)
        largest = max(largest, relative_difference(function(perturbed), reference))
    return largest / PERTURBATION


def _perturb(x, random):
    if not jnp.issubdtype(jnp.result_type(x), jnp.floating):
        return x
    x = np.asarray(x)
    finite = np.isfinite(x)
    size = PERTURBATION * np.max(np.abs(x), where=finite, initial=0.0)
    return jnp.asarray(np.where(finite, x + size * random.choice([-1.0, 1.0], x.shape), x))


def bound(dtype: str, roundings: int, conditioning: float) -> float:
    """Return the relative difference from a float64 reference that round-off may cause.

    dtype: precision of the outputs that are compared. conditioning: as from `condition`.
    """
    unit = (np.finfo(dtype).eps + np.finfo("float64").eps) / 2
    return CONFIDENCE * math.sqrt(roundings) * conditioning * float(unit)
