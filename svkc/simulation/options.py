"""The options of a call of `simulate`: arguments are validated and defaults are resolved before
anything is compiled."""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix
from jaxtyping import Array, Float

from svkc._jax.pytrees import is_concrete
from svkc.integration.integrators import SimplifiedNewton
from svkc.integration.ode import rms_norm
from svkc.integration.replay import Replay
from svkc.integration.stabilization import AbstractStabilization, Projection
from svkc.integration.step_size import (
    MAX_STRETCH,
    SAFETY,
    FixedSteps,
    LimitedPIDController,
    has_jumps,
)
from svkc.integration.vector_field import VectorField
from svkc.loops.constrained_dynamics import (
    AbstractDynamics,
)
from svkc.loops.constraint import gap_tolerance
from svkc.model.annotations import DType, Scalar
from svkc.model.chain import Chain, State
from svkc.model.validation import check_function, integer
from svkc.simulation.default_dynamics import resolve_dynamics
from svkc.simulation.option_checks import (
    check_initial_state,
    check_instance,
    check_solver,
    check_step_options,
    check_times,
)
from svkc.transitions.event_schedule import event_capacity
from svkc.transitions.events import as_events
from svkc.transitions.plan import Plan, make_plan


class Options(eqx.Module):
    """The options of a run, validated and with defaults resolved.

    dt: fixed step size (s); None: `controller` sets the step size.
    first_step: size of the first step with a controller (s).
    has_work: whether to integrate the work of control, joint limits and dampers.
    gap_tolerance: largest loop gap that does not fail a run (rad, m).
    traced_times, traced_steps, traced_masses: whether a time, a step size or tolerance, or a mass,
        inertia or armature of the chain is traced, so that the compiled run has to check it.
    """

    control: Callable | None
    solver: diffrax.AbstractSolver[Any]
    stabilization: AbstractStabilization
    dynamics: AbstractDynamics
    controller: Any
    adjoint: diffrax.AbstractAdjoint | Replay
    progress_meter: diffrax.AbstractProgressMeter[Any]
    dt: Float[Array, ""] | None
    first_step: Float[Array, ""]
    max_events: int = eqx.field(static=True)
    max_steps: int = eqx.field(static=True)
    has_work: bool = eqx.field(static=True)
    gap_tolerance: float = eqx.field(static=True)
    traced_times: bool = eqx.field(static=True)
    traced_steps: bool = eqx.field(static=True)
    traced_masses: bool = eqx.field(static=True)

    @property
    def field(self) -> VectorField:
        """The vector field of each phase."""
        return VectorField(self.control, self.stabilization, self.dynamics)

    def step_size_control(self, ts: Float[Array, " times"] | None = None) -> Any:
        """Return the step-size controller and the size of the first step (None: the controller
        chooses it).

        ts: times at which an adaptive or fixed-step controller ends a step, for loops that do not
            clip steps at save times themselves; None: no such times.
        """
        if self.dt is not None:
            return FixedSteps(self.dt, jnp.zeros(0, self.dt.dtype) if ts is None else ts), None
        if ts is not None and isinstance(
            self.controller, diffrax.AbstractAdaptiveStepSizeController
        ):
            return diffrax.ClipStepSizeController(self.controller, step_ts=ts), self.first_step
        return self.controller, (
            None if isinstance(self.controller, diffrax.StepTo) else self.first_step
        )


