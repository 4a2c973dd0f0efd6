"""On which variables of a stage the user's functions depend, and which derivatives can be nonzero.

The functions are evaluated with large changes of each variable. Derivatives at random points would
not do: those of max(0, q - 3) are zero at most points.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from svkc._jax.eager import eager_jit
from svkc.optimize.blocks import StageBlock
from svkc.optimize.lift import Layout, StagePolynomials, dependencies

# changes of a variable, as multiples of its mean size at the samples; the first is the unit
_CHANGES = np.array([1.0, -1.0, 1e-3, -1e-3, 100.0, -100.0])
# differences below this fraction of the values are taken for round-off
_ROUND_OFF = 1e-9


class Dependence(NamedTuple):
    """How the rows of a stage depend on its variables.

    reads: mask [rows y] of the variables on which a row depends.
    nonlinear: mask [rows y] of the variables in which a row is not linear.
    """

    reads: np.ndarray
    nonlinear: np.ndarray


def find_dependence(block: StageBlock, params: Any, samples: np.ndarray) -> Dependence | None:
    """Return how the function of a block depends on its variables; None if a row is never finite.

    The variables are changed one at a time at random points, by small and by large amounts. A row
    is linear in a variable if its change is proportional to that of the variable, and independent
    of the other variables.

    samples: values [samples lanes n] of local unknowns at these points. One lane is evaluated.
    """

    @eager_jit
    def evaluate(params, data, z, offsets):
        def of_stage(f, lift):
            y = lift.variables()
            return y, jax.vmap(lambda offset: f(y + offset))(offsets)

        return block.over_stages(of_stage, params, data, z)

    data, n = jax.tree.map(lambda x: jnp.asarray(x[:1]), block.data), block.layout.stage_size
    values = lambda z, offsets: evaluate(params, data, z[:1], offsets)
    none = np.zeros((1 + len(_CHANGES) * n, n))
    size = np.mean([np.abs(values(z, none)[0]) for z in samples], (0, 1, 2))
    size = np.where(size > 0, size, 1.0)
    change = none.copy()
    change[1:] = (_CHANGES[:, None, None] * np.diag(size)).reshape(-1, n)
    others = size * np.random.default_rng(0).normal(size=n)
    stages = []
    for z in samples:
        pairs = (np.asarray(values(z, change + at)[1])[0] for at in (0 * others, others))
        stages += zip(*pairs, strict=True)
    if not np.any([np.isfinite(f[0]) for f, _ in stages], 0).all():
        return None
    masks = [_compare(f, g, n) for f, g in stages]
    return Dependence(*(np.any(x, 0).T for x in zip(*masks)))


def _compare(f: np.ndarray, g: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the masks [y rows] of the read and of the nonlinear variables.

    Rows that are not finite without a change are left out.

    f, g: rows without a change, then with each change of each variable. Of g, the other variables
        have other values. n: number of variables.
    """

    def changes(rows):
        base, changed = rows[0], rows[1:].reshape(len(_CHANGES), n, -1)
        return changed - base, _ROUND_OFF * (np.abs(changed) + np.abs(base)), np.isfinite(base)

    with np.errstate(invalid="ignore"):
        (d, round_off, valid), (d_other, round_off_other, valid_other) = changes(f), changes(g)
        factor = _CHANGES[:, None, None]
        same = np.abs(d - d_other) <= round_off + round_off_other
        proportional = np.abs(d - factor * d[0]) <= round_off + np.abs(factor) * round_off[0]
        linear = proportional & (same | ~valid_other)
    return ((d != 0) & valid).any(0), (~linear & valid).any(0)


def entry_masks(block: StageBlock, dependence: Dependence) -> tuple[np.ndarray, np.ndarray]:
    """Return which entries of a block's `jacobian_pattern` and `hessian_pattern` can be nonzero.

    dependence: of the block, whose `variables` are those that are not linear.
    """
    layout, selected = block.layout, block.variables
    reads, nonlinear = dependence.reads, dependence.nonlinear[:, selected]
    stages = [
        jax.tree.map(lambda x, k=k: np.asarray(x)[k], block.poly) for k in range(len(block.poly.c))
    ]
    first = [_lift_masks(layout, poly) for poly in stages]
    jacobian = np.stack([reads @ by_z for by_z, _ in first]).ravel()
    by_duration = np.any([reads.any(0) @ second for _, second in first], 0)
    if not len(selected):
        return jacobian, by_duration
    columns, pairs = dependencies(layout, selected), nonlinear.T @ nonlinear
    some = [by_z[selected][:, columns] for by_z, _ in first]
    both = np.any([x.T @ pairs @ x for x in some], 0)
    return jacobian, np.concatenate([by_duration, both[np.tril_indices(len(columns))]])


def _lift_masks(layout: Layout, poly: StagePolynomials) -> tuple[np.ndarray, np.ndarray]:
    """Return the masks [y z] of the nonzero entries of dy/dz, and of its derivative by T.

    poly: of one stage.
    """
    y, z = np.arange(layout.stage_size), np.arange(layout.interval_size)
    (t, duration), motion, control, forces = layout.split_stage(y)
    (_, T), x, w, f = layout.split_interval(z)
    first, second = np.zeros((2, len(y), len(z)), bool)
    first[t, :2] = first[duration, T] = True
    first[forces, f] = (np.asarray(poly.slot) != 0)[:, None]
    C0, C1, C2, D0, D1 = (np.asarray(x) != 0 for x in (poly.C0, poly.C1, poly.C2, poly.D0, poly.D1))
    for at, unknowns, once, twice, constant in (
        (motion, x, C1 | C2, C2, C0),
        (control, w, D1, np.zeros_like(D1), D0),
    ):
        pairs = at[:, None], unknowns[None]
        first[pairs], second[pairs] = (constant | once)[:, :, None], once[:, :, None]
        first[at, T], second[at, T] = once.any(1)[:, None], twice.any(1)[:, None]
    return first, second
