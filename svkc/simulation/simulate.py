"""`simulate`: a scan over phases, with a change of structure after each phase.

A phase has one structure and one smooth vector field. A phase ends at the next scheduled time, or
at the first zero crossing of a guard. A crossing is located by re-taking the step in which the
guard changed sign, so that its time and state have the order of the solver and not the order of an
interpolation. In a batch, lanes that have ended run phases of zero length until all have ended.
"""

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from svkc._jax.control_flow import unvmap_any
from svkc._jax.eager import eager_jit
from svkc._jax.functions import call_with_comparable
from svkc._jax.primitive import ClosureConverted
from svkc._jax.pytrees import is_concrete, stop_gradient_tree
from svkc.integration.replay import Replay
from svkc.integration.runge_kutta import without_dense_output
from svkc.model.annotations import Function, Integer, Numbers, Scalar
from svkc.model.chain import Chain, State
from svkc.simulation.certificate import certificate, evaluations_per_step
from svkc.simulation.codes import DERIVATIVE, RESULTS
from svkc.simulation.option_checks import (
    Adjoint,
    AnyDynamics,
    Controller,
    EventList,
    Progress,
    Solver,
    Stabilization,
)
from svkc.simulation.options import Options, prepare_options
from svkc.simulation.phase import RunState
from svkc.simulation.run import initial_run_state, needs_phase, run_phase, with_lock_mask
from svkc.simulation.trajectory import Trajectory
from svkc.transitions.events import stop_gradient_of_events
from svkc.transitions.plan import Plan


def simulate(
    chain: Chain, state: State, t1: Scalar, *, t0: Scalar = 0.0, ts: Numbers | None = None,
    events: EventList = (), control: Function | None = None, args: Any = None,
    dt: Scalar | None = None, rtol: Scalar | None = None, atol: Scalar | None = None,
    solver: Solver | None = None, stepsize_controller: Controller | None = None,
    stabilization: Stabilization | None = None, dynamics: AnyDynamics | None = None,
    adjoint: Adjoint | None = None, max_events: Integer | None = None, dtmax: Scalar | None = None,
    max_steps: Integer | None = None, throw: bool = True, progress_meter: Progress | None = None,
) -> Trajectory:  # fmt: skip
    """Integrate the motion from t0 to t1, through the changes of structure of `events`.

    t0, t1: start and end of the run (s).
    ts: save times (s), which steps meet exactly; None: t0 and t1. A state saved at the time of an
        event is the state after the event. Times past the end of a lane hold its last state.
    events: `svkc.at(...)`, `svkc.when(...)`, or several.
    control: function (t, state, args) -> torques (N m, N): [dofs], the tree's [nv], or by joint.
    args: passed to `control` and to guards.
    dt: fixed step size (s). dtmax: longest adaptive step (s); `stepsize_controller` has its own.
    rtol, atol: tolerances of adaptive steps; by default 1e-7 (float32: 1e-4) and a hundredth of
        rtol.
    solver: of diffrax; by default Dopri8, or Tsit5 with dt or in float32.
    stepsize_controller, progress_meter: of diffrax.
    stabilization: of `svkc.stabilization`; by default `Projection()`.
    dynamics: of `svkc.dynamics`; None: chosen for the chain.
    adjoint: `svkc.integrators.Replay()`, the default, or an adjoint of diffrax.
    max_events: capacity for events; by default one for each timed event, four for each guard and
        each event after a guard. The run ends before the next event.
    max_steps: bound on the number of steps in one phase.
    throw: raise RuntimeError if the run fails; False returns the trajectory, whose `result` says
        why the run failed.

    Functions are compared by their code and by the values that they read (defaults, closures,
    globals), so that an equal function is not compiled again. Floating-point arrays among these
    values are data; numbers, integer arrays and arrays that Python reads are static. A function
    that reads other objects is compared by identity: a `UserWarning` names the argument if this
    compiles it again. Raises ValueError for invalid arguments.
    """
    options, save_at, plan = prepare_options(
        chain, state, t0, t1, ts=ts, events=events, control=control, dt=dt, rtol=rtol, atol=atol,
        dtmax=dtmax, solver=solver, stepsize_controller=stepsize_controller,
        stabilization=stabilization, dynamics=dynamics, adjoint=adjoint, max_events=max_events,
        max_steps=max_steps, progress_meter=progress_meter,
    )  # fmt: skip
    times = jnp.asarray(t0, state.q.dtype), jnp.asarray(t1, state.q.dtype), save_at
    run = lambda control, events: _run(
        chain, state, times, replace(plan, guards=events), replace(options, control=control), args
    )
    run = call_with_comparable(run, control=options.control, events=plan.guards)
    traj = _certified(chain, run, times, options)
    return _raise_on_failure(chain, traj, (control, events, args, dt)) if throw else traj


