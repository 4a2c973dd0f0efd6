"""Which derivatives of a block of user functions can be nonzero."""

import jax
import numpy as np

from svkc.optimize.blocks import StageBlock
from svkc.optimize.lift import Layout, StagePolynomials, dependencies


def entry_masks(block: StageBlock, nonlinear: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return masks of entries of a block's `jacobian_pattern` and `hessian_pattern`.

    They are the entries by variables in which the rows are not linear. The rows' derivatives by the
    other variables are constant, so their values at any point show whether they are zero.

    nonlinear: mask [rows y] of the variables in which a row of a stage is not linear. Those of any
        row are `block.variables`.
    """
    layout, selected = block.layout, block.variables
    own = nonlinear[:, selected].astype(int)
    stages = range(len(block.poly.c))
    polys = [jax.tree.map(lambda x, k=k: np.asarray(x)[k], block.poly) for k in stages]
    lifts = [_lift_masks(layout, poly) for poly in polys]
    jacobian = np.stack([nonlinear @ by_z for by_z, _ in lifts]).ravel()
    by_duration = np.any([nonlinear.any(0) @ by_T for _, by_T in lifts], 0)
    if not len(selected):
        return jacobian, by_duration
    columns, pairs = dependencies(layout, selected), own.T @ own > 0
    some = [by_z[selected][:, columns] for by_z, _ in lifts]
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
