"""Accuracy of runs: an error estimate, and a search for the fastest options that reach a target.

These functions call `simulate`. They are no part of a run.
"""

import dataclasses
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

from svkc.integration.integrators import RodriguesEuler, SymplecticEuler
from svkc.integration.stabilization import NoStabilization, Projection
from svkc.loops.constrained_dynamics import ArticulatedBodies
from svkc.model.annotations import DType, Scalar
from svkc.model.chain import Chain, State
from svkc.model.checked_jit import check_state
from svkc.model.validation import integer, positive_scalar, scalar
from svkc.simulation.codes import RESULTS
from svkc.simulation.options import resolve_tolerances
from svkc.simulation.simulate import simulate
from svkc.simulation.trajectory import Trajectory
from svkc.tree.configuration import difference


@dataclasses.dataclass(frozen=True)
class Candidate:
    """Named options of `simulate`, with the cost and accuracy that `tune` measured for them.

    name: label in the table.
    options: keyword arguments of `simulate`.
    seconds: shortest computing time of a run (s), without compilation.
    error: `configuration_error` relative to the reference run (rad, m).
    gap: largest loop gap of the run (m or rad, the larger number).
    energy_drift: energy drift of the run (J).
    steps: accepted and rejected steps.
    result: name of the run's result code.
    """

    name: str
    options: dict[str, Any]
    seconds: float = np.inf
    error: float = np.inf
    gap: float = np.inf
    energy_drift: float = np.inf
    steps: int = 0
    result: str = ""


@dataclasses.dataclass(frozen=True)
class Tuning:
    """The result of `tune`. `str` of a `Tuning` is a table of all candidates.

    target: largest error that was allowed (rad, m).
    best: options of the fastest candidate that reached the target. None if no candidate did.
    table: all measured candidates, those that reached the target first, each group by seconds.
    """

    target: float
    best: dict[str, Any] | None
    table: tuple[Candidate, ...]

    def __str__(self) -> str:
        lines = [
            f"target {self.target:.1e}               seconds of computing    error  loop gap"
            "  energy drift  steps"
        ]
        for c in self.table:
            mark = "*" if c.options is self.best else ("+" if c.error <= self.target else " ")
            lines.append(
                f"{mark} {c.name:<40}{c.seconds:10.4f}{c.error:11.1e}{c.gap:10.1e}"
                f"{c.energy_drift:14.1e}{c.steps:7d}  {c.result}".rstrip()
            )
        return "\n".join(
            [
                *lines,
                (
                    "* the fastest that holds the target, + those that hold it too"
                    if self.best is not None
                    else "no candidate holds the target"
                ),
            ]
        )


def default_candidates(dtype: DType, span: float) -> list[Candidate]:
    """Return the candidates of `tune`, from fast to accurate.

    They are explicit solvers with fixed steps, explicit solvers with adaptive steps (with
    projection, without stabilization, and with articulated bodies), and one implicit solver.

    dtype: dtype of the state. Tolerances go down to 1e-10 in float64, to 1e-5 in float32.
    span: duration of the run (s). A fixed step is at most a quarter of the span.
    """
    candidates = []
    for steps in (1e-2, 1e-3):
        for solver in (SymplecticEuler(), RodriguesEuler(), diffrax.Heun(), diffrax.Tsit5()):
            dt = min(steps, span / 4)
            candidates.append(
                Candidate(f"{type(solver).__name__}, dt {dt:g}", {"solver": solver, "dt": dt})
            )
    double = np.finfo(dtype).eps < 1e-10
    for rtol in (1e-4, 1e-6, 1e-8, 1e-10) if double else (1e-3, 1e-4, 1e-5):
        for solver in (diffrax.Tsit5(), diffrax.Dopri8()):
            name, options = (
                f"{type(solver).__name__}, rtol {rtol:g}",
                {"solver": solver, "rtol": rtol, "atol": rtol / 100},
            )
            candidates.append(Candidate(name, options | {"stabilization": Projection()}))
            candidates.append(
                Candidate(
                    f"{name}, no stabilization", options | {"stabilization": NoStabilization()}
                )
            )
            candidates.append(
                Candidate(
                    f"{name}, articulated bodies", options | {"dynamics": ArticulatedBodies()}
                )
            )
        if rtol >= 1e-8:
            candidates.append(
                Candidate(
                    f"Kvaerno5, rtol {rtol:g}",
                    {"solver": diffrax.Kvaerno5(), "rtol": rtol, "atol": rtol / 100},
                )
            )
    return candidates


def configuration_error(chain: Chain, run: Trajectory, reference: Trajectory) -> float:
    """Return the distance between the configurations of two runs.

    The distance at one save time is the root mean square over the coordinates of the tree (rad, m).
    The result is the largest distance over the save times.

    run: the run to judge.
    reference: a run with the same save times.
    """
    errors = jax.vmap(lambda a, b: difference(chain, a, b)[: chain.nv])(
        reference.states.q, run.states.q
    )
    return float(jnp.max(jnp.sqrt(jnp.mean(errors**2, 1))))


