"""float32 at the same extremes as float64, with bounds of its own, and what it cannot do."""

import diffrax
import jax
import jax.numpy as jnp
import maximal
import models
import numpy as np
import pytest
import test_extremes as extremes
from test_reference import n_four_bar

import svkc

pytestmark = pytest.mark.slow

TIMES = np.linspace(0, 1, 11, dtype=np.float32)


@pytest.fixture
def single():
    with jax.enable_x64(False):
        yield


def test_single_precision():
    """float32: the N four-bar and a chain of unlike masses, with bounds of their own; float64 input
    where x64 is off warns once."""
    with jax.enable_x64(False):
        chain, state = maximal.load(n_four_bar(2))
        assert state.q.dtype == jnp.float32
        traj = svkc.simulate(chain, state, 2.0, ts=2 * TIMES, rtol=1e-5, atol=1e-6)
        assert float(traj.gaps.max()) < 1e-5
        assert abs(float(traj.report().energy_drift)) < 1e-2 * 35.8
        chain = extremes.rods([1e3, 1.0, 1e-3], [1.0] * 3)
        traj = svkc.simulate(chain, extremes.zigzag(chain), 1.0, ts=TIMES)
        assert extremes.drift(chain, traj) < 1e-3
        chain = models.four_bar()
        with pytest.warns(UserWarning, match="v in float64, kept in float32") as said:
            state = chain.state(v=np.array([1.0, 0.0, 0.0]))
        assert len(said) == 1
        svkc.simulate(chain, state, np.float64(0.1), ts=np.linspace(0, 0.1, 3))
    wide = models.four_bar()
    state = wide.state()
    with (
        jax.enable_x64(False),
        pytest.raises(ValueError, match="float64, but jax_enable_x64 is off"),
    ):
        svkc.simulate(wide, state, 0.1)


def test_the_high_bar_in_single_precision():
    """Ten seconds on the bar by both hands: the loops stay closed by projection."""
    with jax.enable_x64(False):
        chain, state = svkc.scenes.high_bar(ignore=("limit",))
        traj = svkc.simulate(chain, state, 10.0, ts=jnp.linspace(0, 10, 101))
        assert traj.final.structure.connected.all()
        assert traj.states.q.dtype == jnp.float32
        assert float(traj.gaps[:, 1].max()) < 1e-5
        assert float(traj.gaps[:, 0].max()) < 1e-5


@pytest.mark.usefixtures("single")
def test_lengths_from_a_millimetre_to_a_kilometre():
    """A kilometre at the end of a millimetre is kept. A millimetre at the end of a kilometre is
    below what float32 can tell apart there: said by a code."""
    chain = extremes.four_bar_on_a_bar(1e3)
    traj = svkc.simulate(chain, chain.state(v={"crank": 4.0}), 1.0, ts=TIMES)
    assert extremes.drift(chain, traj) < 3e-4
    assert float(traj.gaps[:, 1].max()) < 1e-3
    chain = extremes.four_bar_on_a_bar(1e-3)
    traj = svkc.simulate(
        chain, chain.state(v={"crank": 4.0}), 0.05, ts=0.05 * TIMES, dt=1e-4, throw=False
    )
    assert traj.result == svkc.RESULTS.non_finite
    assert np.isfinite(traj.states.q).all()


@pytest.mark.usefixtures("single")
def test_far_away_and_fast():
    """1e6 m from the origin, where places are told apart by 6 cm: a metre's figure turns as at the
    origin to 5e-3."""
    chain = extremes.two_bars()
    run = jax.jit(lambda state: svkc.simulate(chain, state, 1.0, throw=False))
    q, v = np.array(chain.q_load), np.array(extremes.THROWN, np.float32)
    near = run(chain.state(q, v))
    q[:3] += np.array([1e6, -1e6, 1e6])
    v[:3] += np.array([1e3, -1e3, 1e3])
    far = run(chain.state(q, v))
    np.testing.assert_allclose(far.final.q[3:], near.final.q[3:], atol=5e-3)
    np.testing.assert_allclose(far.final.v[3:], near.final.v[3:], atol=0.1)


