"""Replay of a solution by `simulate`, with events between phases and feedback to the plan."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc.model.chain import Chain, State
from svkc.model.tables import as_text
from svkc.optimize.plans import Plan, control_of, plan_of
from svkc.optimize.points import full_configuration, full_state
from svkc.simulation.codes import RESULTS
from svkc.simulation.report import Report
from svkc.simulation.simulate import simulate
from svkc.simulation.trajectory import Trajectory
from svkc.transitions.events import at
from svkc.transitions.transition import connect
from svkc.tree.configuration import difference

# the end of a phase is compared with the plan this much earlier, as a fraction of the motion
_JUST_BEFORE = 1e-9


@dataclasses.dataclass(frozen=True)
class Distance:
    """Largest distance from the plan, over all coordinates and over some times.

    position: rad, m. velocity: rad/s, m/s.
    worst: name of the coordinate with the largest distance in position.
    """

    position: float
    velocity: float
    worst: str

    @classmethod
    def of(cls, names: Sequence[str], q: np.ndarray, v: np.ndarray) -> "Distance":
        """Return the largest of the distances [... nv] in q and v. names: of the coordinates."""
        q, v = (np.abs(x).reshape(-1, x.shape[-1]) for x in (q, v))
        worst = names[int(np.argmax(np.max(q, 0)))]
        return cls(position=float(np.max(q)), velocity=float(np.max(v)), worst=worst)


@dataclasses.dataclass(frozen=True)
class ReplayReport:
    """The whole motion simulated with feedback, with events between the phases.

    phases: of each phase, the largest distance from the plan over its nodes.
    report: report of the run, with its loop gaps and its energy balance.
    """

    phases: tuple[Distance, ...]
    report: Report

    def __str__(self) -> str:
        run = self.report
        ended = "" if run.result == RESULTS.successful else f"; ended with {run.result}"
        return as_text(
            [
                f"with feedback: largest loop gap {float(run.gap):.2e} m,"
                f" {float(run.angular_gap):.2e} rad; energy drift {float(run.energy_drift):.2e} J,"
                f" lost in impacts {float(run.energy_lost):.4g} J{ended}"
            ]
        )


def distance(
    chain: Chain, state: State, q: Float[Array, " nq"], v: Float[Array, " nv"]
) -> tuple[Float[Array, " nv"], Float[Array, " nv"]]:
    """Return the differences [nv] of a state from q and v of the tree."""
    here, there = (full_configuration(chain, x) for x in (state.q[: chain.nq], q))
    return difference(chain, here, there)[: chain.nv], state.v[: chain.nv] - v


def control_and_plan(solution: Any, feedback: bool) -> tuple[Any, Plan]:
    """Return the control function and the plan, as `Solution.control` describes."""
    gains = solution.gains() if feedback else None
    return control_of(solution.problem), plan_of(solution.problem, solution.motion, gains)


def replay(solution: Any, feedback: bool, ts: Any, options: Mapping[str, Any]) -> Trajectory:
    """Return the run of a solution with events between its phases.

    ts: save times (s); None: 101 times. options: further keyword arguments of `simulate`.
    """
    problem, motion = solution.problem, solution.motion
    chain, (control, plan) = problem.chain, control_and_plan(solution, feedback)
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
    total = end + float(motion[-1].duration)
    ts = np.linspace(0, total, 101) if ts is None else ts
    return simulate(
        chain, state, total, ts=ts, events=events, control=control, args=plan, **options
    )


def replay_report(solution: Any, options: Mapping[str, Any]) -> ReplayReport:
    """Return the report of the replay with feedback. options: keyword arguments of `simulate`."""
    motion, chain = solution.motion, solution.problem.chain
    total = sum(float(m.duration) for m in motion)
    starts = np.cumsum([0.0, *(float(m.duration) for m in motion)])
    # shortly before the end of a phase, because the event there may change velocities
    times = [s + np.append(m.times[1:-1], m.duration - _JUST_BEFORE * total)
             for s, m in zip(starts, motion)]  # fmt: skip
    traj = replay(solution, True, np.concatenate(times), {"throw": False, **options})
    q, v = (np.concatenate([getattr(m, name)[1:] for m in motion]) for name in "qv")
    of_q, of_v = jax.vmap(lambda *x: distance(chain, *x))(
        traj.states, jnp.asarray(q), jnp.asarray(v)
    )
    edges = np.cumsum([len(m.vdot) for m in motion])[:-1]
    parts = zip(np.split(np.asarray(of_q), edges), np.split(np.asarray(of_v), edges), strict=True)
    phases = tuple(Distance.of(chain.dof_names, q, v) for q, v in parts)
    return ReplayReport(phases=phases, report=traj.report())
