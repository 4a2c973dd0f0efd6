"""`SolutionReport`: how far a solution is from a motion, by simulation with error control.

Intervals are simulated one by one, then phases, then the whole motion.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from svkc.model.chain import Chain, State, Structure
from svkc.model.tables import Table, as_text
from svkc.optimize.feedback import growth
from svkc.optimize.guesses import PhaseMotion
from svkc.optimize.plans import Plan, control_of, plan_of
from svkc.optimize.points import full_configuration, full_state, full_velocity, padded, states_of
from svkc.optimize.replay import Distance, ReplayReport, distance, replay_report
from svkc.simulation.simulate import simulate
from svkc.transitions.placement import place_at_current_pose
from svkc.tree.kinematics import kinematics

# tolerances of the simulations, far below the defects that matter
TOLERANCES: dict[str, Any] = {"rtol": 1e-8, "atol": 1e-10}
# lanes simulated in one batch; a batch takes as many steps as its slowest lane
_BATCH = 16


@dataclasses.dataclass(frozen=True)
class SolutionReport:
    """How far a solution is from a motion of the chain.

    Each interval is simulated with error control, from its first node and with its planned torques.
    The defect of an interval is the distance of the simulated end from the next node.

    position, velocity: of each phase, the defect of each interval, as the largest over the
        coordinates (rad, m; rad/s, m/s).
    names: names of the phases.
    worst: of each phase, the name of the coordinate with the largest defect in velocity.
    failed: number of intervals and phases whose simulation did not reach its end.
    open_loop: of each phase, the distance of its end from the plan, if the phase is simulated from
        its first node with the planned torques alone. None: without replay.
    growth: of each phase, the largest factor by which it multiplies a small error without feedback.
        Errors are measured in the problem's units. None: without replay.
    replay: closed-loop replay: the whole motion simulated with feedback. None: without replay.
    """

    position: tuple[np.ndarray, ...]
    velocity: tuple[np.ndarray, ...]
    names: tuple[str, ...]
    worst: tuple[str, ...]
    failed: int
    open_loop: tuple[Distance, ...] | None = None
    growth: np.ndarray | None = None
    replay: ReplayReport | None = None

    def largest(self) -> tuple[float, float]:
        """Return the largest defects in position and in velocity over all intervals."""
        position, velocity = (
            float(max(np.max(x) for x in of)) for of in (self.position, self.velocity)
        )
        return position, velocity

    def __str__(self) -> str:
        header = ("phase", "position\n(rad, m)", "velocity\n(rad/s, m/s)", "interval", "worst of")
        rows = [
            (name, f"{np.max(q):.2e}", f"{np.max(v):.2e}", str(int(np.argmax(v))), worst)
            for name, q, v, worst in zip(
                self.names, self.position, self.velocity, self.worst, strict=True
            )
        ]
        failed = [f"{self.failed} intervals or phases could not be simulated"] * (self.failed > 0)
        blocks = ["largest defects of the intervals", Table(header, rows), *failed]
        return as_text([*blocks, *self._replayed()])

    def _replayed(self) -> list[Any]:
        """Return the parts of the text on the replay, none without replay."""
        if self.replay is None or self.open_loop is None or self.growth is None:
            return []
        header = (
            "phase", "growth of\nan error", "open loop:\nend (rad, m)", "worst of",
            "feedback:\n(rad, m)", "feedback:\n(rad/s, m/s)", "worst of",
        )  # fmt: skip
        rows = [
            (name, f"{factor:.3g}", f"{alone.position:.2e}", alone.worst,
             f"{near.position:.2e}", f"{near.velocity:.2e}", near.worst)
            for name, factor, alone, near in zip(
                self.names, self.growth, self.open_loop, self.replay.phases, strict=True
            )
        ]  # fmt: skip
        return ["largest distances from the plan", Table(header, rows), str(self.replay)]


def _lanes(problem: Any, structures: Sequence[Structure], motion: tuple[PhaseMotion, ...]) -> tuple:
    """Return the simulations of all intervals, and those of all phases.

    Each is a tuple with a leading axis over lanes: first state, start time, end time, planned (q,
    v) at the end, and the first and the last interval of the plan.
    """
    chain, parts, wholes, k, start = problem.chain, [], [], 0, 0.0
    places = [(m.q[:-1], m.v[:-1]) for m in motion]
    of_phases = states_of(chain, structures, places, at_own_place)
    for m, states in zip(motion, of_phases, strict=True):
        n, times = len(m.vdot), start + m.times
        parts.append((states, times[:-1], times[1:], (m.q[1:], m.v[1:]), *[k + np.arange(n)] * 2))
        first = jax.tree.map(lambda x: x[:1], states)
        ends, last = (m.q[-1:], m.v[-1:]), np.array([k + n - 1])
        wholes.append((first, times[:1], times[-1:], ends, np.array([k]), last))
        k, start = k + n, start + m.duration
    join = lambda parts: jax.tree.map(lambda *x: np.concatenate(x), *parts)
    return join(parts), join(wholes)


def at_own_place(
    chain: Chain, structure: Structure, q: Float[Array, " nq"], v: Float[Array, " nv"]
) -> State:
    """Return the state at q and v, with links placed at the bodies' current poses.

    A simulation from a node whose loops have drifted then starts with closed loops.
    """
    full = full_configuration(chain, q)
    if not chain.link_names:
        return State(full, full_velocity(chain, v), structure)
    kin = kinematics(chain, full)
    placed = place_at_current_pose(chain, structure, full, structure.connected, kin)
    return full_state(eqx.tree_at(lambda c: c.structure, chain, placed), placed, q, v)


def _distances(chain: Chain, plan: Plan, lanes: tuple, control: Any) -> tuple:
    """Return the distances [lanes nv] in q and v from planned ends, and the runs' result codes."""
    count, lanes, parts = len(lanes[-1]), padded(lanes, _BATCH), []
    for k in range(0, count, _BATCH):
        own = jax.tree.map(lambda x, k=k: x[k : k + _BATCH], lanes)
        parts.append(_simulate_all(chain, plan, own, control))
    return tuple(np.concatenate(x)[:count] for x in zip(*parts, strict=True))


