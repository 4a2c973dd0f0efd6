"""What a call of `simulate` asks for, checked at once, with defaults filled in."""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from jaxtyping import Array, Float

from svkc._jax.pytrees import is_concrete
from svkc.integration.integrators import SimplifiedNewton
from svkc.integration.ode import rms_norm
from svkc.integration.replay import Replay
from svkc.integration.stabilization import AbstractStabilization, Projection
from svkc.integration.step_size import FixedSteps
from svkc.integration.vector_field import VectorField
from svkc.loops.constrained_dynamics import AbstractDynamics, Dynamics, default_dynamics
from svkc.loops.constraint import gap_tolerance
from svkc.model.chain import Chain, State
from svkc.model.checked_jit import check_state
from svkc.model.validation import check_function, finite_array, integer, positive_scalar, scalar
from svkc.transitions.events import At, as_events
from svkc.transitions.plan import Plan, make_plan


class Options(eqx.Module):
    """How to integrate."""

    control: Callable | None
    solver: diffrax.AbstractSolver
    stabilization: AbstractStabilization
    dynamics: AbstractDynamics
    controller: Any
    adjoint: diffrax.AbstractAdjoint | Replay
    progress_meter: diffrax.AbstractProgressMeter
    dt: Float[Array, ""] | None
    first_step: Float[Array, ""]
    max_events: int = eqx.field(static=True)
    max_steps: int = eqx.field(static=True)
    has_work: bool = eqx.field(static=True)
    gap: float = eqx.field(static=True)

    @property
    def field(self) -> VectorField:
        """The vector field of a phase."""
        return VectorField(self.control, self.stabilization, self.dynamics)

    def step_size_control(self, ts=None):
        """The step-size controller and the first step; for a loop that does not look to the save
        times itself, made to stop at each of `ts`."""
        if self.dt is not None:
            return FixedSteps(self.dt, jnp.zeros(0, self.dt.dtype) if ts is None else ts), None
        if ts is not None and isinstance(
            self.controller, diffrax.AbstractAdaptiveStepSizeController
        ):
            return diffrax.ClipStepSizeController(self.controller, step_ts=ts), self.first_step
        return self.controller, (
            None if isinstance(self.controller, diffrax.StepTo) else self.first_step
        )


def resolve_tolerances(dtype, rtol=None, atol=None) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Those left open are 1e-7 (float32: 1e-4), and a hundredth of rtol, or what round-off
    leaves."""
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
    chain: Chain, state: State, t0, t1, *, ts, events, control, dt, rtol, atol, solver,
    stepsize_controller, stabilization, dynamics, adjoint, max_events, max_steps, progress_meter,
) -> tuple[Options, Float[Array, " times"], Plan]:  # fmt: skip
    """The call's options, save times and plan of events; ValueError for what cannot be right."""
    _check_state(chain, state)
    dtype, events = state.q.dtype, as_events(events)
    _check_times(t0, t1, ts, events)
    _check_steps(dt, rtol, atol, stepsize_controller)
    check_function("control", control)
    _check_kind("stepsize_controller", stepsize_controller, diffrax.AbstractStepSizeController)
    _check_kind("progress_meter", progress_meter, diffrax.AbstractProgressMeter)
    made = make_plan(chain, events, dtype)
    # on the host where nothing is traced: each operation that jax is given eagerly is a program of
    # its own
    of = lambda x: np.asarray(x, dtype) if is_concrete(x) else jnp.asarray(x, dtype)
    host = np if is_concrete(t0, t1) else jnp
    span = of(t1) - of(t0)
    controller = stepsize_controller
    if controller is None:
        smallest = np.finfo(dtype).eps * host.maximum(host.abs(span), host.abs(of(t1)))
        controller = _controller(rtol, atol, smallest, dtype)
    options = Options(
        control=control,
        solver=_resolve_solver(solver, None if dt is not None else controller, dtype),
        stabilization=_stabilization(stabilization),
        dynamics=_dynamics(chain, dynamics),
        controller=controller,
        adjoint=_adjoint(adjoint, controller if dt is None else None),
        progress_meter=diffrax.NoProgressMeter() if progress_meter is None else progress_meter,
        dt=None if dt is None else jnp.asarray(dt, dtype),
        first_step=jnp.asarray(host.maximum(span, np.finfo(dtype).tiny) * 1e-3, dtype),
        max_events=_capacity(max_events, made),
        max_steps=_step_bound(max_steps, span, dt),
        has_work=control is not None or chain.limit is not None or chain.damping is not None,
        gap=1e3 * gap_tolerance(dtype),
    )
    save_at = host.stack([of(t0), of(t1)]) if ts is None else ts
    return options, jnp.asarray(save_at, dtype), made