def _raise_on_failure(chain: Chain, traj: Trajectory, arguments) -> Trajectory:
    """Return the trajectory. Raises RuntimeError (a runtime error under jit) if the run failed.

    arguments: control, events, args and dt of the run.
    """
    result, success = traj.result, (RESULTS.successful, RESULTS.stopped)
    if not is_concrete(result._value):
        return result.error_if(traj, (result != success[0]) & (result != success[1]))
    if np.all(np.isin(np.asarray(result._value), [code._value for code in success])):
        return traj
    # inside of jvp and grad the primal values are concrete
    control, events, args, dt = arguments
    chain, traj, control, args, dt = stop_gradient_tree((chain, traj, control, args, dt))
    events = stop_gradient_of_events(events)
    phase, loop = int(traj.phases.count), int(traj.report().loop)
    where = f"phase {phase}" if loop < 0 else f"phase {phase}, loop {chain.link_names[loop]!r}"
    reason = RESULTS[result]
    if result == RESULTS.non_finite and is_concrete(chain, traj, control, events, args, dt):
        source = traj.trace_non_finite(chain, control=control, events=events, args=args, dt=dt)
        reason += f" First: {source}"
    raise RuntimeError(f"simulate stopped at t = {float(traj.t_final):.9g} s, in {where}: {reason}")


@eqx.filter_jit
def _run(chain: Chain, state: State, times, plan: Plan, options: Options, args) -> RunState:
    """Run all phases. The capacity for events bounds their number.

    times: start, end and save times.
    """
    t0, t1, ts = times
    plan, options = _closure_convert(chain, state, t0, plan, options, args)
    run = initial_run_state(chain, state, times, plan, options)

    def phase(run: RunState, index):
        return run_phase(chain, run, index, (t1, ts), plan=plan, options=options, args=args)

    def scan_body(run: RunState, index):
        if not isinstance(options.adjoint, Replay):
            # JAX refuses progress meters and other effects in a conditional under `vmap`; `Replay`
            # hides them in its primitive
            return phase(run, index), None
        # Most runs have fewer events than the capacity. The phases left over are skipped, in a
        # batch once all lanes have ended.
        needed = unvmap_any(needs_phase(run, t1))
        return jax.lax.cond(needed, lambda: phase(run, index), lambda: run), None

    if options.max_events == 0:
        return phase(run, jnp.asarray(0))
    return jax.lax.scan(scan_body, run, jnp.arange(options.max_events + 1))[0]


def _with_certificate(
    chain: Chain, run: RunState, ts, t1, gap_tolerance: float, stages: int
) -> Trajectory:
    """Return the trajectory of a run with its certificate.

    gap_tolerance: largest loop gap that does not fail a run (rad, m).
    stages: evaluations of the vector field in one attempted step.
    """
    incomplete = (run.t < t1) & (run.result == RESULTS.successful)
    result = RESULTS.where(incomplete, RESULTS.max_events, run.result)
    phases, saved, rank_lost_at = certificate(
        chain, run.records, run.count, (ts, run.saved), stages
    )
    largest_gap = jnp.maximum(jnp.max(saved.gap), jnp.max(phases.gap))
    ended = (result == RESULTS.successful) | (result == RESULTS.stopped)
    is_open = ended & (largest_gap > gap_tolerance)
    result = RESULTS.where(is_open, RESULTS.loop_open, result)
    derivative = DERIVATIVE.where(
        (rank_lost_at < phases.start.shape[0]) & (rank_lost_at <= run.invalid_from),
        DERIVATIVE.rank_lost,
        run.derivative,
    )
    return Trajectory(
        ts=ts,
        states=run.saved,
        work=jnp.zeros((ts.shape[0], 3), ts.dtype) if run.saved_work is None else run.saved_work,
        gaps=saved.gap,
        gap_rates=saved.gap_rate,
        events=run.events,
        phases=phases,
        final=run.state,
        t_final=run.t,
        result=result,
        derivative=derivative,
        names=chain.names,
    )


# The certificate visits each state once, so compile time outweighs run time up to this many states.
MAX_EAGER_STATES = 1000
_certify, _certify_eagerly = (
    eqx.filter_jit(_with_certificate),
    eager_jit(_with_certificate, eqx.filter_jit),
)


def _certified(chain: Chain, run: RunState, times, options: Options) -> Trajectory:
    """Return the trajectory of a run with its certificate. times: start, end and save times."""
    _, t1, ts = times
    certify = _certify_eagerly if len(ts) <= MAX_EAGER_STATES else _certify
    solver = options.solver
    if run.guard_values is None and isinstance(options.adjoint, Replay):
        solver = without_dense_output(solver)
    stages = evaluations_per_step(solver)
    return certify(chain, run, ts, t1, options.gap_tolerance, stages)


def _closure_convert(
    chain: Chain, state: State, t0, plan: Plan, options: Options, args
) -> tuple[Plan, Options]:
    """Return the plan and the options with closure-converted guards and control, so that
    derivatives by the arrays that these functions close over exist."""
    state = with_lock_mask(chain, state, plan)
    guards = tuple(g.closure_convert(t0, state, args) for g in plan.guards)
    control = options.control
    control = None if control is None else ClosureConverted.from_function(control, t0, state, args)
    return replace(plan, guards=guards), replace(options, control=control)
