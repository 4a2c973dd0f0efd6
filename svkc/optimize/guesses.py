"""Guesses: motions from which a solver starts."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc._jax.eager import eager_jit
from svkc.model.chain import Chain, State
from svkc.model.validation import finite_array
from svkc.optimize.controls import AbstractControls
from svkc.optimize.equations import equations_of_motion
from svkc.optimize.loop_rows import LinkRows
from svkc.optimize.phases import Phase
from svkc.optimize.points import full_configuration, full_velocity
from svkc.optimize.schemes import Radau
from svkc.optimize.structures import candidate_rows, gaps_and_jacobian, links_here
from svkc.transitions.initial_state import full_vector
from svkc.tree.configuration import difference, integrate

# largest number of Newton steps that close the loops of a pose, and the longest step (rad, m)
_STEPS, _LARGEST_STEP = 30, 0.3
# gaps (m, rad) at which the steps end, and above which the pose is left as the user gave it
_CLOSED, _NEARLY_CLOSED = 1e-12, 1e-6


class PhaseMotion(eqx.Module):
    """The motion of one phase on a mesh of n intervals with s stages.

    duration: s.
    q: [n + 1 nq], v: [n + 1 nv] of the tree, at the nodes.
    states: [n + 1 control] states of the controls at the nodes; empty where controls have none.
    blocks: [n blocks control] control blocks of the intervals, see `AbstractControls`.
    vdot: [n s nv] accelerations of the tree at the stages.
    forces: [n s 6 links] multipliers of the links' rows at the stages (N m, N).
    impulse: [6 links] multipliers of the links' rows in the impact at the start (N m s, N s).
    mesh: [n + 1] positions of the nodes, as fractions of the duration; None: equal intervals.
    """

    duration: Any
    q: Any
    v: Any
    states: Any
    blocks: Any
    vdot: Any
    forces: Any
    impulse: Any
    mesh: Any = None

    @property
    def times(self) -> np.ndarray:
        """Times [n + 1] of the nodes from the start of the phase (s)."""
        mesh = np.linspace(0, 1, len(self.q)) if self.mesh is None else np.asarray(self.mesh)
        return self.duration * mesh


@dataclasses.dataclass
class Guess:
    """A motion from which a solver starts.

    phases: motion of each phase.
    noise: unknowns are moved at random by at most this fraction of the range between their bounds.
    key: seed of the random numbers.
    free: values of free args by name.
    """

    phases: list[PhaseMotion]
    noise: float = 0.0
    key: int = 0
    free: dict[str, Any] = dataclasses.field(default_factory=dict)


class PoseLine:
    """Straight lines between the known poses at the boundaries of phases.

    poses: as of `Problem.guess`.
    Raises ValueError for another number of poses, or if the first or the last one is None.
    """

    def __init__(self, chain: Chain, phases: Sequence[Phase], poses: Sequence[Any]):
        if len(poses) != len(phases) + 1:
            raise ValueError(
                f"guess: got {len(poses)} poses, expected {len(phases) + 1}: at the start of each"
                " phase, and at the end; None where a pose is not known"
            )
        if poses[0] is None or poses[-1] is None:
            raise ValueError("guess: the first and the last pose must be known")
        self.chain = chain
        self.phases = phases
        self.here = links_here(chain, phases)
        self.poses: list[np.ndarray | None] = [
            None if p is None else self._closed(i, p) for i, p in enumerate(poses)
        ]

    def _closed(self, i: int, pose: Any) -> np.ndarray:
        """Return the pose at boundary i as q [nq], with the loops of both phases closed."""
        chain = self.chain
        if isinstance(pose, State):
            pose = pose.q[: chain.nq]
        start = jnp.asarray(chain.q_load)
        pose = finite_array(f"pose {i}", pose) if not isinstance(pose, dict) else pose
        q = np.asarray(full_vector(chain, "q", pose, start)[0])[: chain.nq]
        closed = np.zeros(len(chain.link_names), bool)
        for phase, here in list(zip(self.phases, self.here))[max(i - 1, 0) : i + 1]:
            closed |= np.isin(chain.link_names, phase.connected) & ~here
        rows = candidate_rows(chain, closed)
        return close_loops(chain, q, rows) if len(rows) else q

    def at(self, durations: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return (q [n + 1 nq], v [n + 1 nv]) of each phase at its nodes.

        durations: of the phases (s).
        """
        ends = np.concatenate([[0], np.cumsum(durations)])
        known = [i for i, pose in enumerate(self.poses) if pose is not None]
        out = []
        for k, phase in enumerate(self.phases):
            first = max(i for i in known if i <= k)
            last = min(i for i in known if i > k)
            span = ends[last] - ends[first]
            times = (ends[k] + durations[k] * phase.node_fractions - ends[first]) / span
            out.append(self._line(self.poses[first], self.poses[last], times, span))
        return out

    def _line(
        self, start, end, fractions: np.ndarray, span: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return q and v at fractions of the line between two poses, which takes `span` seconds."""
        chain = self.chain
        start, end = (full_configuration(chain, jnp.asarray(x)) for x in (start, end))
        step = difference(chain, start, end)
        q = jax.vmap(lambda x: integrate(chain, start, x * step))(jnp.asarray(fractions))
        v = np.broadcast_to(np.asarray(step)[: chain.nv] / span, (len(fractions), chain.nv))
        return np.asarray(q)[:, : chain.nq], v.copy()


def close_loops(chain: Chain, q: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return q [nq] of the tree, moved by Newton steps of least norm until the gaps are closed.

    The result is the given q if the gaps cannot be closed. rows: of links, as of `LinkRows`.
    """
    table = LinkRows.of(chain, rows)

    moved, gaps = jnp.asarray(q), np.zeros(0)
    for _ in range(_STEPS):
        gaps, J = (np.asarray(x) for x in gaps_and_jacobian(chain, moved, table))
        if np.max(np.abs(gaps)) < _CLOSED:
            break
        step = np.linalg.lstsq(J, -gaps, rcond=1e-6)[0]
        step = step / max(1.0, np.max(np.abs(step)) / _LARGEST_STEP)
        full = full_velocity(chain, jnp.asarray(step))
        moved = integrate(chain, full_configuration(chain, moved), full)[: chain.nq]
    return np.asarray(moved) if np.max(np.abs(gaps)) < _NEARLY_CLOSED else q


@functools.partial(eager_jit, jit=eqx.filter_jit)
def _balance(chain: Chain, table: LinkRows, q: Float[Array, "nodes nq"]) -> tuple[Array, Array]:
    """Return, at each node, the generalized forces [nv] of the weight, and the links' Jacobian."""
    zero, tau, f = jnp.zeros(chain.nv), jnp.zeros(chain.dofs), jnp.zeros(len(table))

    def at_node(q):
        weight = equations_of_motion(chain, table, q, zero, zero, tau=tau, f=f)[0]
        return weight, gaps_and_jacobian(chain, q, table)[1]

    return jax.vmap(at_node)(q)


def static_forces(
    chain: Chain, connected: Sequence[str], driven: np.ndarray, q: np.ndarray
) -> np.ndarray:
    """Return multipliers [nodes 6 links] of connected links that carry the weight at rest.

    They balance the equations of motion of the coordinates that no motor drives, in the sense of
    least squares with least norm.

    driven: mask [nv] of the coordinates that a motor drives. q: [nodes nq].
    """
    out = np.zeros((len(q), 6 * len(chain.link_names)))
    rows = candidate_rows(chain, np.isin(chain.link_names, connected))
    if not len(rows):
        return out
    balance = _balance(chain, LinkRows.of(chain, rows), jnp.asarray(q))
    weight, J = (np.asarray(x) for x in balance)
    for i in range(len(q)):
        out[i, rows] = np.linalg.lstsq(J[i][:, ~driven].T, weight[i][~driven], rcond=1e-6)[0]
    return out


def motion_without_torques(
    chain: Chain,
    controls: AbstractControls,
    scheme: Radau,
    phase: Phase,
    duration: float,
    line: tuple[np.ndarray, np.ndarray],
) -> PhaseMotion:
    """Return the motion of a phase along a line, with zero torques and zero accelerations.

    Multipliers of links are those of `static_forces`.

    duration: s. line: (q [n + 1 nq], v [n + 1 nv]) of the tree at the nodes.
    """
    n, s, control = phase.intervals, scheme.stages, controls.count(chain)
    q, v = line
    forces = static_forces(chain, phase.connected, controls.driven(chain), q)
    return PhaseMotion(
        duration=float(duration),
        q=q,
        v=v,
        states=np.zeros((n + 1, control * controls.has_state)),
        blocks=np.zeros((n, controls.blocks(scheme), control)),
        vdot=np.zeros((n, s, chain.nv)),
        forces=np.repeat(forces[:-1, None], s, 1),
        impulse=np.zeros(6 * len(chain.link_names)),
        mesh=phase.node_fractions,
    )
