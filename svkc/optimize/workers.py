"""Worker processes that solve guesses, and return solutions as files.

Threads would not run in parallel: the linear algebra of IPOPT is not thread-safe. Functions of a
problem, such as lambdas, cannot be pickled in general; cloudpickle serializes them.
"""

import importlib
import os
import pathlib
import pickle
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from typing import Any

import jax

from svkc.optimize.loading import load_solution
from svkc.optimize.solution import Solution

_MAIN = "import sys; from svkc.optimize.workers import work; work(sys.argv[1])"
# settings of JAX that a worker process copies from this process
_SETTINGS = ("jax_enable_x64", "jax_compilation_cache_dir")
# seconds between two counts of the files of finished solutions
_WAIT = 0.1


def solve_in_processes(
    problem: Any, guesses: Sequence[Any], processes: int, *, solver: Any, progress: Callable
) -> list[Solution]:
    """Return the solutions from several guesses, solved in worker processes.

    processes: number of worker processes. solver: as of `Problem.solve`.
    progress: called with the fraction of the guesses that are solved.
    Raises ImportError without cloudpickle, and RuntimeError if a process fails.
    """
    try:
        cloudpickle = importlib.import_module("cloudpickle")
    except ImportError as error:
        raise ImportError(
            "multistart in several processes needs cloudpickle: pip install cloudpickle"
        ) from error
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        # guesses that are solutions are passed as files: their result codes cannot be pickled
        for k, guess in enumerate(guesses):
            if isinstance(guess, Solution):
                guess.save(folder / f"{k}.start.npz")
        starts = [None if isinstance(guess, Solution) else guess for guess in guesses]
        settings = {"path": sys.path, "jax": {x: getattr(jax.config, x) for x in _SETTINGS}}
        (folder / "settings").write_bytes(pickle.dumps(settings))
        (folder / "work").write_bytes(cloudpickle.dumps((problem, solver, starts)))
        # silences XLA's messages on programs from a cache
        environment = {"TF_CPP_MIN_LOG_LEVEL": "3"} | os.environ
        workers = []
        try:
            for _ in range(min(processes, len(guesses))):
                call = [sys.executable, "-c", _MAIN, name]
                workers.append(subprocess.Popen(call, env=environment))
            _wait(folder, workers, len(guesses), progress)
        finally:
            for worker in workers:
                worker.kill()
                worker.wait()
        return [load_solution(folder / f"{k}.npz", problem) for k in range(len(guesses))]


def _wait(folder: pathlib.Path, workers: list[Any], count: int, progress: Callable) -> None:
    """Wait until all solutions are there.

    Raises RuntimeError if a process raised an exception, or if all ended before.
    """
    while True:
        # checked before counting: a process writes its last file before it ends
        running = any(worker.poll() is None for worker in workers)
        done = sum((folder / f"{k}.npz").exists() for k in range(count))
        progress(done / count)
        for error in folder.glob("*.error"):
            raise RuntimeError(
                f"multistart: start {error.stem} failed in its process:\n{error.read_text()}"
            )
        if done == count:
            return
        if not running:
            raise RuntimeError(
                f"multistart: all processes ended with {done} of {count} starts done; what they"
                " printed is above"
            )
        time.sleep(_WAIT)


def work(name: str) -> None:
    """Run a worker process: solve guesses of a folder that no other process has taken.

    name: path of the folder.
    """
    folder = pathlib.Path(name)
    settings = pickle.loads((folder / "settings").read_bytes())
    sys.path[:] = settings["path"]
    for option, value in settings["jax"].items():
        jax.config.update(option, value)
    problem, solver, starts = pickle.loads((folder / "work").read_bytes())
    for k, guess in enumerate(starts):
        try:
            # creating this file fails if another process has created it
            os.close(os.open(folder / f"{k}.taken", os.O_CREAT | os.O_EXCL))
        except FileExistsError:
            continue
        try:
            if guess is None:
                guess = load_solution(folder / f"{k}.start.npz", problem)
            problem.solve(guess, solver=solver, throw=False).save(folder / f"{k}.npz")
        except BaseException:
            part = folder / f"{k}.part"
            part.write_text(traceback.format_exc())
            part.rename(folder / f"{k}.error")
            raise