@pytest.mark.usefixtures("single")
def test_fast_spin():
    chain = svkc.load(extremes.WEIGHTLESS)
    state = chain.state(v=np.array(extremes.SPIN, np.float32))
    traj = svkc.simulate(chain, state, 1.0, ts=TIMES)
    assert extremes.drift(chain, traj) < 1e-2
    assert float(traj.report().angular_momentum_drift) < 1e-3 * float(
        jnp.linalg.norm(svkc.momentum(chain, state)[1])
    )


@pytest.mark.usefixtures("single")
def test_two_hundred_links():
    """Twenty metres of links of ten centimetres, by fixed steps: their accelerations are good to
    some 1e-2, finer than which no tolerance can ask."""
    chain = extremes.rods([0.1] * 200, [0.1] * 200)
    traj = svkc.simulate(chain, extremes.zigzag(chain, 0.05), 0.1, ts=0.1 * TIMES, dt=1e-3)
    assert extremes.drift(chain, traj) < 5e-2


@pytest.mark.usefixtures("single")
def test_twenty_loops():
    chain = extremes.legs(20)
    state = chain.state({"leg0": 0.3})
    assert svkc.mobility(chain, state).freedoms == 1
    traj = svkc.simulate(chain, state, 1.0, ts=TIMES)
    assert extremes.drift(chain, traj) < 5e-4
    assert float(traj.gaps.max()) < 1e-5


@pytest.mark.usefixtures("single")
def test_stiff_springs():
    chain, rigid = extremes.sprung_and_rigid()
    expected = svkc.simulate(rigid, rigid.state({"b": 0.5}), 0.1)
    for solver, most in ((diffrax.Tsit5(), 3000), (diffrax.Kvaerno5(), 100)):
        traj = svkc.simulate(chain, chain.state({"b": 0.5}), 0.1, solver=solver)
        assert float(traj.final.q[1]) == pytest.approx(float(expected.final.q[0]), abs=1e-5)
        assert int(traj.report().accepted) < most


@pytest.mark.usefixtures("single")
def test_a_hundred_thousand_steps():
    """The loop stays closed; the steps are those that time in float32 can tell apart, a thousandth
    off at the end of ten seconds."""
    chain = models.four_bar()
    traj = svkc.simulate(
        chain,
        chain.state(v={"crank": 4.0}),
        10.0,
        ts=10 * TIMES,
        dt=1e-4,
        solver=svkc.SemiImplicitEuler(),
    )
    assert int(traj.report().accepted) == pytest.approx(100_000, rel=2e-3)
    assert float(traj.report().gap) < 2e-5
    assert extremes.drift(chain, traj) < 1e-2


@pytest.mark.parametrize("name", ["four_bar", "two_bars", "deep"])
def test_both_precisions_in_one_process(name):
    """One model in float64, then in float32, then in float64 again: each as if it were alone."""
    make = {
        "four_bar": models.four_bar,
        "two_bars": extremes.two_bars,
        "deep": lambda: extremes.rods([0.1] * 40, [0.1] * 40),
    }[name]

    def found():
        chain = make()
        state = chain.state(v=np.linspace(-1, 1, chain.nv, dtype=chain.q_load.dtype))
        fast = svkc.Dynamics(inertia=svkc.by_bodies)
        stepped = svkc.step(chain, state, jnp.zeros(chain.nv), 1e-3)
        run = svkc.simulate(chain, state, 0.01, dt=2e-3, dynamics=fast)
        return [
            np.asarray(x, float)
            for x in (
                svkc.forward_dynamics(chain, state, jnp.zeros(chain.nv)),
                stepped.v,
                run.final.q,
            )
        ]

    double = found()
    with jax.enable_x64(False):
        single = found()
    for a, b in zip(double, single, strict=True):
        np.testing.assert_allclose(b, a, atol=2e-3 * np.abs(a).max())
    for a, b in zip(double, found(), strict=True):
        np.testing.assert_array_equal(a, b)
