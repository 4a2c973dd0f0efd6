"""Steps put back onto the loops within diffrax's own loop, for diffrax's own adjoints."""

import functools
from typing import Any, ClassVar

import diffrax
import jax

from svkc.integration.integrators import Motion
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
    return _Interpolation(t0, t1, cls(t0=t0, t1=t1, **inner), shift)


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
            terms, t0, t1, y0, args, solver_state, fresh
        )
        y1, _ = settle(self.field, args, raw)
        shift = jax.tree.map(lambda a, b: a - b, y1, raw)
        return y1, error, {"inner": dense, "shift": shift}, solver_state, result
