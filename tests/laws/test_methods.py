"""All methods of dynamics give equal accelerations, motions and derivatives.

They are compared with a KKT solution in loops/test_forward_dynamics.py, and with a mechanism's own
equation of motion in problems/test_bricard.py.
"""

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
from svkc.loops.forward_dynamics import acceleration as acceleration_by


@pytest.mark.slow
@pytest.mark.parametrize("name", cases.params("loops"))
def test_articulated_bodies_transmit_torques_at_virtual_joints(name):
    """Articulated and composite bodies give equal accelerations and derivatives.

    Torques act on virtual joints, and a joint of the tree is locked. Derivatives are with respect
    to masses and along the loops, in both modes.
    """
    chain, state, tau = cases.CASES[name].random_motion()
    locked = (
        svkc.lock(chain, state, chain.joint_names[-1])
        if name in ("stewart", "two_hands")
        else state
    )
    along = svkc.coordinates(chain, locked).W @ jnp.linspace(-1.0, 1.0, chain.dofs)

    def both_methods(scale):
        c = eqx.tree_at(
            lambda c: c.mass,
            chain,
            chain.mass * (1 + scale * jnp.linspace(0.0, 3.0, chain.mass.shape[0])),
        )
        q = svkc.integrate(chain, locked.q, scale * along)
        return [
            acceleration_by(c, locked.structure, q, locked.v, tau, method)
            for method in (svkc.dynamics.CompositeBodies(), svkc.dynamics.ArticulatedBodies())
        ]

    for reference, bodies in (both_methods(0.0), jax.jvp(both_methods, (0.0,), (1.0,))[1]):
        assert np.abs(bodies - reference).max() < REFERENCE * np.abs(reference).max()
    back = [
        jax.grad(lambda x, i=i: jnp.sum(both_methods(x)[i] * jnp.linspace(-1.0, 2.0, chain.dofs)))(
            0.0
        )
        for i in (0, 1)
    ]
    np.testing.assert_allclose(*back, rtol=1e-8)


METHODS = {
    "exact": {"stabilization": svkc.stabilization.CoordinatePartitioning()},
    "unit vectors": {"dynamics": svkc.dynamics.UnitVectors()},
    "bodies": {"dynamics": svkc.dynamics.ArticulatedBodies()},
    "chosen at every evaluation": {"dynamics": svkc.dynamics.CompositeBodies(hold=None)},
    "held": {"dynamics": svkc.dynamics.CompositeBodies(hold=0.0)},
}


@pytest.fixture(scope="module")
def swinging():
    """Return the run of a four-bar whose bars come in line for every choice of coordinates.

    Its three equal bars swing on a base that is too long for full revolutions.
    """
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

    def run(crank, **method):
        state = eqx.tree_at(lambda s: s.v, start, crank * start.v)
        return svkc.simulate(
            chain, state, 1.5, ts=ts, rtol=1e-10, atol=1e-12, solver=diffrax.Dopri8(), **method
        )

    return run, run(1.0)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_every_method_gives_the_same_motion(swinging, method):
    run, reference = swinging
    result = run(1.0, **METHODS[method])
    # the errors of the steps and of their projections
    np.testing.assert_allclose(result.states.q, reference.states.q, atol=1e-8)
    swaps = int(result.phases.swaps[0])
    # articulated bodies use no pivots, which is recorded as -1
    assert (
        swaps == {"held": 0, "bodies": -1}[method] if method in ("held", "bodies") else swaps >= 3
    )
    steps = [int(r.report().accepted + r.report().rejected) for r in (result, reference)]
    assert steps[0] < 1.5 * steps[1]


@pytest.mark.slow
@pytest.mark.parametrize("method", ["held", "bodies"])
def test_derivatives_do_not_depend_on_the_method(swinging, method):
    run, _ = swinging
    end = lambda x: run(x, **METHODS[method]).final.q
    forward, step = jax.jacfwd(end)(1.0), 1e-4
    differences = (end(1 + step) - end(1 - step)) / (2 * step)
    np.testing.assert_allclose(forward, differences, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(
        jax.grad(lambda x: jnp.sum(jnp.sin(end(x))))(1.0), jnp.cos(end(1.0)) @ forward, rtol=1e-10
    )
