"""Least squares of least cost, with and without bounds, for torques of redundant actuators.

The matrices may have any rank. Everything here is numbers: chains and states do not enter.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from svkc._jax.batched_lapack import solve_general
from svkc._jax.eager import eager_jit
from svkc._jax.pytrees import stop_gradient_tree
from svkc._jax.select import where
from svkc.loops.pivoting import PivotedQR, pivoted_qr_with_rank, solve_positive


def least_cost_solution(
    qr: PivotedQR, B: Float[Array, "rows dofs"], target_force: Any, cost: Any
) -> Any:
    """Return the y of least sum(cost y^2) among those of least |B y - target_force|.

    qr: pivoted QR of B, whose Q gives an orthonormal basis Z of B's range.
    """
    Z = qr.Q.T
    ZB = Z.T @ B
    ZB_over_cost = ZB.T / cost[:, None]
    G = ZB @ ZB_over_cost + jnp.diag(where(qr.active, 0, 1).astype(B.dtype))
    y = ZB_over_cost @ solve_general(G, Z.T @ target_force)
    # one step of iterative refinement
    return y + ZB_over_cost @ solve_general(G, Z.T @ (target_force - B @ y))


@eager_jit
def solve_bounded(
    problem, weight, lower, upper
) -> tuple[Float[Array, " dofs"], Float[Array, " dofs"]]:
    """Return the least weighted torques of least residual within the bounds, and that residual.

    The active set is determined under stop_gradient. The free torques then follow from one linear
    solve, so that derivatives are exact wherever the active set is locally constant.
    """
    B, target_force, column = problem
    root, tol = jnp.sqrt(weight), jnp.finfo(B.dtype).eps ** 0.25
    scaled = stop_gradient_tree(
        (B * (column / root)[None], target_force, root * lower, root * upper)
    )
    target = _bounded_target(*scaled) / jax.lax.stop_gradient(root)
    clipped_target, has_effect = jnp.clip(target, lower, upper), jnp.any(B != 0, 0)
    free = has_effect & (lower < target) & (target < upper)
    at_bound = where(has_effect & ~free, where(target <= lower, lower, upper), 0)
    B_free = where(free[None], B, 0)
    y = least_cost_solution(
        pivoted_qr_with_rank(B_free)[0],
        B_free,
        target_force - B @ (column * at_bound),
        weight / column**2,
    )
    solved = where(free, y / column, clipped_target)
    tau = jnp.clip(solved, lower, upper)
    # fall back to the clipped target if a free torque leaves its bounds by more than round-off
    inside = jnp.max(jnp.abs(solved - tau)) <= tol * jnp.max(jnp.abs(clipped_target))
    tau = where(free, where(inside, tau, clipped_target), at_bound)
    valid = jnp.all(lower <= upper) & jnp.isfinite(jnp.sum(B) + jnp.sum(target_force))
    tau = where(valid, tau, jnp.nan)
    return tau, (target_force - B @ (column * tau)) / column


def _bounded_target(A, b, lower, upper):
    """Return z such that clip(z, lower, upper) is the x of least norm that minimises |A x - b|.

    There are two stages. In the second, coordinates that the residual presses against a bound are
    fixed there. Without these the residual does not enter the multiplier, which stays precise.
    """
    tol = jnp.finfo(A.dtype).eps ** 0.25

    def stage(_, carry):
        at_bound, target = carry
        rest = b - A @ where(at_bound, jnp.clip(target, lower, upper), 0)
        A_free = where(at_bound[None], 0, A)
        Z = pivoted_qr_with_rank(A_free)[0].Q
        A_free, rest = Z @ A_free, Z @ rest
        target = where(at_bound, target, _multiplier(A_free, rest, lower, upper) @ A_free)
        pressure = (rest - A_free @ jnp.clip(target, lower, upper)) @ A_free
        presses = jnp.abs(pressure) > tol * jnp.sqrt(jnp.sum(A_free**2, 0) * jnp.sum(rest**2))
        return at_bound | (presses & ((target <= lower) | (target >= upper))), target

    start = jnp.zeros(b.shape, bool), jnp.zeros_like(b)
    return jax.lax.fori_loop(0, 2, stage, start)[1]


def _multiplier(A, b, lower, upper):
    """Return mu such that x = clip(A^T mu, lower, upper) has least norm among minimisers.

    The x minimise |A x - b| in the box. This is the augmented Lagrangian method with ten updates of
    `center`. If no x of the box solves A x = b, it converges to the closest problem that has a
    solution (Chiche and Gilbert, 2016). Each inner problem is solved in its dual, by semismooth
    Newton with exact line search.
    """
    eps, size = jnp.finfo(A.dtype).eps, jnp.sum(A * A)
    damping = eps**0.8 * where(size > 0, size, 1)

    def body_fun(carry):
        mu, center, updates, k = carry
        target = mu @ A
        x, free = jnp.clip(target, lower, upper), (lower < target) & (target < upper)
        gradient = A @ x - b + damping * (mu - center)
        hessian = where(free[None], A, 0) @ A.T + damping * jnp.eye(b.size, dtype=A.dtype)
        d = -solve_positive(hessian, gradient)
        direction = d @ A
        # the slope along d is piecewise linear in t, with breaks where a coordinate meets a bound
        rate = where(direction == 0, 1, direction)
        t_at_bound = jnp.append((lower - target) / rate, (upper - target) / rate)
        t = jnp.sort(jnp.append(jnp.clip(t_at_bound, 0, 1), jnp.array([0, 1], A.dtype)))
        clipped = jax.vmap(lambda t: jnp.clip(target + t * direction, lower, upper))(t)
        slope = clipped @ direction - b @ d + damping * ((mu - center) @ d + t * (d @ d))
        mu = mu + jnp.interp(jnp.zeros((), A.dtype), slope, t) * d
        x_new = jnp.clip(mu @ A, lower, upper)
        error = jnp.max(jnp.abs(x_new - x - where(free, direction, 0)))
        # also true for NaN, which ends the loop
        solved = ~(error > eps**0.5 * jnp.max(jnp.abs(x_new)))
        return mu, where(solved, mu, center), where(solved, updates + 1, updates), k + 1

    cond_fun = lambda carry: (carry[2] < 10) & (carry[3] < 10 * b.size + 10)
    return jax.lax.while_loop(cond_fun, body_fun, (jnp.zeros_like(b), jnp.zeros_like(b), 0, 0))[0]
