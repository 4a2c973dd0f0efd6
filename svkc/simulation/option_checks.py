"""Validation of the arguments of `simulate` that need no defaults: state, times, step sizes."""

from collections.abc import Iterable
from typing import Any, TypeAlias

import diffrax
import jax
import numpy as np

from svkc._jax.pytrees import is_concrete
from svkc.integration.stabilization import AbstractStabilization
from svkc.loops.constrained_dynamics import AbstractDynamics, Dynamics
from svkc.model.annotations import Checked
from svkc.model.chain import Chain, State
from svkc.model.checked_jit import check_state
from svkc.model.validation import finite_array, positive_scalar, scalar
from svkc.transitions.events import At, When

# arguments of `simulate`
EventList: TypeAlias = Checked[At | When | Iterable[At | When]]
Solver: TypeAlias = Checked[diffrax.AbstractSolver[Any]]
Controller: TypeAlias = Checked[diffrax.AbstractStepSizeController[Any, Any]]
Adjoint: TypeAlias = Checked[diffrax.AbstractAdjoint]
Progress: TypeAlias = Checked[diffrax.AbstractProgressMeter[Any]]
Stabilization: TypeAlias = Checked[AbstractStabilization]
AnyDynamics: TypeAlias = Checked[AbstractDynamics | Dynamics]


def check_step_options(dt: Any, rtol: Any, atol: Any, dtmax: Any, stepsize_controller: Any) -> None:
    """Raise ValueError unless dt, the tolerances or a controller alone sets the step size."""
    for name, value in (("dt", dt), ("rtol", rtol), ("atol", atol), ("dtmax", dtmax)):
        if value is not None:
            positive_scalar(name, value)
    if dtmax is not None:
        finite_array("dtmax", dtmax)
    adaptive = rtol is not None or atol is not None or dtmax is not None
    if dt is not None and (adaptive or stepsize_controller is not None):
        raise ValueError(
            "dt sets fixed steps; rtol, atol, dtmax and stepsize_controller set adaptive steps;"
            " give one or the other"
        )
    if stepsize_controller is not None and adaptive:
        raise ValueError("rtol, atol and dtmax: give them to the stepsize_controller instead")


def check_instance(name: str, value: Any, kind: type) -> None:
    """Raise ValueError if an option is neither None nor an instance of a class of diffrax."""
    if value is not None and not isinstance(value, kind):
        raise ValueError(f"{name}: expected a diffrax object for it, got {value!r}")


def check_solver(solver: Any) -> None:
    """Raise ValueError unless the solver is one of diffrax for ordinary differential equations."""
    if not isinstance(solver, diffrax.AbstractSolver):
        raise ValueError(f"solver: expected a diffrax solver, got {solver!r}")
    if solver.term_structure not in (diffrax.AbstractTerm, diffrax.ODETerm):
        raise ValueError(
            f"solver: {type(solver).__name__} needs a split or a stochastic vector field; use a"
            " solver of one ordinary differential equation, such as diffrax.Kvaerno5 or"
            " svkc.integrators.SymplecticEuler"
        )


def check_initial_state(chain: Chain, state: State) -> None:
    """Raise ValueError if the state does not belong to the chain or is not finite."""
    check_state(chain, state)
    if state.q.dtype == np.float64 and not jax.config.read("jax_enable_x64"):
        raise ValueError(
            "state and chain are float64, but jax_enable_x64 is off now; enable it, or load the"
            " chain and make the state in float32"
        )
    if is_concrete(state) and not (
        np.isfinite(np.asarray(state.q)).all() and np.isfinite(np.asarray(state.v)).all()
    ):
        raise ValueError("state: q and v must be finite")


def check_times(t0: Any, t1: Any, ts: Any, events: Any) -> None:
    """Raise ValueError for invalid start, end, save and event times, if they are concrete."""
    for name, value in (("t0", t0), ("t1", t1)):
        scalar(name, value)
    times = None if ts is None else finite_array("ts", ts)
    if times is not None and (times.ndim != 1 or not times.size):
        raise ValueError(f"ts: expected one or more times, got an array of shape {times.shape}")
    if not is_concrete(t0, t1):
        return
    if not t1 >= t0 or not np.isfinite(t1) or not np.isfinite(t0):
        raise ValueError(f"t1: got {t1}, expected a time at or after t0 = {t0}")
    if ts is not None and is_concrete(ts):
        times = np.asarray(times)
        if np.any(np.diff(times) < 0) or np.any((times < t0) | (times > t1)):
            raise ValueError(
                f"ts: expected non-decreasing times from t0 = {t0} to t1 = {t1}, got {times}"
            )
    for event in events:
        if not isinstance(event, At) or not is_concrete(event.time):
            continue
        if np.any(np.isnan(np.asarray(event.time))):
            raise ValueError(f"at: got time {event.time}, expected a number")
        # an event at an infinite time does not happen
        if np.any(np.asarray(event.time) < (t0 if event.after is None else 0)):
            if event.after is not None:
                raise ValueError(f"at: got time {event.time} after an event, expected 0 or more")
            raise ValueError(f"at: got time {event.time}, before the start of the run at {t0}")
