"""Projection of configuration and velocity onto closed loops."""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from svkc._jax.lanes_last import with_lanes_last
from svkc.loops.constrained_dynamics import ArticulatedBodies, CompositeBodies
from svkc.loops.constraint import LoopKinematics, gap_norms, jacobian_scales, loop_kinematics
from svkc.loops.pivoting import (
    PivotedQR,
    drop_below,
    lacks_pivots,
    pivot_blocks,
    pivot_ratio,
    pivoted_qr,
    rank_tolerance,
    refactor,
    release_threshold,
    solve_pivot_block,
    solve_positive,
)
from svkc.model.chain import Chain, Structure, active_dofs
from svkc.tree.configuration import integrate, normalize


def least_norm_change(
    chain: Chain, qr: PivotedQR, J, x: Float[Array, "rows n"]
) -> Float[Array, "dofs n"]:
    """Return the y (m, rad, or their rates) with J y = x of least norm in scaled coordinates."""
    Jm, _ = pivot_blocks(qr, J)
    gram = Jm @ Jm.T + jnp.diag(jnp.where(qr.active, 0, 1).astype(J.dtype))
    return jacobian_scales(chain)[1][:, None] * (Jm.T @ solve_positive(gram, qr.Q @ x))


def dependent_change(
    chain: Chain, qr: PivotedQR, J, x: Float[Array, "rows n"]
) -> Float[Array, "dofs n"]:
    """Return the y (m, rad, or their rates) with J y = x that is zero for independent coordinates.

    (Paper (16).)
    """
    _, JS = pivot_blocks(qr, J)
    return jacobian_scales(chain)[1][:, None] * (qr.P.T @ solve_pivot_block(JS, qr.Q @ x))


def inertia_metric_change(
    chain: Chain,
    structure: Structure,
    loops: LoopKinematics,
    qr: PivotedQR,
    x: Float[Array, "rows n"],
) -> Float[Array, "dofs n"]:
    """Return the y (m, rad, or their rates) with J y = x and least y^T M y.

    Velocities change so under an impulse of the loops (paper (29)).
    """
    none = jnp.zeros(chain.dofs, x.dtype)
    solve = CompositeBodies().prepare(chain, structure, loops, qr)
    return jax.vmap(lambda x: solve(none, -x), 1, 1)(x)


def _drop_unsolvable(structure: Structure, qr: PivotedQR) -> PivotedQR:
    """Return the QR without rows below `rank_tolerance` and below `release_threshold`.

    A gap along a row below the tolerance is of second order, and its quotient by R_kk round-off.
    """
    return drop_below(
        qr,
        jnp.maximum(
            rank_tolerance(qr.diag_R.dtype),
            release_threshold(qr.diag_R.dtype) * structure.margin,
        ),
    )


@functools.partial(jax.jit, static_argnames=("iterations", "dependent_only", "hold"))
def project(
    chain: Chain,
    structure: Structure,
    q,
    v,
    *,
    iterations: int,
    dependent_only: bool = False,
    pivots=None,
    hold: float = 0.0,
) -> tuple[
    Float[Array, " q"],
    Float[Array, " dofs"],
    Float[Array, "links 2"],
    Float[Array, ""],
    Float[Array, "steps dofs"],
]:
    """Close the loops by Newton's method, then project the velocity. The last turn of one loop is
    the velocity's, so that the body is compiled once. dependent: only dependent coordinates move;
    otherwise the change is the least in the metric of the inertia.

    And what the loops show: the gaps (rad, `chain.length`s) that each loop is left with, |R_mm| /
    |R_11|, and the pivots to go on with. pivots: those held so far (None: none are), which go on
    until their |R_mm| / |R_11| is below `hold` times that of new ones.
    """

    @functools.partial(jax.checkpoint, prevent_cse=False)
    def turn(i, both):
        q, v = both[:2]
        last = i == iterations
        loops = loop_kinematics(chain, structure, q)
        full = pivoted_qr(loops.J, structure.rank, structure.independent)
        held = (
            full.P
            if pivots is None
            else _pivots_to_keep(structure, loops.J, full, pivots, hold, last)
        )
        step, open_ = _step_by_pivots(chain, structure, loops, v, full, dependent_only)
        seen = jax.lax.stop_gradient((gap_norms(open_), pivot_ratio(full), held))
        q = integrate(chain, q, jnp.where(last, 0, step[:, 0]))
        return q, jnp.where(last, v + step[:, 1], v), *seen

    links = len(chain.link_names)
    none = (
        jnp.zeros((links, 2), q.dtype),
        jnp.ones((), q.dtype),
        jnp.zeros((min(6 * links, chain.dofs), chain.dofs), q.dtype),
    )
    return jax.lax.fori_loop(0, iterations + 1, turn, (normalize(chain, q), v, *none))


