"""The backflip by svkc alone, with its defaults: mesh refinement, and many noisy guesses.

`python benchmarks/optimize_motions.py refined` solves from straight lines between poses. It refines
the mesh until each interval, simulated from its first node, ends within 1e-3 rad (m) and 1e-2 rad/s
(m/s) of the next node. `... starts [--starts 20] [--processes 2] [--solver NAME]` solves from noisy
guesses in several processes. Both (extra `optimize`) print a table and write it to results/.

Seconds are wall time: that of the solver, and that of a whole round with tracing and compilation.
Costs are J / 1e6.
"""

import argparse
import csv
import os
import pathlib
import platform
import time

# several threads for small dense blocks cost more time than they save
os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
os.environ.setdefault("JAX_PLATFORMS", "cpu")

import jax

jax.config.update("jax_enable_x64", True)

from svkc import optimize
from svkc.scenes.backflip import backflip
from svkc.scenes.backflip_problem import backflip_guess, backflip_problem

RESULTS = pathlib.Path(__file__).parent / "results"
SOLVER = optimize.Ipopt(tolerance=1e-6)
TOLERANCE = 1e-3
ROUNDS = 8
# of each noisy start: one that needs more would delay the others
MOST_ITERATIONS = 500


def write(name: str, rows: list[dict]) -> None:
    """Write rows, with the versions and the machine, to a table in results/."""
    model = next(line for line in open("/proc/cpuinfo") if line.startswith("model name"))
    machine = {
        "jax": jax.__version__,
        "python": platform.python_version(),
        "processor": model.split(":")[1].strip(),
        "cores": os.cpu_count(),
    }
    with (RESULTS / name).open("w", newline="") as file:
        table = csv.DictWriter(file, [*rows[0], *machine], lineterminator="\n")
        table.writeheader()
        table.writerows(row | machine for row in rows)


def show(row: dict) -> None:
    """Print a row."""
    print(", ".join(f"{name} {value}" for name, value in row.items()), flush=True)


def refined() -> None:
    """Solve from straight lines, refine the mesh round by round, and write a row for each round."""
    problem = backflip_problem(backflip()[0])
    rows, begin = [], time.perf_counter()
    solution = problem.solve(backflip_guess(problem), solver=SOLVER)
    for k in range(ROUNDS + 1):
        solved = time.perf_counter() - begin
        position, velocity = solution.report(replay=False).largest()
        row = {
            "round": k,
            "intervals": " ".join(str(len(m.vdot)) for m in solution.motion),
            "cost": f"{float(solution.cost) / 1e6:.6f}",
            "change": f"{float(solution.cost_error) / 1e6:.6f}" if k else "",
            "iterations": int(solution.iterations),
            "solver s": f"{float(solution.seconds[0]):.1f}",
            "with compilation s": f"{solved:.1f}",
            "position": f"{position:.2e}",
            "velocity": f"{velocity:.2e}",
        }
        rows.append(row)
        show(row)
        if position < TOLERANCE and velocity < 10 * TOLERANCE:
            break
        begin = time.perf_counter()
        solution = solution.refined(TOLERANCE, rounds=1, solver=SOLVER)
    write("optimize_refined.csv", rows)
    print(solution, solution.report(), sep="\n")


def starts(count: int, processes: int, name: str) -> None:
    """Solve from `count` noisy guesses and write a row for each. name: of the solver's class."""
    problem = backflip_problem(backflip()[0])
    guesses = [backflip_guess(problem, noise=0.2, key=key) for key in range(count)]
    begin = time.perf_counter()
    solver = getattr(optimize, name)(tolerance=1e-6, max_iterations=MOST_ITERATIONS)
    solutions = problem.multistart(guesses, processes=processes, solver=solver)
    wall = time.perf_counter() - begin
    rows = [
        {
            "start": k,
            "result": str(solution.result),
            "cost": f"{float(solution.cost) / 1e6:.6f}",
            "violation": f"{float(solution.violation):.1e}",
            "iterations": int(solution.iterations),
            "solver s": f"{float(solution.seconds[0]):.1f}",
            "processes": processes,
            "all starts s": f"{wall:.0f}",
        }
        for k, solution in enumerate(solutions)
    ]
    print(solutions)
    best = solutions.best
    print(f"{wall:.0f} s in {processes} processes; best cost {best and float(best.cost):.6g}")
    write("optimize_starts.csv" if name == "Ipopt" else f"optimize_starts_{name}.csv", rows)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("what", choices=["refined", "starts"])
    parser.add_argument("--starts", type=int, default=20, help="number of noisy guesses")
    parser.add_argument("--processes", type=int, default=os.cpu_count())
    parser.add_argument("--solver", choices=["Ipopt", "InteriorPoint"], default="Ipopt")
    options = parser.parse_args()
    if options.what == "refined":
        refined()
    else:
        starts(options.starts, options.processes, options.solver)
