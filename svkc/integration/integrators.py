"""The state and the arguments of the vector field, integrators of our own as diffrax solvers, and
one step by itself."""

from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix
from jaxtyping import Array, Bool, Float

from svkc._jax.lanes_last import with_lanes_last
from svkc.loops.constrained_dynamics import ArticulatedBodies
from svkc.loops.forward_dynamics import velocity_and_acceleration
from svkc.model.chain import Chain, State, Structure, active_dofs
from svkc.model.checked_jit import checked_jit, joint_torques
from svkc.model.validation import scalar
from svkc.tree.configuration import integrate
from svkc.tree.inverse_dynamics import limit_forces

# a step that would leave less than this part of itself before a time to be met goes all the way
MAX_STRETCH = 1e-6


class ODEState(eqx.Module):
    """What is integrated: q, v, and the work (J) done by control, limits and dampers; None where
    the scene has none of them."""

    q: Float[Array, " q"]
    v: Float[Array, " dofs"]
    work: Float[Array, ""] | None = None


class FieldArgs(eqx.Module):
    """The `args` of the vector field: all it depends on besides time and motion. pivots: of the
    loops' rows, where they are held (`AbstractDynamics.hold`)."""

    chain: Chain
    structure: Structure
    args: Any
    pivots: Float[Array, "steps dofs"] | None = None


def is_finite(y: ODEState) -> Bool[Array, ""]:
    """Whether every number is."""
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(y)]))


class FixedSteps(diffrax.AbstractStepSizeController):
    """Steps of dt; diffrax is told the times `ts` to shorten them for. A step that is not finite is
    not taken: it ends the solve."""

    dt: Float[Array, ""]
    ts: Float[Array, " times"]

    def wrap(self, direction):
        return self

    def _tnext(self, t):
        times = jnp.where(self.ts > t, self.ts, jnp.inf)
        stop = jnp.min(times, initial=jnp.inf)
        return jnp.where(t + self.dt * (1 + MAX_STRETCH) >= stop, stop, t + self.dt)

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        return self._tnext(t0), None

    def adapt_step_size(
        self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state
    ):
        whole = is_finite(y1_candidate)
        said = diffrax.RESULTS.where(
            whole, diffrax.RESULTS.successful, diffrax.RESULTS.internal_error
        )
        return whole, jnp.where(whole, t1, t0), self._tnext(t1), False, controller_state, said


def rms_norm(error: ODEState) -> Float[Array, ""]:
    """Root mean square over q and v alone: work and guards do not choose the step."""
    both = jnp.concatenate([error.q, error.v])
    return jnp.sqrt(jnp.mean(both * both))


class RodriguesEuler(diffrax.AbstractSolver):
    """The paper's integration (39)-(44): first order, orientations turned by Rodrigues' formula,
    which keeps quaternions at unit length.

    q(t + dt) = q(t) moved by v dt along the exponential map, v(t + dt) = v(t) + vdot dt. For
    `svkc.simulate` alone, with dt.
    """

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar = diffrax.LocalLinearInterpolation

    def _position_velocity(self, before, after):
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
        v = jnp.where(
            active_dofs(args.chain, args.structure), self._position_velocity(y0.v, moved.v), 0
        )
        y1 = eqx.tree_at(lambda y: y.q, moved, integrate(args.chain, y0.q, dt * v))
        return y1, None, {"y0": y0, "y1": y1}, None, diffrax.RESULTS.successful


class SymplecticEuler(RodriguesEuler):
    """Symplectic Euler: the velocity first, v(t + dt) = v(t) + vdot dt, then q moved by the new one
    along the exponential map. First order; on conservative open chains the energy's error stays
    bounded. For `svkc.simulate` alone, with dt.
    """

    def _moving(self, before, after):
        return after


class SimplifiedNewton(diffrax.VeryChord):
    """Newton's iteration with one Jacobian for all stages of a step, for solvers with implicit
    stages (Hairer and Wanner, Solving Ordinary Differential Equations II, IV.8), ended where what
    is left, by the last update or by its rate, is below kappa of the tolerance, or below round-off.

    diffrax's own always takes a second update, and finds it diverging where both are round-off: on
    the high bar it takes five times as many steps.
    """

    def terminate(self, fn, y, args, options, state, tags):
        size, again = state.diffsize, state.step >= 2
        rate = size / state.diffsize_prev
        near = (size <= self.kappa) | (
            self.norm(state.diff) <= 100 * jnp.finfo(size.dtype).eps * self.norm(y)
        )
        close = ((state.step >= 1) & near) | (
            again & (rate < 1) & (size * rate / (1 - rate) <= self.kappa)
        )
        diverging = again & ~close & ~(rate < 2)
        failed = state.result != optimistix.RESULTS.successful
        result = optimistix.RESULTS.where(
            diverging, optimistix.RESULTS.nonlinear_divergence, optimistix.RESULTS.successful
        )
        return failed | close | diverging, optimistix.RESULTS.where(failed, state.result, result)


@checked_jit
def step(
    chain: Chain, state: State, tau: Float[Array, " torques"], dt: Float[Array, ""] | float
) -> State:
    """One step of symplectic Euler of dt (s), for loops of one's own: v + vdot dt, then q moved by
    that along the exponential map.

    The joint torques tau (N m, N; over every coordinate, or the tree's alone) are held over the
    step; springs, dampers and ranges of the joints act.
    Each step takes away a quarter of what loops are open by (Baumgarte's rate 1 / (2 dt)). First
    order; structure, events, other orders and error
    control: `svkc.simulate`. ValueError: tau has another size.
    """
    return _step(
        chain, state, joint_torques(chain, tau), jnp.asarray(scalar("dt", dt), state.q.dtype)
    )


@with_lanes_last
def _step(chain: Chain, state: State, tau: Float[Array, " dofs"], dt: Float[Array, ""]) -> State:
    tau = tau + limit_forces(chain, state.q, state.v)
    v, vdot = velocity_and_acceleration(
        chain,
        state.structure,
        state.q,
        state.v,
        tau,
        dynamics=ArticulatedBodies(),
        baumgarte=0.5 / dt if chain.link_names else None,
    )
    v = v + dt * vdot
    return State(
        integrate(chain, state.q, dt * jnp.where(active_dofs(chain, state.structure), v, 0)),
        v,
        state.structure,
    )
