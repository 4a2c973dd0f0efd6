"""Wall time of the steps of examples/09_backflip.py, in a new process with an empty cache.

`python benchmarks/optimize_cold.py` (extra `optimize`) runs the steps of the example one after
another, with an empty cache of compiled programs. It prints a row for each step: wall time,
processor time, and the parts of the wall time that JAX reports: tracing, lowering to StableHLO, and
compilation. The rest of the wall time is execution, IPOPT, and Python.
"""

import os
import tempfile
import time

os.environ["SVKC_CACHE_DIR"] = tempfile.mkdtemp()
os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
os.environ.setdefault("JAX_PLATFORMS", "cpu")

EVENTS = {
    "/jax/core/compile/jaxpr_trace_duration": "trace",
    "/jax/core/compile/jaxpr_to_mlir_module_duration": "lower",
    "/jax/core/compile/backend_compile_duration": "compile",
}
rows, spent, begin = [], dict.fromkeys(EVENTS.values(), 0.0), (time.perf_counter(), 0.0)


def count(event: str, duration: float, **_options) -> None:
    """Add a duration that JAX reports."""
    if event in EVENTS:
        spent[EVENTS[event]] += duration


def step(name: str) -> None:
    """Print the row of the step that ends now, with the times since the last call."""
    global begin
    now = time.perf_counter(), time.process_time()
    row = [now[0] - begin[0], now[1] - begin[1], *spent.values()]
    rows.append(row)
    print(f"| {name} | " + " | ".join(f"{x:.1f}" for x in row) + " |", flush=True)
    spent.update(dict.fromkeys(spent, 0.0))
    begin = now


print("| step | wall s | processor s | " + " | ".join(f"{x} s" for x in spent) + " |")
print("|---|" + "---|" * 5)

import jax

jax.config.update("jax_enable_x64", True)
jax.monitoring.register_event_duration_secs_listener(count)

from svkc import optimize
from svkc.optimize.checks import check_finite
from svkc.scenes.backflip import backflip
from svkc.scenes.backflip_problem import backflip_guess, backflip_problem

step("import")
problem = backflip_problem(backflip()[0])
step("model and problem")
guess = backflip_guess(problem)
step("guess")
program, start = problem.start(guess)
step("rows, patterns")
check_finite(program, start.x)
step("values at the guess")
motion = problem.solve(guess, solver=optimize.Ipopt(tolerance=1e-6))
step(f"solve, {int(motion.iterations)} iterations")
report = motion.report()
step("report")
totals = [sum(column) for column in zip(*rows, strict=True)]
print("| **all** | " + " | ".join(f"{x:.1f}" for x in totals) + " |")
print(motion, report, sep="\n")
