"""Optimization of a backflip with a loop that closes in flight: svkc compared with CasADi.

Both solve one transcription (Radau IIA, two stages, 130 intervals) of the problem in backflip.py
with IPOPT and MUMPS on one thread. They start from straight lines between poses, and from the same
noisy guesses. Costs in the table are J / 1e6.

`python benchmarks/optimize.py [--starts 20] [--by CasADi svkc]` (extras `bench`, `optimize`) prints
a table and writes it to results/optimize.csv. To confirm the optima, the last rows solve with
CasADi from the best solution of each other solver. `--confirm FILE` does this from a stored point
in the layout of backflip.py, and nothing else.

Columns in seconds are processor time by IPOPT's statistics: of the problem's functions, of linear
algebra (the primal-dual system), and in total. `ready` is the time before the first solve: graphs,
derivatives, compilation. Columns in milliseconds are times per iteration. svkc's functions run in
two threads, so their wall time, which has a column of its own, is shorter. The rows, Jacobian and
Hessian are also timed alone at the straight-line guess: medians of calls that alternate between the
solvers.
"""

import argparse
import csv
import importlib
import os
import pathlib
import platform
import statistics
import time

# several threads for small dense blocks cost more time than they save
os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
os.environ.setdefault("JAX_PLATFORMS", "cpu")

import backflip
import casadi
import numpy as np
import optimize_casadi

RESULTS = pathlib.Path(__file__).parent / "results"
# the module of each solver, which defines a class `Backflip`
SOLVERS = {"CasADi": "optimize_casadi", "svkc": "optimize_svkc"}
HEAD = [
    "start",
    "by",
    "result",
    "cost",
    "violation",
    "iterations",
    "functions s",
    "linear algebra s",
    "total s",
    "functions ms",
    "functions wall ms",
    "linear algebra ms",
    "ready s",
]
ROUNDS = 15


def row(start: str, by: str, solve: optimize_casadi.Solve, ready: float) -> list:
    """Return the table's row of a solve.

    start: name of the guess. by: name of the solver. ready: seconds before the first solve.
    """
    per_iteration = 1e3 / max(solve.iterations, 1)
    return [
        start,
        by,
        solve.status,
        f"{solve.cost / 1e6:.6g}",
        f"{solve.violation:.1e}",
        solve.iterations,
        f"{solve.functions_s:.2f}",
        f"{solve.linear_algebra_s:.2f}",
        f"{solve.total_s:.2f}",
        f"{solve.functions_s * per_iteration:.1f}",
        f"{solve.functions_wall_s * per_iteration:.1f}",
        f"{solve.linear_algebra_s * per_iteration:.1f}",
        f"{ready:.1f}",
    ]


def time_functions(problems: dict):
    """Yield (function, solver, ms of the processor, wall ms): medians of each function's calls."""
    calls = {by: p.functions(backflip.straight_line_guess()) for by, p in problems.items()}
    for name in ("rows", "Jacobian", "Hessian"):
        times = {by: [] for by in calls}
        for _ in range(ROUNDS + 1):
            for by, functions in calls.items():
                begin = time.process_time(), time.perf_counter()
                functions[name]()
                times[by].append((time.process_time() - begin[0], time.perf_counter() - begin[1]))
        for by, values in times.items():
            yield name, by, *(1e3 * statistics.median(x) for x in zip(*values[1:]))


def machine() -> dict:
    """Return versions, processor and number of cores."""
    names = [line for line in open("/proc/cpuinfo") if line.startswith("model name")]
    return {
        "python": platform.python_version(),
        "casadi": casadi.__version__,
        "processor": names[0].split(":")[1].strip(),
        "cores": os.cpu_count(),
    }


def main(starts: int, solvers: list[str]):
    """Measure, print and write all rows. starts: number of noisy guesses."""
    problems = {by: importlib.import_module(SOLVERS[by]).Backflip() for by in solvers}
    guesses = {"straight lines": backflip.straight_line_guess()}
    guesses |= {f"noise {seed}": backflip.noisy_guess(seed) for seed in range(starts)}
    rows, best = [], {}
    print("| " + " | ".join(HEAD) + " |")
    for start, guess in guesses.items():
        for by, problem in problems.items():
            solve = problem.solve(guess)
            rows.append(row(start, by, solve, problem.seconds))
            print("| " + " | ".join(map(str, rows[-1])) + " |", flush=True)
            if solve.violation < 1e-6 and (by not in best or solve.cost < best[by].cost):
                best[by] = solve
    for by in best.keys() - {"CasADi"}:
        solve = optimize_casadi.confirm(best[by].point)
        rows.append([*row(f"best of {by}", "CasADi", solve, 0)[:-1], ""])
        print("| " + " | ".join(map(str, rows[-1])) + " |", flush=True)
    for name, by, ms, wall in time_functions(problems):
        rows.append([name, by, *[""] * 7, f"{ms:.2f}", f"{wall:.2f}", "", ""])
        print(f"| {name} | {by} | {ms:.2f} ms of the processor | {wall:.2f} ms of wall time |")
    with (RESULTS / "optimize.csv").open("w", newline="") as file:
        versions = machine()
        table = [[*HEAD, *versions], *([*x, *versions.values()] for x in rows)]
        csv.writer(file, lineterminator="\n").writerows(table)
    print(machine())


def confirm(path: str):
    """Print the result of CasADi from a stored point. path: of an .npz file."""
    with np.load(path) as file:
        point = {name: file[name] for name in backflip.SHAPES}
    solve = optimize_casadi.confirm(point)
    print(
        f"J = {solve.cost:.6g}, violation {solve.violation:.1e}, {solve.iterations} iterations,"
        f" {solve.status}"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--starts", type=int, default=20, help="number of noisy guesses")
    parser.add_argument("--by", nargs="+", default=list(SOLVERS), choices=SOLVERS)
    parser.add_argument("--confirm", metavar="FILE")
    options = parser.parse_args()
    if options.confirm:
        confirm(options.confirm)
    else:
        main(options.starts, options.by)
