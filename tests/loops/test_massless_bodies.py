"""Bodies without mass that loops hold, by articulated bodies: the tree's mass matrix is singular.

MuJoCo reads no moving body of zero mass: models have tiny ones, and chains have zero as data.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import models
import numpy as np
import pytest
from tolerances import REFERENCE, ROUND_OFF

import svkc
from svkc.loops.forward_dynamics import acceleration

TINY = '<inertial pos="0 0 0" mass="{0}" diaginertia="{1} {1} {1}"/>'
# rotation about y, slide along x
SLOT = (False, True, False, True, False, False)
TO_SLOT = {"pos": (1.5, 0, 0), "connected": True}


def crank_and_rod(tip: str) -> str:
    rod = models.bar("rod", models.Y, "1 0 0", "0.5 0 0", tip)
    return models.MJCF.format(models.bar("crank", models.Y, "0.5 0 0", inside=rod))


def with_slider(mass: float, inertia: float | None = None) -> svkc.Chain:
    """Return a slider-crank whose slider is a body on a hinge, held by a slide 0.2 m above it."""
    tiny = TINY.format(mass, inertia or mass)
    slider = f'<body name="slider" pos="1 0 0"><joint name="wrist" axis="0 1 0"/>{tiny}</body>'
    at = {"pos": (1.5, 0, 0.2), "real_pos": (0, 0, 0.2), "axis": (1, 0, 0), "connected": True}
    link = svkc.VirtualLink("slot", "world", "slider", "slide", **at)
    return svkc.load(crank_and_rod(slider), virtual_links=[link])


def without_slider() -> svkc.Chain:
    """Return the same slider-crank with both freedoms in its virtual link."""
    link = svkc.VirtualLink("slot", "world", "rod", SLOT, real_pos=(1, 0, 0), **TO_SLOT)
    return svkc.load(crank_and_rod(""), virtual_links=[link])


def hub(mass: float) -> svkc.Chain:
    """Return three legs on balls, which hold a free body, on which a bar hangs."""
    legs, links = "", []
    for i, angle in enumerate(2 * np.pi * np.arange(3) / 3):
        c, s = np.cos(angle), np.sin(angle)
        inward = (-0.8 * c, -0.8 * s, 1.0)
        to = " ".join(map(str, inward))
        legs += models.bar(f"leg{i}", 'type="ball"', to, f"{c} {s} 0")
        at = {"pos": (0.2 * c, 0.2 * s, 0), "real_pos": inward, "connected": True}
        links.append(svkc.VirtualLink(f"ball{i}", "hub", f"leg{i}", "ball", **at))
    load = models.bar("load", 'axis="1 0.2 0"', "0.1 0.5 -0.3")
    inside = f'<freejoint name="hub"/>{TINY.format(mass, mass)}{load}'
    free = f'<body name="hub" pos="0 0 1">{inside}</body>'
    return svkc.load(models.MJCF.format(legs + free), virtual_links=links)


def massless(chain, body: str):
    """Return the chain with a body of zero mass and inertia."""
    row = chain.topology.body_row[chain.body_names.index(body)]
    zero = chain.mass.at[row].set(0), chain.inertia.at[row].set(0)
    return eqx.tree_at(lambda c: (c.mass, c.inertia), chain, zero)


def accelerations(dynamics):
    """Return the program of vdot under some torques."""
    tau = lambda chain: jnp.sin(jnp.arange(1.0, 1 + chain.dofs, dtype=chain.mass.dtype))
    return jax.jit(
        lambda chain, s: acceleration(chain, s.structure, s.q, s.v, tau(chain), dynamics)
    )


BODIES, PIVOTS = svkc.dynamics.ArticulatedBodies(), svkc.dynamics.CompositeBodies()


@pytest.fixture(scope="module")
def slider_crank():
    chain = with_slider(1e-14)
    return chain, chain.state({"crank": -0.6}, {"crank": 3.0})


@pytest.mark.slow
def test_accelerations_of_a_massless_slider(slider_crank):
    """They are those by pivots, for a tiny mass and for none, and those without the slider."""
    chain, state = slider_crank
    plain = without_slider()
    names = ["crank", "rod"]
    same = plain.state({n: state.q[i] for i, n in enumerate(names)}, {"crank": 3.0})
    torque = lambda c: jnp.zeros(c.dofs).at[:2].set(jnp.array([0.3, -0.2]))
    by = lambda c, s, d: acceleration(c, s.structure, s.q, s.v, torque(c), d)[:2]
    expected = jax.jit(by, static_argnums=2)(plain, same, BODIES)
    for each in (chain, massless(chain, "slider")):
        got = jax.jit(by, static_argnums=2)(each, state, BODIES)
        np.testing.assert_allclose(got, expected, atol=REFERENCE)


@pytest.mark.slow
@pytest.mark.parametrize("body", ["slider", "hub"])
def test_accelerations_by_bodies_are_those_by_pivots(body, slider_crank):
    """Also with loops open, in a batch, and with a locked joint of the massless body."""
    chain, state = slider_crank
    if body == "hub":
        chain = hub(1e-14)
        state = chain.state(v={"load": 2.0, "leg0": [0.3, 0.2, 0.1]})
    bodies, pivots = accelerations(BODIES), accelerations(PIVOTS)
    for each in (chain, massless(chain, body)):
        expected = pivots(each, state)
        np.testing.assert_allclose(bodies(each, state), expected, rtol=ROUND_OFF, atol=REFERENCE)
    batch = jax.tree.map(lambda x: jnp.stack([x, x]), state)
    lanes = jax.vmap(lambda s: bodies(chain, s))(batch)
    np.testing.assert_allclose(lanes[1], bodies(chain, state), rtol=ROUND_OFF, atol=REFERENCE)


@pytest.mark.slow
def test_a_slider_with_mass_but_without_inertia():
    """A point mass that a loop keeps from spinning moves as by pivots."""
    chain = with_slider(0.1, 1e-13)
    state = chain.state({"crank": -0.6}, {"crank": 3.0})
    got, expected = (accelerations(way)(chain, state) for way in (BODIES, PIVOTS))
    np.testing.assert_allclose(got, expected, rtol=ROUND_OFF, atol=REFERENCE)


@pytest.mark.slow
def test_a_massless_body_that_nothing_holds(slider_crank):
    """Torque-free, a body of 1e-9 kg on an open loop accelerates as by pivots."""
    chain = with_slider(1e-9)
    state = svkc.cut(chain, chain.state({"crank": -0.6}, {"crank": 3.0}), "slot")
    rates = [
        jax.jit(lambda s, d=d: acceleration(chain, s.structure, s.q, s.v, jnp.zeros(chain.dofs), d))
        for d in (BODIES, PIVOTS)
    ]
    np.testing.assert_allclose(rates[0](state), rates[1](state), rtol=1e-8)


@pytest.mark.slow
def test_derivatives_with_a_massless_body(slider_crank):
    """Derivatives by state and masses, forward and reverse, are those by pivots."""
    chain, state = slider_crank

    def rate(x, dynamics):
        c = eqx.tree_at(lambda c: c.mass, chain, x[2])
        tau = jnp.zeros(chain.dofs)
        return acceleration(c, state.structure, x[0], x[1], tau, dynamics)

    x = state.q, state.v, chain.mass
    expected = jax.jit(jax.jacfwd(lambda x: rate(x, PIVOTS)))(x)
    for jacobian in (jax.jacfwd, jax.jacrev):
        for got, right in zip(
            jax.jit(jacobian(lambda x: rate(x, BODIES)))(x), expected, strict=True
        ):
            np.testing.assert_allclose(got, right, atol=REFERENCE * float(jnp.abs(right).max()))


@pytest.mark.slow
def test_runs_with_massless_bodies_take_the_steps_of_those_without():
    """Steps and energy of a run at rtol 1e-8 are those of the equal mechanism without the slider;
    positions agree at a fine tolerance."""
    speed = {"crank": 3.0}
    ends, steps = [], []
    for chain in (without_slider(), with_slider(1e-14)):
        state = chain.state({"crank": -0.6}, speed)
        run = svkc.simulate(chain, state, 1.0, rtol=1e-8, dynamics=BODIES)
        report = run.report()
        assert abs(float(report.energy_drift)) < 1e-8
        steps.append(int(report.accepted) + int(report.rejected))
        fine = svkc.simulate(chain, state, 1.0, rtol=1e-12, atol=1e-13, dynamics=BODIES)
        ends.append(fine.final.q[:2])
    assert steps[1] <= 1.2 * steps[0]
    np.testing.assert_allclose(*ends, atol=REFERENCE)


@pytest.mark.slow
def test_a_run_of_a_hub_without_mass():
    """A run by articulated bodies ends where the default's does, in as many steps."""
    chain = massless(hub(1e-14), "hub")
    state = chain.state(v={"load": 2.0, "leg0": [0.3, 0.2, 0.1]})
    runs = [svkc.simulate(chain, state, 1.0, rtol=1e-8, dynamics=d) for d in (None, BODIES)]
    counts = [int(r.report().accepted) + int(r.report().rejected) for r in runs]
    assert counts[1] <= 1.2 * counts[0]
    assert abs(float(runs[1].report().energy_drift)) < 1e-7
    np.testing.assert_allclose(
        svkc.poses(chain, runs[1].final)[0], svkc.poses(chain, runs[0].final)[0], atol=1e-7
    )


def test_models_without_massless_bodies_have_no_code_for_them():
    """A body without mass of its own but with a fixed one, and one of several joints, have mass."""
    assert not models.four_bar().topology.massless_dofs
    assert with_slider(1e-14).topology.massless_dofs == (2,)
    assert hub(1e-14).topology.massless_dofs == tuple(range(9, 15))
    box = '<geom type="box" size="0.1 0.2 0.3" pos="0 0 0.5"/>'
    joints = '<joint name="x" type="slide"/><joint name="y" axis="0 1 0"/>'
    fixed = f'<body name="a">{joints}<body name="b">{box}</body></body>'
    assert not svkc.load(models.MJCF.format(fixed)).topology.massless_dofs
