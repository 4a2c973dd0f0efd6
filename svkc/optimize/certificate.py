"""The certificate of a solution: every interval simulated from its own first node."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from svkc.model.chain import Chain, State, Structure
from svkc.model.tables import Table, as_text
from svkc.optimize.guesses import PhaseMotion
from svkc.optimize.points import full_state, tree_configuration, tree_velocity
from svkc.simulation.simulate import simulate
from svkc.transitions.placement import place_at_current_pose
from svkc.tree.configuration import difference
from svkc.tree.kinematics import kinematics

# tolerances of the simulations, far below the defects that matter
_RTOL, _ATOL = 1e-8, 1e-10


@dataclasses.dataclass(frozen=True)
class SolutionReport:
    """How far a solution is a motion.

    Each interval is simulated with error control from its own first node, with its own torques. A
    defect is how far the end is from the next node of the solution.

    position, velocity: of each phase, [intervals] largest defects over the coordinates (rad, m;
        rad/s, m/s).
    names: of the phases. worst: of each phase, the coordinate of the largest defect in velocity.
    failed: number of intervals whose simulation did not reach its end.
    """

    position: tuple[np.ndarray, ...]
    velocity: tuple[np.ndarray, ...]
    names: tuple[str, ...]
    worst: tuple[str, ...]
    failed: int

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
        failed = [f"{self.failed} intervals could not be simulated"] * (self.failed > 0)
        return as_text(["largest defects of the intervals", Table(header, rows), *failed])


class _Torques(eqx.Module):
    """The torques of one interval as a control of `simulate`.

    blocks: of the interval. start, step: its start and its length (s).
    """

    blocks: Any
    start: Any
    step: Any


def _control(controls: Any, chain: Chain, table: np.ndarray, args: Any):
    """Return the control (t, state, torques) -> tau of one interval.

    table: [powers blocks_of_stage blocks] coefficients of the blocks by the fraction's powers.
    """

    def control(t, state, own: _Torques):
        blocks = blocks_at(table, own.step, (t - own.start) / own.step, own.blocks)
        return controls.torques(chain, t, state, blocks, args)

    return control


def blocks_at(table: np.ndarray, step: Any, fraction: Any, blocks: Any) -> Any:
    """Return the blocks of a stage at a fraction of an interval, from the interval's blocks."""
    powers = fraction ** np.arange(table.shape[1])
    D = jnp.tensordot(powers, table[0], 1) + step * jnp.tensordot(powers, table[1], 1)
    return D @ blocks


def control_table(controls: Any, scheme: Any) -> np.ndarray:
    """Return D0 and D1 of `AbstractControls.coefficients` as polynomials of the fraction."""
    fractions = np.linspace(0, 1, scheme.stages + 1)
    inverse = np.linalg.inv(fractions[:, None] ** np.arange(len(fractions)))
    return np.stack([np.tensordot(inverse, D, 1) for D in controls.coefficients(scheme, fractions)])


def _lanes(problem: Any, structures: Sequence[Structure], motion: tuple[PhaseMotion, ...]) -> tuple:
    """Return first states, ends (q, v) and torques of all intervals."""
    chain, starts, parts = problem.chain, 0.0, []
    for m, structure in zip(motion, structures, strict=True):
        n, h = len(m.vdot), m.duration / len(m.vdot)
        states = jax.vmap(lambda q, v, s=structure: _at_own_place(chain, s, q, v))(
            jnp.asarray(m.q[:-1]), jnp.asarray(m.v[:-1])
        )
        own = _Torques(m.blocks, start=starts + h * np.arange(n), step=np.full(n, h))
        parts.append((states, (m.q[1:], m.v[1:]), own))
        starts = starts + m.duration
    return jax.tree.map(lambda *x: jnp.concatenate(x), *parts)


def _at_own_place(chain: Chain, structure: Structure, q, v) -> State:
    """Return a state whose links are where its bodies are, so that drift of the loops is none."""
    full = tree_configuration(chain, q)
    if not chain.link_names:
        return State(full, tree_velocity(chain, v), structure)
    kin = kinematics(chain, full)
    placed = place_at_current_pose(chain, structure, full, structure.connected, kin)
    return full_state(eqx.tree_at(lambda c: c.structure, chain, placed), placed, q, v)


@eqx.filter_jit
def _simulate_all(chain: Chain, states: State, ends, torques: _Torques, control) -> tuple:
    """Return defects in q and v of all lanes, and which runs reached their end."""

    def run(state, end, own):
        traj = simulate(
            chain, state, own.start + own.step, t0=own.start, control=control, args=own,
            rtol=_RTOL, atol=_ATOL, throw=False,
        )  # fmt: skip
        last = tree_configuration(chain, end[0])
        reached = tree_configuration(chain, traj.final.q[: chain.nq])
        of_q = difference(chain, reached, last)[: chain.nv]
        return of_q, traj.final.v[: chain.nv] - end[1], traj.result._value

    return jax.vmap(run)(states, ends, torques)


def report(problem: Any, structures: Sequence[Structure], motion) -> SolutionReport:
    """Return the certificate of a motion."""
    chain = problem.chain
    table = control_table(problem.controls, problem.scheme)
    control = _control(problem.controls, chain, table, problem.args)
    states, ends, torques = _lanes(problem, structures, motion)
    of_q, of_v, results = (
        np.asarray(x) for x in _simulate_all(chain, states, ends, torques, control)
    )
    edges = np.cumsum([len(m.vdot) for m in motion])[:-1]
    split = lambda x: tuple(np.split(np.abs(x), edges))
    worst = [chain.dof_names[int(np.argmax(np.max(v, 0)))] for v in split(of_v)]
    return SolutionReport(
        position=tuple(np.max(q, 1) for q in split(of_q)),
        velocity=tuple(np.max(v, 1) for v in split(of_v)),
        names=tuple(phase.name for phase in problem.phases),
        worst=tuple(worst),
        failed=int(np.sum(results != 0)),
    )
