"""Reading of solutions from .npz files."""

import json
from typing import Any

import numpy as np

from svkc.model.annotations import Path
from svkc.optimize.archive import MOTION, MULTIPLIERS, NUMBERS, SCHEMA, description_of
from svkc.optimize.guesses import PhaseMotion
from svkc.optimize.solution import OUTCOME, Multipliers, Solution, solution_of
from svkc.optimize.structures import phase_structures


def load_solution(path: Path, problem: Any) -> Solution:
    """Return a solution that `Solution.save` wrote.

    `problem` of the result is the given problem with the mesh and the free args of the file. The
    problem is not compiled.

    path: path of the file.
    problem: the `Problem` that the solution is of, on any mesh. Files hold no functions.

    Raises ValueError if the file does not hold a solution, has another schema, or belongs to
    another problem. Raises FileNotFoundError if there is no file.
    """
    arrays, meta = _read(path)
    own = description_of(problem)
    for name, stored in meta["problem"].items():
        if own[name] != stored:
            raise ValueError(
                f"{path} is of another problem: {name} {stored}, the problem has {own[name]}"
            )
    try:
        motion = tuple(
            PhaseMotion(**{name: arrays[f"{i}.{name}"] for name in MOTION})
            for i in range(len(problem.phases))
        )
        numbers = {name: arrays[name] for name in NUMBERS}
        multipliers = Multipliers(**{name: arrays[f"multipliers.{name}"] for name in MULTIPLIERS})
        result = OUTCOME._name_to_item[meta["result"]]
        free = arrays["free"]
    except KeyError as error:
        raise ValueError(
            f"{path} is not a complete file of a solution: {error} is missing"
        ) from None
    meshed = problem.with_mesh([m.mesh for m in motion]).with_free(free)
    poses = [[m.q[0], m.q[-1]] for m in motion]
    _, structures = phase_structures(meshed.chain, meshed.phases, poses)
    return solution_of(
        meshed,
        motion,
        [s.structure for s in structures],
        multipliers=multipliers,
        result=result,
        **numbers,
    )


def _read(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Return the arrays and the metadata of a file. Raises as `load_solution` does."""
    try:
        with open(path, "rb") as raw, np.load(raw, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        meta = json.loads(str(arrays.pop("metadata")))
        schema = int(meta["optimize_schema"])
    except FileNotFoundError:
        raise
    # the readers of zip, npy and JSON raise exceptions of many types for a damaged file
    except Exception as error:
        raise ValueError(f"{path} is not a complete file of a solution: {error}") from error
    if schema != SCHEMA:
        raise ValueError(
            f"{path} has schema {schema} of solutions, this version reads {SCHEMA}; load it with"
            " the version of svkc that wrote it"
        )
    return arrays, meta
