"""Integrators that diffrax lacks, a root finder for implicit solvers, and a single step."""

from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax.numpy as jnp
import optimistix
from jaxtyping import Array, Float

from svkc._jax.lanes_last import with_lanes_last
from svkc._jax.one_kernel import one_kernel
from svkc._jax.select import where
from svkc.loops.constrained_dynamics import ArticulatedBodies
from svkc.loops.forward_dynamics import velocity_and_acceleration
from svkc.model.annotations import Checked, Torques
from svkc.model.chain import Chain, State, active_dofs
from svkc.model.checked_jit import checked_jit, torques_over_dofs
from svkc.model.validation import boolean, scalar
from svkc.tree.configuration import integrate
from svkc.tree.inverse_dynamics import limit_forces


class RodriguesEuler(diffrax.AbstractSolver[Any]):
    """The paper's integrator (39)-(44): explicit Euler of first order with fixed steps.

    q(t + dt) = q(t) exp(v(t) dt) and v(t + dt) = v(t) + vdot(t) dt, where exp is the exponential
    map of the configuration space. Rodrigues' formula for exp keeps quaternions at unit length.

    Use as `solver` of `svkc.simulate` together with `dt`: the solver estimates no error and
    handles the states of `svkc.simulate` alone.
    """

    term_structure: ClassVar[Any] = diffrax.AbstractTerm
    interpolation_cls: ClassVar[Any] = diffrax.LocalLinearInterpolation

    def _position_velocity(self, v0, v1):
        """Return the velocity that moves q: v0 at the start of the step, or v1 at its end."""
        return v0

    def order(self, terms: Any) -> int:
        return 1

    def init(self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any) -> None:
        return None

    def func(self, terms: Any, t0: Any, y0: Any, args: Any) -> Any:
        return terms.vf(t0, y0, args)

    def step(
        self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any, solver_state: None, made_jump: Any
    ) -> Any:
        dt = t1 - t0
        rate = terms.vf(t0, y0, args)
        y1 = eqx.tree_at(lambda y: y.v, y0, y0.v + dt * rate.v)
        if y0.work is not None:
            y1 = eqx.tree_at(lambda y: y.work, y1, y0.work + dt * rate.work)
        active = active_dofs(args.chain, args.structure)
        v = where(active, self._position_velocity(y0.v, y1.v), 0)
        y1 = eqx.tree_at(lambda y: y.q, y1, integrate(args.chain, y0.q, dt * v))
        return y1, None, {"y0": y0, "y1": y1}, None, diffrax.RESULTS.successful


class SymplecticEuler(RodriguesEuler):
    """Symplectic Euler (semi-implicit Euler) of first order with fixed steps.

    v(t + dt) = v(t) + vdot(t) dt, then q(t + dt) = q(t) exp(v(t + dt) dt), where exp is the
    exponential map of the configuration space. The step is symplectic where the mass matrix is
    constant: the energy error of a conservative system then stays bounded (Hairer, Lubich and
    Wanner, Geometric Numerical Integration). Where the mass matrix depends on q, as for a double
    pendulum, the energy drifts.

    Joint damping is explicit, as this solver knows the vector field alone. Without closed loops, a
    step equals one of `svkc.step` with `implicit_damping=False`.

    Use as `solver` of `svkc.simulate` together with `dt`: the solver estimates no error and
    handles the states of `svkc.simulate` alone.
    """

    def _position_velocity(self, v0, v1):
        return v1


class SimplifiedNewton(diffrax.VeryChord):
    """Newton's method with one Jacobian for all stages of an implicit step.

    The iteration ends when the remaining error, estimated by the last update or by the rate of
    convergence, is below kappa times the tolerance, or when the update is round-off (Hairer and
    Wanner, Solving Ordinary Differential Equations II, section IV.8).

    `diffrax.VeryChord` always takes a second update, and reports divergence where both updates are
    round-off. With it, the model of the high bar takes five times as many steps.
    """

    def terminate(self, fn: Any, y: Any, args: Any, options: Any, state: Any, tags: Any) -> Any:
        update = state.diffsize
        rate = update / state.diffsize_prev
        round_off = 100 * jnp.finfo(update.dtype).eps * self.norm(y)
        small = (update <= self.kappa) | (self.norm(state.diff) <= round_off)
        # The rate of convergence needs two updates.
        has_rate = state.step >= 2
        remaining_error = update * rate / (1 - rate)
        converged = ((state.step >= 1) & small) | (
            has_rate & (rate < 1) & (remaining_error <= self.kappa)
        )
        diverging = has_rate & ~converged & ~(rate < 2)
        failed = state.result != optimistix.RESULTS.successful
        result = optimistix.RESULTS.where(
            diverging, optimistix.RESULTS.nonlinear_divergence, optimistix.RESULTS.successful
        )
        return failed | converged | diverging, optimistix.RESULTS.where(
            failed, state.result, result
        )


@checked_jit(static=("implicit_damping",))
def step(
    chain: Chain,
    state: State,
    tau: Torques,
    dt: Float[Array, ""] | float,
    *,
    implicit_damping: Checked[bool] = True,
) -> State:
    """Take one step of symplectic Euler and return the new state.

    v(t + dt) = v(t) + a dt, then q moves by v(t + dt) dt along the exponential map. Use `step` in a
    simulation loop of your own, such as for control or reinforcement learning. Springs, dampers and
    joint limits act; the structure is unchanged. The method is of first order; `svkc.simulate` has
    events, other solvers and error control.

    The acceleration a solves (M + dt D) a = f(q(t), v(t)) under the loop constraints. D is the
    diagonal matrix of the joints' damping, so that dampers are stable with any step size: an open
    chain moves as by `mj_step` of MuJoCo's default integrator, Euler, which differs from its
    `implicitfast`. Springs are explicit, as in MuJoCo. Joint limits are explicit springs and
    dampers of svkc's own law (paper, section VII-B), so that motions beyond a joint's range differ
    from those of MuJoCo. The damping of virtual links that are not cuttable joints is explicit.

    Each step reduces the loop gaps by a quarter (Baumgarte stabilization of rate 1 / (2 dt)).

    tau: joint torques (N m, N), constant over the step: over all coordinates, over the tree's, or
        by joint name.
    dt: step size (s).
    implicit_damping: whether joint damping is implicit. False: a = vdot(t), as in a step of
        `svkc.integrators.SymplecticEuler`, and of MuJoCo without its flag `eulerdamp`.

    Raises ValueError if `tau` has neither of these sizes or an unknown name, if `dt` is not one
    real number, or if `implicit_damping` is neither True nor False.
    """
    return _step(
        chain,
        state,
        torques_over_dofs(chain, tau),
        jnp.asarray(scalar("dt", dt), state.q.dtype),
        chain.damping if boolean("implicit_damping", implicit_damping) else None,
    )


@one_kernel
@with_lanes_last
def _step(
    chain: Chain,
    state: State,
    tau: Float[Array, " dofs"],
    dt: Float[Array, ""],
    damping: Float[Array, " dofs"] | None,
) -> State:
    tau = tau + limit_forces(chain, state.q, state.v)
    v, vdot = velocity_and_acceleration(
        chain,
        state.structure,
        state.q,
        state.v,
        tau,
        dynamics=ArticulatedBodies(),
        baumgarte=0.5 / dt if chain.link_names else None,
        added_inertia=None if damping is None else dt * damping,
    )
    v = v + dt * vdot
    return State(
        integrate(chain, state.q, dt * where(active_dofs(chain, state.structure), v, 0)),
        v,
        state.structure,
    )
