"""Paths of closed configurations: the state of a continuation and its linear systems.

A continuation first closes the loops at the start, then follows closed configurations to the
requested coordinates, so that its end is on the branch that is connected with the start. These are
the two legs of the path, each with a parameter s from 0 to 1. On the first leg the loop gaps shrink
as 1 - s. On the second leg the gaps are zero and the held coordinates move on a straight line.
Every point of a leg is a stationary point of the change from the start under the leg's constraints
at s (`stationarity.py`). `path_steps.py` chooses the steps.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from svkc._jax.batched_lapack import factor_general, solve_factored
from svkc._jax.select import where
from svkc.loops.constraint import LoopKinematics, jacobian_scales, loop_kinematics
from svkc.loops.frames import LoopFrames
from svkc.loops.pivoting import PivotedQR, pivoted_qr
from svkc.model.chain import Chain, Structure, active_dofs, without_locks
from svkc.transitions.newton_state import CLOSE_PERTURBED, NewtonState, is_any_of
from svkc.transitions.stationarity import (
    Targets,
    gradient,
    independent_rows,
    optimality_matrix,
    weights,
)
from svkc.tree.configuration import difference, integrate
from svkc.tree.kinematics import Kinematics
from svkc.tree.spatial import matvec, quat_conjugate, quat_matrix, skew

# kinds of iterations, numbered apart from those of the search for the rank in `newton_state.py`
(
    READ_COORDINATES,  # compute the coordinates of virtual joints from the poses of their bodies
    CLOSE_START,  # the first leg
    SELECT_HELD,  # select the coordinates that the second leg moves
    FOLLOW,  # the second leg
    PROJECT_VELOCITY_HELD,  # project the velocity, held velocities fixed
    PROJECT_VELOCITY,  # project every velocity
    DONE,  # the path has ended or failed
) = range(20, 27)

# rotation (rad) below which the quadratic coefficient of the inverse left Jacobian is the first
# term of its series, 1/12; the next term is smaller by a factor of angle^2 / 60
_SMALL_ANGLE = 1e-3


class PathPoint(eqx.Module):
    """An accepted point of a leg.

    q: configuration at which the point was accepted.
    correction: Newton step at q, without units (see `stationarity.py`); the next predictor adds it.
    tangent: derivative of the path by s, without units.
    multiplier, multiplier_rate: multipliers of the loop rows, and their derivative by s.
    s: parameter of the leg.
    Q, P: the independent rows and the pivot columns at the point, as in `PivotedQR`.
    """

    q: Float[Array, " q"]
    correction: Float[Array, " dofs"]
    tangent: Float[Array, " dofs"]
    multiplier: Float[Array, " rows"]
    multiplier_rate: Float[Array, " rows"]
    s: Float[Array, ""]
    Q: Float[Array, "steps rows"]
    P: Float[Array, "steps dofs"]


class PathState(eqx.Module):
    """The state of the continuation.

    newton: configuration, velocity and rank.
    point: the last accepted point of the leg.
    kind: kind of the next iteration.
    corrections: number of Newton steps since the last predictor step or perturbation.
    iterations: number of iterations of all kinds since the start of the path.
    s, step_size: parameter of the leg, and its increment in the last predictor step.
    correction_size: largest entry of the last correction.
    multiplier: multipliers of the loop rows.
    initial_gap: loop gaps at the start of the first leg; zero on the second leg.
    initial_offset: change without units from the start of the leg to the requested coordinates.
    held: coordinates that the second leg moves: those to hold that the loops leave independent.
    origin: configuration at the start of the first leg.
    closing_rows: number of independent loop rows at the end of the first leg.
    has_point: whether the leg has an accepted point.
    rank_known: whether the rank has been decided.
    from_requested: whether the path starts at the requested coordinates instead of the start.
    reached: whether the path has come to its end without failing.
    """

    newton: NewtonState
    point: PathPoint
    kind: Int[Array, ""]
    corrections: Int[Array, ""]
    iterations: Int[Array, ""]
    s: Float[Array, ""]
    step_size: Float[Array, ""]
    correction_size: Float[Array, ""]
    multiplier: Float[Array, " rows"]
    initial_gap: Float[Array, " rows"]
    initial_offset: Float[Array, " dofs"]
    held: Bool[Array, " dofs"]
    origin: Float[Array, " q"]
    closing_rows: Int[Array, ""]
    has_point: Bool[Array, ""]
    rank_known: Bool[Array, ""]
    from_requested: Bool[Array, ""]
    reached: Bool[Array, ""]

    @classmethod
    def init(cls, chain: Chain, structure: Structure, targets: Targets) -> "PathState":
        """Return the state before the first iteration."""
        rows, dofs, dtype = 6 * len(chain.link_names), chain.dofs, targets.start.dtype
        steps, zero = min(rows, dofs), jnp.zeros((), dtype)
        count, no = jnp.zeros((), jnp.int32), jnp.zeros((), bool)
        y, multiplier = jnp.zeros(dofs, dtype), jnp.zeros(rows, dtype)
        v = where(active_dofs(chain, structure), targets.v, 0)
        point = PathPoint(
            q=targets.start,
            correction=y,
            tangent=y,
            multiplier=multiplier,
            multiplier_rate=multiplier,
            s=zero,
            Q=jnp.zeros((steps, rows), dtype),
            P=jnp.zeros((steps, dofs), dtype),
        )
        return cls(
            newton=NewtonState.init(chain, structure, targets.start, v),
            point=point,
            kind=count + READ_COORDINATES,
            corrections=count,
            iterations=count,
            s=zero,
            step_size=zero,
            correction_size=zero,
            multiplier=multiplier,
            initial_gap=multiplier,
            initial_offset=y,
            held=jnp.zeros(dofs, bool),
            origin=targets.start,
            closing_rows=count,
            has_point=no,
            rank_known=no,
            from_requested=no,
            reached=no,
        )


class LinearSolution(eqx.Module):
    """The solutions of the linear systems of one iteration.

    kin, frames, gap: kinematics, frames of the virtual joints and loop gaps at the evaluated point.
    all_pivots: pivoted QR of the columns of the loop Jacobian that are not fixed.
    selection: `all_pivots` without the pivots that are too small to divide by.
    step, multiplier: Newton step without units, and the multipliers of the loop rows after it.
    tangent, multiplier_rate: derivatives of the path and of the multipliers by s.
    initial_gap, initial_offset: as in `PathState`.
    same_orientation: whether the determinant of the pivot block of the last accepted point has
        kept its sign (see `_orientation_matrix`).
    """

    kin: Kinematics
    frames: LoopFrames
    gap: Float[Array, " rows"]
    all_pivots: PivotedQR
    selection: PivotedQR
    step: Float[Array, " dofs"]
    multiplier: Float[Array, " rows"]
    tangent: Float[Array, " dofs"]
    multiplier_rate: Float[Array, " rows"]
    initial_gap: Float[Array, " rows"]
    initial_offset: Float[Array, " dofs"]
    same_orientation: Bool[Array, ""]


def _jacobian_and_gaps(loops: LoopKinematics):
    """Return the scaled derivative of the loop gaps, and the scaled gaps, with angular rows in the
    frames of the real links.

    In these frames the rate of a gap's rotation vector is the inverse left Jacobian of SO(3) times
    the relative angular velocity, for open loops too. J_C itself, in world axes, is the derivative
    of the gaps of closed loops only.
    """
    count = len(loops.gap) // 6
    J, gap = loops.J.reshape(count, 6, -1), loops.gap.reshape(count, 6)
    vector = gap[:, :3]
    squared = jnp.sum(vector * vector, 1)
    half = jnp.sqrt(where(squared < _SMALL_ANGLE**2, 1, squared)) / 2
    factor = where(squared < _SMALL_ANGLE**2, 1 / 12, (1 - half / jnp.tan(half)) / (2 * half) ** 2)
    to_real = quat_matrix(quat_conjugate(loops.frames.real_quat))
    across = skew(vector)
    inverse = jnp.eye(3, dtype=gap.dtype)[None] - across / 2
    inverse = inverse + factor[:, None, None] * (across @ across)
    angular = to_real @ (inverse @ J[:, :3])
    J = jnp.concatenate([angular, J[:, 3:]], 1).reshape(loops.J.shape)
    gap = jnp.concatenate([matvec(to_real, vector), gap[:, 3:]], 1).ravel()
    return J, gap


def _neighbourhood(chain: Chain, structure: Structure, q):
    """Return kinematics, joint frames, gap derivatives, gaps and configurations, each stacked over
    q and a small step from q along each coordinate, and the size of these steps without units.

    `linearize` differentiates the gradient, and with it the loop Jacobian, by differences of these.
    """
    size, column = float(jnp.finfo(q.dtype).eps) ** 0.5, jacobian_scales(chain)[1]
    steps = size * jnp.eye(chain.dofs + 1, chain.dofs, k=-1, dtype=q.dtype) * column[None]

    def evaluate(step):
        q_step = integrate(chain, q, step)
        loops = loop_kinematics(chain, structure, q_step)
        return loops.kin, loops.frames, *_jacobian_and_gaps(loops), q_step

    return (*jax.vmap(evaluate)(steps), size)


def _initial_values(path: PathState, offset, gap):
    """Return the offset and the gap at the start of the leg.

    offset, gap: values of this iteration, at the start of the leg if it has no accepted point.
    """
    gap_to_close = where(path.kind == CLOSE_START, gap, 0)
    return (
        where(path.has_point, path.initial_offset, offset),
        where(path.has_point, path.initial_gap, gap_to_close),
    )


def linearize(
    chain: Chain, structure: Structure, targets: Targets, path: PathState, q: Float[Array, " q"]
) -> LinearSolution:
    """Return the Newton step (corrector) and the tangent of the path (predictor) at q."""
    kind, column, weight = path.kind, jacobian_scales(chain)[1], weights(chain, structure)
    # columns of locked coordinates are kept: their requested values change the loop gaps
    kins, frames, Js, gaps, qs, size = _neighbourhood(chain, without_locks(structure), q)
    kin, frames, J, gap = jax.tree.map(lambda x: x[0], (kins, frames, Js, gaps))
    on_leg, moved = is_any_of(kind, CLOSE_START, FOLLOW), path.held & (kind == FOLLOW)
    projects_held = (kind == PROJECT_VELOCITY_HELD) & targets.held_v
    fixed = moved | projects_held | ~(active := active_dofs(chain, structure))
    free_J = where(fixed, 0, J)
    rank = where(path.rank_known, path.newton.rank, min(J.shape))
    all_pivots = pivoted_qr(free_J, rank, targets.held_q & (kind == SELECT_HELD))
    with_margin = eqx.tree_at(lambda s: s.margin, structure, path.newton.margin)
    selection = independent_rows(with_margin, free_J, all_pivots, path.rank_known)
    gradient_at = lambda q, J: gradient(chain, path.origin, q, J, path.multiplier, weight)
    gradients = jax.vmap(gradient_at)(qs, Js)
    hessian_on_leg = (gradients[1:] - gradients[:1]).T / size
    gradient_of_change = gradients[0] - path.multiplier @ J
    offset = difference(chain, q, targets.requested) / column
    initial_offset, initial_gap = _initial_values(path, offset, gap)
    # gaps and offsets shrink as 1 - s from their values where the leg begins
    residual = where(on_leg, gap - (1 - path.s) * initial_gap, gap)
    projects = is_any_of(kind, PROJECT_VELOCITY_HELD, PROJECT_VELOCITY)
    residual = where(projects, J @ where(active, path.newton.v / column, 0), residual)
    for_fixed = where(moved, offset - (1 - path.s) * initial_offset, 0)
    upper = where(fixed, for_fixed, where(on_leg, -gradient_of_change, 0))
    right_side = jnp.concatenate([upper, -selection.Q @ residual])
    along = jnp.concatenate([where(moved, initial_offset, 0), selection.Q @ -initial_gap])
    hessian = where(on_leg, hessian_on_leg, jnp.diag(where(kind == CLOSE_PERTURBED, 1, weight)))
    matrix = optimality_matrix(hessian, selection.Q @ J, selection.active, fixed)
    # one call of LAPACK for both matrices
    orientation = _orientation_matrix(path.point, free_J)
    lu, order, positive = factor_general(jnp.stack([matrix, orientation]))
    n, solution = chain.dofs, solve_factored(lu[0], order[0], jnp.stack([right_side, along], 1))
    return LinearSolution(
        kin=kin,
        frames=frames,
        gap=gap,
        all_pivots=all_pivots,
        selection=selection,
        step=solution[:n, 0],
        multiplier=solution[n:, 0] @ selection.Q,
        tangent=solution[:n, 1],
        multiplier_rate=solution[n:, 1] @ selection.Q,
        initial_gap=initial_gap,
        initial_offset=initial_offset,
        same_orientation=positive[1],
    )


def _orientation_matrix(point: PathPoint, J) -> Float[Array, "n n"]:
    """Return the block of J in the rows Q and pivot columns P of `point`, padded with the identity
    to the size of the KKT matrix.

    The determinant was positive at `point`. It is negative on a branch that nearly crosses the
    path.
    """
    unused = jnp.diag(where(jnp.any(point.P > 0, 1), 0, 1).astype(J.dtype))
    steps, n = point.P.shape
    block = point.Q @ J @ point.P.T + unused
    return jnp.pad(block - jnp.eye(steps, dtype=J.dtype), (0, n)) + jnp.eye(
        n + steps, dtype=J.dtype
    )
