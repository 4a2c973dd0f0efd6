"""`optimize.InteriorPoint`: its linear algebra, known optima, and how its runs end."""

import itertools
from unittest import mock

import numpy as np
import pytest
import wrong_optimizations

from svkc import optimize
from svkc.optimize import interior_point
from svkc.optimize.block_chain import BlockChain
from svkc.optimize.nonlinear_program import Functions
from svkc.optimize.program import Program
from svkc.optimize.restoration import restore
from svkc.scenes.backflip import backflip
from svkc.scenes.backflip_problem import backflip_guess, backflip_problem

SOLVER = optimize.InteriorPoint()


def move(shortest=0.5, longest=5.0):
    """Return a problem, and a guess: from rest to rest over 1 m with at most 1 N, in least time."""
    ends = [
        [optimize.between("x", x, x), optimize.between("x", 0, 0, of="velocity")] for x in (0, 1)
    ]
    problem = optimize.Problem(
        wrong_optimizations.cart(),
        optimize.Phase(
            "move", duration=(shortest, longest), intervals=4, start=ends[0], end=ends[1]
        ),
        controls=optimize.Torques(1.0, constant=True),
        final=lambda p: p.t,
    )
    return problem, problem.guess([{"x": 0.0}, {"x": 1.0}])


@pytest.fixture(scope="module")
def solved():
    problem, guess = move()
    return problem, guess, problem.solve(guess, solver=SOLVER)


def chain_of(group, random):
    """Return places (row, column) and values of the entries, and the dense matrix."""
    row, column = np.tril_indices(len(group))
    ends = np.sort([group[row], group[column]], axis=0)
    keep = (ends[1] - ends[0] <= 1) | (ends[0] < 0)
    row, column = row[keep], column[keep]
    values = random.normal(size=len(row))
    dense = np.zeros((len(group), len(group)))
    dense[row, column] = dense[column, row] = values
    return row, column, values, dense


@pytest.mark.parametrize("border", [0, 3])
@pytest.mark.parametrize("counts", [[4], [3, 5, 2], [2, 0, 3, 3], []])
def test_solutions_and_inertia_of_block_chains(counts, border):
    random = np.random.default_rng(len(counts) + border)
    group = np.concatenate([np.full(border, -1), np.repeat(np.arange(len(counts)), counts)])
    group = random.permutation(group.astype(int))
    row, column, values, dense = chain_of(group, random)
    matrix = BlockChain(group, row, column)
    assert matrix.factor(values) == (np.linalg.eigvalsh(dense) < 0).sum()
    right = random.normal(size=len(group))
    np.testing.assert_allclose(matrix.solve(right), np.linalg.solve(dense, right), atol=1e-10)
    if len(group):
        assert matrix.factor(0 * values) is None
        assert matrix.factor(np.nan * values) is None


def test_groups_that_are_not_neighbours_become_one_block():
    random, group = np.random.default_rng(0), np.array([0, 1, 2])
    row, column, values, dense = chain_of(np.zeros(3, int), random)
    matrix = BlockChain(group, row, column)
    assert matrix.factor(values) == (np.linalg.eigvalsh(dense) < 0).sum()
    np.testing.assert_allclose(matrix.solve(np.ones(3)), np.linalg.solve(dense, np.ones(3)))


def test_least_time_of_a_double_integrator(solved):
    """It takes 2 s, half of it braking."""
    _, _, solution = solved
    assert abs(float(solution.cost) - 2) < 1e-6
    assert solution.result == optimize.OUTCOME.successful
    assert solution.violation < 1e-6
    np.testing.assert_allclose(solution.motion[0].blocks.ravel(), [1, 1, -1, -1], atol=1e-5)


def test_the_gradient_of_the_lagrangian_is_zero(solved):
    """Multipliers have the solver's units, signs as those of IPOPT, and belong to active bounds."""
    problem, _, solution = solved
    program, start = problem.start(solution)
    entries, of_x = program.jacobian_entries, program.jacobian(start.x)
    factor = np.append(start.multipliers, 1.0)[entries.row]
    gradient = np.bincount(entries.column, factor * of_x, program.count)
    low, high, *_ = program.bounds()
    free = low < high
    assert np.abs(gradient - start.lower + start.upper)[free].max() < 1e-6
    for multiplier, gap in ((start.lower, start.x - low), (start.upper, high - start.x)):
        assert (multiplier >= 0).all()
        assert np.abs(multiplier[free & (gap > 1e-3)]).max(initial=0.0) < 1e-4
    assert (start.upper > 0.1).sum() == (start.lower > 0.1).sum() == 2


