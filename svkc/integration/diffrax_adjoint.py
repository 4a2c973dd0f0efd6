"""Integrate one phase by `diffrax.diffeqsolve`, for the adjoints of diffrax.

This module is separate from the stepping loop of svkc, as it alone adapts steps with projection to
diffrax's solver interface.
"""

import functools
from typing import Any, ClassVar

import diffrax
import jax
import jax.numpy as jnp

from svkc._jax.select import where
from svkc.integration.dense_output import make_interpolation
from svkc.integration.event_location import EventInfo
from svkc.integration.ode import FieldArgs, ODEState, Times
from svkc.integration.runge_kutta import with_scan_kind
from svkc.integration.solution import (
    EVENT,
    NON_FINITE,
    SUCCESSFUL,
    PhaseProblem,
    PhaseSolution,
    Stats,
    StepperOptions,
)
from svkc.integration.stabilization import needs_projection
from svkc.integration.vector_field import VectorField, project_state


class ProjectedSolver(diffrax.AbstractWrappedSolver[Any]):
    """A diffrax solver whose steps are projected onto the closed loops."""

    # A placeholder: diffrax reads `scan_kind` of every solver, but the inner one's takes effect.
    scan_kind: ClassVar[str] = "inner"

    solver: diffrax.AbstractSolver[Any]
    field: VectorField

    @property
    def term_structure(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.solver.term_structure

    @property
    def interpolation_cls(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        return functools.partial(make_interpolation, self.solver.interpolation_cls)

    def order(self, terms: Any) -> int | None:
        return self.solver.order(terms)

    def strong_order(self, terms: Any) -> Any:
        return self.solver.strong_order(terms)

    def error_order(self, terms: Any) -> Any:
        return self.solver.error_order(terms)

    def init(self, terms: Any, t0: Any, t1: Any, y0: ODEState, args: FieldArgs) -> Any:
        return self.solver.init(terms, t0, t1, y0, args)

    def func(self, terms: Any, t0: Any, y0: ODEState, args: FieldArgs) -> Any:
        return self.solver.func(terms, t0, y0, args)

    def step(
        self,
        terms: Any,
        t0: Any,
        t1: Any,
        y0: ODEState,
        args: FieldArgs,
        solver_state: Any,
        made_jump: Any,
    ) -> Any:
        # Projection moved the state, so the FSAL derivative is stale: re-evaluate.
        stale = True if needs_projection(self.field.stabilization, args.chain) else made_jump
        y_solver, error, dense_info, solver_state, result = self.solver.step(
            terms, t0, t1, y0, args, solver_state, made_jump=stale
        )
        y1, _ = project_state(self.field, args, y_solver)
        shift = jax.tree.map(lambda a, b: a - b, y1, y_solver)
        return y1, error, {"inner": dense_info, "shift": shift}, solver_state, result


def integrate_with_diffrax(
    start: ODEState,
    times: Times,
    problem: PhaseProblem,
    options: StepperOptions,
    adjoint: diffrax.AbstractAdjoint,
    event: EventInfo | None,
) -> PhaseSolution:
    """Integrate one phase by `diffrax.diffeqsolve`, which differentiates by `adjoint`.

    times: start, end and save times.
    event: the event at the end, located beforehand. None: there are no guards.
    """
    t0, stop, save_ts = times
    # diffrax sets `scan_kind` of the solver for these adjoints, but not of a wrapped one.
    kind = {diffrax.ForwardMode: "lax", diffrax.DirectAdjoint: "bounded"}.get(type(adjoint))
    saveat = diffrax.SaveAt(subs=[diffrax.SubSaveAt(t1=True), diffrax.SubSaveAt(ts=save_ts)])
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(problem.field),
        ProjectedSolver(with_scan_kind(options.solver, kind), problem.field),
        t0=t0,
        t1=stop,
        dt0=options.first_step,
        y0=start,
        args=problem.field_args,
        saveat=saveat,
        stepsize_controller=options.controller,
        adjoint=adjoint,
        max_steps=options.max_steps,
        throw=False,
        progress_meter=options.progress_meter,
    )
    assert solution.ts is not None
    assert solution.ys is not None
    y_end, ys = solution.ys
    accepted = jnp.asarray(solution.stats["num_accepted_steps"], jnp.int32)
    rejected = jnp.asarray(solution.stats["num_rejected_steps"], jnp.int32)
    return PhaseSolution(
        t=solution.ts[0][0],
        y=jax.tree.map(lambda x: x[0], y_end),
        ys=ys,
        step_ts=jnp.zeros(0, t0.dtype),
        step_near=None,
        checkpoints=ys,
        accepted=accepted,
        rejected=rejected,
        result=_result_code(solution, event),
        stats=Stats.attempts_only(t0.dtype, accepted + rejected),
        event=event,
    )


def _result_code(solution: diffrax.Solution, event: EventInfo | None):
    """Return the result code of a phase."""
    result = solution.result._value
    # `FixedSteps` reports a non-finite state as an internal error.
    result = where(result == diffrax.RESULTS.internal_error._value, NON_FINITE, result)
    if event is None:
        return result
    return where((result == SUCCESSFUL) & event.occurred, EVENT, result)
