"""The work of control, of dampers and of joint limits at the save times."""

import jax
import jax.numpy as jnp
import numpy as np

import svkc

PENDULUM = """<mujoco><worldbody><body name="rod">
  <joint name="pivot" axis="0 1 0" damping="0.3" stiffness="1" range="-20 20" limited="true"/>
  <geom type="capsule" fromto="0 0 0 0 0 -1" size="0.03"/></body></worldbody></mujoco>"""


def test_energy_changes_by_the_work_and_by_what_events_lose():
    """A spring that a lock holds keeps its energy."""
    chain = svkc.load(PENDULUM)
    events = [svkc.at(0.7, lock="pivot"), svkc.at(0.9, unlock="pivot")]
    traj = svkc.simulate(
        chain,
        chain.state({"pivot": 1.2}),
        1.5,
        ts=jnp.arange(16) / 10,
        rtol=1e-10,
        control=lambda t, state, args: 2 * jnp.sin(5 * t) * jnp.ones(1),
        events=events,
    )
    energy = np.asarray(jax.vmap(lambda s: svkc.energy(chain, s))(traj.states))
    control, dampers, limits = np.asarray(traj.work).T
    lost = float(traj.events.energy_lost[0]) * (np.arange(16) >= 7)
    balance = energy - control - dampers - limits + lost
    assert np.ptp(balance) < 1e-8
    assert lost[-1] > 1e-3
    # dampers only take energy, and nothing works on a locked joint
    assert np.all(np.diff(dampers) <= 0)
    np.testing.assert_array_equal(
        np.asarray(traj.work)[7:10], np.asarray(traj.work)[7] + np.zeros((3, 3))
    )
    assert limits[-1] < -1
    # the phases record the sum
    np.testing.assert_allclose(traj.phases.work.sum(), traj.work[-1].sum(), rtol=1e-12)
