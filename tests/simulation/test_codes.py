"""The codes of a run: how it ended, and whether it has derivatives."""

import itertools

import jax
import jax.numpy as jnp
import models
import numpy as np
import pytest

import svkc
from svkc.simulation.codes import RESULTS
from svkc.types import DERIVATIVE

MOVED = ("grazing", "jump", "together", "rank_lost")


def members(enumeration):
    return enumeration._name_to_item


def test_results_hold_outcomes_only_and_derivative_verdicts_have_an_enumeration():
    assert not set(MOVED) & set(members(svkc.RESULTS))
    assert {*MOVED, "successful"} == set(members(DERIVATIVE))
    annotations = svkc.Trajectory.__annotations__, svkc.types.Report.__annotations__
    for fields in annotations:
        assert fields["result"] is svkc.RESULTS
        assert fields["derivative"] is DERIVATIVE


def test_codes_of_derivatives_compare_with_what_users_wrote_before():
    """`traj.derivative == RESULTS.grazing` answers as before in both orders, also for batches and
    inside of compiled programs; each warns and names the new enumeration."""
    batch = jax.vmap(lambda i: DERIVATIVE.where(i > 0, DERIVATIVE.grazing, DERIVATIVE.successful))
    codes = jax.jit(batch)(jnp.arange(3))
    with pytest.warns(DeprecationWarning, match=r"svkc.types.DERIVATIVE.grazing"):
        assert (codes == RESULTS.grazing).tolist() == [False, True, True]
    for compare in (lambda a, b: a == b, jax.jit(lambda a, b: a == b)):
        for a, b in ((codes, RESULTS.successful), (RESULTS.successful, codes)):
            with pytest.warns(DeprecationWarning, match="use svkc.types.DERIVATIVE"):
                assert compare(a, b).tolist() == [True, False, False]
    with pytest.warns(DeprecationWarning, match="svkc.types.DERIVATIVE"):
        assert (codes != RESULTS.successful).tolist() == [False, True, True]
    with pytest.warns(DeprecationWarning, match="svkc.types.DERIVATIVE"):
        assert svkc.RESULTS[DERIVATIVE.jump] == DERIVATIVE[DERIVATIVE.jump]


def test_results_and_derivatives_are_equal_only_if_both_are_successful():
    """Integer values coincide by chance; names decide."""
    pairs = itertools.product(members(RESULTS).items(), members(DERIVATIVE).items())
    for (result, a), (derivative, b) in pairs:
        with pytest.warns(DeprecationWarning, match="use svkc.types.DERIVATIVE"):
            assert bool(a == b) == bool(b == a) == (result == derivative)
    with pytest.raises(ValueError, match="Can only compare"):
        assert DERIVATIVE.successful == 0


@pytest.mark.filterwarnings("error")
def test_new_spellings_do_not_warn():
    four = models.four_bar()
    traj = svkc.simulate(four, four.state(), 1e-3, dt=1e-3)
    assert traj.derivative == DERIVATIVE.successful
    assert traj.result == RESULTS.successful
    assert isinstance(traj.derivative, DERIVATIVE)
    assert not isinstance(traj.derivative, RESULTS)
    assert "derivatives" not in str(traj.report())
    with pytest.raises(AttributeError):
        RESULTS.nothing
    np.testing.assert_array_equal(np.asarray(traj.derivative._value), 0)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["dt", "rtol", "dtmax"])
def test_traced_step_options_that_are_not_positive(name):
    """Such lanes end before they start; a positive option runs as a concrete one does."""
    chain = svkc.load(models.ARM)
    state = chain.state({"arm": 0.5})
    run = lambda x: svkc.simulate(chain, state, 0.2, throw=False, **{name: x})
    lanes = jax.jit(jax.vmap(run))(jnp.array([0.01, 0.0, -0.01, np.nan]))
    too_small = RESULTS.step_too_small
    assert (lanes.result == RESULTS.successful).tolist() == [True, False, False, False]
    assert (lanes.result == too_small).tolist() == [False, True, True, True]
    assert lanes.t_final.tolist() == [0.2, 0, 0, 0]
    np.testing.assert_array_equal(lanes.final.q[1:, 0], 0.5)
    np.testing.assert_allclose(lanes.final.q[0], run(0.01).final.q, atol=1e-13)


@pytest.mark.slow
def test_steps_below_the_resolution_of_time():
    """In float32, at t = 5e4 s, a stiff spring needs steps below the resolution of time."""
    with jax.enable_x64(False):
        arm = models.ARM.replace("<joint ", '<joint stiffness="1e4" ')
        chain = svkc.load(arm)
        traj = svkc.simulate(chain, chain.state({"arm": 0.2}), 50008.0, t0=5e4, throw=False)
        assert traj.result == RESULTS.step_too_small
        assert int(traj.report().rejected) < 10
