"""A Runge-Kutta-Munthe-Kaas method around any diffrax solver, for comparison.

The inner solver integrates a rotation vector from the start of each step. svkc itself integrates
the four numbers of a quaternion and normalizes them after every step.
"""

from typing import ClassVar

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np

from svkc.tree.configuration import configuration_derivative, integrate


def rotation_vector_rate(chain, u, v):
    """Return du/dt for q = q0 exp(u) moving with velocity v, on every ball and free joint.

    This is the inverse of the exponential map's derivative, applied to v.
    """
    columns = chain.topology.quaternion_starts[1][:, None] + np.arange(3)
    x, w = u[columns], v[columns]
    squared_angle = jnp.sum(x * x, -1, keepdims=True)
    near_zero = squared_angle < 1e-4
    nonzero = jnp.where(near_zero, 1, squared_angle)
    angle = jnp.sqrt(nonzero)
    coefficient = jnp.where(
        near_zero,
        1 / 12 + squared_angle / 720 + squared_angle**2 / 30240,
        1 / nonzero - 1 / (2 * angle * jnp.tan(angle / 2)),
    )
    cross = jnp.cross(x, w)
    return v.at[columns].set(w + cross / 2 + coefficient * jnp.cross(x, cross))


class MuntheKaas(diffrax.AbstractAdaptiveSolver):
    """A solver whose inner solver steps in exponential coordinates about each step's start."""

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
            return eqx.tree_at(lambda y: y.q, rate, rotation_vector_rate(chain, y.q, y.v))

        term, start = diffrax.ODETerm(field), eqx.tree_at(lambda y: y.q, y0, jnp.zeros_like(y0.v))
        inner = self.solver.init(term, t0, t1, start, args)
        end, error, *_ = self.solver.step(
            term, t0, t1, start, args, solver_state=inner, made_jump=True
        )
        y1 = eqx.tree_at(lambda y: y.q, end, integrate(chain, q0, end.q))
        error = eqx.tree_at(lambda y: y.q, error, configuration_derivative(chain, y1.q, error.q))
        return y1, error, {"y0": y0, "y1": y1}, None, diffrax.RESULTS.successful
