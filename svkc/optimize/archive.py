"""Writing of solutions to .npz files."""

import json
import os
import pathlib
from typing import Any

import numpy as np

from svkc.model.annotations import Path
from svkc.optimize.guesses import PhaseMotion

# increase the schema whenever a stored array is added, renamed or changes its meaning
SCHEMA = 2
MOTION = tuple(PhaseMotion.__dataclass_fields__)
NUMBERS = ("cost", "violation", "iterations", "seconds", "cost_error")
MULTIPLIERS = ("rows", "lower", "upper")


def description_of(problem: Any) -> dict[str, Any]:
    """Return the properties that a problem and the problem of a stored solution must share."""
    return {
        "phases": [[p.name, *p.connected] for p in problem.phases],
        "coordinates": list(problem.chain.dof_names),
        "controls": [type(problem.controls).__name__, *problem.controls.names(problem.chain)],
        "stages": problem.scheme.stages,
        "free": [[name, *shape] for name, shape in problem.args_model.shapes.items()],
    }


def save_solution(solution: Any, result: str, path: Path) -> None:
    """Write a solution to one .npz file; see `Solution.save`. result: name of its result code."""
    import svkc

    arrays: dict[str, Any] = {name: np.asarray(getattr(solution, name)) for name in NUMBERS}
    for name in MULTIPLIERS:
        arrays[f"multipliers.{name}"] = getattr(solution.multipliers, name)
    for i, (phase, motion) in enumerate(zip(solution.problem.phases, solution.motion)):
        arrays |= {f"{i}.{name}": np.asarray(getattr(motion, name)) for name in MOTION}
        arrays[f"{i}.mesh"] = phase.node_fractions
    meta = {
        "optimize_schema": SCHEMA,
        "svkc": svkc.__version__,
        "result": result,
        "problem": description_of(solution.problem),
    }
    arrays["free"] = solution.problem.args_model.numbers(solution.args)
    arrays["metadata"] = np.array(json.dumps(meta))
    path = pathlib.Path(path)
    # a temporary file in the folder of the target, so that os.replace is atomic
    temporary = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        with open(temporary, "wb") as file:
            np.savez_compressed(file, **arrays)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