@pytest.mark.slow
def test_warm_starts(solved):
    """From multipliers, and on another mesh without them."""
    problem, guess, solution = solved
    assert problem.solve(solution, solver=SOLVER).iterations <= 3
    finer = problem.with_mesh([6]).solve(solution, solver=SOLVER)
    assert abs(float(finer.cost) - 2) < 1e-6
    many = problem.multistart([guess, solution], solver=SOLVER)
    assert many.solved.all()


def test_an_infeasible_problem_names_its_rows():
    problem, guess = move(longest=1.0)
    last = problem.solve(guess, solver=SOLVER, throw=False)
    assert last.result == optimize.OUTCOME.infeasible
    with pytest.raises(RuntimeError, match=r"violates constraints.*x in move, interval"):
        problem.solve(guess, solver=SOLVER)


def test_a_limit_in_a_restoration_returns_the_iterate_before_it():
    """Unknowns and multipliers are of the same iterate."""
    problem, guess = move(longest=1.0)
    begins: list[int] = []

    def record(method):
        begins.append(method.run.iterations)
        return restore(method)

    with mock.patch.object(interior_point, "restore", record):
        problem.solve(guess, solver=SOLVER, throw=False)
    limits = begins[0] + np.arange(4)
    ended = [
        problem.solve(guess, solver=optimize.InteriorPoint(max_iterations=int(k)), throw=False)
        for k in limits
    ]
    assert [int(x.iterations) for x in ended] == limits.tolist()
    for other in ended[1:]:
        np.testing.assert_array_equal(other.motion[0].q, ended[0].motion[0].q)
        np.testing.assert_array_equal(other.multipliers.rows, ended[0].multipliers.rows)


def test_scales_do_not_depend_on_earlier_scales(solved):
    problem, guess, _ = solved
    program, start = problem.start(guess)
    functions = Functions(program, start.x)
    functions.scale(100 * functions.start)
    functions.scale(functions.start)
    once = Functions(program, start.x)
    once.scale(once.start)
    np.testing.assert_array_equal(functions.row_scale, once.row_scale)
    np.testing.assert_array_equal(functions.row_lower, once.row_lower)
    assert functions.cost_scale == once.cost_scale


def test_limits_have_their_results(solved):
    problem, guess, _ = solved
    ended = lambda **limits: problem.solve(
        guess, solver=optimize.InteriorPoint(**limits), throw=False
    )
    short = ended(max_iterations=2)
    assert short.result == optimize.OUTCOME.max_iterations
    assert short.iterations == 2
    assert ended(max_seconds=1e-9).result == optimize.OUTCOME.max_time
    with pytest.raises(ValueError, match="max_iterations: got 0"):
        optimize.InteriorPoint(max_iterations=0)


def test_points_that_are_not_finite_are_refused(solved):
    """The rows of the first trial point are not finite."""
    problem, guess, solution = solved
    calls, rows = itertools.count(), Program.rows

    def sometimes(program, x):
        # calls 0 to 2 are those of the check of the guess and of the start
        return rows(program, x) * (np.nan if next(calls) == 3 else 1.0)

    with mock.patch.object(Program, "rows", sometimes):
        again = problem.solve(guess, solver=SOLVER)
    assert again.iterations != solution.iterations
    assert abs(float(again.cost) - 2) < 1e-6


@pytest.mark.slow
def test_backflip():
    """The optimum from straight lines between poses, as IPOPT finds it."""
    problem = backflip_problem(backflip()[0])
    solver = optimize.InteriorPoint(tolerance=1e-6, max_iterations=500)
    solution = problem.solve(backflip_guess(problem), solver=solver)
    assert solution.result == optimize.OUTCOME.successful
    assert float(solution.cost) == pytest.approx(5.19970e6, rel=1e-5)
    assert solution.violation < 2e-6
