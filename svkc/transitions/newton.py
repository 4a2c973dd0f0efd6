"""Newton's method for a change of structure: closes the loops, decides their rank, and projects the
velocity, with or without an impact (paper, section V-C).

One loop with one body runs every kind of iteration of a `Schedule` (`newton_state.py`), so that
kinematics, loop Jacobian and pivoting are compiled once.
"""

import dataclasses
import functools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc._jax.control_flow import unvmap_any
from svkc._jax.one_kernel import one_kernel
from svkc._jax.primitive import custom_primitive
from svkc._jax.pytrees import tree_where
from svkc._jax.select import where
from svkc.loops.constraint import jacobian_scales, loop_kinematics
from svkc.loops.pivoting import (
    PivotedQR,
    drop_below,
    pivoted_qr,
    rank_tolerance,
    release_threshold,
)
from svkc.loops.projection import least_norm_change
from svkc.model.chain import Chain, Structure, active_dofs
from svkc.transitions.impact import velocity_after_impact
from svkc.transitions.newton_state import (
    CLOSE,
    CLOSE_PERTURBED,
    DECIDE_RANK,
    IMPACT,
    PERTURB,
    RANK_SEARCH,
    NewtonState,
    Schedule,
    is_any_of,
)
from svkc.tree.configuration import integrate

# The probe is closed once a Newton step is smaller than this fraction of the rank tolerance.
PROBE_TOLERANCE = 1e-2

_loop_kinematics = one_kernel(loop_kinematics)


class _Iteration(eqx.Module):
    """The body of the loop: one iteration of one of `kinds`.

    kinds: kinds of iterations in the schedule. Parts that none of them needs are not compiled.
    perturbation: the change of q by which the search for the rank starts.
    """

    chain: Chain
    structure: Structure
    perturbation: Float[Array, " dofs"]
    kinds: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, current: NewtonState, kind, rank_known) -> NewtonState:
        """Return the state after one more iteration.

        rank_known: whether the rank of `current` has been decided; if not, all rows are used.
        """
        chain, structure = self.chain, self.structure
        q_eval = current.q
        if DECIDE_RANK in self.kinds:
            q_eval = where(is_any_of(kind, CLOSE_PERTURBED, DECIDE_RANK), current.probe, current.q)
        loops = _loop_kinematics(chain, structure, q_eval)
        J = loops.J
        all_pivots, qr = self._pivots(J, current, kind, rank_known)
        step = -least_norm_change(chain, qr, J, loops.gap[:, None])[:, 0]
        residual_gaps = jnp.max(jnp.abs(loops.gap).reshape(-1, 6), 1)
        if DECIDE_RANK in self.kinds:
            current = current.record_rank_search(kind, all_pivots.diag_R, residual_gaps)
        v, spatial_impulse, energy_lost = current.v, current.spatial_impulse, current.energy_lost
        if IMPACT in self.kinds:
            v, spatial_impulse, energy_lost = jax.lax.cond(
                kind == IMPACT,
                lambda: velocity_after_impact(chain, structure, loops, qr, current.v),
                lambda: (v, spatial_impulse, energy_lost),
            )
        q, probe = self._updated_configuration(q_eval, kind, step), current.probe
        probe_step = current.probe_step
        if DECIDE_RANK in self.kinds:
            in_rank_search = is_any_of(kind, *RANK_SEARCH)
            q, probe = where(in_rank_search, current.q, q), where(in_rank_search, q, probe)
            largest = jnp.max(jnp.abs(step) / jacobian_scales(chain)[1])
            probe_step = where(kind == CLOSE_PERTURBED, largest, jnp.inf)
        return dataclasses.replace(
            current,
            q=q,
            v=v,
            probe=probe,
            probe_step=probe_step,
            spatial_impulse=spatial_impulse,
            energy_lost=energy_lost,
            residual_gaps=residual_gaps,
        )

    def _pivots(self, J, current: NewtonState, kind, rank_known) -> tuple[PivotedQR, PivotedQR]:
        """Return the pivoted QR of J, and this QR without the pivots too small to divide by."""
        independent, max_rank, dtype = None, min(J.shape), J.dtype
        if self.structure.independent is not None and IMPACT in self.kinds:
            independent = self.structure.independent & (kind == IMPACT)
        all_pivots = pivoted_qr(J, where(rank_known, current.rank, max_rank), independent)
        weak_threshold = where(rank_known, release_threshold(dtype) * current.margin, 0)
        # along rows with weaker pivots a gap is of second order in the change of q, and dividing by
        # these pivots amplifies round-off; an impact does not solve for gaps
        threshold = where(
            kind == IMPACT, weak_threshold, jnp.maximum(rank_tolerance(dtype), weak_threshold)
        )
        return all_pivots, drop_below(all_pivots, threshold)

    def _updated_configuration(self, q, kind, step) -> Float[Array, " q"]:
        """Return q moved by the Newton step or by the perturbation, as the kind says; for other
        kinds return q."""
        delta = where(is_any_of(kind, CLOSE, CLOSE_PERTURBED), step, 0)
        return integrate(self.chain, q, where(kind == PERTURB, self.perturbation, delta))


