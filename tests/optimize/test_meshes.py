"""Intervals of other lengths: splitting, joining, resampling, and a solution on such a mesh."""

import jax.numpy as jnp
import models
import numpy as np
import pytest
import wrong_optimizations

import svkc
from svkc import optimize
from svkc.optimize.guesses import PhaseMotion
from svkc.optimize.refinement import new_mesh
from svkc.optimize.resampling import resample
from svkc.scenes.hopper import hopper, stance

MESH = [0, 0.2, 0.5, 0.9, 1]


def move(**options):
    """Return a problem from rest to rest over 1 m with at most 1 N, and a guess."""
    rest = optimize.between("x", 0, 0, of="velocity")
    phase = optimize.Phase(
        "move", duration=(0.5, 5.0), start=[optimize.between("x", 0, 0), rest],
        end=[optimize.between("x", 1, 1), rest], **options,
    )  # fmt: skip
    problem = optimize.Problem(
        wrong_optimizations.cart(),
        [phase],
        controls=optimize.Torques(1.0, constant=True),
        final=lambda p: p.t,
    )
    return problem, problem.guess([{"x": 0.0}, {"x": 1.0}])


def test_single_intervals_are_split_and_neighbours_joined():
    places = np.array([0, 0.25, 0.5, 0.75, 1])
    one_split = new_mesh(places, np.array([0.1, 3.0, 0.1, 0.1]), 3)
    np.testing.assert_allclose(one_split, [0, 0.25, 0.375, 0.5, 0.75, 1])
    most = new_mesh(places, np.array([0.1, 1e9, 0.1, 0.1]), 3)
    np.testing.assert_allclose(most, [0, *np.linspace(0.25, 0.5, 5), 0.75, 1])
    joined = new_mesh(places, np.array([0.1, 1e-4, 1e-4, 0.1]), 3)
    np.testing.assert_allclose(joined, [0, 0.25, 0.75, 1])
    # joined intervals would have 16 times the defect
    kept = new_mesh(places, np.array([0.1, 4e-3, 4e-3, 0.1]), 3)
    np.testing.assert_allclose(kept, places)
    assert len(new_mesh(places[:3], np.zeros(2), 3)) == 3


def test_resampled_motions_are_the_polynomials_of_their_intervals():
    """A free body under constant acceleration and turning is the same at all nodes."""
    chain = svkc.load(models.TWO_BOXES)
    scheme, places = optimize.Radau(2), np.linspace(0, 1, 4)
    # along the first box's slides alone
    acceleration = np.zeros(chain.nv)
    acceleration[:3] = [1.0, 2.0, -3.0]
    rest = np.asarray(chain.q_load)[: chain.nq]

    def nodes(places):
        t = 1.5 * places[:, None]
        q = np.tile(rest, (len(places), 1))
        q[:, :3] += t**2 / 2 * acceleration[:3]
        return q, t * acceleration

    q, v = nodes(places)
    motion = PhaseMotion(
        duration=1.5, q=q, v=v, states=np.zeros((4, 0)), blocks=np.zeros((3, 2, 1)),
        vdot=np.tile(acceleration, (3, 2, 1)), forces=np.zeros((3, 2, 0)), impulse=np.zeros(0),
    )  # fmt: skip
    phase = optimize.Phase("fall", mesh=MESH)
    new = resample(chain, scheme, optimize.Torques(joints=["a"]), motion, phase)
    for computed, exact in zip((new.q, new.v), nodes(np.array(MESH)), strict=True):
        np.testing.assert_allclose(computed, exact, atol=1e-12)
    np.testing.assert_allclose(new.vdot, np.tile(acceleration, (4, 2, 1)), atol=1e-12)
    np.testing.assert_allclose(new.times, 1.5 * np.array(MESH))


def test_minimum_time_on_intervals_of_other_lengths():
    """The brake begins at the second node, in the middle of 2 s. The mesh is kept in a file."""
    problem, guess = move(mesh=MESH)
    assert problem.check(guess).derivative_error < 1e-6
    solution = problem.solve(guess, solver=optimize.Ipopt(backend="cyipopt"))
    assert abs(float(solution.cost) - 2) < 1e-6
    np.testing.assert_allclose(solution.ts, 2 * np.array(MESH), atol=1e-6)
    np.testing.assert_allclose(solution.motion[0].blocks.ravel(), [1, 1, -1, -1], atol=1e-5)
    # the second of two stages is the end of an interval
    times = solution.stage_times("move").reshape(4, 2)
    np.testing.assert_allclose(times[:, 1], solution.ts[1:])
    np.testing.assert_allclose(times[:, 0], solution.ts[:-1] + np.diff(solution.ts) / 3)
    with pytest.raises(ValueError, match="'fall'"):
        solution.stage_times("fall")
    np.testing.assert_allclose(jnp.squeeze(solution.states.q[:, 0])[2], 0.5, atol=1e-6)


def test_files_hold_solutions(tmp_path):
    problem, guess = move(mesh=MESH)
    solver = optimize.Ipopt(backend="cyipopt", max_iterations=3)
    solution = problem.solve(guess, solver=solver, throw=False)
    path = tmp_path / "move.npz"
    solution.save(path)
    loaded = optimize.load_solution(path, move(intervals=7)[0])
    assert loaded.problem.phases[0].mesh == tuple(MESH)
    assert loaded.result == solution.result
    for name in ("cost", "violation", "durations", "ts", "iterations", "seconds"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(solution, name))
    np.testing.assert_array_equal(loaded.states.q, solution.states.q)
    np.testing.assert_array_equal(loaded.motion[0].blocks, solution.motion[0].blocks)
    np.testing.assert_array_equal(loaded.multipliers.rows, solution.multipliers.rows)


@pytest.mark.slow
def test_links_that_connect_at_current_poses_stay_there():
    """A foot keeps its place while it stands, and gets another one where it lands.

    The four-bar, which is connected in the loaded chain, is closed at its declared placement.
    """
    chain = hopper()
    stands = {"connected": ("four_bar", "foot"), "duration": 0.2, "intervals": 2}
    phases = [
        optimize.Phase("push", here=True, **stands),
        optimize.Phase("wait", **stands),
        optimize.Phase("flight", "four_bar", duration=0.2, intervals=2),
        optimize.Phase("landing", here="foot", **stands),
    ]
    problem = optimize.Problem(chain, phases, controls=optimize.Torques({"hip": 80.0}))
    poses = [stance(0.1, -1.0), None, stance(0.1, -0.2), stance(0.4, 0.2), stance(0.4, 1.0)]
    program, start = problem.start(problem.guess(poses))
    push, wait, flight, landing = (indices.kept_gap for indices in program.transcription.indices)
    np.testing.assert_array_equal(push, wait)
    assert not np.any(flight >= 0)
    assert not set(push[push >= 0]) & set(landing[landing >= 0])
    # two translations of the foot are independent in the plane
    assert np.sum(push >= 0) == np.sum(landing >= 0) == 2
    x = start.x * program.unit
    assert np.isclose(np.abs(x[push[push >= 0]]).max(), 0.1)
    assert np.isclose(np.abs(x[landing[landing >= 0]]).max(), 0.4)
    check = problem.check(problem.guess(poses))
    assert max(check.derivative_error, check.hessian_error) < 1e-6
