"""The integration of one phase by diffrax's own loop, for diffrax's own adjoints."""

import functools
from typing import Any, ClassVar

import diffrax
import jax
import jax.numpy as jnp

from svkc.integration.event_location import EventInfo
from svkc.integration.ode import ODEState
from svkc.integration.replay import with_scan_kind
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


class _ProjectedInterpolation(diffrax.AbstractLocalInterpolation):
    """The inner solver's dense output, drawn to the settled end of the step."""

    t0: Any
    t1: Any
    inner: Any
    shift: ODEState

    def evaluate(self, t0, t1=None, left=True):
        def at(t):
            part = (t - self.t0) / (self.t1 - self.t0)
            return jax.tree.map(
                lambda y, s: y + part * s, self.inner.evaluate(t, left=left), self.shift
            )

        if t1 is None:
            return at(t0)
        return jax.tree.map(lambda a, b: b - a, at(t0), at(t1))


def _make_interpolation(cls, *, t0, t1, inner, shift):
    return _ProjectedInterpolation(t0=t0, t1=t1, inner=cls(t0=t0, t1=t1, **inner), shift=shift)


class ProjectedSolver(diffrax.AbstractWrappedSolver):
    """Any diffrax solver, its steps settled, for diffrax's own adjoints."""

    # diffrax takes a wrapper for what it wraps and asks for it; the inner solver has its own
    scan_kind: ClassVar[str] = "inner"

    solver: diffrax.AbstractSolver
    field: VectorField

    @property
    def term_structure(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.solver.term_structure

    @property
    def interpolation_cls(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return functools.partial(_make_interpolation, self.solver.interpolation_cls)

    def order(self, terms):
        return self.solver.order(terms)

    def strong_order(self, terms):
        return self.solver.strong_order(terms)

    def error_order(self, terms):
        return self.solver.error_order(terms)

    def init(self, terms, t0, t1, y0, args):
        return self.solver.init(terms, t0, t1, y0, args)

    def func(self, terms, t0, y0, args):
        return self.solver.func(terms, t0, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        fresh = True if needs_projection(self.field.stabilization, args) else made_jump
        raw, error, dense, solver_state, result = self.solver.step(
            terms, t0, t1, y0, args, solver_state, made_jump=fresh
        )
        y1, _ = project_state(self.field, args, raw)
        shift = jax.tree.map(lambda a, b: a - b, y1, raw)
        return y1, error, {"inner": dense, "shift": shift}, solver_state, result


def integrate_with_diffrax(
    start: ODEState,
    times,
    world: PhaseProblem,
    how: StepperOptions,
    adjoint: diffrax.AbstractAdjoint,
    found: EventInfo | None,
) -> PhaseSolution:
    """Integrate one phase by `diffrax.diffeqsolve` and return its path.

    times: the start, the end and the save times. found: the event at the end, None: none.
    """
    t0, stop, at = times
    # diffrax sets `scan_kind` for the adjoint, but not through a wrapper
    kind = {diffrax.ForwardMode: "lax", diffrax.DirectAdjoint: "bounded"}.get(type(adjoint))
    saveat = diffrax.SaveAt(subs=[diffrax.SubSaveAt(t1=True), diffrax.SubSaveAt(ts=at)])
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(world.field),
        ProjectedSolver(with_scan_kind(how.solver, kind), world.field),
        t0=t0,
        t1=stop,
        dt0=how.first_step,
        y0=start,
        args=world.field_args,
        saveat=saveat,
        stepsize_controller=how.controller,
        adjoint=adjoint,
        max_steps=how.max_steps,
        throw=False,
        progress_meter=how.progress_meter,
    )
    (end, saved), result = solution.ys, solution.result._value
    result = jnp.where(result == diffrax.RESULTS.internal_error._value, NON_FINITE, result)
    if found is not None:
        result = jnp.where((result == SUCCESSFUL) & found.occurred, EVENT, result)
    accepted = jnp.asarray(solution.stats["num_accepted_steps"], jnp.int32)
    rejected = jnp.asarray(solution.stats["num_rejected_steps"], jnp.int32)
    return PhaseSolution(
        t=solution.ts[0][0],
        y=jax.tree.map(lambda x: x[0], end),
        ys=saved,
        step_ts=jnp.zeros(0, t0.dtype),
        checkpoints=saved,
        accepted=accepted,
        rejected=rejected,
        result=result,
        stats=Stats.attempts_only(t0.dtype, accepted + rejected),
        event=found,
    )
