"""The certificate of a run: loop gaps, energy, momentum and rank margins of its records.

These are computed after the run, from the states that it recorded.
"""

import dataclasses
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from svkc._jax.control_flow import unvmap_any
from svkc._jax.one_kernel import one_kernel
from svkc._jax.pytrees import stop_gradient_tree
from svkc._jax.select import where
from svkc.loops.constraint import assemble_loop_jacobian, jacobian_scales, largest_norms
from svkc.loops.frames import frame_gaps, loop_frames
from svkc.loops.pivoting import pivot_ratio, pivoted_qr, rank_tolerance
from svkc.model.annotations import DType
from svkc.model.chain import Chain, State, Structure, active_dofs
from svkc.model.topology import FREE
from svkc.simulation.records import PhaseRecords, Phases
from svkc.tree.energy import body_motions, energy_and_momentum, kinetic_of_bodies
from svkc.tree.kinematics import kinematics


class StateCheck(eqx.Module):
    """Quantities of the certificate at one state.

    gap, gap_rate: largest gaps of the loops (rad, m) and their rates (rad/s, m/s).
    kinetic: kinetic energy (J), not differentiated.
    energy: mechanical energy (J).
    linear, angular: linear momentum (N s), and angular momentum about the centre of mass (N m s).
    margin: rank margin |R_mm| / |R_11| (R of the loop Jacobian's pivoted QR, m its rank).

    Energy, momenta and margin are computed at the two ends of phases only; elsewhere they are zero,
    and the margin is one.
    """

    gap: Float[Array, "*states 2"]
    gap_rate: Float[Array, "*states 2"]
    kinetic: Float[Array, "*states"]
    energy: Float[Array, "*states"]
    linear: Float[Array, "*states 3"]
    angular: Float[Array, "*states 3"]
    margin: Float[Array, "*states"]

    @classmethod
    def unchecked(cls, dtype: DType) -> "StateCheck":
        """Return the values for a state that is not checked: zeros, and a margin of one."""
        zero, zeros = jnp.zeros((), dtype), lambda n: jnp.zeros(n, dtype)
        return cls(zeros(2), zeros(2), zero, zero, zeros(3), zeros(3), margin=jnp.ones((), dtype))


def certificate(
    chain: Chain,
    records: PhaseRecords,
    count: Int[Array, ""],
    saved: tuple[Float[Array, " times"], State],
    stages: int,
) -> tuple[Phases, StateCheck, Int[Array, ""]]:
    """Return the phases of a run, the checks of its saved states, and where loops first lose rank.

    The last is the index of the first phase whose loops lose rank at one of its two ends. It is the
    number of rows if no phase does.

    count: number of phases.
    saved: the save times, and the states at these times.
    stages: evaluations of the vector field in one attempted step.
    """
    rows = records.start.shape[0]
    ts, saved_states = saved
    written = jnp.arange(rows, dtype=jnp.int32) < count
    first, last, saved_checks = _check_states(chain, records, written, saved_states)
    margin = stop_gradient_tree(jnp.minimum(first.margin, last.margin))
    lost = written & (margin < rank_tolerance(margin.dtype))
    lost_at = where(jnp.any(lost), jnp.argmax(lost).astype(jnp.int32), rows)
    at_ends = jnp.maximum(first.kinetic, last.kinetic)
    within = (ts[None] >= records.start[:, None]) & (ts[None] <= records.stop[:, None])
    at_saves = jnp.max(where(within, saved_checks.kinetic[None], 0), 1, initial=0)
    kinetic = where(written, jnp.maximum(at_ends, at_saves), 0)
    phases = _phases(chain, records, count, (first, last), stages)
    phases = dataclasses.replace(phases, kinetic_energy=kinetic)
    return phases, saved_checks, lost_at


def _check_states(
    chain: Chain, records: PhaseRecords, written: Bool[Array, " phases"], saved: State
) -> tuple[StateCheck, StateCheck, StateCheck]:
    """Return the checks of the states at starts of phases, at ends of phases, and at save times.

    One loop checks all states, so that kinematics and energy are compiled once. It skips rows of
    phases that no lane has written.
    """
    r, rows, join = records, records.start.shape[0], lambda *x: jnp.concatenate(x)
    states = State(
        join(r.q[:, 0], r.q[:, 1], saved.q),
        join(r.v[:, 0], r.v[:, 1], saved.v),
        jax.tree.map(join, r.structure, r.structure, saved.structure),
    )
    is_phase_end = np.arange(states.q.shape[0]) < 2 * rows
    needed = join(written, written, jnp.ones(saved.q.shape[0], bool))
    dtype = states.q.dtype

    def check(x):
        state, is_phase_end, is_needed = x
        return jax.lax.cond(
            unvmap_any(is_needed),
            lambda: _check_state(chain, state, is_phase_end),
            lambda: StateCheck.unchecked(dtype),
        )

    checks = jax.lax.map(check, (states, jnp.asarray(is_phase_end), needed))
    parts = slice(rows), slice(rows, 2 * rows), slice(2 * rows, None)
    return tuple(jax.tree.map(lambda x, part=part: x[part], checks) for part in parts)


