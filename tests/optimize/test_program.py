"""Derivatives of a whole problem as a solver gets them, against central differences."""

import numpy as np
import pytest

from svkc.scenes.backflip import backflip
from svkc.scenes.backflip_problem import backflip_guess, backflip_problem

STEP = 1e-6  # of unknowns in the solver's units


@pytest.fixture(scope="module")
def problem():
    """The backflip's compiled problem on few intervals, and unknowns away from the guess."""
    chain, _ = backflip()
    problem = backflip_problem(chain).with_mesh([1, 2, 2, 1, 2])
    program, start = problem.start(backflip_guess(problem))
    lower, upper, _, _ = program.bounds()
    # entries are those for the values that the problem gives to fixed unknowns
    free = lower < upper
    random = np.random.default_rng(0)
    return program, start.x + 0.03 * random.normal(size=len(free)) * free, free


def _difference(function, x, direction):
    """Return the central difference of a function along a direction."""
    return (function(x + STEP * direction) - function(x - STEP * direction)) / (2 * STEP)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_derivatives_are_those_of_differences(problem, seed):
    """Links, impact, projection, users' costs and constraints: every row has a random weight."""
    program, x, free = problem
    random = np.random.default_rng(1 + seed)
    direction = random.normal(size=len(x)) * free
    weight = random.normal(size=program.cost_row + 1)
    jacobian, hessian = program.jacobian_entries, program.hessian_entries

    def along(x):
        parts = program.jacobian(x) * direction[jacobian.column]
        return np.bincount(jacobian.row, parts, len(weight))

    def gradient(x):
        parts = program.jacobian(x) * weight[jacobian.row]
        return np.bincount(jacobian.column, parts, len(x))

    by_difference = _difference(program.rows, x, direction)
    np.testing.assert_allclose(along(x), by_difference, atol=1e-8 * np.abs(by_difference).max())
    values, row, column = program.hessian(x, weight), hessian.row, hessian.column
    product = np.bincount(row, values * direction[column], len(x))
    other = row != column
    product += np.bincount(column[other], (values * direction[row])[other], len(x))
    by_difference = _difference(gradient, x, direction)
    np.testing.assert_allclose(product, by_difference, atol=1e-8 * np.abs(by_difference).max())