def estimate_error(chain: Chain, state: State, t1: Scalar, **options: Any) -> float:
    """Return an estimate of a run's integration error from a second, finer run.

    The finer run has half the step (`dt`), or tolerances (`rtol`, `atol`) divided by 32. The result
    is the `configuration_error` between the two runs (rad, m). The estimate is good if the finer
    run's own error is much smaller. It is infinite if one of the runs fails (`throw=False`).

    t1: end time (s).
    options: keyword arguments of `simulate`. The finer run may take eight times `max_steps`.

    Raises ValueError if a `stepsize_controller` is given, and what `simulate` raises.
    """
    if options.get("stepsize_controller") is not None:
        raise ValueError(
            "stepsize_controller: its tolerances cannot be reduced; give rtol and atol, or dt"
        )
    run = simulate(chain, state, t1, **options)
    if options.get("dt") is not None:
        finer: dict[str, Any] = {"dt": options["dt"] / 2}
    else:
        rtol, atol = resolve_tolerances(state.q.dtype, options.get("rtol"), options.get("atol"))
        finer = {"rtol": rtol / 32, "atol": atol / 32}
    if options.get("max_steps") is not None:
        finer["max_steps"] = 8 * options["max_steps"]
    reference = simulate(chain, state, t1, **(options | finer))
    for traj in (run, reference):
        if traj.result != RESULTS.successful and traj.result != RESULTS.stopped:
            return np.inf
    return configuration_error(chain, run, reference)


def tune(
    chain: Chain, state: State, t1: Scalar, target: float = 1e-6,
    options: Sequence[Candidate] | None = None, repeats: int = 3, show: bool = True, **common: Any,
) -> Tuning:  # fmt: skip
    """Measure candidate options on this scene and return them, the fastest sufficient one first.

    A candidate is sufficient if its `configuration_error` relative to a reference run is at most
    `target`. The reference run is Dopri8 at rtol = target / 1000, or 50 machine epsilons if
    that is larger.

    t1: end time (s).
    target: allowed error (rad, m; root mean square over coordinates, largest over save times).
    options: sequence of `Candidate` to measure. None: `default_candidates`.
    repeats: timed runs of each candidate, after one that compiles. The shortest run counts. A
        candidate that takes ten times as long as the best so far is not repeated.
    show: whether to print progress and the final table.
    common: keyword arguments of `simulate` that all runs share, such as `events`, `control`,
        `args`, or `ts` (default: 11 equally spaced times).

    Raises ValueError if `target` is not positive or if the reference run fails.
    """
    check_state(chain, state)
    target, t1 = positive_scalar("target", target), scalar("t1", t1)
    repeats = integer("repeats", repeats, 1)
    t0, dtype = common.get("t0", 0.0), state.q.dtype
    common = {"ts": jnp.linspace(t0, t1, 11, dtype=dtype), **common, "throw": False}
    run = lambda **options: simulate(chain, state, t1, **common, **options)
    reference = _reference_run(run, target, dtype)
    error = lambda traj: configuration_error(chain, traj, reference)
    measured, best = [], np.inf
    if options is None:
        options = default_candidates(dtype, float(t1) - float(t0))
    for candidate in options:
        measured.append(_measure(run, candidate, error=error, repeats=repeats, limit=10 * best))
        if measured[-1].error <= target:
            best = min(best, measured[-1].seconds)
        if show:
            line = f"\r{len(measured)} tried, {candidate.name:<40}"
            print(line, end="", file=sys.stderr, flush=True)
    table = tuple(sorted(measured, key=lambda c: (not c.error <= target, c.seconds)))
    reached = bool(table) and table[0].error <= target
    tuning = Tuning(target, table[0].options if reached else None, table)
    if show:
        print(f"\r{tuning}", flush=True)
    return tuning


def _reference_run(run: Callable, target: float, dtype) -> Trajectory:
    """Return an accurate run. Raise ValueError if it does not succeed."""
    rtol = float(max(target * 1e-3, 50 * np.finfo(dtype).eps))
    reference = run(solver=diffrax.Dopri8(), rtol=rtol, atol=rtol / 100)
    if reference.result != RESULTS.successful:
        raise ValueError(
            f"target: {target} cannot be judged, a run at rtol {rtol:.1e} ends with:"
            f" {RESULTS[reference.result]}"
        )
    return reference


def _measure(
    run: Callable, candidate: Candidate, *, error: Callable, repeats: int, limit: float
) -> Candidate:
    """Run a candidate and return it with its measured cost and accuracy.

    limit: seconds after which a candidate is not repeated.
    """
    run_once = lambda: jax.block_until_ready(run(**candidate.options))
    traj, seconds = run_once(), np.inf
    for _ in range(repeats):
        start = time.perf_counter()
        run_once()
        seconds = min(seconds, time.perf_counter() - start)
        if seconds > limit:
            break
    report = traj.report()
    successful = traj.result == RESULTS.successful
    return dataclasses.replace(
        candidate,
        seconds=seconds,
        error=error(traj) if successful else np.inf,
        gap=float(jnp.maximum(report.gap, report.angular_gap)),
        energy_drift=float(report.energy_drift),
        steps=int(report.accepted + report.rejected),
        result=RESULTS[traj.result],
    )
