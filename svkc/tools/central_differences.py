"""Central differences of a function of a pytree, extrapolated to step zero."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array


def central_differences(
    value: Callable[[Any], dict[str, Array]], differentiable: Any, direction: Any, step: float
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return central differences extrapolated to step zero, and an estimate of their errors.

    Ridders' method: differences with eight steps, each half of the one before, fill a Neville
    tableau. For every entry, the estimate that differs least from its neighbours in the tableau is
    returned, with that difference as its uncertainty. Both are NaN unless `value` is finite with
    the last two steps.

    value: function of a pytree like `differentiable` that returns arrays by name.
    direction: a pytree like `differentiable`.
    step: first step, as a multiple of the direction.
    """
    evaluate = lambda h: value(
        jax.tree.map(lambda x, d: x + jnp.asarray(h, x.dtype) * d, differentiable, direction)
    )
    table, best, uncertainty = [], {}, {}
    for h in step / 2.0 ** np.arange(8):
        after, before = evaluate(h), evaluate(-h)
        if not all(np.isfinite(x).all() for x in (*after.values(), *before.values())):
            # The function is not defined this far away: restart with smaller steps.
            table, best, uncertainty = [], {}, {}
            continue
        row = [
            {name: (np.asarray(after[name]) - np.asarray(before[name])) / (2 * h) for name in after}
        ]
        for k, coarser in enumerate(table[-1] if table else [], start=1):
            row.append(
                {
                    name: row[-1][name] + (row[-1][name] - coarser[name]) / (4**k - 1)
                    for name in coarser
                }
            )
        for k in range(1, len(row)):
            for name, new in row[k].items():
                change = np.maximum(
                    np.abs(new - row[k - 1][name]), np.abs(new - table[-1][k - 1][name])
                )
                better = change < uncertainty.get(name, np.inf)
                best[name] = np.where(better, new, best.get(name, new))
                uncertainty[name] = np.where(better, change, uncertainty.get(name, change))
        table.append(row)
    undefined = {name: np.full(np.shape(leaf), np.nan) for name, leaf in after.items()}
    return undefined | best, undefined | uncertainty
