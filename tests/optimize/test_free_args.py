"""Args that the solver chooses: `free` and `chain_from` of a problem."""

import equinox as eqx
import jax
import jax.numpy as jnp
import models
import numpy as np
import pytest
import wrong_optimizations
from test_program import check_derivatives

import svkc
from svkc import optimize


def heavier(chain, args):
    """Return the cart with the mass of the args."""
    return chain.replace(mass={"cart": args["mass"]})


def move(price=2.0, **options):
    """Return a problem, and a guess: 1 m from rest to rest by at most 1 N.

    The cost is the duration plus the price divided by the mass m. As the least duration is 2
    sqrt(m), the optimal mass is price^(2/3).
    """
    ends = [
        [optimize.between("x", x, x), optimize.between("x", 0, 0, of="velocity")] for x in (0, 1)
    ]
    problem = optimize.Problem(
        wrong_optimizations.cart(),
        optimize.Phase("move", duration=(0.5, 8.0), intervals=4, start=ends[0], end=ends[1]),
        controls=optimize.Torques(1.0, constant=True),
        final=lambda p: p.t + p.args["price"] / p.args["mass"],
        **{
            "args": {"mass": 1.0, "price": price},
            "free": {"mass": (0.5, 5.0)},
            "chain_from": heavier,
        }
        | options,
    )
    return problem, problem.guess([{"x": 0.0}, {"x": 1.0}])


@pytest.fixture(scope="module")
def solved():
    problem, guess = move()
    return problem, guess, problem.solve(guess)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [optimize.Ipopt(), optimize.InteriorPoint()])
def test_a_mass_with_a_known_optimum(solved, solver):
    problem, guess, _ = solved
    solution = problem.solve(guess, solver=solver)
    mass = 2 ** (2 / 3)
    assert abs(float(solution.args["mass"]) - mass) < 1e-5
    assert abs(float(solution.cost) - (2 * mass**0.5 + 2 / mass)) < 1e-6
    assert float(solution.problem.chain.mass[-1]) == float(solution.args["mass"])
    assert "mass: 1.58" in str(solution)


@pytest.mark.slow
def test_simulations_and_refinement_use_the_optimal_args(solved):
    _, _, solution = solved
    assert max(x.max() for x in solution.report(replay=False).position) < 1e-6
    run = solution.trajectory(feedback=False)
    assert abs(float(run.final.q[0]) - 1) < 1e-6
    finer = solution.refined(tol=1e-9, rounds=1)
    assert abs(float(finer.args["mass"]) - float(solution.args["mass"])) < 1e-4


@pytest.mark.slow
def test_guesses_of_free_args(solved):
    problem, _, solution = solved
    guess = problem.guess([{"x": 0.0}, {"x": 1.0}], free={"mass": 4.0})
    assert guess.free == {"mass": 4.0}
    assert abs(float(problem.solve(guess).cost) - float(solution.cost)) < 1e-6
    many = problem.multistart([guess, solution])
    assert many.solved.all()
    assert int(many[1].iterations) < int(many[0].iterations)


@pytest.mark.slow
def test_free_args_in_other_processes(solved):
    problem, guess, solution = solved
    for other in problem.multistart([guess, solution], processes=2):
        assert abs(float(other.args["mass"]) - float(solution.args["mass"])) < 1e-5


@pytest.mark.slow
def test_saved_solutions_have_their_args(solved, tmp_path):
    problem, _, solution = solved
    solution.save(tmp_path / "move.npz")
    loaded = optimize.load_solution(tmp_path / "move.npz", problem)
    assert float(loaded.args["mass"]) == float(solution.args["mass"])
    other = optimize.Problem(
        problem.args_model.chain, problem.phases, controls=optimize.Torques(1.0, constant=True)
    )
    with pytest.raises(ValueError, match="another problem: free"):
        optimize.load_solution(tmp_path / "move.npz", other)


@pytest.mark.slow
def test_the_optimal_cost_by_an_arg(solved):
    """The derivative by the price is 1 / mass, and zero by the free arg."""
    _, _, solution = solved
    _, by_args = solution.gradient()
    assert abs(float(by_args["price"]) - 2 ** (-2 / 3)) < 1e-5
    assert float(by_args["mass"]) == 0.0


