"""Projection onto closed loops by the forces of the loops, without pivots."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from svkc._jax.chunked_sum import sum_in_chunks
from svkc._jax.control_flow import unvmap_any
from svkc._jax.lanes_last import with_lanes_last
from svkc._jax.one_kernel import one_kernel
from svkc._jax.select import where
from svkc.loops.constrained_dynamics import ArticulatedBodies
from svkc.loops.constraint import gap_norms, loop_kinematics, loop_rates
from svkc.loops.constraint_rows import RowChoice, constraint_rows, independent_rows
from svkc.loops.pivoting import has_redundant_rows, rank_tolerance
from svkc.loops.projection import ProjectionInfo
from svkc.model.chain import Chain, Structure, active_dofs
from svkc.tree.configuration import integrate, normalize

# scaled gaps below eps to this power are round-off: 8e-15 in float64, 6e-7 in float32
_ROUND_OFF = 0.9


@functools.partial(jax.jit, static_argnames=("iterations", "differentiated"))
def project_by_loop_forces(
    chain: Chain,
    structure: Structure,
    q,
    v,
    choice: RowChoice | None = None,
    *,
    iterations: int,
    differentiated: bool = True,
) -> tuple[Float[Array, " q"], Float[Array, " dofs"], ProjectionInfo]:
    """Return `project` in the metric of the mass matrix, by `ArticulatedBodies`.

    choice: rows of the loops that are used (None: all).
    differentiated: whether derivatives are taken through the projection. If not, a `vmap` keeps
    lanes last, and the info has the margin and the rows of the next step unless `choice` is None.
    """
    kept = None if differentiated or choice is None else choice.kept
    info = ProjectionInfo.of_loop_forces(chain, q.dtype, kept)
    q = normalize(chain, q)
    if not differentiated:
        return _project_until_closed(chain, structure, (q, v, info), choice, iterations)

    def newton_step(i, carry):
        q, v, _ = carry
        is_last = i == iterations
        step = _step_by_loop_forces(chain, structure, q, v, is_last, choice)
        q = integrate(chain, q, where(is_last, 0, step.change))
        v = where(is_last, v + step.change, v)
        return q, v, jax.lax.stop_gradient(ProjectionInfo(gap=step.gap))

    return jax.lax.fori_loop(0, iterations + 1, newton_step, (q, v, info))


@one_kernel
def _project_until_closed(
    chain: Chain, structure: Structure, start: tuple, choice: RowChoice | None, iterations: int
) -> tuple[Float[Array, " q"], Float[Array, " dofs"], ProjectionInfo]:
    """Take Newton steps on q until the gaps are round-off, then project v.

    start: q, v and info before the first step. iterations: largest number of Newton steps.
    """

    def cond_fun(carry):
        i, _ = carry
        return i <= iterations

    def body_fun(carry):
        i, (q, v, info) = carry
        step = _step_lanes_last(chain, structure, q, v, i == iterations, choice)
        on_velocity = step.on_velocity
        q = integrate(chain, q, where(on_velocity, 0, step.change))
        v = where(on_velocity, v + step.change, v)
        info = ProjectionInfo(gap=step.gap, margin=step.margin, kept=step.kept)
        # all lanes of a `vmap` share i, so that the margin is computed in the last step alone
        return where(unvmap_any(~on_velocity), i, iterations) + 1, (q, v, info)

    return jax.lax.while_loop(cond_fun, body_fun, (jnp.zeros((), jnp.int32), start))[1]


class _ProjectionStep(eqx.Module):
    """One Newton step of a projection.

    change: of v if `on_velocity`, else of q.
    gap: of the loops at q.
    margin: see `ProjectionInfo`; 1 unless `on_velocity`.
    kept: see `ProjectionInfo`; of redundant loops they are chosen anew if `on_velocity`.
    """

    change: Float[Array, " dofs"]
    gap: Float[Array, "links 2"]
    margin: Float[Array, ""] | None
    kept: Bool[Array, " delassus"] | None
    on_velocity: Bool[Array, ""]


def _step_by_loop_forces(
    chain: Chain,
    structure: Structure,
    q,
    v,
    is_last: Bool[Array, ""],
    choice: RowChoice | None,
    may_be_last: bool = False,
) -> _ProjectionStep:
    """Return the change of q that closes the loops, or in the last step the change of v that makes
    the rates of their gaps zero.

    The change is the least in the metric of the mass matrix.

    may_be_last: whether the step is the last, too, if the gaps are round-off. The margin is then
    computed, unless `choice` is None.
    """
    loops = loop_kinematics(chain, structure, q)
    J, active = loops.J, active_dofs(chain, structure)
    gap = jax.lax.stop_gradient(gap_norms(loops.gap))
    on_velocity, margin = is_last, None
    if may_be_last:
        # under `vmap`, one open lane lets all lanes take a step on q
        on_velocity = is_last | ~unvmap_any(jnp.max(gap) > jnp.finfo(J.dtype).eps ** _ROUND_OFF)
    residual = where(on_velocity, loop_rates(chain, loops, where(active, v, 0)), loops.gap)
    rows = constraint_rows(chain, structure, loops, choice)
    kept = rows.kept
    solve = ArticulatedBodies().prepare(chain, structure, loops, rows)
    change = solve(jnp.zeros(chain.dofs, q.dtype), residual)
    if may_be_last and choice is not None:
        assert kept is not None
        kept_before = kept

        def of_next_step():
            margin = margin_of_rows(J, structure.rank, structure.independent)
            # reduced rows are independent
            chooses = ~choice.near & has_redundant_rows(structure)
            independent = lambda: independent_rows(structure, rows)
            choose = lambda: where(chooses, independent(), kept_before)
            return margin, jax.lax.cond(unvmap_any(chooses), choose, lambda: kept_before)

        unchanged = jnp.ones((), J.dtype), kept_before
        margin, kept = jax.lax.cond(on_velocity, of_next_step, lambda: unchanged)
    return _ProjectionStep(
        change=change, gap=gap, margin=margin, kept=kept, on_velocity=on_velocity
    )


@with_lanes_last
def _step_lanes_last(chain: Chain, structure: Structure, q, v, is_last, choice) -> _ProjectionStep:
    """Return `_step_by_loop_forces`, which may be the last; a `vmap` keeps lanes last."""
    return _step_by_loop_forces(chain, structure, q, v, is_last, choice, may_be_last=True)


def margin_of_rows(
    J: Float[Array, "rows dofs"], rank: Int[Array, ""], independent: Bool[Array, " dofs"] | None
) -> Float[Array, ""]:
    """Return `pivot_ratio` of `pivoted_qr`, by modified Gram-Schmidt with column pivoting.

    An iteration has fewer operations than one of the QR, as it computes no Q.

    rank, independent: as in `pivoted_qr`.
    """
    dofs = J.shape[1]
    weight = 1.0
    if independent is not None:
        weight = where(independent, rank_tolerance(J.dtype) ** 2, 1).astype(J.dtype)
    J = jax.lax.stop_gradient(J)

    def step(k, carry):
        # A: columns minus their projections onto earlier pivot columns
        A, least, largest = carry
        weighted = sum_in_chunks(A * A, (0,)) * weight
        pivot = jnp.arange(dofs) == jnp.argmax(
            weighted >= (1 - rank_tolerance(J.dtype)) * jnp.max(weighted)
        )
        column = sum_in_chunks(where(pivot, A, 0), (1,))
        squared = jnp.sum(column * column)
        products = sum_in_chunks(column[:, None] * A, (0,))
        quotients = where(pivot, 0, products / where(squared > 0, squared, 1))
        A = where(pivot, 0, A - column[:, None] * quotients[None])
        least = where(k < rank, jnp.minimum(least, squared), least)
        return A, least, jnp.maximum(largest, squared)

    start = J, jnp.asarray(jnp.inf, J.dtype), jnp.zeros((), J.dtype)
    _, least, largest = jax.lax.fori_loop(0, min(J.shape), step, start)
    ratio = jnp.sqrt(jnp.maximum(least, 0) / where(largest > 0, largest, 1))
    return where(rank > 0, ratio, 1)
