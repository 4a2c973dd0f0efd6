"""F5: solvers of our own, as diffrax solvers."""

from typing import ClassVar

import diffrax
import equinox as eqx
import jax.numpy as jnp

from svkc.kinematics import integrate
from svkc.loops import active_dofs


class RodriguesEuler(diffrax.AbstractSolver):
    """The paper's integration (39)-(44): first order, orientations turned by Rodrigues' formula, which keeps quaternions at unit length.

    q(t + dt) = q(t) moved by v dt along the exponential map, v(t + dt) = v(t) + vdot dt. For `svkc.simulate` alone, with dt.
    """

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar = diffrax.LocalLinearInterpolation

    def _moving(self, before, after):
        """The velocity that q goes by."""
        return before

    def order(self, terms):
        return 1

    def init(self, terms, t0, t1, y0, args):
        return None

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        dt = t1 - t0
        rate = terms.vf(t0, y0, args)
        moved = eqx.tree_at(lambda y: y.v, y0, y0.v + dt * rate.v)
        if y0.work is not None:
            moved = eqx.tree_at(lambda y: y.work, moved, y0.work + dt * rate.work)
        v = jnp.where(active_dofs(args.chain, args.structure), self._moving(y0.v, moved.v), 0)
        y1 = eqx.tree_at(lambda y: y.q, moved, integrate(args.chain, y0.q, dt * v))
        return y1, None, {"y0": y0, "y1": y1}, None, diffrax.RESULTS.successful


class SemiImplicitEuler(RodriguesEuler):
    """Symplectic Euler: the velocity first, v(t + dt) = v(t) + vdot dt, then q moved by the new one along the exponential map. First order; on
    conservative open chains the energy's error stays bounded. For `svkc.simulate` alone, with dt.
    """

    def _moving(self, before, after):
        return after
