"""The margin of the loop Jacobian: |R_mm| / |R_11| of the column-pivoted QR."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from tolerances import ROUND_OFF

from svkc.loops.loop_force_projection import margin_of_rows
from svkc.loops.pivoting import pivot_ratio, pivoted_qr


@pytest.mark.parametrize(("rows", "rank", "dofs"), [(6, 4, 4), (6, 5, 10), (12, 7, 24)])
def test_margin_against_lapack(rows, rank, dofs):
    """Both ways agree with LAPACK's pivoted QR where all |R_kk| exceed one."""
    rng = np.random.default_rng(0)
    J = rng.normal(size=(rows, rank)) @ rng.normal(size=(rank, dofs))
    R = np.abs(np.diag(scipy.linalg.qr(J, pivoting=True, mode="r")[0]))
    margin = R[rank - 1] / R[0]
    by_qr = pivot_ratio(pivoted_qr(jnp.asarray(J), jnp.asarray(rank)))
    by_columns = margin_of_rows(jnp.asarray(J), jnp.asarray(rank), None)
    np.testing.assert_allclose([by_qr, by_columns], margin, rtol=ROUND_OFF)


def test_independent_columns_are_pivots_last():
    """Both ways choose the same pivots where some coordinates shall be independent."""
    rng = np.random.default_rng(1)
    J, rank = jnp.asarray(rng.normal(size=(6, 10))), jnp.asarray(6)
    independent = jnp.arange(10) < 3
    by_qr = pivot_ratio(pivoted_qr(J, rank, independent))
    by_columns = margin_of_rows(J, rank, independent)
    np.testing.assert_allclose(by_columns, by_qr, rtol=ROUND_OFF)
    assert abs(float(by_columns) - float(margin_of_rows(J, rank, None))) > 1e-3


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_independent_columns_complete_the_rank(dtype):
    """Where the other columns have a lower rank, columns that shall be independent are pivots, and
    not the round-off that the others leave."""
    rng = np.random.default_rng(2)
    independent, eps = jnp.arange(10) < 3, np.finfo(dtype).eps
    for _ in range(20):
        others = rng.normal(size=(6, 4)) @ rng.normal(size=(4, 7))
        J = np.concatenate([rng.normal(size=(6, 3)), others], 1).astype(dtype)
        margin = float(margin_of_rows(jnp.asarray(J), jnp.asarray(6), independent))
        expected = float(pivot_ratio(pivoted_qr(jnp.asarray(J), jnp.asarray(6), independent)))
        assert expected > 1e3 * eps
        np.testing.assert_allclose(margin, expected, rtol=1e4 * eps)


def test_margin_without_loops():
    """Without rows of loops the margin is one."""
    zero = jnp.zeros((6, 4))
    assert float(margin_of_rows(zero, jnp.asarray(0), None)) == 1
    assert float(pivot_ratio(pivoted_qr(zero, jnp.asarray(0)))) == 1
