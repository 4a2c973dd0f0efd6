"""Loops that are singular, nearly singular, redundant, of zero length, or impossible to close.

A motion that exists is found; otherwise a result code names the time and the loop.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import maximal
import models
import numpy as np
import pytest
from reference_problems import load_reference, n_four_bar
from tolerances import REFERENCE, ROUND_OFF

import svkc

FINE = {"rtol": 1e-9, "atol": 1e-11}


def tilted_four_bar(angle):
    """Return the four-bar with the axis of its last pin tilted by a small angle (rad)."""
    pin = models.pin(axis=(np.sin(angle), np.cos(angle), 0))
    return svkc.load(models.MJCF.format(models.FOUR_BAR), virtual_links=[pin])


@pytest.mark.slow
def test_nearly_redundant_loops():
    """A tilt of 1e-8 rad leaves the pin's rows redundant; one of 1e-6 rad blocks the motion.

    The margin shows the difference.
    """
    run = eqx.filter_jit(lambda chain, state: svkc.simulate(chain, state, 1.0, **FINE))
    ends = {}
    for angle in (0.0, 1e-8, 1e-6):
        chain = tilted_four_bar(angle)
        state = chain.state(v={"crank": 4.0}, hold=None if angle < 1e-7 else False)
        mobility = svkc.mobility(chain, state)
        traj = run(chain, state)
        assert int(mobility.rank) == (3 if angle < 1e-7 else 4)
        assert float(mobility.margin) == pytest.approx(
            0.3032 if angle < 1e-7 else 0.255 * angle, rel=1e-2
        )
        assert float(traj.gaps.max()) <= max(0.5 * angle, 1e-12)
        ends[angle] = float(traj.final.q[0])
    assert ends[0.0] == pytest.approx(7.0109395, abs=1e-6)
    assert ends[1e-8] == pytest.approx(ends[0.0], abs=REFERENCE)
    assert abs(ends[1e-6]) < ROUND_OFF


@pytest.mark.slow
def test_a_wrong_rank_is_reported():
    """A rank set too low ends the run as a loop opens; one set too high shows in the margin."""
    chain = models.four_bar()
    state = chain.state(v={"crank": 4.0})
    with_rank = lambda rank: eqx.tree_at(
        lambda s: s.structure.rank, state, jnp.asarray(rank, jnp.int32)
    )
    for kw in ({"dt": 1e-3}, FINE):
        low = svkc.simulate(chain, with_rank(2), 1.0, throw=False, **kw)
        assert low.result == svkc.RESULTS.loop_open
        assert float(low.t_final) < 0.1
        assert int(low.report().loop) == 0
        assert float(low.gaps.max()) < 1e-5
        with pytest.raises(RuntimeError, match=r"in phase 1, loop 'pin': A loop is open"):
            svkc.simulate(chain, with_rank(2), 1.0, **kw)
    high = svkc.simulate(chain, with_rank(4), 0.1, throw=False, dt=1e-3)
    assert float(high.report().margin) < ROUND_OFF
    assert high.derivative == svkc.types.DERIVATIVE.rank_lost


@pytest.mark.slow
def test_loops_that_allow_only_the_first_order():
    """Two parallel slides allow a rate of the pelvis on the swing's seat, but no finite turn.

    The run stops as the slides open, and names one of them.
    """
    from svkc.scenes.swing import swing

    chain, seated = swing(ignore="limit")
    state = chain.state(seated.q[: chain.nq], {"base": [0, 0, 0, 0, 0, 3.0]}, hold=False)
    with pytest.raises(
        RuntimeError,
        match=r"t = 0\.0[01]\d+ s, in phase 1, loop '(left|right)_thigh_plate': A loop is open",
    ):
        svkc.simulate(chain, state, 0.03)


@pytest.mark.slow
def test_a_pin_on_a_hinge_is_redundant():
    """A second pin on a hinge removes no freedom."""
    rods = models.TWO_RODS
    pin = svkc.VirtualLink(
        "again",
        "upper",
        "lower",
        "hinge",
        pos=(0, 0, -1),
        real_pos=(0, 0, 0),
        axis=(0, 1, 0),
        connected=True,
    )
    chain, plain = (
        svkc.load(models.MJCF.format(rods), virtual_links=[pin]),
        svkc.load(models.MJCF.format(rods)),
    )
    pose = {"upper": 0.5}, {"lower": 1.0}
    state = chain.state(*pose)
    assert svkc.mobility(chain, state).freedoms == 2
    one, other = (
        svkc.simulate(chain, state, 1.0, **FINE),
        svkc.simulate(plain, plain.state(*pose), 1.0, **FINE),
    )
    np.testing.assert_allclose(one.final.q[:2], other.final.q, atol=REFERENCE)


@pytest.mark.slow
def test_a_crank_that_turns_back_at_a_dead_centre():
    """A crank longer than its rod reaches a dead centre and turns back, with all its energy.

    The driving coordinate stands still there, so the run changes to other independent coordinates.
    """
    slider = (
        '<body name="slider"><joint name="slider" type="slide" axis="1 0 0"/><geom size="0.05"'
        ' mass="1" contype="0"/></body>'
    )
    crank = models.bar(
        "crank", models.Y, "0 0 -1", inside=models.bar("rod", models.Y, "0 0 -0.5", "0 0 -1")
    )
    pin = svkc.VirtualLink(
        "pin", "slider", "rod", "hinge", real_pos=(0, 0, -0.5), axis=(0, 1, 0), connected=True
    )
    text = models.MJCF.format(
        f'<body name="at" pos="0 0 -0.9">{slider.split(">", 1)[1].rsplit("</body>", 1)[0]}</body>'
        + crank
    )
    chain = svkc.load(
        text.replace("0.3 -0.2", "0 0"),
        virtual_links=[svkc.VirtualLink(**{**vars(pin), "parent": "at"})],
    )
    near = chain.state({"crank": 0.2, "rod": -0.5}, hold=False)
    state = chain.state(near.q, {"crank": 2.0})
    ts = jnp.linspace(0, 3.0, 301)
    pivots = {"dynamics": svkc.dynamics.CompositeBodies()}
    for options in ({}, pivots):
        traj = svkc.simulate(chain, state, 3.0, ts=ts, **FINE, **options)
        crank_angle = np.asarray(traj.states.q[:, chain.dof_names.index("crank")])
        # The rod of half a metre reaches the slider's line only from within that distance.
        assert np.abs(-np.cos(crank_angle) + 0.9).max() <= 0.5 + 1e-9
        assert np.diff(np.sign(np.diff(crank_angle))).any()
        assert abs(float(traj.report().energy_drift)) < 1e-6
        assert (int(traj.report().swaps) > 0) == (options is pivots)


@pytest.mark.slow
def test_a_slider_crank_passes_its_bifurcation_in_both_ways():
    """A slider-crank of equal bars with a massless slider has a bifurcation as the bars align.

    Pivots determine the branch, and so does the reduction of rows by articulated bodies.
    """
    bar = (
        '<body name="{0}" pos="{1} 0 0"><joint name="{0}" axis="0 1 0"/><geom type="capsule"'
        ' fromto="0 0 0 1 0 0" size="0.02"/>'
    )
    slot = svkc.VirtualLink(
        "slot",
        "world",
        "rod",
        (False, True, False, True, False, False),
        real_pos=(1, 0, 0),
        connected=True,
    )
    chain = svkc.load(
        models.MJCF.format(bar.format("crank", 0) + bar.format("rod", 1) + "</body></body>"),
        virtual_links=[slot],
    )
    state = chain.state({"crank": -np.pi / 4, "rod": np.pi / 2}, {"crank": 3.0})
    for dynamics in (svkc.dynamics.CompositeBodies(), svkc.dynamics.ArticulatedBodies()):
        traj = svkc.simulate(chain, state, 3.0, dynamics=dynamics)
        assert float(traj.final.q[0]) > 3 * np.pi
        assert abs(float(traj.report().energy_drift)) < 2e-6
        assert bool(traj.phases.reduced_steps[0] > 0) == (not dynamics.uses_pivots)


@pytest.mark.slow
@pytest.mark.parametrize("offset", [1e-2, 1e-4, 1e-6, 0.0])
def test_start_near_a_singular_configuration(offset):
    """The N four-bar started with its bars nearly aligned moves on as a parallelogram.

    The direction of its velocity is kept.
    """
    case = next(case for case in load_reference("n_four_bar")["cases"] if case["N"] == 2)
    chain, state = maximal.load(n_four_bar(2))
    signs = np.sign(np.asarray(state.v))
    theta = np.pi / 2 - offset
    # Three bars rotate about their ends, two translate; each has one kilogram and one metre.
    rate = np.sqrt(2 * (case["energy"] - 9.81 * (3 / 2 + 2) * np.cos(theta)) / (3 / 3 + 2))
    start = svkc.State(jnp.asarray(signs * theta), jnp.asarray(signs * rate), state.structure)
    traj = svkc.simulate(chain, start, 1.0, ts=jnp.linspace(0, 1, 5), **FINE)
    energy = jax.vmap(lambda s: svkc.energy(chain, s))(traj.states)
    np.testing.assert_allclose(energy, case["energy"], atol=1e-5)
    angles = np.asarray(traj.states.q)[:, [chain.dof_names.index(f"vert{i}") for i in range(3)]]
    np.testing.assert_allclose(angles, angles[:, :1].repeat(3, 1), atol=REFERENCE)
