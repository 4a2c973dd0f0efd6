"""The certificate of a run, computed after the run from its records."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from svkc._jax.pytrees import stop_gradient_tree
from svkc.loops.constraint import (
    assemble_loop_jacobian,
    frame_gaps,
    jacobian_scales,
    largest_norms,
    loop_frames,
)
from svkc.loops.pivoting import pivot_ratio, pivoted_qr, rank_tolerance
from svkc.model.chain import Chain, State, Structure, active_dofs
from svkc.model.topology import FREE
from svkc.simulation.records import PhaseRecords, Phases
from svkc.tree.energy import energy_and_momentum
from svkc.tree.kinematics import kinematics


class StateCheck(eqx.Module):
    """Quantities of the certificate at one state: the largest gaps of the loops (rad, m) and their
    rates, and at the ends of phases energy (J), linear momentum (N s), angular momentum about the
    centre of mass (N m s) and rank margin."""

    frame_gaps: Float[Array, "*states 2"]
    gap_rate: Float[Array, "*states 2"]
    energy: Float[Array, "*states"]
    linear: Float[Array, "*states 3"]
    angular: Float[Array, "*states 3"]
    margin: Float[Array, "*states"]


def certificate(
    chain: Chain, records: PhaseRecords, count: Int[Array, ""], saved: State, stages: int
) -> tuple[Phases, StateCheck, Int[Array, ""]]:
    """Return the phases of a run, the checks of its saved states, and the index of the first phase
    whose loops lose rank at an end (past the last: none).

    stages: evaluations of the vector field in one try of a step.
    """
    rows = records.start.shape[0]
    first, last, saved_checks = _check_states(chain, records, saved)
    written = jnp.arange(rows, dtype=jnp.int32) < count
    margin = stop_gradient_tree(jnp.minimum(first.margin, last.margin))
    lost = written & (margin < rank_tolerance(margin.dtype))
    lost_at = jnp.where(jnp.any(lost), jnp.argmax(lost).astype(jnp.int32), rows)
    phases = _phases(chain, records, count, (first, last), stages)
    return phases, saved_checks, lost_at


def _check_states(
    chain: Chain, records: PhaseRecords, saved: State
) -> tuple[StateCheck, StateCheck, StateCheck]:
    """Return the checks of the states at the starts of phases, at their ends, and of the saved
    ones. One loop checks them all, so that kinematics and energy are compiled once."""
    r, rows, join = records, records.start.shape[0], lambda *x: jnp.concatenate(x)
    states = State(
        join(r.q[:, 0], r.q[:, 1], saved.q),
        join(r.v[:, 0], r.v[:, 1], saved.v),
        jax.tree.map(join, r.structure, r.structure, saved.structure),
    )
    at_end = np.arange(states.q.shape[0]) < 2 * rows
    checks = jax.lax.map(
        jax.checkpoint(lambda x: _check_state(chain, *x)), (states, jnp.asarray(at_end))
    )
    parts = slice(rows), slice(rows, 2 * rows), slice(2 * rows, None)
    return tuple(jax.tree.map(lambda x, part=part: x[part], checks) for part in parts)


def _phases(
    chain: Chain,
    records: PhaseRecords,
    count: Int[Array, ""],
    both: tuple[StateCheck, StateCheck],
    stages: int,
) -> Phases:
    """Return the phases of a run. both: the checks at their starts and at their ends."""
    r, (first, last) = records, both
    written = jnp.arange(r.start.shape[0], dtype=jnp.int32) < count
    fill = lambda value, none: jnp.where(
        written.reshape(-1, *(1,) * (jnp.ndim(value) - 1)), value, none
    )
    free, joint_freedoms = jax.vmap(
        lambda s: (_free(chain, s), jnp.sum(active_dofs(chain, s), dtype=jnp.int32))
    )(r.structure)
    # no derivative is promised of the certificate's worst values
    margin, gap, gap_rate, drift = stop_gradient_tree(
        (
            jnp.minimum(first.margin, last.margin),
            jnp.maximum(first.gap, last.gap),
            jnp.maximum(first.gap_rate, last.gap_rate),
            _momentum_drift(chain, first, last, fill(r.stop - r.start, 0)),
        )
    )
    return Phases(
        start=r.start,
        stop=r.stop,
        connected=fill(r.structure.connected, False),
        rank=fill(r.structure.rank, -1),
        joint_freedoms=fill(joint_freedoms, -1),
        energy=fill(jnp.stack([first.energy, last.energy], 1), 0),
        work=r.work,
        margin=fill(jnp.minimum(margin, r.stats.margin), 1),
        accepted=r.accepted,
        rejected=r.rejected,
        evaluations=stages * r.stats.attempts,
        swaps=r.stats.swaps,
        loop=r.stats.loop,
        error=r.stats.error,
        gap=fill(jnp.maximum(gap, r.stats.gap), 0),
        gap_rate=fill(gap_rate, 0),
        free=fill(free, False),
        momentum_drift=jnp.where((written & free)[:, None], drift, 0),
        count=count,
    )


def _check_state(chain: Chain, state: State, at_end: Bool[Array, ""]) -> StateCheck:
    """Check one state. at_end: whether it is at an end of a phase; elsewhere energy, momenta and
    margin are left out."""
    kin, dtype, looped = kinematics(chain, state.q), state.q.dtype, bool(chain.link_names)
    gaps = rates = jnp.zeros(2, dtype)
    J = jnp.zeros((0, chain.dofs), dtype)
    if looped:
        end = loop_frames(chain, state.structure, kin, state.q)
        J = assemble_loop_jacobian(chain, state.structure, kin, end)
        gaps, rates = (
            largest_norms(frame_gaps(state.structure, end)),
            largest_norms((J @ state.v).reshape(-1, 6)),
        )

    def whole():
        energy, *momenta = energy_and_momentum(chain, state, kin)
        row, column = jacobian_scales(chain)
        margin = (
            pivot_ratio(
                pivoted_qr(
                    stop_gradient_tree(row[:, None] * J * column[None]), state.structure.rank
                )
            )
            if looped
            else jnp.ones((), dtype)
        )
        return energy, *stop_gradient_tree(tuple(momenta)), margin

    none = jnp.zeros((), dtype), jnp.zeros(3, dtype), jnp.zeros(3, dtype), jnp.ones((), dtype)
    energy, linear, angular, margin = jax.lax.cond(at_end, whole, lambda: none)
    return StateCheck(
        gap=gaps, gap_rate=rates, energy=energy, linear=linear, angular=angular, margin=margin
    )


def _free(chain: Chain, s: Structure) -> Bool[Array, ""]:
    """Whether nothing holds the bodies to the ground: every tree hangs on it by a free joint, and
    no loop does."""
    top = chain.topology
    roots = [i for i in range(1, len(top.parent)) if top.parent[i] == 0]
    if not roots or any(top.kind[i] != FREE for i in roots):
        return jnp.zeros((), bool)
    return ~jnp.any(s.connected & ((s.parent == 0) | (s.real == 0)))


def _momentum_drift(
    chain: Chain, first: StateCheck, last: StateCheck, span: Float[Array, " phases"]
) -> Float[Array, "phases 2"]:
    """Change of linear momentum (N s) that gravity does not explain, and of the angular momentum
    about the centre of mass (N m s)."""
    fallen = jnp.sum(chain.mass) * chain.gravity[None] * span[:, None]
    size = lambda x: jnp.linalg.norm(x, axis=-1)
    return jnp.stack(
        [size(last.linear - first.linear - fallen), size(last.angular - first.angular)], 1
    )


def evaluations_per_step(solver: diffrax.AbstractSolver) -> int:
    """Evaluations of the vector field in one try of a step; Newton iterations of implicit stages
    are not counted."""
    tableau = getattr(solver, "tableau", None)
    return len(np.asarray(tableau.b_sol)) if isinstance(tableau, diffrax.ButcherTableau) else 1
