"""Linearization of a solution: intervals and impacts as linear maps of small state errors."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from svkc._jax.batched_lapack import solve_general
from svkc._jax.eager import eager_jit
from svkc.model.chain import Chain
from svkc.optimize.charts import chart_from_motion, motion_from_chart, to_next_chart
from svkc.optimize.equations import IntervalData, Model, Params, stage_equations
from svkc.optimize.guesses import PhaseMotion
from svkc.optimize.loop_rows import rates_at
from svkc.optimize.plans import driven_coordinates
from svkc.optimize.points import full_configuration, full_velocity, padded
from svkc.optimize.structures import phase_structures
from svkc.tree.configuration import difference, integrate
from svkc.tree.inverse_dynamics import mass_matrix_product
from svkc.tree.kinematics import kinematics


class LinearMaps(NamedTuple):
    """Linear maps of small errors (q, v) [2 nv] of the tree, for all N intervals of a motion.

    At the start of each interval, errors of velocity are projected onto the velocities that the
    connected links allow, in the metric of the mass matrix. Errors of position are not projected.

    A: [N 2nv 2nv] from the start of an interval to its end.
    B: [N 2nv driven] from constant torques of the driven coordinates to the end of an interval.
    before: [N 2nv 2nv] from an error just before the start of an interval to the error after the
        projection, linearized at the velocity before the impact.
    after: [N 2nv 2nv] the projection, linearized at the velocity after the impact.
    """

    A: np.ndarray
    B: np.ndarray
    before: np.ndarray
    after: np.ndarray


class _Lane(NamedTuple):
    """An interval: its data, and its unknowns.

    start: time of its start (s). step: length (s). q, v: of the tree at its start.
    before: [nv] velocity just before its start. vdot, blocks, forces: as of `PhaseMotion`.
    """

    data: IntervalData
    start: Any
    step: Any
    q: Any
    v: Any
    before: Any
    vdot: Any
    blocks: Any
    forces: Any


def linear_maps(problem: Any, motion: tuple[PhaseMotion, ...]) -> LinearMaps:
    """Return the linear maps of a motion's intervals.

    The implicit function theorem gives A and B from the derivatives of the collocation equations.
    """
    chain, model, lanes = problem.chain, *_lanes(problem, motion)
    stages = problem.scheme.stages * (chain.nv + len(model.rows))
    key = f"linear maps {model.rows.rows.tolist()}"
    if key not in problem.functions:
        problem.functions[key] = _derivatives(problem, model, stages)
    results = problem.functions[key](Params(chain, problem.args), padded(lanes))
    first, before, after = (np.asarray(x)[: len(lanes.q)] for x in results)
    matrix = np.split(first, [stages], axis=1)
    nx = 2 * chain.nv
    (by_state, by_stages, by_torque), (of_state, of_stages, _) = (
        np.split(x, [nx, nx + stages], axis=2) for x in matrix
    )
    A = of_state - of_stages @ np.linalg.solve(by_stages, by_state)
    B = -of_stages @ np.linalg.solve(by_stages, by_torque)
    return LinearMaps(A, B, before=before, after=after)


def _derivatives(problem: Any, model: Model, stages: int) -> Any:
    """Return the compiled function (params, lanes) -> derivatives for each interval.

    They are the Jacobian of `_interval`, and those of `_projected_velocity` before and after the
    start of the interval.

    stages: number of rows of all stages of an interval.
    """
    unit = np.eye(model.layout.nv)[driven_coordinates(problem)]

    @eager_jit
    def derivatives(params, lanes):
        def of_lane(lane):
            interval = lambda z: _interval(problem, model, params, lane, unit, z)
            first = jax.jacfwd(interval)(jnp.zeros(2 * model.layout.nv + stages + len(unit)))
            of_links = lambda v: _projected_velocity(model, params, lane, v)
            return first, of_links(lane.before), of_links(lane.v)

        return jax.vmap(of_lane)(lanes)

    return derivatives


def _lanes(problem: Any, motion: tuple[PhaseMotion, ...]) -> tuple[Model, _Lane]:
    """Return the static part of the equations, and all intervals with a leading axis."""
    chain, controls, parts, start = problem.chain, problem.controls, [], 0.0
    poses = [[m.q[0], m.q[-1]] for m in motion]
    rows, structures = phase_structures(chain, problem.phases, poses)
    for i, (m, structure) in enumerate(zip(motion, structures, strict=True)):
        before = m.v[:1] if i == 0 else motion[i - 1].v[-1:]
        repeat = lambda x, m=m: np.broadcast_to(np.asarray(x), (len(m.vdot), *np.shape(x)))
        data = IntervalData(
            reference=m.q[:-1],
            next_reference=m.q[1:],
            active=repeat(structure.active),
            structure=jax.tree.map(repeat, structure.structure),
        )
        lane = _Lane(
            data,
            start=start + m.times[:-1],
            step=np.diff(m.times),
            q=m.q[:-1],
            v=m.v[:-1],
            before=np.concatenate([before, m.v[1:-1]]),
            vdot=m.vdot,
            blocks=m.blocks,
            forces=np.asarray(m.forces)[..., rows],
        )
        parts.append(lane)
        start += float(m.duration)
    lanes = jax.tree.map(lambda *x: jnp.concatenate([jnp.asarray(y) for y in x]), *parts)
    return Model.of(chain, controls, problem.scheme, rows), lanes


def _moved(chain: Chain, q, dq):
    """Return a configuration of the tree moved by a tangent vector [nv]."""
    full = full_configuration(chain, q)
    return integrate(chain, full, full_velocity(chain, dq))[: chain.nq]


def _interval(problem: Any, model: Model, params: Params, lane: _Lane, unit: np.ndarray, z):
    """Return the residuals of all stages, then the error (q, v) at the end of the interval.

    unit: [driven nv] rows of the identity matrix that belong to driven coordinates.
    z: changes of q and v at the start, changes of accelerations and multipliers at the stages, and
        constant torques that are added.
    """
    chain, scheme, s, nv = params.chain, problem.scheme, model.layout.stages, model.layout.nv
    ends = np.cumsum([nv, nv, s * nv, s * len(model.rows)])
    dq, dv, da, df, torque = jnp.split(z, ends)
    h, reference = lane.step, lane.data.reference
    x, rate = chart_from_motion(chain, reference, _moved(chain, lane.q, dq), lane.v + dv)
    a, f = lane.vdot + da.reshape(s, nv), lane.forces + df.reshape(s, -1)
    D0, D1 = problem.controls.coefficients(scheme, scheme.c)
    A, ones = scheme.A, np.ones((s, 1))
    X = x[None] + h * scheme.c[:, None] * rate[None] + h**2 * (A @ A) @ a
    R = rate[None] + h * A @ a
    blocks = (D0 + h * D1) @ lane.blocks
    times = jnp.stack([lane.start + h * scheme.c, h * ones[:, 0]], 1)
    y = jnp.concatenate([times, X, R, a, blocks.reshape(s, -1), f], 1)
    rows = jax.vmap(lambda y: stage_equations(model, params, lane.data, 0.0, y))(y)
    force = rows[:, :nv] - ones * (torque @ unit)[None]
    links = jnp.where(lane.data.active[None], rows[:, nv:], f)
    next_reference = lane.data.next_reference
    x, rate = to_next_chart(chain, reference, next_reference, X[-1], R[-1])
    q, v, _ = motion_from_chart(chain, next_reference, x, rate, rate)
    there, here = full_configuration(chain, next_reference), full_configuration(chain, q)
    end = [difference(chain, there, here)[:nv], v]
    return jnp.concatenate([force.ravel(), links.ravel(), *end])


def _projected_velocity(model: Model, params: Params, lane: _Lane, v):
    """Return the derivatives [2nv 2nv] of (q, v projected onto the links' rows) by (q, v).

    The projection is that of an impact: M (v_new - v) = J^T impulse, J v_new = 0.
    """
    chain, nv, active = params.chain, model.layout.nv, lane.data.active

    def after(z):
        dq, dv = jnp.split(z, 2)
        q = _moved(chain, lane.q, dq)
        kin, zero = kinematics(chain, q), jnp.zeros(nv)
        M = jax.jacfwd(lambda x: mass_matrix_product(chain, kin, x))(zero)
        momentum = jnp.concatenate([M @ (v + dv), jnp.zeros(len(active))])
        J = jax.jacfwd(lambda x: rates_at(chain, q, x, model.rows))(zero) if len(active) else None
        if J is None:
            return z
        J = jnp.where(active[:, None], J, 0)
        matrix = jnp.block([[M, J.T], [J, jnp.diag(jnp.where(active, 0.0, 1.0))]])
        return jnp.concatenate([dq, solve_general(matrix, momentum)[:nv]])

    return jax.jacfwd(after)(jnp.zeros(2 * nv))
