"""Invalid numbers in the data of a lane: the lane ends with a code of its own, and the other lanes
are those of a batch without invalid numbers, bit for bit."""

import functools

import equinox as eqx
import error_page
import jax
import jax.numpy as jnp
import models
import numpy as np
import pytest

import svkc
from svkc.model.inertial_parameters import has_invalid_inertial_parameters
from svkc.types import DERIVATIVE

NAN, INF = np.nan, np.inf
# t0, t1, time of the event, two save times
GOOD = [0.0, 0.02, 0.01, 0.005, 0.02]
TIMES = {
    "the end is NaN": ([0.0, NAN, 0.01, 0.005, 0.02], "not_a_time"),
    "the end is infinite": ([0.0, INF, 0.01, 0.005, 0.02], "not_a_time"),
    "the start is NaN": ([NAN, 0.02, 0.01, 0.005, 0.02], "not_a_time"),
    "the event is NaN": ([0.0, 0.02, NAN, 0.005, 0.02], "not_a_time"),
    "a save time is NaN": ([0.0, 0.02, 0.01, NAN, 0.02], "not_a_time"),
    "a save time is infinite": ([0.0, 0.02, 0.01, 0.005, INF], "not_a_time"),
    "the end is before the start": ([0.03, 0.02, 0.01, 0.005, 0.02], "reversed"),
    "the end is negative": ([0.0, -0.02, 0.01, 0.0, 0.0], "reversed"),
    "the event is before the start": ([0.0, 0.02, -0.01, 0.005, 0.02], "reversed"),
    "save times decrease": ([0.0, 0.02, 0.01, 0.02, 0.005], "reversed"),
    "a save time is before the start": ([0.001, 0.02, 0.01, 0.0, 0.02], "reversed"),
    "the event never happens": ([0.0, 0.02, INF, 0.005, 0.02], "successful"),
    "a save time is past the end": ([0.0, 0.02, 0.01, 0.005, 0.021], "successful"),
}  # fmt: skip


@pytest.fixture(scope="module")
def pendulum():
    return svkc.load(models.ARM)


@pytest.fixture(scope="module")
def lanes(pendulum):
    """Return the compiled batch of runs, with the derivative of the final angle by the first."""

    def run(angle, times, throw=False):
        t0, t1, event, *ts = times
        state = pendulum.state()
        state = svkc.State(state.q.at[0].set(angle), state.v, state.structure)
        traj = svkc.simulate(
            pendulum, state, t1, t0=t0, ts=jnp.stack(ts), events=[svkc.at(event)], dt=5e-3,
            throw=throw,
        )  # fmt: skip
        return traj.final.q[0], traj

    return run, jax.jit(jax.vmap(jax.value_and_grad(run, has_aux=True)))


@pytest.mark.slow
def test_times_of_lanes(lanes):
    """Codes, finite states, and lanes beside them that do not change by a bit."""
    _, batch = lanes
    angles = jnp.linspace(0.1, 1.2, 2 * len(TIMES))
    valid = np.array([GOOD] * len(angles))
    times = valid.copy()
    times[::2] = [row for row, _ in TIMES.values()]
    (_, traj), slopes = batch(angles, jnp.asarray(times))
    (_, reference), reference_slopes = batch(angles, jnp.asarray(valid))
    assert np.all(reference.result == svkc.RESULTS.successful)
    for name, value, expected in zip(
        TIMES, traj.result._value[::2], [code for _, code in TIMES.values()], strict=True
    ):
        assert value == getattr(svkc.RESULTS, expected)._value, name
    failed = np.asarray(traj.result != svkc.RESULTS.successful)
    for got, want in zip(*map(jax.tree.leaves, (traj, reference)), strict=True):
        np.testing.assert_array_equal(got[1::2], want[1::2])
    np.testing.assert_array_equal(slopes[1::2], reference_slopes[1::2])
    # nothing was run
    assert np.isfinite(traj.final.q).all()
    np.testing.assert_array_equal(traj.final.q[failed, 0], angles[failed])
    np.testing.assert_array_equal(
        traj.states.q[failed, :, 0], np.repeat(angles[failed, None], 2, axis=1)
    )
    assert traj.phases.count[failed].tolist() == [0] * int(failed.sum())
    assert traj.events.count[failed].tolist() == [0] * int(failed.sum())
    assert np.all(traj.derivative == DERIVATIVE.successful)


def test_a_compiled_run_with_invalid_times_raises(lanes):
    run = jax.jit(lambda times: lanes[0](0.1, times, throw=True)[0])
    for name in ("the event is NaN", "the end is before the start"):
        times, code = TIMES[name]
        message = svkc.RESULTS[getattr(svkc.RESULTS, code)].split(":")[0]
        with error_page.as_users_see(), pytest.raises(RuntimeError, match=message):
            run(jnp.asarray(times))


def test_rollout_codes_invalid_times(pendulum):
    states = jax.tree.map(lambda x: jnp.stack([x] * 3), pendulum.state())
    lane = lambda chain, t: {"t1": t[0], "events": [svkc.at(t[1])]}
    data = jnp.array([[1e-3, 5e-4], [1e-3, NAN], [-1e-3, 5e-4]])
    traj = svkc.rollout(pendulum, states, 0.0, data=data, lane=lane, dt=5e-4, progress=False)
    codes = svkc.RESULTS.successful, svkc.RESULTS.not_a_time, svkc.RESULTS.reversed
    assert traj.result._value.tolist() == [code._value for code in codes]