def _pivots_to_keep(
    structure: Structure, J, full: PivotedQR, pivots, hold: float, last: Bool[Array, ""]
) -> Float[Array, "steps dofs"]:
    """Return the pivots or, where they are poor in the last turn, those of the new qr
    `full`."""
    poor = lambda: (
        (pivot_ratio(refactor(J, pivots)) < hold * pivot_ratio(full))
        | lacks_pivots(pivots, structure.rank)
    )
    return jax.lax.cond(last, lambda: jnp.where(poor(), full.P, pivots), lambda: pivots)


def _step_by_pivots(
    chain: Chain, structure: Structure, loops: LoopKinematics, v, full: PivotedQR, dependent: bool
) -> tuple[Float[Array, "dofs 2"], Float[Array, " rows"]]:
    """Return the changes of q, that close the loops, and of v, that keep them; and the gaps."""
    moving = jnp.where(active_dofs(chain, structure), v / jacobian_scales(chain)[1], 0)
    gap, J, qr = loops.gap, loops.J, _drop_unsolvable(structure, full)
    open_ = jnp.stack([gap, J @ moving], 1)
    if dependent:
        return -dependent_change(chain, qr, J, open_), gap
    return -inertia_metric_change(chain, structure, loops, qr, open_), gap


@functools.partial(jax.jit, static_argnames=("iterations", "differentiated"))
def project_by_loop_forces(
    chain: Chain, structure: Structure, q, v, *, iterations: int, differentiated: bool = True
) -> tuple[Float[Array, " q"], Float[Array, " dofs"], Float[Array, "links 2"]]:
    """`settle_loops` in the metric of the inertia, by articulated bodies and the forces of the
    loops: no pivots are chosen. And the gaps (rad, `chain.length`s) that each loop is left with.
    differentiated: as `Field`'s."""
    one_turn = _step_by_loop_forces if differentiated else with_lanes_last(_step_by_loop_forces)

    @functools.partial(jax.checkpoint, prevent_cse=False)
    def turn(i, both):
        q, v, _ = both
        step, left = one_turn(chain, structure, q, v, i == iterations)
        return (
            integrate(chain, q, jnp.where(i == iterations, 0, step)),
            jnp.where(i == iterations, v + step, v),
            left,
        )

    return jax.lax.fori_loop(
        0,
        iterations + 1,
        turn,
        (normalize(chain, q), v, jnp.zeros((len(chain.link_names), 2), q.dtype)),
    )


def _step_by_loop_forces(
    chain: Chain, structure: Structure, q, v, last: Bool[Array, ""]
) -> tuple[Float[Array, " dofs"], Float[Array, "links 2"]]:
    """The least change, in the metric of the inertia, of q that closes the loops or, in the last
    turn, of v that keeps them; and the gaps at q."""
    column = jacobian_scales(chain)[1]
    loops = loop_kinematics(chain, structure, q)
    J, open_, active = loops.J, loops.gap, active_dofs(chain, structure)
    apart = jnp.where(last, J @ jnp.where(active, v / column, 0), open_)
    solve = ArticulatedBodies().prepare(chain, structure, loops)
    step = solve(jnp.zeros(chain.dofs, q.dtype), apart)
    return step, jax.lax.stop_gradient(gap_norms(open_))
