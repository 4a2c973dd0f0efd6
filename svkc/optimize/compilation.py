"""From a problem to its compiled program."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from svkc.optimize.equations import Model, Params
from svkc.optimize.free_args import ArgsBlock
from svkc.optimize.guesses import Guess
from svkc.optimize.points import PhaseStructure
from svkc.optimize.program import Program
from svkc.optimize.transcription import Transcription
from svkc.optimize.unknowns import UnknownsBuilder
from svkc.optimize.user_rows import UserRows

# number of random points at which sparsity is determined, and the scaled cost at these points
_SAMPLES, _COST_AT_SAMPLES = 3, 50.0
# number of further points for the sparsity alone, and their distance in units: joints are beyond
# their ranges there
_FAR_SAMPLES, _FAR = 2, 30.0


def compile_problem(
    problem: Any, rows: np.ndarray, structures: Sequence[PhaseStructure], guess: Guess
) -> Program:
    """Return the compiled program of a `Problem`.

    rows: the links' rows that are constraints in some phase. structures: of each phase.
    guess: its configurations are the origins of the charts.
    """
    chain, controls, model = problem.chain, problem.controls, problem.args_model
    builder = UnknownsBuilder(
        chain, controls, rows, scheme=problem.scheme, units=problem.units, project=problem.project
    )
    transcription = Transcription(
        builder,
        problem.phases,
        Model.of(chain, controls, problem.scheme, rows),
        scheme=problem.scheme,
        structures=structures,
        references=[m.q for m in guess.phases],
    )
    free = builder.add_free_args(model)
    builder.table.freeze()
    samples = _sample_points(problem, transcription)
    _add_user_rows(problem, transcription)
    if model:
        transcription.blocks = [ArgsBlock(b, model, free) for b in transcription.blocks]
    params = Params(model.chain, problem.args)
    program = Program(
        transcription, params, samples, near=_SAMPLES, cost_unit=problem.units.cost or 1.0
    )
    if problem.units.cost is None:
        costs = np.array([abs(program.rows(x / program.unit)[-1]) for x in samples[:_SAMPLES]])
        costs = costs[np.isfinite(costs) & (costs > 0)]
        # a cost that is zero at the samples, such as a penalty, keeps its unit
        program.set_cost_unit(float(np.median(costs)) / _COST_AT_SAMPLES if len(costs) else 1.0)
    return program


def _add_user_rows(problem: Any, transcription: Transcription) -> None:
    """Append the rows and cost terms of the user's functions."""
    model, last = problem.args_model, len(problem.phases) - 1
    users = UserRows(transcription, model, Params(model.chain, problem.args))
    for i, phase in enumerate(problem.phases):
        running = [f for f in (problem.running, phase.running) if f is not None]
        final = [f for f in (problem.final if i == last else None, phase.final) if f is not None]
        users.add_phase(i, running, final)
    users.add_blocks()


def _sample_points(problem: Any, transcription: Transcription) -> np.ndarray:
    """Return random points [samples unknowns] in SI units, the far ones last.

    Durations and free args are near the middle of their bounds, and fixed unknowns have their
    values.
    """
    table, random = transcription.builder.table, np.random.default_rng(0)
    count = _SAMPLES + _FAR_SAMPLES
    samples = random.normal(size=(count, table.count)) * table.unit
    samples[_SAMPLES:] *= _FAR
    for phase, indices in zip(problem.phases, transcription.indices):
        middle = sum(phase.duration) / 2
        samples[:, indices.duration] = middle * random.uniform(0.8, 1.2, count)
    free = transcription.builder.free_args
    share = random.uniform(0.4, 0.6, (count, len(free)))
    samples[:, free] = (1 - share) * table.lower[free] + share * table.upper[free]
    fixed = table.lower == table.upper
    return np.where(fixed, table.lower, samples)
