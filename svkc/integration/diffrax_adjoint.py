"""The integration of one phase by diffrax's own loop, for diffrax's own adjoints."""

import functools
from typing import Any, ClassVar

import diffrax
import jax
import jax.numpy as jnp

from svkc.integration.event_location import Found
from svkc.integration.integrators import Motion
from svkc.integration.replay import staged
from svkc.integration.solution import EVENT, NON_FINITE, SUCCESSFUL, How, Path, Tally, World
from svkc.integration.stabilization import projects
from svkc.integration.vector_field import Field, settle


class _Interpolation(diffrax.AbstractLocalInterpolation):
    """The inner solver's dense output, drawn to the settled end of the step."""

    t0: Any
    t1: Any
    inner: Any
    shift: Motion

    def evaluate(self, t0, t1=None, left=True):
        def at(t):
            part = (t - self.t0) / (self.t1 - self.t0)
            return jax.tree.map(
                lambda y, s: y + part * s, self.inner.evaluate(t, left=left), self.shift
            )

        if t1 is None:
            return at(t0)
        return jax.tree.map(lambda a, b: b - a, at(t0), at(t1))


def _interpolation(cls, *, t0, t1, inner, shift):
    return _Interpolation(t0=t0, t1=t1, inner=cls(t0=t0, t1=t1, **inner), shift=shift)


class Settled(diffrax.AbstractWrappedSolver):
    """Any diffrax solver, its steps settled, for diffrax's own adjoints."""

    # diffrax takes a wrapper for what it wraps and asks for it; the inner solver has its own
    scan_kind: ClassVar[str] = "inner"

    solver: diffrax.AbstractSolver
    field: Field

    @property
    def term_structure(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.solver.term_structure

    @property
    def interpolation_cls(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return functools.partial(_interpolation, self.solver.interpolation_cls)

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
        fresh = True if projects(self.field.stabilization, args) else made_jump
        raw, error, dense, solver_state, result = self.solver.step(
            terms, t0, t1, y0, args, solver_state, made_jump=fresh
        )
        y1, _ = settle(self.field, args, raw)
        shift = jax.tree.map(lambda a, b: a - b, y1, raw)
        return y1, error, {"inner": dense, "shift": shift}, solver_state, result


def solve_by_diffrax(
    start: Motion,
    times,
    world: World,
    how: How,
    adjoint: diffrax.AbstractAdjoint,
    found: Found | None,
) -> Path:
    """Integrate one phase by `diffrax.diffeqsolve` and return its path.

    times: the start, the end and the save times. found: the event at the end, None: none.
    """
    t0, stop, at = times
    # diffrax sets `scan_kind` for the adjoint, but not through a wrapper
    kind = {diffrax.ForwardMode: "lax", diffrax.DirectAdjoint: "bounded"}.get(type(adjoint))
    saveat = diffrax.SaveAt(subs=[diffrax.SubSaveAt(t1=True), diffrax.SubSaveAt(ts=at)])
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(world.field),
        Settled(staged(how.solver, kind), world.field),
        t0=t0,
        t1=stop,
        dt0=how.first_step,
        y0=start,
        args=world.scene,
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
        result = jnp.where((result == SUCCESSFUL) & found.hit, EVENT, result)
    accepted = jnp.asarray(solution.stats["num_accepted_steps"], jnp.int32)
    rejected = jnp.asarray(solution.stats["num_rejected_steps"], jnp.int32)
    return Path(
        t=solution.ts[0][0],
        end=jax.tree.map(lambda x: x[0], end),
        saved=saved,
        times=jnp.zeros(0, t0.dtype),
        kept=saved,
        accepted=accepted,
        rejected=rejected,
        result=result,
        tally=Tally.unknown(t0.dtype, accepted + rejected),
        found=found,
    )
