"""Mobility of overconstrained linkages, its table, and the loop forces of redundant loops."""

import cases
import jax.numpy as jnp
import models
import numpy as np
import pytest
from kkt import constrained_acceleration
from tolerances import REFERENCE, ROUND_OFF

import svkc
from svkc.loops.pivoting import pivoted_qr


@pytest.fixture(params=cases.params("overconstrained"), scope="module")
def linkage(request):
    case = cases.CASES[request.param]
    chain = case.build()
    return case, chain, chain.state()


def test_mobility_is_one_where_the_counting_formula_gives_none(linkage):
    case, chain, state = linkage
    m = svkc.mobility(chain, state)
    actual = int(m.joint_freedoms), int(m.rank), int(m.freedoms)
    assert actual == (case.joint_freedoms, case.rank, 1)
    assert case.joint_freedoms - 6 * len(chain.link_names) == case.counted
    assert int(jnp.sum(m.redundant)) == 6 * len(chain.link_names) - case.rank
    assert float(m.margin) > 1e-3


@pytest.mark.slow
def test_the_linkage_moves_a_finite_distance(linkage):
    """The freedom is not only of first order.

    A run of 0.6 s moves by tenths of a radian, with closed loops, conserved energy and unchanged
    rank.
    """
    case, chain, state = linkage
    W = svkc.coordinates(chain, state).W
    direction = np.asarray(W)[:, np.any(W != 0, 0)][:, 0]
    start = chain.state(state.q, 2 * direction / np.abs(direction).max())
    traj = svkc.simulate(chain, start, 0.6, rtol=1e-9, atol=1e-11)
    assert float(jnp.abs(svkc.difference(chain, start.q, traj.final.q)).max()) > 0.3
    assert float(traj.gaps.max()) < ROUND_OFF
    assert abs(float(traj.phases.energy_drift[0])) < 1e-6 * (
        1 + abs(float(traj.phases.energy[0, 0]))
    )
    there = chain.state(traj.final.q)
    assert int(svkc.mobility(chain, there).rank) == case.rank
    expected = constrained_acceleration(chain, start, np.zeros(chain.nv))
    vdot = svkc.forward_dynamics(chain, start, jnp.zeros(chain.nv))
    np.testing.assert_allclose(vdot[: chain.nv], expected, atol=REFERENCE * np.abs(expected).max())


def test_str_is_a_table_with_names():
    chain = models.parallelogram()
    state = chain.state()
    text = str(svkc.mobility(chain, state))
    assert "joint freedoms (N_J)      6" in text
    assert "rank of the loops (m)     5   margin 1.70e-01" in text
    assert "pin1:  6 rows, 3 of them redundant" in text
    assert "pin2:  6 rows, 4 of them redundant" in text
    assert "independent coordinates: " in text
    assert "pin1:  not connected" in str(svkc.mobility(chain, chain.state(connected=["pin2"])))
    for name in ("leg0", "plate"):
        independent = svkc.mobility(chain, svkc.with_independent(chain, state, name)).independent
        assert chain.dof_names[int(jnp.argmax(independent))] == name


@pytest.mark.slow
@pytest.mark.parametrize("name", cases.params("forces"))
def test_loop_forces_are_the_multipliers(name):
    """Loop forces are numpy's least-norm multipliers, and `unique` tells which are determined."""
    case = cases.CASES[name]
    chain = case.build()
    rng = np.random.default_rng(4)
    state = chain.state(v=rng.normal(size=chain.nv))
    tau = jnp.concatenate(
        [jnp.asarray(rng.normal(size=chain.nv)), jnp.zeros(chain.dofs - chain.nv)]
    )
    forces = svkc.loop_forces(chain, state, tau)
    assert forces.unique.tolist() == list(case.unique)
    linear, angular = (np.asarray(x) for x in svkc.loop_jacobian(chain, state))
    J = np.concatenate([angular, linear / float(chain.length)], 1).reshape(-1, chain.dofs)
    vdot = constrained_acceleration(chain, state, tau)
    excess = np.zeros(chain.dofs)
    excess[: chain.nv] = (
        np.asarray(svkc.inverse_dynamics(chain, state, jnp.asarray(vdot)))
        - np.asarray(tau)[: chain.nv]
    )
    # the multipliers act on the virtual link, loop forces on the real one
    wrench = -np.linalg.lstsq(J.T, excess, rcond=1e-9)[0].reshape(-1, 6)
    scale = max(1.0, np.abs(wrench).max())
    np.testing.assert_allclose(forces.torque, wrench[:, :3], atol=REFERENCE * scale)
    np.testing.assert_allclose(
        forces.force, wrench[:, 3:] / float(chain.length), atol=REFERENCE * scale
    )


def test_the_first_of_equal_columns_becomes_the_pivot():
    """Mirrored limbs have columns equal but for round-off, which differs between machines."""
    rng = np.random.default_rng(0)
    half = rng.normal(size=(6, 8))
    J = np.concatenate([half, -half], 1) * (1 + 1e-13 * rng.normal(size=(6, 16)))
    assert set(np.argmax(pivoted_qr(jnp.asarray(J)).P, 1).tolist()) <= set(range(8))