def _controller(rtol, atol, smallest, dtype) -> diffrax.PIDController:
    """Return the default control of adaptive steps. smallest: step (s)."""
    # as arrays: another tolerance is the same program
    rtol, atol = resolve_tolerances(dtype, rtol, atol)
    return diffrax.PIDController(
        rtol, atol, norm=rms_norm, dtmin=jnp.asarray(smallest, dtype), force_dtmin=False
    )


def _check_steps(dt, rtol, atol, stepsize_controller) -> None:
    """Check that steps are asked for in one way."""
    for name, value in (("dt", dt), ("rtol", rtol), ("atol", atol)):
        if value is not None:
            positive_scalar(name, value)
    tolerance = rtol is not None or atol is not None
    if dt is not None and (tolerance or stepsize_controller is not None):
        raise ValueError(
            "dt asks for fixed steps, rtol, atol and stepsize_controller for others; give one of"
            " them"
        )
    if stepsize_controller is not None and tolerance:
        raise ValueError("rtol and atol belong inside the stepsize_controller that is given")


def _check_kind(name: str, value, kind: type) -> None:
    """Check that an option is of a class of diffrax's."""
    if value is not None and not isinstance(value, kind):
        raise ValueError(f"{name}: expected a diffrax one, got {value!r}")


def _stabilization(stabilization) -> AbstractStabilization:
    """Return what is done about the drift of the loops, or the default."""
    if stabilization is None:
        return Projection()
    if not isinstance(stabilization, AbstractStabilization):
        raise ValueError(
            "stabilization: expected an object of svkc.stabilization, such as"
            f" svkc.stabilization.Projection(), got {stabilization!r}"
        )
    return stabilization


def _dynamics(chain: Chain, dynamics) -> AbstractDynamics:
    """Return the way to compute accelerations, or the default one of the chain."""
    if dynamics is None:
        return default_dynamics(chain)
    if isinstance(dynamics, Dynamics):
        return dynamics.resolved(chain)
    if not isinstance(dynamics, AbstractDynamics):
        raise ValueError(
            "dynamics: expected an object of svkc.dynamics, such as"
            f" svkc.dynamics.CompositeBodies(), got {dynamics!r}"
        )
    return dynamics


def _resolve_solver(solver, controller, dtype) -> diffrax.AbstractSolver:
    """The solver, or the default; one with implicit stages solves them as closely as steps are
    controlled, or, where they are not, to sqrt(eps)."""
    if solver is None:
        return (
            diffrax.Dopri8()
            if np.finfo(dtype).eps < 1e-10 and controller is not None
            else diffrax.Tsit5()
        )
    if not isinstance(solver, diffrax.AbstractSolver):
        raise ValueError(f"solver: expected a diffrax solver, got {solver!r}")
    if isinstance(controller, diffrax.AbstractAdaptiveStepSizeController) and not isinstance(
        solver, diffrax.AbstractAdaptiveSolver
    ):
        raise ValueError(
            f"solver: {type(solver).__name__} does not estimate the errors of its steps; give dt,"
            " or another solver"
        )
    if not isinstance(solver, diffrax.AbstractImplicitSolver):
        return solver
    finder = solver.root_finder
    given = {name: getattr(controller, name, None) for name in ("rtol", "atol", "norm")}
    # diffrax marks what is to be the step-size controller's with a thing that is neither a number
    # nor a function
    left_open = [
        name
        for name in given
        if not (callable(x := getattr(finder, name, 0.0)) or eqx.is_inexact_array_like(x))
    ]
    if None in given.values() and left_open:
        # a step that cannot be made shorter has to be solved: by Newton's method
        close = float(np.finfo(dtype).eps ** 0.5)
        return eqx.tree_at(
            lambda s: s.root_finder, solver, optimistix.Newton(close, close, norm=rms_norm)
        )
    if left_open and isinstance(finder, diffrax.VeryChord):
        solver = eqx.tree_at(lambda s: s.root_finder, solver, SimplifiedNewton(0.0, 0.0))
    return eqx.tree_at(
        lambda s: [getattr(s.root_finder, name) for name in left_open],
        solver,
        [given[name] for name in left_open],
    )


