"""The kernel of the transcription against the library's dynamics, and its order of convergence."""

import cases
import jax
import jax.numpy as jnp
import models
import numpy as np
import pytest
from tolerances import REFERENCE

import svkc
from svkc import optimize
from svkc.optimize.charts import chart_from_motion, motion_from_chart
from svkc.optimize.equations import (
    IntervalData,
    Model,
    Params,
    connection,
    equations_of_motion,
)
from svkc.optimize.lift import Layout
from svkc.optimize.loop_rows import (
    LinkRows,
    gaps_at,
    link_force,
    link_torque,
    rates_at,
)
from svkc.optimize.points import full_state
from svkc.optimize.structures import candidate_rows

# MuJoCo warns so of gymnasium's half_cheetah.xml
pytestmark = pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass' is deprecated")

# an issue of the same algebra in another order, amplified by the condition of the mass matrix
KERNEL = 1e-10


def tree(chain, state):
    return state.q[: chain.nq], state.v[: chain.nv]


def connected_rows(chain, state) -> LinkRows:
    return LinkRows.of(chain, candidate_rows(chain, np.asarray(state.structure.connected)))


def jacobian(chain, q, table):
    return np.asarray(jax.jacfwd(lambda v: rates_at(chain, q, v, table))(jnp.zeros(chain.nv)))


@pytest.mark.parametrize("name", cases.params("tree"))
def test_open_chains_are_those_of_inverse_dynamics(name):
    chain, state, _ = cases.CASES[name].random_motion()
    q, v = tree(chain, state)
    vdot = jnp.asarray(np.random.default_rng(0).normal(size=chain.nv))
    none = LinkRows.of(chain, np.zeros(0, int))
    zero = jnp.zeros(chain.dofs)
    evaluate = jax.jit(lambda *x: equations_of_motion(chain, none, *x, tau=zero, f=zero[:0])[0])
    force = evaluate(q, v, vdot)
    expected = svkc.inverse_dynamics(chain, state, vdot)
    limits = svkc.tree.inverse_dynamics.limit_forces(chain, state.q, state.v)[: chain.nv]
    np.testing.assert_allclose(force, expected - limits, rtol=KERNEL, atol=KERNEL)


@pytest.mark.parametrize("name", cases.params("loops"))
def test_closed_chains_are_those_of_forward_dynamics_and_loop_forces(name):
    """Accelerations of `forward_dynamics` satisfy the equations with the wrenches of
    `loop_forces`."""
    chain, state, tau = cases.CASES[name].random_motion()
    # torques of virtual joints are none of the transcription's
    tau = jnp.where(np.arange(chain.dofs) < chain.nv, tau, 0)
    q, v = tree(chain, state)
    vdot = svkc.forward_dynamics(chain, state, tau)[: chain.nv]
    table = connected_rows(chain, state)
    evaluate = jax.jit(lambda f: equations_of_motion(chain, table, q, v, vdot, tau=tau, f=f))
    without, links = (np.asarray(x) for x in evaluate(jnp.zeros(len(table))))
    scale = 1 + np.abs(vdot).max()
    assert np.abs(links).max() < KERNEL * scale
    # the multipliers are linear in the force that the links must give
    J = jacobian(chain, q, table)
    f = jnp.asarray(np.linalg.lstsq(J.T, without, rcond=1e-9)[0])
    assert np.abs(evaluate(f)[0]).max() < KERNEL * scale * (1 + np.abs(f).max())
    wrenches = svkc.loop_forces(chain, state, tau)
    rotations = svkc.poses(chain, state).quaternion
    for i, link in enumerate(chain.link_names):
        if not wrenches.unique[i] or not state.structure.connected[i]:
            continue
        parent = np.flatnonzero(np.array(chain.topology.body_row) == int(state.structure.parent[i]))
        to_parent = svkc.tree.spatial.quat_conjugate(rotations[int(parent[0])])
        own = link_force(chain, table, i, f), link_torque(chain, q, table, i, f)
        for ours, theirs in zip(own, wrenches.wrench(link), strict=True):
            theirs = svkc.tree.spatial.quat_rotate(to_parent, theirs)
            assert np.abs(ours - theirs).max() < KERNEL * scale * (1 + np.abs(f).max())


