"""A Runge-Kutta-Munthe-Kaas method, to compare with: any solver of diffrax, in a rotation vector
from the start of each step.

What svkc does instead: quaternions as four numbers, put back to unit length after every step.
"""

from typing import ClassVar

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np

from svkc.tree.configuration import configuration_derivative, integrate


def turned(chain, u, v):
    """The rate of u where q = q0 exp(u) moves with v: the inverse of the exponential's derivative,
    on every ball and free joint."""
    at = chain.topology.quaternion_starts[1][:, None] + np.arange(3)
    x, w = u[at], v[at]
    square = jnp.sum(x * x, -1, keepdims=True)
    small = square < 1e-4
    safe = jnp.where(small, 1, square)
    angle = jnp.sqrt(safe)
    second = jnp.where(
        small,
        1 / 12 + square / 720 + square**2 / 30240,
        1 / safe - 1 / (2 * angle * jnp.tan(angle / 2)),
    )
    once = jnp.cross(x, w)
    return v.at[at].set(w + once / 2 + second * jnp.cross(x, once))


class MuntheKaas(diffrax.AbstractAdaptiveSolver):
    """The inner solver's steps in coordinates about where each begins."""

    solver: diffrax.AbstractSolver
    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar = diffrax.LocalLinearInterpolation

    def order(self, terms):
        return self.solver.order(terms)

    def error_order(self, terms):
        return self.solver.error_order(terms)

    def init(self, terms, t0, t1, y0, args):
        return None

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        chain, q0 = args.chain, y0.q

        def field(t, y, args):
            rate = terms.vf(t, eqx.tree_at(lambda y: y.q, y, integrate(chain, q0, y.q)), args)
            return eqx.tree_at(lambda y: y.q, rate, turned(chain, y.q, y.v))

        term, start = diffrax.ODETerm(field), eqx.tree_at(lambda y: y.q, y0, jnp.zeros_like(y0.v))
        inner = self.solver.init(term, t0, t1, start, args)
        end, error, *_ = self.solver.step(
            term, t0, t1, start, args, solver_state=inner, made_jump=True
        )
        y1 = eqx.tree_at(lambda y: y.q, end, integrate(chain, q0, end.q))
        error = eqx.tree_at(lambda y: y.q, error, configuration_derivative(chain, y1.q, error.q))
        return y1, error, {"y0": y0, "y1": y1}, None, diffrax.RESULTS.successful
