"""The quintic spline through points: its derivatives at the points, themselves differentiable.

Of all curves through the points with its first and second derivatives at both ends, it has the
least integral of the squared third derivative. Its derivatives are continuous up to the fourth.
The integral is a quadratic function of the first and second derivatives at the points, with a
positive definite block tridiagonal matrix.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc._jax.batched_lapack import solve_general
from svkc.tree.spatial import inverse_positive

# number of points at each end through which a polynomial gives the derivatives there
_END_POINTS = 6


def _unit_energy() -> np.ndarray:
    """Return the matrix [6 6] of the integral of f'''^2 over 0 to 1.

    It belongs to the quintic f with given f, f', f'' at 0, then at 1.
    """
    powers = np.arange(6)
    # values and derivatives of t^k at 0 and at 1, as rows
    falling = np.array([powers**0, powers, powers * (powers - 1)])
    at_zero = np.where(powers[None] == np.arange(3)[:, None], falling, 0)
    coefficients = np.linalg.inv(np.concatenate([at_zero, falling]))
    third = powers * (powers - 1) * (powers - 2)
    exponent = np.maximum(powers[:, None] + powers[None] - 5, 1)
    gram = third[:, None] * third[None] / exponent
    return coefficients.T @ gram @ coefficients


_ENERGY = _unit_energy()


def _end_derivatives(
    t: Float[Array, " points"], y: Float[Array, "points n"]
) -> Float[Array, "2 n"]:
    """Return the first and the second derivative at t[0] of the polynomial through the points."""
    span = t[-1] - t[0]
    x = (t - t[0]) / span
    coefficients = solve_general(jnp.stack([x**k for k in range(len(x))], 1), y)
    return jnp.stack([coefficients[1] / span, 2 * coefficients[2] / span**2])


def _solve_block_tridiagonal(
    D: Float[Array, "m k k"], B: Float[Array, "m k k"], r: Float[Array, "m k n"]
) -> Float[Array, "m k n"]:
    """Return the solution of a positive definite block tridiagonal system.

    D: diagonal blocks. B: block i is at row i - 1 and column i; block 0 is zero.
    """

    def forward(carry, row):
        inverse, r_above = carry
        D, B, r = row
        inverse, r = (
            inverse_positive(D - B.T @ inverse @ B),
            r - B.T @ inverse @ r_above,
        )
        return (inverse, r), (inverse, r)

    def backward(x_below, row):
        inverse, r, B_below = row
        x = inverse @ (r - B_below @ x_below)
        return x, x

    _, (inverses, r) = jax.lax.scan(
        forward, (jnp.zeros_like(D[0]), jnp.zeros_like(r[0])), (D, B, r)
    )
    B_below = jnp.concatenate([B[1:], jnp.zeros_like(B[:1])])
    return jax.lax.scan(backward, jnp.zeros_like(r[0]), (inverses, r, B_below), reverse=True)[1]


def spline_derivatives(
    ts: Float[Array, " times"], y: Float[Array, "times n"]
) -> tuple[Float[Array, "times n"], Float[Array, "times n"]]:
    """Return the first and second derivatives at `ts` of the quintic spline through y.

    At each end the derivatives are those of the polynomial through the nearest six points, or
    through all if there are fewer. Polynomials up to the degree of these have no error.

    ts: at least four increasing times.
    """
    scale = (ts[-1] - ts[0]) / (len(ts) - 1)
    t = (ts - ts[0]) / scale
    first = _end_derivatives(t[:_END_POINTS], y[:_END_POINTS])
    last = _end_derivatives(t[: -_END_POINTS - 1 : -1], y[: -_END_POINTS - 1 : -1])
    h = jnp.diff(t)
    units = jnp.stack([jnp.ones_like(h), h, h**2] * 2, 1) / h[:, None] ** 2.5
    K = units[:, :, None] * units[:, None, :] * _ENERGY.astype(y.dtype)[None]
    # the unknowns at a point: rows 4, 5 of the interval before it and 1, 2 of that after it
    ends = jnp.stack([y[:-1], y[1:]], 1)
    before, after = K[:-1, 4:], K[1:, 1:3]
    r = -(before[:, :, ::3] @ ends[:-1] + after[:, :, ::3] @ ends[1:])
    r = r.at[0].add(-K[0, 4:, 1:3] @ first).at[-1].add(-K[-1, 1:3, 4:] @ last)
    B = jnp.concatenate([jnp.zeros_like(K[:1, 1:3, 4:]), K[1:-1, 1:3, 4:]])
    inner = _solve_block_tridiagonal(before[:, :, 4:] + after[:, :, 1:3], B, r)
    z = jnp.concatenate([first[None], inner, last[None]])
    return z[:, 0] / scale, z[:, 1] / scale**2
