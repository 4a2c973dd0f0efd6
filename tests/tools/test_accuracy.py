"""Orders of integrators, stabilizations, error estimates, tuning, and the report of a run."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import models
import numpy as np
import pytest
from tolerances import REFERENCE, ROUND_OFF

import svkc
from svkc import _deprecated as deprecated
from svkc.loops.constrained_dynamics import Dynamics, default_dynamics
from svkc.loops.projection import project
from svkc.tools.accuracy import Candidate, default_candidates


@pytest.fixture(scope="module")
def arm():
    """Return chain and state of a free body with a ball and a hinge, thrown and spinning."""
    rods = models.bar(
        "base",
        'type="free"',
        "0.2 0 -0.5",
        inside=models.bar(
            "ball",
            'type="ball"',
            "0.1 0.3 -0.4",
            "0.2 0 -0.5",
            models.bar("hinge", models.Y, "0 0 -0.3"),
        ),
    )
    chain = svkc.load(models.MJCF.format(rods))
    return chain, chain.state(v=np.array([0.5, 0.2, 1.0, 2.0, -3.0, 1.5, 1.0, 2.0, -2.5, 3.0]))


@pytest.mark.parametrize(
    ("solver", "order", "dt"),
    [
        pytest.param(svkc.integrators.RodriguesEuler(), 1, 2e-3, marks=pytest.mark.slow),
        pytest.param(svkc.integrators.SymplecticEuler(), 1, 2e-3, marks=pytest.mark.slow),
        pytest.param(diffrax.Heun(), 2, 4e-3, marks=pytest.mark.slow),
        pytest.param(diffrax.Bosh3(), 3, 0.01, marks=pytest.mark.slow),
        pytest.param(diffrax.Tsit5(), 5, 0.02, marks=pytest.mark.slow),
        (diffrax.Dopri8(), 8, 0.05),
        pytest.param(diffrax.ImplicitEuler(), 1, 2e-3, marks=pytest.mark.slow),
        pytest.param(diffrax.Kvaerno3(), 3, 5e-3, marks=pytest.mark.slow),
        pytest.param(diffrax.Kvaerno5(), 5, 0.01, marks=pytest.mark.slow),
    ],
    ids=lambda x: type(x).__name__ if isinstance(x, diffrax.AbstractSolver) else None,
)
def test_order_of_integrators(arm, exact, solver, order, dt):
    """Halving the step divides the error by two to the order, also on balls and free joints."""
    chain, state = arm
    run = jax.jit(
        lambda dt: svkc.simulate(chain, state, 0.4, dt=dt, solver=solver, max_steps=2000).final
    )
    errors = [
        np.linalg.norm(svkc.difference(chain, exact.q, end.q)) + np.linalg.norm(exact.v - end.v)
        for end in (run(dt), run(dt / 2))
    ]
    assert errors[1] > 1e-13
    # the leading error term of Tsit5 is so small that its order appears as six here
    assert order - 0.3 < np.log2(errors[0] / errors[1]) < order + 1.3


@pytest.fixture(scope="module")
def exact(arm):
    return svkc.simulate(*arm, 0.4, rtol=1e-13, atol=1e-14, solver=diffrax.Dopri8()).final


@pytest.mark.slow
def test_symplectic_euler_bounds_the_energy_error_of_a_pendulum():
    """The energy error of symplectic Euler does not grow; that of Rodrigues-Euler does.

    A pendulum, whose mass matrix is constant, swings 100 times, with 60 steps each.
    """
    chain = svkc.load(
        models.MJCF.format(models.bar("rod", models.Y, "0 0 -1")).replace("0.3 -0.2", "0 0")
    )
    state, ts = chain.state({"rod": 0.5}), jnp.linspace(0, 160.0, 161)
    errors = {}
    for solver in (svkc.integrators.SymplecticEuler(), svkc.integrators.RodriguesEuler()):
        traj = svkc.simulate(chain, state, 160.0, ts=ts, dt=0.026, solver=solver)
        energy = jax.vmap(lambda s: svkc.energy(chain, s))(traj.states)
        errors[type(solver)] = np.abs(energy - energy[0])
    symplectic, explicit = (
        errors[svkc.integrators.SymplecticEuler],
        errors[svkc.integrators.RodriguesEuler],
    )
    assert symplectic[80:].max() < 1.1 * symplectic[:80].max()
    assert explicit[-1] > 20 * symplectic.max()


@pytest.mark.slow
@pytest.mark.parametrize(
    "stabilization", [svkc.stabilization.Projection(), svkc.stabilization.CoordinatePartitioning()]
)
def test_each_stabilization_closes_the_loops(stabilization):
    """Short steps close the loops to round-off; one step that is too long reduces the gap."""
    chain = models.four_bar()
    state = chain.state(v={"crank": 4.0})
    unstabilized = lambda t1, dt: svkc.simulate(
        chain, state, t1, dt=dt, stabilization=svkc.stabilization.NoStabilization(), throw=False
    )
    stabilized = lambda t1, dt: svkc.simulate(chain, state, t1, dt=dt, stabilization=stabilization)
    reference = stabilized(0.5, 1e-3)
    np.testing.assert_allclose(reference.final.q, unstabilized(0.5, 1e-3).final.q, atol=1e-7)
    assert float(reference.gaps.max()) < 1e-14
    assert float(reference.gap_rates.max()) < 1e-13
    before, after = unstabilized(0.1, 0.1).final, stabilized(0.1, 0.1).final
    gap = np.abs(svkc.loop_gaps(chain, before)).max()
    assert gap > 1e-6
    assert np.abs(svkc.loop_gaps(chain, after)).max() < 1e-3 * gap


@pytest.mark.slow
def test_partitioning_moves_only_dependent_coordinates():
    """Coordinate partitioning closes the loops and leaves the independent coordinates unchanged."""
    chain = models.four_bar()
    drifted = svkc.simulate(
        chain,
        chain.state(v={"crank": 4.0}),
        0.1,
        dt=0.1,
        stabilization=svkc.stabilization.NoStabilization(),
        throw=False,
    ).final
    projected = lambda dependent: project(
        chain, drifted.structure, drifted.q, drifted.v, iterations=3, dependent_only=dependent
    )[:2]
    independent = np.asarray(svkc.coordinates(chain, drifted).independent)
    q, v = projected(True)
    np.testing.assert_allclose(q[independent], drifted.q[independent], atol=1e-15)
    np.testing.assert_allclose(v[independent], drifted.v[independent], atol=1e-15)
    closed = svkc.State(q, v, drifted.structure)
    assert np.abs(svkc.loop_gaps(chain, drifted)).max() > 1e-6
    assert np.abs(svkc.loop_gaps(chain, closed)).max() < 1e-13
    assert np.abs(svkc.loop_gap_rates(chain, closed)).max() < ROUND_OFF
    # projection in the metric of the mass matrix moves independent coordinates as well
    assert np.abs(projected(False)[0][independent] - drifted.q[independent]).max() > 1e-9


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_former_names_of_dynamics():
    closed, tree = (
        models.four_bar(),
        svkc.load(models.MJCF.format(models.bar("a", models.Y, "0 0 1"))),
    )
    new = svkc.dynamics
    for chain, usual in ((closed, new.CompositeBodies), (tree, new.ArticulatedBodies)):
        assert default_dynamics(chain) == usual()
        for inertia, kind in (
            (None, usual),
            (deprecated.resolve("by_bodies"), new.ArticulatedBodies),
            (deprecated.resolve("inertia_by_composites"), new.CompositeBodies),
            (deprecated.resolve("inertia_by_unit_vectors"), new.UnitVectors),
        ):
            for hold in (None, 0.0, 0.3):
                assert Dynamics(inertia, hold).resolved(chain) == kind(hold)
        assert type(Dynamics().resolved(chain)) is usual


@pytest.mark.slow
def test_every_line_of_the_report():
    """Each number of the report equals an independent computation, for a driven four-bar."""
    chain = models.four_bar()
    control = lambda t, s, args: jnp.zeros(chain.dofs).at[0].set(3.0)
    dynamics = svkc.dynamics.CompositeBodies(hold=None)
    run = jax.jit(
        lambda dt: svkc.simulate(
            chain,
            chain.state(v={"crank": 6.0}),
            1.0,
            ts=jnp.linspace(0, 1, 11),
            control=control,
            dt=dt,
            dynamics=dynamics,
        )
    )
    coarse, fine = run(0.02), run(0.001)
    report = coarse.report()
    states = coarse.states
    assert float(report.gap_rate) == pytest.approx(
        float(
            jnp.max(
                jnp.linalg.norm(
                    jax.vmap(lambda s: svkc.loop_gap_rates(chain, s))(states)[..., 3:], axis=-1
                )
            )
        )
    )
    gained = svkc.energy(chain, coarse.final) - svkc.energy(
        chain, jax.tree.map(lambda x: x[0], states)
    )
    assert float(report.energy_drift) == pytest.approx(
        float(gained - coarse.phases.work[0]), rel=REFERENCE
    )
    assert (
        int(report.accepted),
        int(report.rejected),
        int(report.evaluations),
        int(report.phases),
    ) == (50, 0, 350, 1)
    # the sum of the steps' error estimates is within two or three orders of the run's error
    error = float(np.sqrt(np.mean((coarse.final.q - fine.final.q) ** 2)))
    assert 0.01 * error < float(report.error) < 1000 * error
    assert int(report.swaps) > 0
    margins = [
        float(svkc.mobility(chain, jax.tree.map(lambda x, i=i: x[i], states)).margin)
        for i in range(11)
    ]
    assert 0 < float(report.margin) <= min(margins) + 1e-12
    assert not bool(report.free)
    for word in (
        "largest loop gap",
        "drift",
        "in no phase are all bodies free",
        "rank margin",
        "350 evaluations",
        "successful",
    ):
        assert word in str(report)


@pytest.mark.slow
def test_the_report_covers_steps_between_saved_times():
    """A loop drifts open and is cut before the next save time: the report and the result code show
    it.
    """
    chain = models.four_bar()
    options = {
        "dt": 0.02,
        "solver": diffrax.Heun(),
        "stabilization": svkc.stabilization.NoStabilization(),
        "throw": False,
    }
    cut = svkc.simulate(
        chain, chain.state(v={"crank": 6.0}), 0.4, events=[svkc.at(0.2, cut="pin")], **options
    )
    saved_every_step = svkc.simulate(
        chain, chain.state(v={"crank": 6.0}), 0.2, ts=0.02 * np.arange(11), **options
    )
    gap = float(saved_every_step.gaps[:, 1].max())
    assert float(cut.gaps.max()) < ROUND_OFF < 1e-4 < float(saved_every_step.gaps[-1, 1]) < gap
    assert float(cut.report().gap) == pytest.approx(gap, rel=ROUND_OFF)
    assert cut.result == svkc.RESULTS.loop_open


@pytest.mark.slow
def test_momentum_drift_of_a_free_system(arm):
    chain, state = arm
    report = svkc.simulate(chain, state, 0.5, rtol=1e-10, atol=1e-12).report()
    assert bool(report.free)
    assert 0 < float(report.momentum_drift) < 1e-8
    assert float(report.angular_momentum_drift) < 1e-8
    inaccurate = svkc.simulate(chain, state, 0.5, dt=0.05, solver=diffrax.Heun()).report()
    assert float(inaccurate.angular_momentum_drift) > 1e-3
    assert "N m s" in str(inaccurate)


@pytest.mark.slow
def test_a_non_finite_lane_stops_and_keeps_its_last_finite_state(arm):
    """NaN from control or a guard stops its lane at that time; other lanes are unaffected.

    Tested with fixed steps, adaptive steps and diffrax's adjoint.
    """
    chain, state = arm

    def run(times, **kw):
        """Return a run: control is NaN from the first time on, the guard from the second."""
        control = lambda t, s, args: jnp.where(t > args[0], jnp.nan, 0.0) * jnp.ones(chain.dofs)
        nan_guard = svkc.when(lambda t, s, args: jnp.where(t > args[1], jnp.nan, 1.0), stop=True)
        return svkc.simulate(
            chain,
            state,
            0.4,
            events=[svkc.at(0.1, cut=()), nan_guard],
            control=control,
            args=jnp.asarray(times),
            **{"throw": False} | kw,
        )

    diffrax_adjoint = diffrax.RecursiveCheckpointAdjoint()
    for kw, tolerance in (
        ({"dt": 0.01}, 0.011),
        ({"dt": 0.01, "adjoint": diffrax_adjoint}, 0.011),
        ({"rtol": 1e-6, "atol": 1e-8}, 1e-9),
    ):
        batch = jax.jit(jax.vmap(lambda times, kw=kw: run(times, **kw)))
        lanes = batch(jnp.array([[1.0, 1.0], [0.25, 1.0], [0.05, 1.0]]))
        assert (lanes.result == svkc.RESULTS.non_finite).tolist() == [False, True, True]
        assert (lanes.result == svkc.RESULTS.successful).tolist() == [True, False, False]
        np.testing.assert_allclose(lanes.t_final, [0.4, 0.25, 0.05], atol=tolerance)
        assert np.all(lanes.t_final[1:] <= np.array([0.25, 0.05]) + 1e-12)
        assert lanes.phases.count.tolist() == [2, 2, 1]
        assert np.isfinite(lanes.final.q).all()
        assert np.isfinite(lanes.states.q).all()
        # the finite lane equals itself in a batch without NaN
        finite_lanes = batch(jnp.ones((3, 2)))
        assert np.all(finite_lanes.result == svkc.RESULTS.successful)
        np.testing.assert_allclose(lanes.final.q[0], finite_lanes.final.q[0], atol=ROUND_OFF)
    with pytest.raises(RuntimeError, match=r"t = 0\.2\d* s, in phase 2: A non-finite number"):
        run([0.25, 1.0], dt=0.01, throw=True)
    traj = run([1.0, 0.2], dt=0.01)
    assert traj.result == svkc.RESULTS.non_finite
    assert float(traj.t_final) == pytest.approx(0.2, abs=0.011)


@pytest.mark.slow
def test_a_non_finite_event_keeps_the_state_before_it():
    """An event at the end of the run produces NaN: the final state is the one before the event."""
    four = models.four_bar()
    hanging = four.state(connected=())

    def connect_at_end(place):
        start = eqx.tree_at(lambda s: s.structure.pos, hanging, hanging.structure.pos * place)
        return svkc.simulate(four, start, 1e-5, events=[svkc.at(1e-5, connect="pin")], throw=False)

    for factor, code in ((1.0, svkc.RESULTS.successful), (jnp.nan, svkc.RESULTS.non_finite)):
        traj = jax.jit(connect_at_end)(factor)
        assert traj.result == code
        assert np.isfinite(traj.final.q).all()
        assert float(traj.t_final) == 1e-5


@pytest.mark.slow
def test_tune(capsys):
    """`tune` returns the fastest candidate that reaches the target, or None."""
    chain = models.four_bar()
    state = chain.state(v={"crank": 4.0})
    candidates = [
        Candidate("rough", {"dt": 0.02, "solver": svkc.integrators.SymplecticEuler()}),
        Candidate("fine", {"rtol": 1e-8, "atol": 1e-10}),
        Candidate(
            "loose",
            {
                "rtol": 1e-3,
                "atol": 1e-5,
                "stabilization": svkc.stabilization.CoordinatePartitioning(),
            },
        ),
    ]
    tuning = svkc.accuracy.tune(chain, state, 0.5, target=1e-6, options=candidates, repeats=1)
    assert str(tuning) in capsys.readouterr().out
    assert tuning.best is candidates[1].options
    assert tuning.table[0].name == "fine"
    assert tuning.table[0].error <= 1e-6 < min(c.error for c in tuning.table[1:])
    assert all(c.seconds > 0 and c.steps > 0 for c in tuning.table)
    assert next(c for c in tuning.table if c.name == "loose").gap < 1e-13
    for word in ("* fine", "  rough", "loop gap", "* the fastest"):
        assert word in str(tuning)
    run = svkc.simulate(chain, state, 0.5, ts=jnp.linspace(0, 0.5, 11), **tuning.best)
    assert int(run.report().accepted + run.report().rejected) == tuning.table[0].steps
    no_tuning = svkc.accuracy.tune(
        chain, state, 0.5, target=1e-9, options=candidates[:1], repeats=1, show=False
    )
    assert no_tuning.best is None
    assert not capsys.readouterr().out
    assert "no candidate holds the target" in str(no_tuning)
    names = [c.name for c in default_candidates(jnp.float64, 1.0)]
    assert len(set(names)) == len(names)


def test_estimate_error_agrees_with_the_true_error(arm, exact):
    """The estimate is within a factor of two of the true error."""
    chain, state = arm
    for options in ({"dt": 0.02, "solver": diffrax.Heun()}, {"rtol": 1e-5, "atol": 1e-7}):
        estimate = svkc.accuracy.estimate_error(chain, state, 0.4, **options)
        run = svkc.simulate(chain, state, 0.4, **options)
        if "dt" in options:
            finer = svkc.simulate(chain, state, 0.4, **options | {"dt": options["dt"] / 2})
            assert svkc.accuracy.configuration_error(chain, run, finer) == estimate
        error = float(np.sqrt(np.mean(svkc.difference(chain, exact.q, run.final.q) ** 2)))
        assert 0.5 * error < estimate < 2 * error
        assert f"by a finer run {estimate:.2e}" in str(run.report(halved=estimate))


def test_estimate_error_of_options_of_simulate(arm):
    chain, state = arm
    estimate = lambda **options: svkc.accuracy.estimate_error(
        chain, state, 0.4, solver=diffrax.Heun(), **options
    )
    # enough for the run, not for half the step
    assert estimate(dt=0.02, max_steps=25) == estimate(dt=0.02)
    assert estimate(dt=None, rtol=1e-5, atol=1e-7) == estimate(rtol=1e-5, atol=1e-7)
    # the ends of two runs that stopped early have no distance
    assert estimate(dt=0.02, max_steps=3, throw=False) == np.inf
    controller = diffrax.PIDController(rtol=1e-5, atol=1e-7)
    with pytest.raises(ValueError, match=r"stepsize_controller.*give rtol and atol, or dt"):
        estimate(stepsize_controller=controller)


def test_default_options_can_be_the_best():
    """The best candidate's options may be empty, as those of the defaults are."""
    candidates = (svkc.accuracy.Candidate("default", {}, seconds=0.1, error=1e-9),)
    assert "* the fastest" in str(svkc.accuracy.Tuning(1e-6, {}, candidates))
    assert "no candidate" in str(svkc.accuracy.Tuning(1e-12, None, candidates))
