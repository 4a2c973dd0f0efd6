"""Compiled loops of steps, with their compile times and memory; time of runs that alternate."""

import os
import pathlib
import platform
import time

import jax
import mujoco
import numpy as np

import svkc

# Calls that take less (s) are timed right after another call: threads of XLA that sleep take up to
# half a millisecond to wake.
WARMED_BELOW = 0.1


class Program:
    """A compiled function of states. A call runs all its steps.

    compile_stats: seconds of tracing, lowering and compilation; temporary memory (MB).
    """

    def __init__(self, function, states, compiler_options=None):
        seconds = [time.perf_counter()]
        stages = jax.jit(function).trace(states)
        seconds.append(time.perf_counter())
        stages = stages.lower()
        seconds.append(time.perf_counter())
        self.program, self.states = stages.compile(compiler_options), states
        self.compile_stats = [
            *np.diff([*seconds, time.perf_counter()]).tolist(),
            self.program.memory_analysis().temp_size_in_bytes / 1e6,
        ]

    def __call__(self):
        jax.block_until_ready(self.program(self.states))


def scan_steps(step, steps: int):
    """Return a function that takes many steps in one `lax.scan`."""
    return lambda states: jax.lax.scan(lambda s, _: (step(s), None), states, None, length=steps)[0]


def compile_steps(step, states, steps: int) -> Program:
    """Return the compiled steps of a batch; a batch of one is compiled without `vmap`."""
    single = jax.tree.leaves(states)[0].shape[0] == 1
    return (
        Program(scan_steps(step, steps), jax.tree.map(lambda x: x[0], states))
        if single
        else Program(scan_steps(jax.vmap(step), steps), states)
    )


def time_in_turns(runs: dict, rounds: int = 7) -> dict[str, np.ndarray]:
    """Return the seconds of each run of each function. Functions alternate; the first round is
    dropped.
    """
    seconds = {name: [] for name in runs}
    for _ in range(rounds + 1):
        for name, run in list(runs.items()):
            try:
                if seconds[name] and seconds[name][0] < WARMED_BELOW:
                    run()
                start = time.perf_counter()
                run()
            except TimeoutError as timeout:
                print(f"left out: {timeout}", flush=True)
                del runs[name]
                continue
            seconds[name].append(time.perf_counter() - start)
    return {name: np.array(seconds[name][1:]) for name in runs}


def machine() -> dict:
    """Return versions, processor and number of cores."""
    info = pathlib.Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    versions = {
        "python": platform.python_version(),
        "jax": jax.__version__,
        "svkc": svkc.__version__,
        "mujoco": mujoco.__version__,
    }
    return versions | {
        "backend": jax.default_backend(),
        "processor": names[0] if names else platform.machine(),
        "cores": os.cpu_count(),
    }
