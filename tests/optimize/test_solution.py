"""The certificate, refinement, replay and gradient of a solution."""

from unittest import mock

import jax.numpy as jnp
import numpy as np
import pytest
import wrong_optimizations
from processes import run

import svkc
from svkc import optimize

ROD = (
    '<mujoco><worldbody><body name="rod"><joint name="pivot" axis="0 1 0"/><geom type="capsule"'
    ' fromto="0 0 0 0 0 -1" size="0.03"/></body></worldbody></mujoco>'
)


def swing_up(chain):
    rest = optimize.between("pivot", 0, 0, of="velocity")
    swing = optimize.Phase(
        "swing",
        duration=(0.5, 3.0),
        start=[optimize.between("pivot", 0, 0), rest],
        end=[optimize.between("pivot", np.pi, np.pi), rest],
    )
    return optimize.Problem(
        chain,
        [swing],
        controls=optimize.Torques(limit=5.0),
        running=lambda p: p.args * jnp.sum(p.u**2),
        args=1.0,
    )


@pytest.fixture(scope="module")
def solution():
    problem = swing_up(svkc.load(ROD))
    return problem.solve(problem.guess([{"pivot": 0.0}, {"pivot": np.pi}]))


@pytest.mark.slow
def test_refined_until_it_is_a_motion(solution):
    coarse, fine = solution.report(), solution.refined(tol=1e-4)
    assert coarse.failed == 0
    assert max(coarse.largest()) > 1e-3
    position, velocity = fine.report().largest()
    assert position < 1e-4
    assert velocity < 1e-3
    assert len(fine.ts) > len(solution.ts)
    assert 0 < fine.cost_error < 0.05 * fine.cost
    traj = fine.trajectory()
    assert abs(float(fine.problem.chain.joint(traj.final, "pivot").q) - np.pi) < 1e-3
    assert "worst of" in str(coarse)


@pytest.mark.slow
def test_gradient_of_the_optimal_cost_against_solutions(solution):
    """The envelope theorem: by the rod's mass, and by the factor of the cost."""
    chain, step = solution.problem.chain, 1e-4
    of_chain, of_args = solution.gradient()
    assert abs(float(of_args) - float(solution.cost)) < 1e-5 * float(solution.cost)
    mass = float(chain.mass[-1])
    costs = []
    for sign in (1, -1):
        heavier = chain.replace(mass={"rod": mass * (1 + sign * step)})
        costs.append(float(swing_up(heavier).solve(solution).cost))
    difference = (costs[0] - costs[1]) / (2 * step * mass)
    assert abs(float(of_chain.mass[-1]) - difference) < 1e-4 * abs(difference)


@pytest.mark.slow
def test_many_starts():
    """Each start has its result; one that cannot be solved does not end the others."""
    rest = optimize.between("x", 0, 0, of="velocity")
    phase = optimize.Phase(
        "move", duration=1.0, intervals=2, start=[optimize.between("x", 0, 0), rest],
        end=[optimize.between("x", 1, 1), rest],
    )  # fmt: skip
    problem = optimize.Problem(
        wrong_optimizations.cart(),
        [phase],
        controls=optimize.Torques(),
        running=lambda p: p.u @ p.u,
    )
    guesses = [problem.guess([{"x": 0.0}, {"x": 1.0}], noise=0.2, key=key) for key in range(3)]
    many = problem.multistart(guesses)
    np.testing.assert_allclose([m.cost for m in many], float(many[0].cost), rtol=1e-6)
    assert many.solved.all()
    assert "3 of 3 solved" in str(many)
    # the functions are lambdas, one guess is a solution, and one process is given two starts
    apart = problem.multistart([many[0], *guesses[1:]], processes=2)
    np.testing.assert_allclose([m.cost for m in apart], float(many[0].cost), rtol=1e-6)
    assert float(apart.best.cost) == min(float(m.cost) for m in apart)
    assert apart[0].iterations <= 3
    assert optimize.Solutions().best is None


def broken(point):
    raise ZeroDivisionError("mine")


@pytest.mark.slow
def test_exceptions_in_other_processes_are_raised():
    problem = wrong_optimizations.problem()
    problem.running = broken
    guesses = [problem.guess([{"x": 0.0}, {"x": 1.0}])] * 2
    with pytest.raises(RuntimeError, match=r"(?s)failed in its process.*mine"):
        problem.multistart(guesses, processes=2)


def test_other_processes_need_cloudpickle_and_must_stay_alive():
    problem = wrong_optimizations.problem()
    guesses = [problem.guess([{"x": 0.0}, {"x": 1.0}])] * 2
    with (
        mock.patch("svkc.optimize.workers.importlib", **{"import_module.side_effect": ImportError}),
        pytest.raises(ImportError, match="needs cloudpickle: pip install cloudpickle"),
    ):
        problem.multistart(guesses, processes=2)
    with (
        mock.patch("svkc.optimize.workers._MAIN", "raise SystemExit"),
        pytest.raises(RuntimeError, match="all processes ended with 0 of 2 starts done"),
    ):
        problem.multistart(guesses, processes=2)


BACKFLIP = """
import jax
jax.config.update("jax_enable_x64", True)
from svkc import optimize
from svkc.scenes.backflip import backflip
from svkc.scenes.backflip_problem import backflip_guess, backflip_problem
problem = backflip_problem(backflip()[0], project=False)
motion = problem.solve(backflip_guess(problem), solver=optimize.Ipopt(tolerance=1e-6))
print(float(motion.cost), float(motion.violation), motion.impulse("landing")[2])
"""


@pytest.mark.slow
def test_backflip_without_projection():
    """The cost is at most 5.94416e6, that of the same transcription in CasADi.

    In a process of its own, with programs that XLA optimizes.
    """
    done = run("-c", BACKFLIP, optimized=True)
    assert done.returncode == 0, done.stderr
    cost, violation, impulse = map(float, done.stdout.split())
    assert cost < 5.94416e6 * (1 + 1e-6)
    assert violation < 1e-6
    assert impulse > 0
