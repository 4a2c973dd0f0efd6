"""A solution as a run of `simulate`: with events between phases, and feedback to the plan."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from svkc.model.chain import Chain, State
from svkc.optimize.certificate import blocks_at, control_table
from svkc.optimize.points import full_state, tree_configuration, tree_velocity
from svkc.simulation.simulate import simulate
from svkc.simulation.trajectory import Trajectory
from svkc.transitions.events import at
from svkc.transitions.transition import connect
from svkc.tree.configuration import difference, integrate
from svkc.tree.mass_matrix import mass_matrix


class Plan(eqx.Module):
    """The intervals of a solution, one after another.

    starts, steps: of each (s). blocks: of controls. q, v: at both ends [intervals 2 ...], of the
    tree. stiffness, damping: gains of the feedback (N m/rad, N m s/rad), of each coordinate.
    """

    starts: Any
    steps: Any
    blocks: Any
    q: Any
    v: Any
    stiffness: Any
    damping: Any


def plan_of(solution: Any, rate: float) -> Plan:
    """Return the plan of a solution. rate: of the feedback (1/s); zero: open loop."""
    motion, problem = solution.motion, solution.problem
    chain = problem.chain
    steps = np.concatenate([np.full(len(m.vdot), m.duration / len(m.vdot)) for m in motion])
    ends = lambda x: np.stack([x[:-1], x[1:]], 1)
    first = jax.tree.map(lambda x: x[0], solution.states)
    inertia = np.diag(np.asarray(mass_matrix(chain, first)))
    inertia = np.where(problem.controls.driven(chain), inertia, 0)
    return Plan(
        starts=np.cumsum(steps) - steps,
        steps=steps,
        blocks=np.concatenate([m.blocks for m in motion]),
        q=np.concatenate([ends(m.q) for m in motion]),
        v=np.concatenate([ends(m.v) for m in motion]),
        stiffness=rate**2 * inertia,
        damping=2 * rate * inertia,
    )


def _planned(chain: Chain, q, v, step, s) -> tuple[Any, Any]:
    """Return q and v of the tree at a fraction s of an interval, by Hermite's cubic polynomial."""
    start = tree_configuration(chain, q[0])
    step_to = difference(chain, start, tree_configuration(chain, q[1]))[: chain.nv]
    moved = (3 * s**2 - 2 * s**3) * step_to
    moved = moved + step * ((s - 2 * s**2 + s**3) * v[0] + (s**3 - s**2) * v[1])
    rate = (6 * s - 6 * s**2) * step_to / step
    rate = rate + (1 - 4 * s + 3 * s**2) * v[0] + (3 * s**2 - 2 * s) * v[1]
    return integrate(chain, start, tree_velocity(chain, moved))[: chain.nq], rate


def control_of(problem: Any) -> Any:
    """Return the control (t, state, plan) -> tau that follows a `Plan`."""
    chain, controls = problem.chain, problem.controls
    table = control_table(controls, problem.scheme)

    def control(t, state: State, plan: Plan):
        k = jnp.searchsorted(plan.starts, t, side="right") - 1
        k = jnp.clip(k, 0, len(plan.steps) - 1)
        own = jax.tree.map(lambda x: jnp.asarray(x)[k], (plan.starts, plan.steps))
        fraction = jnp.clip((t - own[0]) / own[1], 0, 1)
        blocks = blocks_at(table, own[1], fraction, jnp.asarray(plan.blocks)[k])
        tau = controls.torques(chain, t, state, blocks, problem.args)
        q, v = _planned(chain, jnp.asarray(plan.q)[k], jnp.asarray(plan.v)[k], own[1], fraction)
        here, there = (tree_configuration(chain, x[: chain.nq]) for x in (state.q, q))
        error = difference(chain, here, there)[: chain.nv]
        feedback = plan.stiffness * error + plan.damping * (v - state.v[: chain.nv])
        return tau + tree_velocity(chain, feedback)

    return control


def replay(solution: Any, rate: float, ts: Any, options: dict[str, Any]) -> Trajectory:
    """Return the run of a solution with events between its phases."""
    problem, motion = solution.problem, solution.motion
    chain, plan = problem.chain, plan_of(solution, rate)
    events, end = [], 0.0
    for before, after, m in zip(problem.phases, problem.phases[1:], motion):
        end += float(m.duration)
        cut, new = (
            tuple(n for n in a.connected if n not in b.connected)
            for a, b in ((before, after), (after, before))
        )
        if cut or new:
            events.append(at(end, connect=new, cut=cut, here=bool(new)))
    opened = eqx.tree_at(
        lambda s: s.connected, chain.structure, jnp.zeros(len(chain.link_names), bool)
    )
    state = full_state(chain, opened, jnp.asarray(motion[0].q[0]), jnp.asarray(motion[0].v[0]))
    if problem.phases[0].connected:
        state = connect(chain, state, *problem.phases[0].connected, here=True)
    total = float(np.sum(plan.steps))
    ts = np.linspace(0, total, 101) if ts is None else ts
    control = control_of(problem)
    return simulate(
        chain, state, total, ts=ts, events=events, control=control, args=plan, **options
    )
