"""The plan of a solution: controls and states over time, and the control that follows the plan."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from svkc.model.chain import Chain, State
from svkc.optimize.guesses import PhaseMotion
from svkc.optimize.points import full_configuration, full_velocity, padded
from svkc.tree.configuration import difference, integrate


class Plan(eqx.Module):
    """The intervals of a solution over time: the `args` of its control.

    starts, steps: start and length of each interval (s).
    blocks: [intervals blocks control] control blocks, see `AbstractControls`.
    q, v: [intervals 2 ...] of the tree, at both ends of each interval.
    gains: [intervals 2 driven 2nv] at both ends of each interval, from errors of q and v to torques
        (N m/rad, N m s/rad). An empty axis of driven coordinates: no feedback.
    first, last: indices of the intervals in use. Before and after them the plan is constant. Arrays
        may be longer, so that meshes share compiled programs.
    chain, args: of the problem, with its free args.
    """

    starts: Any
    steps: Any
    blocks: Any
    q: Any
    v: Any
    gains: Any
    first: Any
    last: Any
    chain: Chain
    args: Any


def plan_of(problem: Any, motion: tuple[PhaseMotion, ...], gains: np.ndarray | None = None) -> Plan:
    """Return the plan of a problem's motion. gains: [intervals 2 driven 2 nv]; None: open loop."""
    steps = np.concatenate([np.diff(m.times) for m in motion])
    ends = lambda x: np.stack([x[:-1], x[1:]], 1)
    velocities = np.concatenate([ends(m.v) for m in motion])
    none = np.zeros((len(steps), 2, 0, 2 * velocities.shape[-1]))
    intervals = {
        "starts": np.cumsum(steps) - steps,
        "steps": steps,
        "blocks": np.concatenate([m.blocks for m in motion]),
        "q": np.concatenate([ends(m.q) for m in motion]),
        "v": velocities,
        "gains": none if gains is None else gains,
    }
    return Plan(
        **padded(intervals),
        first=np.array(0),
        last=np.array(len(steps) - 1),
        chain=problem.chain,
        args=problem.args,
    )


def blocks_at(table: np.ndarray, step: Any, fraction: Any, blocks: Any) -> Any:
    """Return the control blocks of a stage at a fraction of an interval.

    table: from `control_table`. step: length of the interval (s). blocks: of the interval.
    """
    powers = jnp.stack([fraction**k for k in range(table.shape[1])])
    D = jnp.tensordot(powers, table[0], 1) + step * jnp.tensordot(powers, table[1], 1)
    return D @ blocks


def control_table(controls: Any, scheme: Any) -> np.ndarray:
    """Return D0 and D1 of `AbstractControls.coefficients` as polynomials of the fraction.

    The result is [2 powers stage_blocks blocks], with the constant terms first.
    """
    fractions = np.linspace(0, 1, scheme.stages + 1)
    inverse = np.linalg.inv(fractions[:, None] ** np.arange(len(fractions)))
    return np.stack([np.tensordot(inverse, D, 1) for D in controls.coefficients(scheme, fractions)])


def _planned(chain: Chain, q, v, step: Any, s: Any) -> tuple[Any, Any]:
    """Return q and v of the tree at a fraction s of an interval, by cubic Hermite interpolation.

    q, v: at both ends of the interval. step: length of the interval (s).
    """
    start = full_configuration(chain, q[0])
    step_to = difference(chain, start, full_configuration(chain, q[1]))[: chain.nv]
    moved = (3 * s**2 - 2 * s**3) * step_to
    moved = moved + step * ((s - 2 * s**2 + s**3) * v[0] + (s**3 - s**2) * v[1])
    rate = (6 * s - 6 * s**2) * step_to / step
    rate = rate + (1 - 4 * s + 3 * s**2) * v[0] + (3 * s**2 - 2 * s) * v[1]
    return integrate(chain, start, full_velocity(chain, moved))[: chain.nq], rate


def control_of(problem: Any) -> Any:
    """Return the control function (t, state, plan) -> tau of a problem's plans.

    Problems on other meshes and with other free args share one function object, so that `simulate`
    compiles once.
    """
    return problem.functions.setdefault("control", PlanControl(problem))


class PlanControl(eqx.Module):
    """The control function (t, state, plan) -> tau of a problem's plans.

    problem: static; two problems are equal if they are one object.
    """

    problem: Any = eqx.field(static=True)

    def __call__(self, t: Any, state: State, plan: Plan) -> Any:
        """Return the joint torques (N m, N) over every coordinate: the plan's, plus feedback."""
        problem, chain = self.problem, plan.chain
        k = jnp.searchsorted(plan.starts, t, side="right") - 1
        k = jnp.clip(k, *(jnp.asarray(i).astype(k.dtype) for i in (plan.first, plan.last)))
        of_interval = lambda x: jnp.asarray(x)[k]
        start, step, blocks = jax.tree.map(of_interval, (plan.starts, plan.steps, plan.blocks))
        fraction = jnp.clip((t - start) / step, 0, 1)
        table = control_table(problem.controls, problem.scheme)
        blocks = blocks_at(table, step, fraction, blocks)
        tau = problem.controls.torques(chain, t, state, blocks, plan.args)
        if not plan.gains.shape[2]:
            return tau
        at_q, at_v, gains = jax.tree.map(of_interval, (plan.q, plan.v, plan.gains))
        q, v = _planned(chain, at_q, at_v, step, fraction)
        here, there = (full_configuration(chain, x[: chain.nq]) for x in (state.q, q))
        error_q = difference(chain, here, there)[: chain.nv]
        error = jnp.concatenate([error_q, v - state.v[: chain.nv]])
        feedback = ((1 - fraction) * gains[0] + fraction * gains[1]) @ error
        return tau.at[driven_coordinates(problem)].add(feedback)


def driven_coordinates(problem: Any) -> np.ndarray:
    """Return the indices in v of the driven coordinates; empty where they are not known."""
    return np.flatnonzero(problem.controls.driven(problem.chain))