def _adjoint(adjoint, controller) -> diffrax.AbstractAdjoint | Replay:
    """Steps that do not meet the save times are not gone through again: what is saved is
    interpolated between them."""
    meets = controller is None or isinstance(controller, diffrax.AbstractAdaptiveStepSizeController)
    if adjoint is None:
        return Replay() if meets else diffrax.RecursiveCheckpointAdjoint()
    if not isinstance(adjoint, Replay | diffrax.AbstractAdjoint):
        raise ValueError(
            f"adjoint: expected svkc.integrators.Replay or a diffrax adjoint, got {adjoint!r}"
        )
    if isinstance(adjoint, Replay) and not meets:
        raise ValueError(
            "adjoint: svkc.integrators.Replay needs dt or an adaptive stepsize_controller; give a diffrax"
            " adjoint with this one"
        )
    return adjoint


def _capacity(max_events, made: Plan) -> int:
    if max_events is None:
        return len(made.timed) + 4 * len(made.guarded)
    most = integer("max_events", max_events, 0)
    return most if made.actions else 0


def _step_bound(max_steps, span, dt) -> int:
    if max_steps is not None:
        return integer("max_steps", max_steps, 1)
    # room for every fixed step, and for those that save times and events make shorter
    if dt is None or not is_concrete(span, dt):
        return 65536
    steps = float(np.max(np.asarray(span / dt)))
    if not steps < 1e9:
        raise ValueError(
            f"dt: got {dt}, with which a run of {float(span):g} s has more than 1e9 steps; give a"
            " larger one, or max_steps"
        )
    return max(65536, int(1.1 * steps) + 1024)


def _check_state(chain: Chain, state: State):
    check_state(chain, state)
    if state.q.dtype == np.float64 and not jax.config.read("jax_enable_x64"):
        raise ValueError(
            "state and chain are float64, but jax_enable_x64 is off now; make them in the precision"
            " that simulate is to compute in"
        )
    if is_concrete(state) and not (
        np.isfinite(np.asarray(state.q)).all() and np.isfinite(np.asarray(state.v)).all()
    ):
        raise ValueError("state: q and v must be finite")


def _check_times(t0, t1, ts, events):
    for name, value in (("t0", t0), ("t1", t1)):
        scalar(name, value)
    times = None if ts is None else finite_array("ts", ts)
    if not is_concrete(t0, t1):
        return
    if not t1 >= t0 or not np.isfinite(t1) or not np.isfinite(t0):
        raise ValueError(f"t1: got {t1}, expected a time at or after t0 = {t0}")
    if ts is not None and is_concrete(ts):
        times = np.asarray(times)
        if (
            times.ndim != 1
            or not times.size
            or np.any(np.diff(times) < 0)
            or np.any((times < t0) | (times > t1))
        ):
            raise ValueError(
                f"ts: expected times in order from t0 = {t0} to t1 = {t1}, got {times}"
            )
    for event in events:
        if (
            isinstance(event, At)
            and is_concrete(event.time)
            and not np.all((np.asarray(event.time) >= t0) & np.isfinite(np.asarray(event.time)))
        ):
            raise ValueError(f"at: got time {event.time}, before the start of the run at {t0}")
