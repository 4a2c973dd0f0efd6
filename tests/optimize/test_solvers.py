"""What solvers do besides solving."""

import importlib.util
from unittest import mock

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest
import wrong_optimizations

from svkc import optimize

# CasADi is no requirement of the tests
BACKENDS = ["cyipopt", *(["casadi"] if importlib.util.find_spec("casadi") else [])]
SOLVERS = [*(optimize.Ipopt(backend=name) for name in BACKENDS), optimize.InteriorPoint()]


@pytest.fixture(scope="module")
def move():
    """Return a problem and a guess: from rest to rest, with the least sum of squared forces."""
    rest = optimize.between("x", 0, 0, of="velocity")
    problem = optimize.Problem(
        wrong_optimizations.cart(),
        [
            optimize.Phase(
                "move",
                duration=1.0,
                intervals=2,
                start=[optimize.between("x", 0, 0), rest],
                end=[optimize.between("x", 1, 1), rest],
            )
        ],
        controls=optimize.Torques(constant=True),
        running=lambda p: jnp.sum(p.u**2),
    )
    return problem, problem.guess([{"x": 0.0}, {"x": 1.0}])


def test_without_the_wheel_the_error_names_the_command(move):
    problem, guess = move
    with (
        mock.patch("svkc.optimize.ipopt.importlib", **{"import_module.side_effect": ImportError}),
        pytest.raises(ImportError, match=r"optimize needs IPOPT: pip install 'svkc\[optimize\]'"),
    ):
        problem.solve(guess, solver=optimize.Ipopt(backend="cyipopt"))


@pytest.mark.parametrize("solver", SOLVERS)
def test_interrupts_return_the_last_iterate_and_errors_are_raised(move, solver):
    problem, guess = move
    step = "svkc.optimize.program.Program.hessian"
    with mock.patch(step, side_effect=KeyboardInterrupt):
        last = problem.solve(guess, solver=solver, throw=False)
    assert last.result == optimize.OUTCOME.interrupted
    assert np.isfinite(last.states.q).all()
    with (
        mock.patch(step, side_effect=ZeroDivisionError("mine")),
        pytest.raises(ZeroDivisionError, match="mine"),
    ):
        problem.solve(guess, solver=solver)


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_progress_meter_is_stepped_and_closed(move, solver, capsys):
    problem, guess = move
    motion = problem.solve(guess, solver=solver, progress_meter=diffrax.TextProgressMeter())
    assert "100.00%" in capsys.readouterr().out
    # forces of +4 N and -4 N
    assert float(motion.cost) == pytest.approx(16, rel=1e-6)
    again = problem.solve(motion, solver=solver)
    assert again.iterations <= 3
    assert "cost 16" in str(again)
