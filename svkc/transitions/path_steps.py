"""The step control of a continuation: accept, correct or halve each step, and go from leg to leg.

The order of a path: compute the coordinates of virtual joints, close the start, search for the
rank, select the coordinates to hold, move them, project the velocity.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from svkc._jax.pytrees import tree_where
from svkc._jax.select import where
from svkc.loops.constraint import gap_tolerance, jacobian_scales
from svkc.model.chain import Chain, Structure
from svkc.transitions.continuation import (
    CLOSE_START,
    DONE,
    FOLLOW,
    PROJECT_VELOCITY,
    PROJECT_VELOCITY_HELD,
    READ_COORDINATES,
    SELECT_HELD,
    LinearSolution,
    PathPoint,
    PathState,
)
from svkc.transitions.newton import rank_search_perturbation
from svkc.transitions.newton_state import (
    CLOSE_PERTURBED,
    DECIDE_RANK,
    PERTURB,
    RANK_SEARCH,
    is_any_of,
)
from svkc.transitions.placement import joint_coordinates, with_coordinates
from svkc.transitions.stationarity import Targets
from svkc.tree.configuration import difference, integrate

# largest entry of a predictor step, and the smallest one before the path fails (rad, or in
# `chain.length`s)
_LARGEST_STEP, _SMALLEST_STEP = 0.1, 1e-5
# iterations after which a path fails: 500, and 100 for each unit of the largest gap and offset. A
# predictor step of the largest size takes about three iterations, so that a coordinate takes 30 for
# each unit that it moves. Near a singular configuration the steps become ever smaller.
_ITERATIONS, _ITERATIONS_PER_UNIT = 500, 100


class _StepDecision(eqx.Module):
    """The decision about the point that an iteration of a leg evaluated.

    accept, reject: a point that is neither accepted nor rejected is corrected. After a rejection
        the predictor starts at the last accepted point again, with half the step.
    leg_done: whether the point is accepted and at the end of the leg.
    stuck: whether the path fails: steps have become too small or too many.
    rank_drops: whether the leg is done because its loops are closed, though the step is not small.
    correction_size: largest entry of the correction.
    step_size: increment of s in the next predictor step.
    """

    accept: Bool[Array, ""]
    reject: Bool[Array, ""]
    leg_done: Bool[Array, ""]
    stuck: Bool[Array, ""]
    rank_drops: Bool[Array, ""]
    correction_size: Float[Array, ""]
    step_size: Float[Array, ""]


def _decide(path: PathState, linear: LinearSolution) -> _StepDecision:
    """Return the decision: accept a point whose correction is small, reject a point whose
    corrections do not converge."""
    eps = float(jnp.finfo(linear.step.dtype).eps)
    on_leg, rank_unknown = is_any_of(path.kind, CLOSE_START, FOLLOW), ~path.rank_known
    size, length = jnp.max(jnp.abs(linear.step)), jnp.max(jnp.abs(linear.tangent))
    at_end = path.s > 1 - 4 * eps
    small = size <= where(at_end, eps**0.5, eps ** (1 / 3))
    # Until the rank is known the first leg uses all rows. An over-constrained loop has a higher
    # rank while open: its corrections converge slowly, and the orientation of its pivot block has
    # no meaning.
    same_branch = linear.same_orientation | ~path.has_point | rank_unknown
    # where such a loop closes its rank drops, and the step leads far along its new freedoms
    is_closed = jnp.max(jnp.abs(linear.gap)) < gap_tolerance(linear.gap.dtype)
    closed = rank_unknown & at_end & is_closed
    accept = on_leg & ((small & same_branch) | closed)
    predicted = path.step_size * jnp.max(jnp.abs(path.point.tangent))
    first = path.corrections == 0
    contraction = where(rank_unknown, 0.95, 0.5)
    converges = where(
        first & path.has_point,
        size <= 0.2 * predicted + eps ** (1 / 3),
        first | (size <= contraction * path.correction_size),
    )
    converges &= ~(small & ~same_branch) & (path.corrections < where(rank_unknown, 60, 10))
    reject = on_leg & ~accept & ~converges
    grown = where(path.has_point, 2 * path.step_size, 1)
    limit = _LARGEST_STEP / jnp.maximum(length, eps)
    step_size = jnp.minimum(jnp.minimum(grown, 1 - path.s), limit)
    too_small = (predicted < 2 * _SMALLEST_STEP) | (path.step_size < 1e-8)
    far = jnp.max(jnp.abs(linear.initial_gap)) + jnp.max(
        where(path.held, jnp.abs(linear.initial_offset), 0)
    )
    longest = _ITERATIONS + _ITERATIONS_PER_UNIT * far
    too_long = on_leg & (path.iterations.astype(far.dtype) > longest)
    return _StepDecision(
        accept=accept,
        reject=reject,
        leg_done=accept & at_end,
        stuck=too_long | (reject & (~path.has_point | too_small)),
        rank_drops=closed & ~small,
        correction_size=size,
        step_size=where(reject, path.step_size / 2, step_size),
    )


def _advance(
    chain: Chain, structure: Structure, path: PathState, q, linear: LinearSolution, decision
) -> PathState:
    """Return the path after this iteration's change of q, probe or v; its kind stays.

    q: the configuration that the iteration evaluated.
    """
    kind, h = path.kind, decision.step_size
    column, onward = jacobian_scales(chain)[1], decision.accept & ~decision.leg_done
    accepted = PathPoint(
        q=q,
        correction=linear.step,
        tangent=linear.tangent,
        multiplier=linear.multiplier,
        multiplier_rate=linear.multiplier_rate,
        s=path.s,
        Q=linear.selection.Q,
        P=linear.selection.P,
    )
    point = tree_where(onward, accepted, path.point)
    predicts, on_leg = onward | decision.reject, is_any_of(kind, CLOSE_START, FOLLOW)
    corrects = on_leg | (kind == CLOSE_PERTURBED)
    correction = where(corrects & ~decision.rank_drops, linear.step, 0)
    step = where(predicts, point.correction + h * point.tangent, correction)
    perturbation = rank_search_perturbation(chain, structure)
    change = column * step + where(kind == PERTURB, perturbation, 0)
    q_next = integrate(chain, where(predicts, point.q, q), change)
    newton, in_rank_search = path.newton, is_any_of(kind, *RANK_SEARCH)
    projects = is_any_of(kind, PROJECT_VELOCITY_HELD, PROJECT_VELOCITY)
    newton = dataclasses.replace(
        newton.record_rank_search(kind, linear.all_pivots.diag_R, _gap_norms(linear)),
        q=where(in_rank_search | (kind == SELECT_HELD), newton.q, q_next),
        probe=where(in_rank_search, q_next, newton.probe),
        v=newton.v + where(projects, column * linear.step, 0),
        residual_gaps=_gap_norms(linear),
    )
    multiplier = where(on_leg, linear.multiplier, path.multiplier)
    return dataclasses.replace(
        path,
        newton=newton,
        point=point,
        s=where(predicts, point.s + h, path.s),
        step_size=where(predicts, h, path.step_size),
        correction_size=decision.correction_size,
        corrections=where(corrects & ~predicts, path.corrections + 1, 0),
        has_point=path.has_point | onward,
        multiplier=where(predicts, point.multiplier + h * point.multiplier_rate, multiplier),
        initial_gap=linear.initial_gap,
        initial_offset=linear.initial_offset,
    )


def _gap_norms(linear: LinearSolution) -> Float[Array, " links"]:
    """Return the largest gap of each loop (rad, or in `chain.length`s)."""
    return jnp.max(jnp.abs(linear.gap).reshape(-1, 6), 1)


def next_path_state(
    chain: Chain,
    structure: Structure,
    targets: Targets,
    path: PathState,
    q: Float[Array, " q"],
    linear: LinearSolution,
) -> PathState:
    """Return the path after an iteration that evaluated the configuration q, with its next kind."""
    kind, decision = path.kind, _decide(path, linear)
    after = _advance(chain, structure, path, q, linear, decision)
    after = _read_coordinates(chain, structure, targets, after, kind, linear)
    start_closed = decision.leg_done & (kind == CLOSE_START)
    used_rows = jnp.sum(linear.selection.active, dtype=jnp.int32)
    # no number of rows: the start is closed again once the rank is known
    used_rows = where(decision.rank_drops, -1, used_rows)
    # coordinates that are no pivots are independent, and can be held
    independent = targets.held_q & ~jnp.any(linear.all_pivots.P > 0, 0)
    after = dataclasses.replace(
        after,
        held=where(kind == SELECT_HELD, independent, path.held),
        rank_known=path.rank_known | (kind == DECIDE_RANK),
        closing_rows=where(start_closed, used_rows, path.closing_rows),
    )
    scaled_offset = difference(chain, q, targets.requested) / jacobian_scales(chain)[1]
    deviation = where(targets.held_q, jnp.abs(scaled_offset - linear.step), 0)
    missed = ~(jnp.max(deviation) <= targets.tolerance)
    failed = decision.stuck | (decision.leg_done & (kind == FOLLOW) & missed)
    # An over-constrained loop was closed with more rows than its rank when closed. The closed point
    # need not be stationary: close the loop again, with the rank known.
    close_again = (kind == SELECT_HELD) & (path.closing_rows != path.newton.rank)
    new_leg = decision.leg_done | close_again
    last_q = where(decision.stuck, path.point.q, after.newton.q)
    after = dataclasses.replace(
        after,
        kind=where(failed, DONE, _next_kind(path, decision, close_again)),
        has_point=after.has_point & ~new_leg,
        s=where(new_leg, 0, after.s),
        reached=path.reached | (kind == PROJECT_VELOCITY),
        multiplier=where(close_again, 0, after.multiplier),
        newton=dataclasses.replace(after.newton, q=where(close_again, path.origin, last_q)),
    )
    return tree_where(
        failed & ~path.from_requested & jnp.any(targets.held_q & ~(path.held & path.rank_known)),
        _restarted(chain, structure, targets, path),
        after,
    )


def _restarted(chain: Chain, structure: Structure, targets: Targets, path: PathState) -> PathState:
    """Return a path that starts at the requested coordinates.

    `next_path_state` restarts a path with coordinates to hold once, if it fails before the rank is
    known or if not all of these are independent, as with more of them than freedoms.
    """
    first = PathState.init(chain, structure, targets)
    return dataclasses.replace(
        first,
        newton=dataclasses.replace(first.newton, q=targets.requested, v=path.newton.v),
        from_requested=~first.from_requested,
    )


def _next_kind(path: PathState, decision: _StepDecision, close_again) -> Int[Array, ""]:
    """Return the kind of the next iteration of a path that does not fail."""
    kind, last_search = path.kind, RANK_SEARCH.count(CLOSE_PERTURBED) - 1
    search_closed = (kind == CLOSE_PERTURBED) & (path.corrections >= last_search)
    after_closing = where(path.rank_known, FOLLOW, PERTURB)
    table = (
        (kind == READ_COORDINATES, CLOSE_START),
        (decision.leg_done & (kind == CLOSE_START), after_closing),
        (kind == PERTURB, CLOSE_PERTURBED),
        (search_closed, DECIDE_RANK),
        (kind == DECIDE_RANK, SELECT_HELD),
        (kind == SELECT_HELD, where(close_again, CLOSE_START, FOLLOW)),
        (decision.leg_done & (kind == FOLLOW), PROJECT_VELOCITY_HELD),
        (kind == PROJECT_VELOCITY_HELD, PROJECT_VELOCITY),
        (kind == PROJECT_VELOCITY, DONE),
    )
    for condition, following in table:
        kind = where(condition, following, kind)
    return kind


def _read_coordinates(
    chain: Chain, structure: Structure, targets: Targets, path: PathState, kind, linear
) -> PathState:
    """Return the path with the coordinates of virtual joints computed from the poses of their
    bodies, except where they close their loop already, and with its origin.

    A no-op for every other kind of iteration.
    """
    q = path.newton.q
    is_open = ~(_gap_norms(linear) < gap_tolerance(q.dtype))
    links = targets.read_links & structure.connected & is_open

    def read():
        coordinates = joint_coordinates(chain, structure, linear.kin, q, linear.frames)
        return with_coordinates(chain, links, coordinates, q)

    q = jax.lax.cond(kind == READ_COORDINATES, read, lambda: q)
    return dataclasses.replace(
        path,
        newton=dataclasses.replace(path.newton, q=q),
        origin=where(kind == READ_COORDINATES, q, path.origin),
    )