def test_concrete_times_raise_value_errors(pendulum):
    state = pendulum.state()
    for t1, kw, words in (
        (NAN, {}, "t1: got nan"),
        (-1.0, {}, "t1: got -1.0"),
        (1.0, {"events": [svkc.at(NAN)]}, "at: got time nan"),
        (1.0, {"ts": [0.5, NAN]}, "ts: expected finite"),
        (1.0, {"ts": [0.5, 2.0]}, "ts: expected non-decreasing"),
    ):
        with error_page.as_users_see(), pytest.raises(ValueError, match=words):
            svkc.simulate(pendulum, state, t1, dt=1e-3, **kw)


# mass, and the principal moments as factors of those of the model
BODIES = {
    "negative mass": ([-1.0, 1, 1, 1], "not_positive_definite"),
    "NaN mass": ([NAN, 1, 1, 1], "not_positive_definite"),
    "infinite mass": ([INF, 1, 1, 1], "not_positive_definite"),
    "negative inertia": ([1.0, 1, -1, 1], "not_positive_definite"),
    "slightly negative inertia": ([1.0, 1, 1, -1e-9], "not_positive_definite"),
    "two negative inertias": ([1.0, -1, -1, 1], "not_positive_definite"),
    "NaN inertia": ([1.0, 1, NAN, 1], "not_positive_definite"),
    "infinite inertia": ([1.0, 1, INF, 1], "not_positive_definite"),
    "point mass": ([1.0, 0, 0, 0], "successful"),
    "thin rod": ([1.0, 1, 1, 0], "successful"),
    "no triangle": ([1.0, 1, 1, 50], "successful"),
}


def with_bodies(chain, factors):
    """Return the chain with factored masses, and principal moments along axes that are no axes of
    the rows."""
    cast = lambda x: jnp.asarray(x, chain.inertia.dtype)
    axes, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    axes, factors = cast(axes), cast(factors)
    unit = axes @ jnp.diag(factors[1:]) @ axes.T
    inertia = jnp.max(chain.inertia, (-2, -1))[:, None, None] * unit[None]
    return eqx.tree_at(lambda c: (c.mass, c.inertia), chain, (chain.mass * factors[0], inertia))


@pytest.mark.slow
def test_masses_of_lanes(pendulum):
    """Codes, finite states, and lanes beside them that do not change by a bit."""

    @jax.jit
    @jax.vmap
    @functools.partial(jax.value_and_grad, has_aux=True)
    def run(factors):
        chain = with_bodies(pendulum, factors)
        traj = svkc.simulate(chain, pendulum.state({"arm": 1.0}), 0.02, dt=5e-3, throw=False)
        return traj.final.q[0], traj

    factors = np.ones((2 * len(BODIES), 4))
    factors[:, 0] = np.linspace(1, 2, len(factors))
    (_, reference), reference_slopes = run(jnp.asarray(factors))
    assert np.all(reference.result == svkc.RESULTS.successful)
    factors[::2] = [row for row, _ in BODIES.values()]
    (_, traj), slopes = run(jnp.asarray(factors))
    for name, value, expected in zip(
        BODIES, traj.result._value[::2], [code for _, code in BODIES.values()], strict=True
    ):
        assert value == getattr(svkc.RESULTS, expected)._value, name
    for got, want in zip(
        *map(jax.tree.leaves, ((traj, slopes), (reference, reference_slopes))), strict=True
    ):
        np.testing.assert_array_equal(got[1::2], want[1::2])
    failed = np.asarray(traj.result != svkc.RESULTS.successful)
    np.testing.assert_array_equal(traj.final.q[failed, 0], 1.0)
    assert np.isfinite(slopes[~failed]).all()


@pytest.mark.parametrize("name", BODIES)
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_concrete_masses(pendulum, name, dtype):
    """An invalid one raises ValueError that names the array and the body; others are accepted."""
    factors, code = BODIES[name]
    cast = lambda x: x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x
    chain, state = jax.tree.map(cast, (pendulum, pendulum.state()))
    chain = jax.tree.map(cast, with_bodies(chain, np.array(factors)))
    if code == "successful":
        assert np.isfinite(svkc.mass_matrix(chain, state)).all()
        return
    if name == "slightly negative inertia" and dtype == np.float32:
        # below round-off
        assert np.isfinite(svkc.mass_matrix(chain, state)).all()
        return
    words = rf"chain.{'mass' if 'mass' in name else 'inertia'}: got .* for body 'arm'"
    for call in (
        lambda: svkc.mass_matrix(chain, state),
        lambda: svkc.simulate(chain, state, 1.0, dt=1e-3),
        lambda: svkc.rollout(chain, jax.tree.map(lambda x: x[None], state), 1.0),
    ):
        # also if a valid chain was checked before
        svkc.poses(pendulum, pendulum.state())
        with error_page.as_users_see(), pytest.raises(ValueError, match=words):
            call()


def test_armature_of_a_chain(pendulum):
    """A negative one raises ValueError that names the joint; as data of a lane it is a code."""
    text = models.ARM.replace("<joint ", '<joint armature="0.1" ')
    chain = svkc.load(text)
    change = lambda x: eqx.tree_at(lambda c: c.armature, chain, chain.armature * x)
    words = r"chain.armature: got -0.1 for 'arm'"
    with error_page.as_users_see(), pytest.raises(ValueError, match=words):
        svkc.simulate(change(-1), chain.state(), 1.0)
    lanes = jax.jit(jax.vmap(lambda x: has_invalid_inertial_parameters(change(x))))
    assert lanes(jnp.array([1.0, 0.0, -1.0, NAN, INF])).tolist() == [False] * 2 + [True] * 3