@pytest.mark.slow
def test_the_optimal_cost_by_an_arg_of_the_chain():
    """Without free args: the duration 2 sqrt(m) has the derivative 1 / sqrt(m)."""
    problem, guess = move(free=None)
    _, by_args = problem.solve(guess).gradient()
    assert abs(float(by_args["mass"]) - (1.0 - 2.0)) < 1e-5


def held_rods(**options):
    """Return two rods whose end hangs on a pin of free height; the cost is least at 1.4 m."""
    height = lambda chain, args: eqx.tree_at(
        lambda c: c.structure.pos, chain, jnp.stack([0.5, 0.0, -args["height"]])[None]
    )
    pin = svkc.VirtualLink(
        "pin", "world", "lower", "hinge", pos=(0.5, 0, -1.6), axis=(0, 1, 0), real_pos=(0, 0, -0.8)
    )
    chain = svkc.load(models.MJCF.format(models.TWO_RODS), virtual_links=[pin])
    rest = [optimize.between(joint, 0, 0, of="velocity") for joint in ("upper", "lower")]
    phase = optimize.Phase(
        "held", connected=("pin",), duration=0.2, intervals=2, start=rest, **options
    )
    problem = optimize.Problem(
        chain,
        phase,
        controls=optimize.Torques(),
        args={"height": 1.6},
        free={"height": (1.2, 1.7)},
        chain_from=height,
        running=lambda p: 1e-6 * jnp.sum(p.u**2),
        final=lambda p: (p.args["height"] - 1.4) ** 2,
    )
    return problem, problem.guess([{"upper": -0.4, "lower": 0.2}, {"upper": -0.4, "lower": 0.2}])


@pytest.mark.slow
def test_a_link_with_a_free_place():
    """Points, states and simulations have the link at its optimal place."""
    angle = lambda p: p.state.q[-1]  # of the pin
    problem, guess = held_rods(end=[optimize.constraint("angle", angle, -3, 3)])
    solution = problem.solve(guess)
    height = float(solution.args["height"])
    assert abs(height - 1.4) < 1e-3
    chain, last = solution.problem.chain, jax.tree.map(lambda x: x[-1], solution.states)
    end = svkc.point_position(chain, last, "lower", jnp.array([0.0, 0.0, -0.8]))
    np.testing.assert_allclose(end, [0.5, 0, -height], atol=1e-7)
    np.testing.assert_allclose(last.structure.pos, chain.structure.pos)
    turned = float(last.q[0] + last.q[1])
    np.testing.assert_allclose(float(last.q[-1]), turned, atol=1e-7)
    run = solution.trajectory()
    np.testing.assert_allclose(run.final.structure.pos[0], [0.5, 0, -height])
    assert max(x.max() for x in solution.report(replay=False).position) < 1e-3


@pytest.mark.slow
def test_a_solution_with_fixed_args_is_a_guess(solved):
    problem, _, solution = solved
    fixed, guess = move(free=None)
    warm = problem.solve(fixed.solve(guess))
    assert abs(float(warm.cost) - float(solution.cost)) < 1e-6
    plain = optimize.Problem(
        wrong_optimizations.cart(), fixed.phases, controls=optimize.Torques(1.0, constant=True)
    )
    assert problem.solve(plain.solve(plain.guess([{"x": 0.0}, {"x": 1.0}]))).args["mass"] > 1


@pytest.mark.slow
def test_free_args_that_are_zero():
    """Derivatives by other unknowns are complete although they are zero at the guess."""
    gain = lambda p: p.args["gain"] * jnp.sum(p.u**2)
    problem, guess = move(
        args={"gain": 0.0, "mass": 1.0, "price": 2.0}, free={"gain": (0.0, 1.0)}, running=gain
    )
    program, start = problem.start(guess)
    x = start.x + np.random.default_rng(0).normal(size=program.count)
    x[program.transcription.builder.free_args] = 0.5
    lower, upper, _, _ = program.bounds()
    check_derivatives(program, x, lower < upper, 0)


