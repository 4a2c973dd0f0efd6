"""The dial turned on a scene of one's own: which integrator, step and way against drift is the
fastest that holds an error."""

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
from svkc.model.chain import Chain, State
from svkc.model.checked_jit import check_state
from svkc.model.validation import integer, positive_scalar, scalar
from svkc.simulation.options import resolve_tolerances
from svkc.simulation.records import RESULTS
from svkc.simulation.simulate import simulate
from svkc.simulation.trajectory import Trajectory
from svkc.tree.configuration import difference


@dataclasses.dataclass(frozen=True)
class Candidate:
    """Options of `simulate` under a name, and what they were found to cost and to give."""

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
    """`best`: options to give to `simulate` (None: no candidate holds the target); `table`: every
    candidate, the fastest that hold it first. Printed, it is that table."""

    target: float
    best: dict[str, Any] | None
    table: tuple[Candidate, ...]

    def __str__(self) -> str:
        lines = [
            f"target {self.target:.1e}       seconds of computing    error  loop gap  energy drift "
            " steps"
        ]
        for c in self.table:
            mark = "*" if c.options is self.best else ("+" if c.error <= self.target else " ")
            lines.append(
                f"{mark} {c.name:<32}{c.seconds:10.4f}{c.error:11.1e}{c.gap:10.1e}"
                f"{c.energy_drift:14.1e}{c.steps:7d}  {c.result}".rstrip()
            )
        return "\n".join(
            [
                *lines,
                (
                    "* the fastest that holds the target, + those that hold it too"
                    if self.best
                    else "no candidate holds the target"
                ),
            ]
        )


def default_candidates(dtype, span: float) -> list[Candidate]:
    """From fast to exact: fixed steps of low order, adaptive ones of higher order, with and without
    projection, by articulated bodies; an implicit one."""
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
                Candidate(f"{name}, drift", options | {"stabilization": NoStabilization()})
            )
            candidates.append(
                Candidate(f"{name}, by bodies", options | {"dynamics": ArticulatedBodies()})
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
    """Root mean square, over coordinates and save times, of how far two runs are apart in
    configuration (rad, m); the largest over the save times."""
    errors = jax.vmap(lambda a, b: difference(chain, a, b)[: chain.nv])(
        reference.states.q, run.states.q
    )
    return float(jnp.max(jnp.sqrt(jnp.mean(errors**2, 1))))


def estimate_error(chain: Chain, state: State, t1, **options) -> float:
    """Integration error of a run, by a second one with half its dt, or with a 32nd of its
    tolerances: `error_between` the two.

    options: of `simulate`. An estimate of the first run's error where the second one's is much
    smaller.
    """
    run = simulate(chain, state, t1, **options)
    if "dt" in options:
        finer_options = options | {"dt": options["dt"] / 2}
    else:
        rtol, atol = resolve_tolerances(state.q.dtype, options.get("rtol"), options.get("atol"))
        finer_options = options | {"rtol": rtol / 32, "atol": atol / 32}
    return configuration_error(chain, run, simulate(chain, state, t1, **finer_options))


def tune(
    chain: Chain,
    state: State,
    t1,
    target: float = 1e-6,
    options: Sequence[Candidate] | None = None,
    repeats: int = 3,
    show: bool = True,
    **common,
) -> Tuning:
    """Runs candidates on this scene and tells the fastest whose configuration stays within `target`
    (rad, m; root mean square over the coordinates, largest over the save times) of a run with much
    smaller tolerances.

    options: the candidates (None: fixed and adaptive steps of several orders, `candidates`). show:
    print each as it is found, and the table in the end. call: ts, events, control, args and
    whatever else of `simulate` all runs share. Seconds are those of computing alone, the least of
    `repeats` runs; what takes ten times the best so far is not repeated. ValueError: a target that
    is not positive, or no reference that holds.
    """
    check_state(chain, state)
    target, t1, repeats = (
        positive_scalar("target", target),
        scalar("t1", t1),
        integer("repeats", repeats, 1),
    )
    dtype, span = state.q.dtype, float(t1) - float(common.get("t0", 0.0))
    reference_rtol = float(max(target * 1e-3, 50 * np.finfo(dtype).eps))
    common = {
        "ts": jnp.linspace(common.get("t0", 0.0), t1, 11, dtype=dtype),
        **common,
        "throw": False,
    }
    run = lambda **options: simulate(chain, state, t1, **common, **options)
    reference = run(solver=diffrax.Dopri8(), rtol=reference_rtol, atol=reference_rtol / 100)
    if reference.result != RESULTS.successful:
        raise ValueError(
            f"target: {target} cannot be judged, a run at rtol {reference_rtol:.1e} ends with:"
            f" {RESULTS[reference.result]}"
        )
    error = lambda traj: configuration_error(chain, traj, reference)
    measured, best = [], np.inf
    for candidate in default_candidates(dtype, span) if options is None else options:
        measured.append(_measure(run, candidate, error=error, repeats=repeats, limit=10 * best))
        if measured[-1].error <= target:
            best = min(best, measured[-1].seconds)
        if show:
            print(
                f"\r{len(measured)} tried, {candidate.name:<40}",
                end="",
                file=sys.stderr,
                flush=True,
            )
    table = sorted(measured, key=lambda c: (not c.error <= target, c.seconds))
    tuning = Tuning(
        target, table[0].options if table and table[0].error <= target else None, tuple(table)
    )
    if show:
        print(f"\r{tuning}", flush=True)
    return tuning


def _measure(
    run: Callable, candidate: Candidate, *, error: Callable, repeats: int, limit: float
) -> Candidate:
    """Return a candidate with what it costs and gives. limit (s): what takes longer is not
    repeated."""
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