def _phases(
    chain: Chain,
    records: PhaseRecords,
    count: Int[Array, ""],
    checks: tuple[StateCheck, StateCheck],
    stages: int,
) -> Phases:
    """Return the phases of a run.

    checks: of the states at the starts and at the ends of the phases.
    """
    r, (first, last) = records, checks
    written = jnp.arange(r.start.shape[0], dtype=jnp.int32) < count
    fill = lambda value, none: where(
        written.reshape(-1, *(1,) * (jnp.ndim(value) - 1)), value, none
    )
    free, joint_freedoms = jax.vmap(
        lambda s: (_is_free(chain, s), jnp.sum(active_dofs(chain, s), dtype=jnp.int32))
    )(r.structure)
    # These values of the certificate are not differentiated.
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
        reduced_steps=r.stats.reduced_steps,
        loop=r.stats.loop,
        error=r.stats.error,
        gap=fill(jnp.maximum(gap, r.stats.gap), 0),
        gap_rate=fill(gap_rate, 0),
        free=fill(free, False),
        momentum_drift=where((written & free)[:, None], drift, 0),
        count=count,
    )


@one_kernel
@eqx.filter_checkpoint
def _check_state(chain: Chain, state: State, is_phase_end: Bool[Array, ""]) -> StateCheck:
    """Return the check of one state.

    is_phase_end: whether a phase starts or ends at the state. Only then are energy, momenta and
        margin computed.
    """
    kin, dtype, has_links = kinematics(chain, state.q), state.q.dtype, bool(chain.link_names)
    gaps = rates = jnp.zeros(2, dtype)
    J = jnp.zeros((0, chain.dofs), dtype)
    if has_links:
        end = loop_frames(chain, state.structure, kin, state.q)
        J = assemble_loop_jacobian(chain, state.structure, kin, end)
        gaps, rates = (
            largest_norms(frame_gaps(state.structure, end)),
            largest_norms((J @ state.v).reshape(-1, 6)),
        )

    bodies = body_motions(chain, kin, state.v)

    def at_phase_end():
        energy, *momenta = energy_and_momentum(chain, state, kin, bodies)
        row, column = jacobian_scales(chain)
        margin = (
            pivot_ratio(
                pivoted_qr(
                    stop_gradient_tree(row[:, None] * J * column[None]), state.structure.rank
                )
            )
            if has_links
            else jnp.ones((), dtype)
        )
        return energy, *stop_gradient_tree(tuple(momenta)), margin

    none = jnp.zeros((), dtype), jnp.zeros(3, dtype), jnp.zeros(3, dtype), jnp.ones((), dtype)
    energy, linear, angular, margin = jax.lax.cond(is_phase_end, at_phase_end, lambda: none)
    return StateCheck(
        gap=gaps,
        gap_rate=rates,
        kinetic=stop_gradient_tree(kinetic_of_bodies(chain, state.v, bodies)),
        energy=energy,
        linear=linear,
        angular=angular,
        margin=margin,
    )


def _is_free(chain: Chain, s: Structure) -> Bool[Array, ""]:
    """Return whether the bodies are free of the ground.

    They are if every tree has a free joint at its root that is not locked, and no connected virtual
    link joins the ground.
    """
    top = chain.topology
    roots = [i for i in range(1, len(top.parent)) if top.parent[i] == 0]
    if not roots or any(top.kind[i] != FREE for i in roots):
        return jnp.zeros((), bool)
    held = jnp.any(s.connected & ((s.parent == 0) | (s.real == 0)))
    if s.locked is not None:
        at_roots = np.concatenate([top.v_start[i] + np.arange(6) for i in roots])
        held = held | jnp.any(s.locked[at_roots])
    return ~held


def _momentum_drift(
    chain: Chain, first: StateCheck, last: StateCheck, span: Float[Array, " phases"]
) -> Float[Array, "phases 2"]:
    """Return the norms of the linear and of the angular momentum drift of each phase.

    The linear drift (N s) is the change of momentum less the impulse of gravity. The angular drift
    (N m s) is the change of angular momentum about the centre of mass.

    span: durations of the phases (s).
    """
    gravity_impulse = jnp.sum(chain.mass) * chain.gravity[None] * span[:, None]
    norm = lambda x: jnp.linalg.norm(x, axis=-1)
    linear = norm(last.linear - first.linear - gravity_impulse)
    return jnp.stack([linear, norm(last.angular - first.angular)], 1)


def evaluations_per_step(solver: diffrax.AbstractSolver[Any]) -> int:
    """Return the number of evaluations of the vector field in one attempted step.

    Newton iterations of implicit stages are not counted.
    """
    if isinstance(solver, diffrax.HalfSolver):
        return 3 * evaluations_per_step(solver.solver)
    tableau = getattr(solver, "tableau", None)
    return len(np.asarray(tableau.b_sol)) if isinstance(tableau, diffrax.ButcherTableau) else 1