@eqx.filter_jit
def _simulate_all(chain: Chain, plan: Plan, lanes: tuple, control: Any) -> tuple:
    """Return the result of `_distances` for one batch."""

    def run(state, start, stop, end, first, last):
        own = dataclasses.replace(plan, first=first, last=last)
        traj = simulate(
            chain, state, stop, t0=start, control=control, args=own, throw=False, **TOLERANCES
        )
        return *distance(chain, traj.final, *end), traj.result._value

    return jax.vmap(run)(*lanes)


def report(solution: Any, replay: bool) -> SolutionReport:
    """Return the report that `Solution.report` describes."""
    problem, motion = solution.problem, solution.motion
    chain, names = problem.chain, problem.chain.dof_names
    intervals, phases = _lanes(problem, solution.structures, motion)
    distances = lambda lanes: _distances(
        chain, plan_of(problem, motion), lanes, control_of(problem)
    )
    *errors, results = distances(intervals)
    edges = np.cumsum([len(m.vdot) for m in motion])[:-1]
    of_q, of_v = (np.split(np.abs(x), edges) for x in errors)
    local = SolutionReport(
        position=tuple(np.max(q, 1) for q in of_q),
        velocity=tuple(np.max(v, 1) for v in of_v),
        names=tuple(phase.name for phase in problem.phases),
        worst=tuple(names[int(np.argmax(np.max(v, 0)))] for v in of_v),
        failed=int(np.sum(results != 0)),
    )
    if not replay:
        return local
    *ends, results = distances(phases)
    return dataclasses.replace(
        local,
        failed=local.failed + int(np.sum(results != 0)),
        open_loop=tuple(Distance.of(names, *x) for x in zip(*ends, strict=True)),
        growth=growth(problem, motion, solution.linear_maps()),
        replay=replay_report(solution, TOLERANCES),
    )
