"""Every method of dynamics gives one acceleration, one motion and one derivative. Against
multipliers: loops/test_forward_dynamics.py; against a mechanism's own equation of motion:
problems/test_bricard.py."""

import cases
import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import models
import numpy as np
import pytest
from tolerances import REFERENCE

import svkc
from svkc.loops.forward_dynamics import acceleration as accelerated


@pytest.mark.slow
@pytest.mark.parametrize("name", cases.params("loops"))
def test_articulated_bodies_carry_what_acts_on_virtual_joints(name):
    """The accelerations of composite ones, with torques at the joints of the loops and with a joint
    of the tree locked; and their derivatives by masses and along the loops, on each side."""
    chain, state, tau = cases.CASES[name].random_motion()
    locked = (
        svkc.lock(chain, state, chain.joint_names[-1])
        if name in ("stewart", "two_hands")
        else state
    )
    along = svkc.coordinates(chain, locked).W @ jnp.linspace(-1.0, 1.0, chain.dofs)

    def both(scale):
        c = eqx.tree_at(
            lambda c: c.mass,
            chain,
            chain.mass * (1 + scale * jnp.linspace(0.0, 3.0, chain.mass.shape[0])),
        )
        q = svkc.integrate(chain, locked.q, scale * along)
        return [
            accelerated(c, locked.structure, q, locked.v, tau, way)
            for way in (svkc.dynamics.CompositeBodies(), svkc.dynamics.ArticulatedBodies())
        ]

    for usual, bodies in (both(0.0), jax.jvp(both, (0.0,), (1.0,))[1]):
        assert np.abs(bodies - usual).max() < REFERENCE * np.abs(usual).max()
    back = [
        jax.grad(lambda x, i=i: jnp.sum(both(x)[i] * jnp.linspace(-1.0, 2.0, chain.dofs)))(0.0)
        for i in (0, 1)
    ]
    np.testing.assert_allclose(*back, rtol=1e-8)


WAYS = {
    "exact": {"stabilization": svkc.stabilization.CoordinatePartitioning()},
    "unit vectors": {"dynamics": svkc.dynamics.UnitVectors()},
    "bodies": {"dynamics": svkc.dynamics.ArticulatedBodies()},
    "chosen at every evaluation": {"dynamics": svkc.dynamics.CompositeBodies(hold=None)},
    "held": {"dynamics": svkc.dynamics.CompositeBodies(hold=0.0)},
}


@pytest.fixture(scope="module")
def swinging():
    """Three equal bars that swing on a base too long for any of them to go round: whatever two
    coordinates depend on the third, they come in line."""
    inner = models.bar(
        "coupler",
        models.Y,
        "1 0 0",
        "0.6 0 0.8",
        models.bar("rocker", models.Y, "0.6 0 -0.8", "1 0 0"),
    )
    pin = svkc.VirtualLink(
        "pin",
        "world",
        "rocker",
        "hinge",
        pos=(2.2, 0, 0),
        axis=(0, 1, 0),
        real_pos=(0.6, 0, -0.8),
        connected=True,
    )
    chain = svkc.load(
        models.MJCF.format(models.bar("crank", models.Y, "0.6 0 0.8", inside=inner)),
        virtual_links=[pin],
    )
    start, ts = chain.state(v={"crank": 1.0}), jnp.linspace(0, 1.5, 16)

    def run(crank, **way):
        state = eqx.tree_at(lambda s: s.v, start, crank * start.v)
        return svkc.simulate(
            chain, state, 1.5, ts=ts, rtol=1e-10, atol=1e-12, solver=diffrax.Dopri8(), **way
        )

    return run, run(1.0)


@pytest.mark.slow
@pytest.mark.parametrize("way", WAYS)
def test_each_way_to_compute_is_the_same_motion(swinging, way):
    run, usual = swinging
    other = run(1.0, **WAYS[way])
    # the steps' own errors, and what the ways back onto the loops make of them
    np.testing.assert_allclose(other.states.q, usual.states.q, atol=1e-8)
    swaps = int(other.phases.swaps[0])
    # (articulated bodies do without pivots)
    assert swaps == {"held": 0, "bodies": -1}[way] if way in ("held", "bodies") else swaps >= 3
    tries = [int(r.report().accepted + r.report().rejected) for r in (other, usual)]
    assert tries[0] < 1.5 * tries[1]


@pytest.mark.slow
@pytest.mark.parametrize("way", ["held", "bodies"])
def test_how_loops_are_kept_leaves_derivatives_as_they_are(swinging, way):
    run, _ = swinging
    end = lambda x: run(x, **WAYS[way]).final.q
    forward, step = jax.jacfwd(end)(1.0), 1e-4
    differences = (end(1 + step) - end(1 - step)) / (2 * step)
    np.testing.assert_allclose(forward, differences, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(
        jax.grad(lambda x: jnp.sum(jnp.sin(end(x))))(1.0), jnp.cos(end(1.0)) @ forward, rtol=1e-10
    )