def rank_search_perturbation(chain: Chain, structure: Structure) -> Float[Array, " dofs"]:
    """Return the change of q by which the search for the rank starts.

    The change has a fixed direction without symmetry, as q itself may be singular.
    """
    change = 0.05 * np.sin(1.0 + 2.3 * np.arange(chain.dofs)) * jacobian_scales(chain)[1]
    return where(active_dofs(chain, structure), change, 0).astype(chain.q_load.dtype)


def _start(
    chain: Chain, structure: Structure, q, v, kinds: tuple[int, ...]
) -> tuple[_Iteration, NewtonState]:
    """Return the body of the loop over `kinds`, and the state before it."""
    unlocked = dataclasses.replace(structure, locked=None)
    # locked joints have a velocity before the impact that stops them
    v = where(active_dofs(chain, unlocked), v, 0)
    perturbation = rank_search_perturbation(chain, structure)
    iteration = _Iteration(chain, structure, perturbation=perturbation, kinds=kinds)
    return iteration, NewtonState.init(chain, structure, q, v)


def _iterate(
    chain: Chain, structure: Structure, q, v, kinds: tuple[int, ...], *, all_row_steps: int
) -> NewtonState:
    """Run one iteration of each kind, in order.

    all_row_steps: the number of first iterations that use all rows, whatever the rank.
    """
    iteration, start = _start(chain, structure, q, v, kinds)

    @functools.partial(jax.checkpoint, prevent_cse=False)
    def scan_body(current: NewtonState, x) -> tuple[NewtonState, None]:
        return iteration(current, *x), None

    xs = (
        jnp.asarray(np.array(kinds, np.int32)),
        jnp.asarray(np.arange(len(kinds)) >= all_row_steps),
    )
    return jax.lax.scan(scan_body, start, xs)[0]


def _solve(chain: Chain, structure: Structure, q, v, schedule: Schedule) -> NewtonState:
    """Run a schedule. All rows are used until the search for the rank has ended.

    The search skips to its last iteration once the probes of all lanes are closed. Reverse mode
    cannot differentiate this loop. It need not: `_solve_jvp` leaves the search out, and
    `decide_rank` has no derivative.
    """
    kinds = schedule.kinds
    if DECIDE_RANK not in kinds:
        return _iterate(chain, structure, q, v, kinds, all_row_steps=0)
    iteration, start = _start(chain, structure, q, v, kinds)
    last_of_search, kind_at = kinds.index(DECIDE_RANK), jnp.asarray(np.array(kinds, np.int32))

    def is_closed(current: NewtonState):
        # A pivot at the probe is wrong by about its distance from a closed configuration. At a
        # singular one Newton's steps halve this distance; elsewhere it is the square of the step.
        return current.probe_step < PROBE_TOLERANCE * rank_tolerance(q.dtype)

    def body(carry):
        i, current = carry
        closes_probe = kind_at[i] == CLOSE_PERTURBED
        after = iteration(current, kind_at[i], i > last_of_search)
        # a lane whose probe is closed stays as it is while others iterate
        after = tree_where(closes_probe & is_closed(current), current, after)
        all_closed = ~unvmap_any(~is_closed(after))
        return where(closes_probe & all_closed, last_of_search, i + 1), after

    return jax.lax.while_loop(lambda carry: carry[0] < len(kinds), body, (np.int32(0), start))[1]


def _solve_jvp(primals, tangents):
    """Return the solution and its tangent.

    The tangent is that of the iterations which change q or v, at the rank of the solution. The
    search for the rank is not differentiated.
    """
    solution = solve_structure(*primals)
    chain, structure, q, v, schedule = primals
    with_rank = eqx.tree_at(
        lambda s: (s.rank, s.margin),
        structure,
        (solution.rank, jax.lax.stop_gradient(solution.margin)),
    )
    without_rank_search = tuple(kind for kind in schedule.kinds if kind not in RANK_SEARCH)

    @eqx.filter_checkpoint
    def iterate(chain, structure, q, v):
        end = _iterate(
            chain,
            structure,
            q,
            v,
            without_rank_search,
            all_row_steps=schedule.all_row_steps,
        )
        return end.q, end.v, end.spatial_impulse, end.energy_lost

    tangent_out = eqx.filter_jvp(iterate, (chain, with_rank, q, v), tangents[:4])[1]
    none = jax.tree.map(lambda x: None, solution)
    return solution, eqx.tree_at(
        lambda t: (t.q, t.v, t.spatial_impulse, t.energy_lost),
        none,
        tangent_out,
        is_leaf=lambda x: x is None,
    )


# solve_structure(chain, structure, q, v, schedule) -> NewtonState after the schedule
solve_structure: Callable[[Chain, Structure, Array, Array, Schedule], NewtonState] = (
    custom_primitive("solve_structure", _solve, _solve_jvp)
)


@jax.jit
def decide_rank(chain: Chain, structure: Structure, q: Float[Array, " q"]) -> Structure:
    """Return the structure with its rank and margin.

    The rank is the larger of the rank at q and the rank at a closed configuration nearby, as q
    itself may be singular.
    """
    if not len(chain.topology.link_names):
        return structure
    constants = jax.lax.stop_gradient((chain, structure, q))
    solution = _solve(*constants, jnp.zeros(chain.dofs, q.dtype), Schedule(RANK_SEARCH))
    return eqx.tree_at(lambda s: (s.rank, s.margin), structure, (solution.rank, solution.margin))
