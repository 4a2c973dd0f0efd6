"""Derivatives of a whole problem as a solver gets them, against central differences."""

import jax.numpy as jnp
import models
import numpy as np
import pytest

import svkc
from svkc import optimize
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


def check_derivatives(program, x, free, seed):
    """Compare products of Jacobian and Hessian with differences, for random weights of the rows."""
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


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_derivatives_are_those_of_differences(problem, seed):
    """Links, impact, projection, users' costs and constraints: every row has a random weight."""
    check_derivatives(*problem, seed)


@pytest.mark.slow
def test_derivatives_of_functions_that_are_constant_at_most_points():
    """Penalties and constraints that begin far from the guess are in the sparsity patterns."""
    over = lambda x, limit: jnp.maximum(x - limit, 0) ** 2
    speed = lambda p: jnp.where(p.state.v[0] > 40, (p.state.v[0] - 40) ** 2, 0.0)
    phase = optimize.Phase(
        "swing",
        duration=(0.5, 3.0),
        intervals=2,
        path=[optimize.constraint("speed", speed, 0, 1)],
        end=[optimize.constraint("power", lambda p: over(p.u[0] * p.state.v[0], 200.0), 0, 1)],
    )
    problem = optimize.Problem(
        svkc.load(models.ARM),
        [phase],
        controls=optimize.Torques(limit=5.0),
        running=lambda p: over(-p.state.q[0], 5.0) + jnp.where(p.t > 0.6, p.u[0] ** 2, 0.0),
        final=lambda p: over(p.vdot[0], 400.0),
    )
    program, start = problem.start(problem.guess([{"arm": 0.0}, {"arm": 1.0}]))
    random, free = np.random.default_rng(0), np.ones(program.count, bool)
    users, active = ["speed", "power"], np.zeros(program.cost_row + 1, bool)
    for seed in range(8):
        x = start.x + 8 * random.normal(size=program.count)
        x[program.transcription.indices[0].duration] = 1.0
        active |= program.rows(x) != 0
        check_derivatives(program, x, free, seed)
    label = program.transcription.rows.label
    own = [i for i in range(program.cost_row) if any(name in label(i) for name in users)]
    assert len(own) == 6
    assert active[own].all()
    assert active[-1]


@pytest.mark.slow
def test_derivatives_of_joint_limits():
    """At the guess and near it the cart is far inside its range."""
    rail = models.MJCF.format(
        '<body><joint name="x" type="slide" axis="1 0 0" limited="true" range="-9 9"'
        ' solreflimit="-100 -10"/><geom size="0.1"/></body>'
    )
    phase = optimize.Phase("move", duration=1.0, intervals=2)
    problem = optimize.Problem(svkc.load(rail), phase, controls=optimize.Torques())
    program, start = problem.start(problem.guess([{"x": 0.0}, {"x": 0.0}]))
    lower, upper, _, _ = program.bounds()
    x = start.x.copy()
    x[program.transcription.indices[0].nodes[:, 0]] = 12.0
    assert np.abs(program.rows(x)).max() > 1
    check_derivatives(program, x, lower < upper, 0)