@pytest.mark.slow
@pytest.mark.parametrize("intervals", [2, 8])
def test_derivatives_by_lengths(intervals):
    """Loops, an impact and users' functions depend on the lengths of two bodies.

    Blocks of eight intervals and more are evaluated with the lanes last.
    """

    down = jnp.array([0.0, 0.0, -1.0])
    longer = lambda chain, args: chain.replace(
        pos={"lower": args["lengths"][0] * down}, com={"lower": args["lengths"][1] * down}
    )
    pin = svkc.VirtualLink(
        "hand", "world", "lower", "hinge", pos=(0.5, 0, -1.6), axis=(0, 1, 0), real_pos=(0, 0, -0.8)
    )
    chain = svkc.load(models.MJCF.format(models.TWO_RODS), virtual_links=[pin])
    phases = [
        optimize.Phase("free", duration=(0.2, 0.6), intervals=intervals),
        optimize.Phase(
            "held",
            connected=("hand",),
            duration=(0.2, 0.6),
            intervals=intervals,
            path=[lambda p: p.forces("hand")[2] + p.args["lengths"][0]],
            end=[optimize.constraint("height", lambda p: p.state.q[0], -1, 1)],
        ),
    ]
    problem = optimize.Problem(
        chain,
        phases,
        controls=optimize.TorqueRates(limit=100.0, torque=50.0),
        running=lambda p: jnp.sum(p.u**2) * p.args["lengths"][1],
        final=lambda p: svkc.center_of_mass(p.chain, p.state)[2] ** 2,
        args={"lengths": np.array([1.0, 0.4])},
        free={"lengths": (0.3, 2.0)},
        chain_from=longer,
    )
    program, start = problem.start(problem.guess([{}, {"upper": -0.2, "lower": 0.3}, {}]))
    lower, upper, _, _ = program.bounds()
    free = lower < upper
    x = start.x + 0.03 * np.random.default_rng(0).normal(size=len(free)) * free
    for seed in range(3):
        check_derivatives(program, x, free, seed)
    columns = np.flatnonzero(free)[-2:]
    assert np.isin(columns, program.hessian_entries.row).all()


WRONG = {
    "unknown": ({"free": {"mas": (1, 2)}}, "no free arg 'mas'; did you mean 'mass'"),
    "bounds": ({"free": {"mass": (2, 1)}}, r"free\['mass'\]: expected \(lower, upper\)"),
    "number": ({"free": {"mass": 2.0}}, r"free\['mass'\]: expected \(lower, upper\)"),
    "infinite": ({"free": {"mass": (0, np.inf)}}, r"free\['mass'\]: expected"),
    "function": ({"chain_from": lambda chain: chain}, "chain_from: expected a function of"),
    "result": ({"chain_from": lambda chain, args: 1.0}, "chain: expected a Chain"),
    "other": (
        {"chain_from": lambda chain, args: svkc.load(models.ARM)},
        "chain_from: expected a chain with the same bodies",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_free_args(case):
    options, message = WRONG[case]
    with pytest.raises(ValueError, match=message):
        move(**options)


@pytest.mark.slow
def test_wrong_guesses_of_free_args(solved):
    problem, _, _ = solved
    poses = [{"x": 0.0}, {"x": 1.0}]
    with pytest.raises(ValueError, match="no free arg 'price'"):
        problem.guess(poses, free={"price": 1.0})
    with pytest.raises(ValueError, match=r"free\['mass'\]: got shape \(2,\), expected \(\)"):
        problem.guess(poses, free={"mass": jnp.ones(2)})
    with pytest.raises(ValueError, match=r"value 9 of mass is not between its bounds 0\.5 and 5"):
        problem.guess(poses, free={"mass": 9.0})


def test_bounds_do_not_depend_on_free_args(solved):
    problem, _, _ = solved
    limit = optimize.constraint("limit", lambda p: (p.state.q[0], -1.0, p.args["mass"]))
    phase = optimize.Phase("move", duration=(0.5, 8.0), intervals=1, path=[limit])
    other = optimize.Problem(
        problem.args_model.chain,
        phase,
        controls=problem.controls,
        args={"mass": 1.0},
        free={"mass": (0.5, 5.0)},
    )
    with pytest.raises(ValueError, match="constraint 'limit': its bounds depend on the point or"):
        other.check(other.guess([{}, {}]))
