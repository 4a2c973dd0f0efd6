"""The verdict of a run's report, and what `print(traj)` shows."""

import functools

import jax
import jax.numpy as jnp
import models
import pytest

import svkc


@pytest.fixture(scope="module")
def arm():
    """Return an arm that turns at 30 rad/s."""
    chain = svkc.load(models.ARM)
    return chain, chain.state([0.3], [30.0])


@functools.cache
def program(driven):
    """Return the compiled run of an arm with fixed steps, driven by a constant torque or not."""
    control = (lambda t, state, args: args * jnp.ones_like(state.v)) if driven else None
    return jax.jit(
        lambda chain, state, dt, torque: svkc.simulate(
            chain, state, 2.0, dt=dt, control=control, args=torque, max_steps=1000, throw=False
        )
    )


def test_steps_that_are_too_long_are_named(arm):
    """The run ends with success, and its verdict says that its energy is wrong."""
    traj = program(False)(*arm, 1.0, 0.0)
    assert traj.result == svkc.RESULTS.successful
    verdict = traj.report().verdict()
    assert "of the kinetic energy: the steps are too long for this motion" in verdict
    assert "errors of the steps add up to" in verdict
    assert str(traj.report()).endswith(f"verdict                  {verdict}")
    extent, *_, last = str(traj).split("\n")
    assert extent == "Trajectory: t = 0 to 2 s, 2 save times, 1 phase, 0 events"
    assert last == verdict


def test_a_fine_run_is_called_fine(arm):
    """Also of a drive and a damper, whose work is no drift, and of an arm that hangs at rest."""
    chain, state = arm
    for run, torque in ((program(False), 0.0), (program(True), 30.0)):
        report = run(chain, state, 0.005, torque).report()
        assert float(report.drift_share) < 1e-6
        assert report.verdict().startswith("no fault found: energy drift is ")
    damped = svkc.load(models.ARM.replace('damping="0"', 'damping="0.5"'))
    traj = program(False)(damped, state, 0.005, 0.0)
    assert float(traj.phases.energy[0, 0] - traj.phases.energy[0, 1]) > 10
    assert traj.report().verdict().startswith("no fault found")
    hanging = svkc.load(models.ARM.replace('gravity="0.3 -0.2 -9.81"', 'gravity="0 0 -9.81"'))
    at_rest = program(False)(hanging, hanging.state(), 0.005, 0.0)
    assert at_rest.report().verdict() == "no fault found: energy drift is within round-off"


def test_a_batch_names_its_worst_lane(arm):
    chain, state = arm
    run = lambda speed: program(False)(
        chain, svkc.State(state.q, speed * state.v, state.structure), 0.25, 0.0
    )
    stack = lambda *x: jnp.stack(x)
    rows = [jax.tree.map(stack, *map(run, speeds)) for speeds in ((0.1, 0.2, 1.0), (0.3, 0.1, 0.5))]
    traj = jax.tree.map(stack, *rows)
    assert traj.report().verdict().startswith("worst of 6 lanes, lane 0, 2: energy drift is ")
    assert str(traj).startswith("Trajectories of 2x3 lanes: t = 0 to 2 s, ")
    assert "\nverdict      worst of 6 lanes, lane 0, 2: " in str(traj.report())


def test_a_failed_run_and_an_unknown_balance(arm):
    """A lane that did not reach its end is the worst one."""
    chain, state = arm
    one, failed = (program(False)(chain, state, dt, 0.0) for dt in (1.0, 0.0015))
    traj = jax.tree.map(lambda *x: jnp.stack(x), one, failed)
    assert "lane 1: the run did not reach its end: More steps than" in traj.report().verdict()
    # as read from a file of an older version
    old = jax.tree.map(lambda x: x, one)
    object.__setattr__(old.phases, "kinetic_energy", None)
    assert "the energy balance is not known; judged by loop gaps" in old.report().verdict()
    # traced, the arrays are shown without values
    jax.jit(lambda x: (str(x), str(x.report()))[0] and x.t_final)(one)
