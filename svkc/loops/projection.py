"""Projection of configuration and velocity onto closed loops, with pivots."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from svkc._jax.select import where
from svkc.loops.constrained_dynamics import CompositeBodies
from svkc.loops.constraint import LoopKinematics, gap_norms, jacobian_scales, loop_kinematics
from svkc.loops.constraint_rows import RowChoice
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
from svkc.model.annotations import DType
from svkc.model.chain import Chain, Structure, active_dofs
from svkc.tree.configuration import integrate, normalize


def least_norm_change(
    chain: Chain, qr: PivotedQR, J: Float[Array, "loop_rows dofs"], x: Float[Array, "rows n"]
) -> Float[Array, "dofs n"]:
    """Return the y (m, rad, or rates) with J (y / column) = x, of least norm of y / column."""
    Jm, _ = pivot_blocks(qr, J)
    gram = Jm @ Jm.T + jnp.diag(where(qr.active, 0, 1).astype(J.dtype))
    return jacobian_scales(chain)[1][:, None] * (Jm.T @ solve_positive(gram, qr.Q @ x))


def dependent_change(
    chain: Chain, qr: PivotedQR, J: Float[Array, "loop_rows dofs"], x: Float[Array, "rows n"]
) -> Float[Array, "dofs n"]:
    """Return the y (m, rad, or rates) with J (y / column) = x, zero where independent.

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
    """Return the y (m, rad, or rates) with J (y / column) = x and least y^T M y.

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


class ProjectionInfo(eqx.Module):
    """What a projection onto the loops has measured.

    gap: what each loop is still open by after the last Newton step (rad, units of `chain.length`).
    margin: |R_mm| / |R_11| of the pivoted QR of J_C. None: not computed.
    pivots: the pivots to use in the next step. None: no pivots were chosen.
    kept: the rows to use in the next step, as in `RowChoice`. None: no rows were chosen.
    """

    gap: Float[Array, "links 2"]
    margin: Float[Array, ""] | None = None
    pivots: Float[Array, "steps dofs"] | None = None
    kept: Bool[Array, " delassus"] | None = None

    @classmethod
    def of_pivots(cls, chain: Chain, dtype: DType) -> "ProjectionInfo":
        """Return the value before the first projection that chooses pivots."""
        links, dofs = len(chain.link_names), chain.dofs
        # zero pivots are fewer than the rank, so that new ones are chosen
        pivots = jnp.zeros((min(6 * links, dofs), dofs), dtype)
        return cls(jnp.zeros((links, 2), dtype), margin=jnp.ones((), dtype), pivots=pivots)

    @classmethod
    def of_loop_forces(
        cls, chain: Chain, dtype: DType, kept: Bool[Array, " delassus"] | None
    ) -> "ProjectionInfo":
        """Return the value before the first projection by loop forces.

        kept: the rows to use in the first step (None: no rows are chosen, nor is the margin known).
        """
        margin = None if kept is None else jnp.ones((), dtype)
        return cls(jnp.zeros((len(chain.link_names), 2), dtype), margin=margin, kept=kept)

    def row_choice(self, near: Bool[Array, ""]) -> RowChoice:
        """Return the rows of the next step. near: as in `RowChoice`."""
        assert self.kept is not None
        return RowChoice(near, self.kept)

    @property
    def dependent(self) -> Bool[Array, " dofs"]:
        """Mask of the dependent coordinates, those with a pivot."""
        assert self.pivots is not None
        return jnp.any(self.pivots > 0, 0)


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
) -> tuple[Float[Array, " q"], Float[Array, " dofs"], ProjectionInfo]:
    """Take `iterations` Newton steps on q to close the loops, then project v once.

    Both are iterations of one loop, so that its body is compiled once.

    dependent_only: whether only dependent coordinates change; otherwise the change is the least in
    the metric of the mass matrix.
    pivots: pivots to return in the info (None: new ones); the steps themselves use new ones. They
    are replaced if their |R_mm| / |R_11| is below `hold` times that of new ones.
    """

    @functools.partial(jax.checkpoint, prevent_cse=False)
    def newton_step(i, carry):
        q, v, _ = carry
        is_velocity_iteration = i == iterations
        loops = loop_kinematics(chain, structure, q)
        new = pivoted_qr(loops.J, structure.rank, structure.independent)
        kept = (
            new.P
            if pivots is None
            else _pivots_to_keep(structure, loops.J, new, pivots, hold, is_velocity_iteration)
        )
        step, gap = _step_by_pivots(chain, structure, loops, v, new, dependent_only)
        info = ProjectionInfo(gap=gap_norms(gap), margin=pivot_ratio(new), pivots=kept)
        q = integrate(chain, q, where(is_velocity_iteration, 0, step[:, 0]))
        v = where(is_velocity_iteration, v + step[:, 1], v)
        return q, v, jax.lax.stop_gradient(info)

    start = (
        normalize(chain, q),
        v,
        ProjectionInfo.of_pivots(chain, q.dtype),
    )
    return jax.lax.fori_loop(0, iterations + 1, newton_step, start)


def _pivots_to_keep(
    structure: Structure,
    J,
    new: PivotedQR,
    pivots,
    hold: float,
    is_velocity_iteration: Bool[Array, ""],
) -> Float[Array, "steps dofs"]:
    """Return `pivots` or, if they are poor in the velocity's iteration, those of the new QR."""
    poor = lambda: (
        (pivot_ratio(refactor(J, pivots)) < hold * pivot_ratio(new))
        | lacks_pivots(pivots, structure.rank)
    )
    return jax.lax.cond(is_velocity_iteration, lambda: where(poor(), new.P, pivots), lambda: pivots)


def _step_by_pivots(
    chain: Chain,
    structure: Structure,
    loops: LoopKinematics,
    v,
    qr: PivotedQR,
    dependent_only: bool,
) -> tuple[Float[Array, "dofs 2"], Float[Array, " rows"]]:
    """Return the changes of q and of v that close the loops, as two columns, and the scaled gap."""
    scaled_v = where(active_dofs(chain, structure), v / jacobian_scales(chain)[1], 0)
    gap, J, qr = loops.gap, loops.J, _drop_unsolvable(structure, qr)
    residual = jnp.stack([gap, J @ scaled_v], 1)
    if dependent_only:
        return -dependent_change(chain, qr, J, residual), gap
    return -inertia_metric_change(chain, structure, loops, qr, residual), gap