@pytest.mark.slow
def test_rows_are_those_of_the_loop_gaps():
    """The rank of the rows is that of J_C without the joints' freedoms, and rates are derivatives
    of gaps."""
    chain, state, _ = cases.CASES["rod_on_balls"].random_motion()
    table, (q, v) = connected_rows(chain, state), tree(chain, state)
    assert np.abs(gaps_at(chain, q, table)).max() < REFERENCE
    assert np.abs(rates_at(chain, q, v, table)).max() < REFERENCE
    freedoms = chain.nv - np.linalg.matrix_rank(jacobian(chain, q, table), 1e-9)
    assert freedoms == int(svkc.mobility(chain, state).freedoms)
    full = svkc.integrate(chain, state.q, jnp.full(chain.dofs, 0.1))
    moved = chain.state(full[: chain.nq], connected=())
    q, v = moved.q[: chain.nq], jnp.asarray(np.random.default_rng(1).normal(size=chain.nv))
    along = svkc.tree.configuration.configuration_derivative(
        chain, moved.q, jnp.concatenate([v, jnp.zeros(chain.dofs - chain.nv)])
    )[: chain.nq]
    derivative = jax.jvp(lambda q: gaps_at(chain, q, table), (q,), (along,))[1]
    np.testing.assert_allclose(rates_at(chain, q, v, table), derivative, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("joint", ["weld", "hinge", "universal", "ball", "slide", "planar"])
def test_an_impact_is_that_of_connect(joint):
    """The velocity after `connect` satisfies the rows of a connection, with some impulse."""
    chain = models.two_boxes(joint)
    link, rng = chain.link_names[0], np.random.default_rng(4)
    state = chain.state(v=rng.normal(size=chain.nv), connected=())
    after = svkc.connect(chain, state, link)
    table = connected_rows(chain, after)
    layout = Layout(
        nv=chain.nv, stages=2, rows=len(table), control=chain.nv, blocks=2, stage_blocks=1
    )
    model = Model(layout, table, optimize.Torques().for_chain(chain))
    (q, before), (_, v) = tree(chain, state), tree(chain, after)
    active = np.ones(len(table), bool)
    data = IntervalData(reference=q, next_reference=q, active=active, structure=after.structure)
    params = Params(chain, None)
    x, rate = chart_from_motion(chain, q, q, v)
    _, rate_before = chart_from_motion(chain, q, q, before)

    @jax.jit
    def rows(impulse):
        return connection(model, params, data, jnp.concatenate([x, rate, rate_before, impulse]))

    n = len(table)
    without = np.asarray(rows(jnp.zeros(n)))
    assert np.abs(without[: 2 * n]).max() < KERNEL
    impulse = np.linalg.lstsq(jacobian(chain, q, table).T, without[2 * n :], rcond=1e-9)[0]
    assert np.abs(rows(jnp.asarray(impulse))[2 * n :]).max() < KERNEL


@pytest.mark.slow
def test_charts_are_inverse_and_second_derivatives():
    """A motion in a chart and back; v and vdot are the derivatives of q along a polynomial."""
    chain = models.free_tree()
    rng = np.random.default_rng(5)
    reference = chain.state().q[: chain.nq]
    x, rate, second = jnp.asarray(0.7 * rng.normal(size=(3, chain.nv)))
    at = lambda t: motion_from_chart(
        chain, reference, x + t * rate + t**2 / 2 * second, rate + t * second, second
    )
    q, v, vdot = at(0.0)
    back = chart_from_motion(chain, reference, q, v)
    np.testing.assert_allclose(back, (x, rate), atol=1e-12)
    zero = jnp.zeros(())
    qdot, acceleration = jax.jvp(lambda t: at(t)[:2], (zero,), (zero + 1,))[1]
    expected = svkc.tree.configuration.configuration_derivative(chain, q, v)
    np.testing.assert_allclose(qdot, expected, atol=1e-12)
    np.testing.assert_allclose(acceleration, vdot, atol=1e-12)


@pytest.mark.slow
def test_states_of_points_have_the_coordinates_of_virtual_joints():
    chain, state, _ = cases.CASES["four_bar"].random_motion()
    full = full_state(chain, state.structure, *tree(chain, state))
    np.testing.assert_allclose(full.q, state.q, atol=REFERENCE)
    np.testing.assert_allclose(full.v, state.v, atol=REFERENCE)


def test_radau_tables():
    """Two stages have the known table; s stages integrate polynomials of degree 2 s - 2."""
    scheme = optimize.Radau(2)
    np.testing.assert_allclose(scheme.A, np.array([[5, -1], [9, 3]]) / 12, atol=1e-14)
    for s in range(1, 6):
        scheme = optimize.Radau(s)
        powers = np.arange(2 * s - 1)
        moments = scheme.b @ scheme.c[:, None] ** powers
        np.testing.assert_allclose(moments, 1 / (powers + 1), atol=1e-12)