def resolve_tolerances(
    dtype: DType, rtol: Scalar | None = None, atol: Scalar | None = None
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return rtol and atol as arrays. The defaults are 1e-7 (float32: 1e-4) for rtol, and a
    hundredth of rtol, but at least eight times round-off, for atol."""
    eps = np.finfo(dtype).eps
    rtol = (1e-7 if eps < 1e-10 else 1e-4) if rtol is None else rtol
    if atol is None:
        atol = (
            max(float(rtol) * 1e-2, 8 * eps)
            if is_concrete(rtol)
            else jnp.maximum(rtol * 1e-2, 8 * eps)
        )
    return jnp.asarray(rtol, dtype), jnp.asarray(atol, dtype)


def prepare_options(
    chain: Chain, state: State, t0: Any, t1: Any, *, ts: Any, events: Any, control: Any, dt: Any,
    rtol: Any, atol: Any, dtmax: Any, solver: Any, stepsize_controller: Any, stabilization: Any,
    dynamics: Any, adjoint: Any, max_events: Any, max_steps: Any, progress_meter: Any,
) -> tuple[Options, Float[Array, " times"], Plan]:  # fmt: skip
    """Return the options, the save times and the plan of events of a call of `simulate`. Raises
    ValueError for invalid arguments."""
    check_initial_state(chain, state)
    dtype, events = state.q.dtype, as_events(events)
    check_times(t0, t1, ts, events)
    check_step_options(dt, rtol, atol, dtmax, stepsize_controller)
    if control is not None:
        check_function("control", control, "t", "state", "args")
    check_instance("stepsize_controller", stepsize_controller, diffrax.AbstractStepSizeController)
    check_instance("progress_meter", progress_meter, diffrax.AbstractProgressMeter)
    plan = make_plan(chain, events, dtype)
    # concrete numbers stay in numpy: JAX compiles a program for every eager operation
    cast = lambda x: np.asarray(x, dtype) if is_concrete(x) else jnp.asarray(x, dtype)
    host = np if is_concrete(t0, t1) else jnp
    span = cast(t1) - cast(t0)
    controller = stepsize_controller
    if controller is None:
        smallest = np.finfo(dtype).eps * host.maximum(host.abs(span), host.abs(cast(t1)))
        controller = _default_controller(rtol, atol, smallest, dtmax, dtype)
    stabilization = _resolve_stabilization(stabilization)
    adjoint = _resolve_adjoint(adjoint, controller if dt is None else None)
    options = Options(
        control=control,
        solver=_resolve_solver(solver, None if dt is not None else controller, dtype),
        stabilization=stabilization,
        dynamics=resolve_dynamics(chain, dynamics, stabilization, adjoint),
        controller=controller,
        adjoint=adjoint,
        progress_meter=diffrax.NoProgressMeter() if progress_meter is None else progress_meter,
        dt=None if dt is None else jnp.asarray(dt, dtype),
        first_step=jnp.asarray(host.maximum(span, np.finfo(dtype).tiny) * 1e-3, dtype),
        max_events=_resolve_max_events(max_events, plan),
        max_steps=_resolve_max_steps(max_steps, span, dt, dtmax),
        has_work=control is not None or chain.limit is not None or chain.damping is not None,
        gap_tolerance=1e3 * gap_tolerance(dtype),
        traced_times=not is_concrete(t0, t1, ts, plan.times),
        traced_steps=not is_concrete(dt, rtol, atol, dtmax),
        traced_masses=not is_concrete(chain.mass, chain.inertia, chain.armature),
    )
    save_at = host.stack([cast(t0), cast(t1)]) if ts is None else ts
    return options, jnp.asarray(save_at, dtype), plan


def _default_controller(
    rtol: Any, atol: Any, smallest: Any, dtmax: Any, dtype: Any
) -> diffrax.PIDController:
    """Return the default step-size controller.

    smallest, dtmax: bounds of the step size (s); dtmax may be None.
    """
    # arrays, so that a run with other tolerances uses the same program
    rtol, atol = resolve_tolerances(dtype, rtol, atol)
    # a step is stretched by up to MAX_STRETCH if it then ends at a save time
    largest = None if dtmax is None else jnp.asarray(dtmax, dtype) / (1 + MAX_STRETCH)
    return LimitedPIDController(
        rtol, atol, norm=rms_norm, dtmin=jnp.asarray(smallest, dtype), dtmax=largest,
        force_dtmin=False, safety=SAFETY,
    )  # fmt: skip


def _resolve_stabilization(stabilization) -> AbstractStabilization:
    """Return the stabilization, `Projection()` by default. Raises ValueError for another type."""
    if stabilization is None:
        return Projection()
    if not isinstance(stabilization, AbstractStabilization):
        raise ValueError(
            "stabilization: expected an object of svkc.stabilization, such as"
            f" svkc.stabilization.Projection(), got {stabilization!r}"
        )
    return stabilization


def _resolve_solver(solver, controller, dtype) -> diffrax.AbstractSolver[Any]:
    """Return the solver, by default Dopri8, or Tsit5 with fixed steps or in float32.

    An implicit solver whose root finder has no tolerances of its own takes those of the
    controller; without a controller with tolerances its stages are solved to sqrt(eps).

    Raises ValueError if the solver is not one of diffrax, or has no error estimate for adaptive
    steps.
    """
    if solver is None:
        return (
            diffrax.Dopri8()
            if np.finfo(dtype).eps < 1e-10 and controller is not None
            else diffrax.Tsit5()
        )
    check_solver(solver)
    if isinstance(controller, diffrax.AbstractAdaptiveStepSizeController) and not isinstance(
        solver, diffrax.AbstractAdaptiveSolver
    ):
        raise ValueError(
            f"solver: {type(solver).__name__} has no error estimate for adaptive steps; give dt, or"
            " another solver"
        )
    if not isinstance(solver, diffrax.AbstractImplicitSolver):
        return solver
    finder = solver.root_finder
    of_controller = {name: getattr(controller, name, None) for name in ("rtol", "atol", "norm")}
    inherited = [name for name in of_controller if _inherits_tolerance(getattr(finder, name, 0.0))]
    if None in of_controller.values() and inherited:
        # fixed steps cannot be shortened if the stages do not converge, so use full Newton steps
        close = float(np.finfo(dtype).eps ** 0.5)
        return eqx.tree_at(
            lambda s: s.root_finder, solver, optimistix.Newton(close, close, norm=rms_norm)
        )
    if inherited and isinstance(finder, diffrax.VeryChord):
        solver = eqx.tree_at(lambda s: s.root_finder, solver, SimplifiedNewton(0.0, 0.0))
    return eqx.tree_at(
        lambda s: [getattr(s.root_finder, name) for name in inherited],
        solver,
        [of_controller[name] for name in inherited],
    )


def _inherits_tolerance(value) -> bool:
    """Return whether a root finder leaves this tolerance or norm to the step-size controller.

    diffrax marks such values with a private sentinel, which is neither a number nor callable.
    """
    return not (callable(value) or eqx.is_inexact_array_like(value))


def _resolve_adjoint(adjoint, controller) -> diffrax.AbstractAdjoint | Replay:
    """Return the adjoint, by default `Replay()`.

    Replay needs steps that end at save times, as fixed and adaptive steps do, and that begin where
    the step before ended, unlike those around a jump (`jump_ts`). With other controllers the
    default is diffrax's adjoint.

    Raises ValueError for another type, for Replay with such a controller, and for
    `BacksolveAdjoint` and `ImplicitAdjoint`, which cannot save states.
    """
    is_adaptive = isinstance(controller, diffrax.AbstractAdaptiveStepSizeController)
    can_replay = controller is None or (is_adaptive and not has_jumps(controller))
    if adjoint is None:
        return Replay() if can_replay else diffrax.RecursiveCheckpointAdjoint()
    if not isinstance(adjoint, Replay | diffrax.AbstractAdjoint):
        raise ValueError(
            f"adjoint: expected svkc.integrators.Replay or a diffrax adjoint, got {adjoint!r}"
        )
    if isinstance(adjoint, diffrax.BacksolveAdjoint | diffrax.ImplicitAdjoint):
        raise ValueError(
            f"adjoint: diffrax.{type(adjoint).__name__} cannot save states; use"
            " svkc.integrators.Replay or diffrax.RecursiveCheckpointAdjoint"
        )
    if isinstance(adjoint, Replay) and not can_replay:
        raise ValueError(
            "adjoint: svkc.integrators.Replay needs dt or an adaptive stepsize_controller without"
            " jump_ts; give a diffrax adjoint with this controller"
        )
    return adjoint


def _resolve_max_events(max_events, plan: Plan) -> int:
    """Return the capacity for events."""
    if max_events is None:
        return event_capacity(plan)
    capacity = integer("max_events", max_events, 0)
    return capacity if plan.actions else 0


def _resolve_max_steps(max_steps: Any, span: Any, dt: Any, dtmax: Any) -> int:
    """Return the bound on the number of steps of a phase, by default large enough for all steps of
    size dt or dtmax. Raises ValueError if these are more than 1e9."""
    if max_steps is not None:
        return integer("max_steps", max_steps, 1)
    name, size = ("dtmax", dtmax) if dt is None else ("dt", dt)
    if size is None or not is_concrete(span, size):
        return 65536
    # save times and events shorten some steps, so there are more than span / size
    steps = float(np.max(np.asarray(span / size)))
    if not steps < 1e9:
        raise ValueError(
            f"{name}: got {size}, with which a run of {float(span):g} s has more than 1e9 steps;"
            f" give a larger {name}, or max_steps"
        )
    return max(65536, int(1.1 * steps) + 1024)
