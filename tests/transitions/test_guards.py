"""Guards and grips: a figure in flight catches the bar, at declared placements and at current
poses; batches of runs; values of guards."""

import equinox as eqx
import jax
import jax.numpy as jnp
import models
import mujoco
import numpy as np
import pytest
from tolerances import REFERENCE, ROUND_OFF

import svkc
from svkc.scenes import BAR_HEIGHT, FOLDER, HALF_GRIP_WIDTH, PALM

SIDES = (("right", -HALF_GRIP_WIDTH, "ball"), ("left", HALF_GRIP_WIDTH, "hinge"))


@pytest.fixture(scope="module")
def figure():
    """Return a figure below a bar with raised arms and both hands connected to the bar, one by a
    ball and one by a hinge."""
    spec = mujoco.MjSpec.from_file(str(FOLDER / "figure16.xml"))
    links = [
        svkc.VirtualLink(
            f"{s}_grip",
            "world",
            f"{s}_hand",
            joint,
            axis=(0, 1, 0),
            pos=(0, y, BAR_HEIGHT),
            real_pos=(0, 0, -PALM),
            real_quat=(1, 0, 0, 0),
        )
        for s, y, joint in SIDES
    ]
    chain = svkc.load(spec, virtual_links=links, ignore="limit")
    near = svkc.scenes.hanging_state(chain, 0.0)
    return chain, chain.state(near.q[: chain.nq], connected=("right_grip", "left_grip"))


def toss(chain, state, up, roll):
    """Return the state of the released figure with rigid limbs, with an upward velocity and an
    angular velocity about the axis x through the point between the hands."""
    hips = np.asarray(state.q[:3])
    linear = np.array([0, 0, up]) + np.cross([roll, 0, 0], hips - np.array([0, 0, BAR_HEIGHT]))
    q = {
        name: float(state.q[i])
        for name, i in zip(chain.joint_names[1:], range(7, chain.nq), strict=True)
    }
    return chain.state(
        q | {"base": np.asarray(state.q[:7])}, {"base": [*linear, roll, 0, 0]}, connected=()
    )


@pytest.fixture(scope="module")
def catches(figure):
    """Return a compiled run in which each hand catches the bar within 4 cm of the bar's axis."""
    chain, _ = figure

    @eqx.filter_jit
    def run(state):
        grips = [f"{s}_grip" for s, _, _ in SIDES]
        events = [
            svkc.when(svkc.touch(chain, g, 0.04, axes="xy"), connect=g, direction=False, here=True)
            for g in grips
        ]
        return svkc.simulate(
            chain,
            state,
            0.5,
            ts=jnp.linspace(0, 0.5, 21),
            events=events,
            rtol=1e-8,
            atol=1e-10,
            max_events=3,
            throw=False,
        )

    return run


@pytest.mark.slow
def test_catch_with_one_hand_then_the_other(figure, catches):
    chain, state = figure
    traj = catches(toss(chain, state, 1.4, 0.25))
    assert int(traj.events.count) == 2
    assert traj.phases.joint_freedoms[:3].tolist() == [
        22,
        25 if int(traj.events.which[0]) == 0 else 23,
        26,
    ]
    assert 0.01 < float(traj.events.time[1] - traj.events.time[0]) < 0.2
    assert np.all(np.asarray(traj.events.energy_lost[:2]) > 0)
    assert float(traj.gaps.max()) < REFERENCE
    assert float(jnp.abs(traj.phases.energy_drift[:3]).max()) < 1e-4
    # each hand is connected where it caught the bar, 4 cm from the bar's axis
    for side in (0, 1):
        grip = traj.final.structure.pos[side]
        assert (
            0.03
            < float(jnp.linalg.norm(grip[jnp.array([0, 2])] - jnp.array([0.0, BAR_HEIGHT])))
            < 0.05
        )


@pytest.mark.slow
def test_catch_with_both_hands_at_once(figure, catches):
    """The rigid figure, thrown straight up, falls back: both guards fire at one instant, at the
    time of the parabola. Connecting at the declared placements loses an equal energy."""
    chain, state = figure
    start = toss(chain, state, 1.4, 0.0)
    traj = catches(start)
    assert int(traj.events.count) == 2
    assert float(traj.events.time[0]) == float(traj.events.time[1])
    impact_speed = np.sqrt(1.4**2 - 2 * 9.81 * 0.04)
    assert abs(float(traj.events.time[0]) - (1.4 + impact_speed) / 9.81) < 1e-8
    falling = svkc.State(start.q, start.v.at[2].set(-impact_speed), start.structure)
    above = svkc.State(falling.q.at[2].add(0.04), falling.v, falling.structure)
    for start_state, here in ((falling, False), (above, True)):
        caught = svkc.connect(chain, start_state, "right_grip", "left_grip", here=here)
        lost = svkc.kinetic_energy(chain, start_state) - svkc.kinetic_energy(chain, caught)
        assert float(lost) > 0
        np.testing.assert_allclose(caught.q[: chain.nq], start_state.q[: chain.nq], atol=ROUND_OFF)
    np.testing.assert_allclose(traj.events.energy_lost[0], lost, rtol=1e-6)


@pytest.fixture(scope="module")
def pair():
    return models.box_with_a_limb()


@pytest.mark.slow
def test_connecting_a_connected_link_is_a_no_op(pair):
    state = svkc.connect(pair, pair.state(v=np.arange(pair.nv) / 10.0), "weld", here=True)
    again = svkc.connect(pair, state, "weld", "limb", here=True)
    assert bool(eqx.tree_equal(again, state))
    several = svkc.transition(pair, state, ())
    assert several.structure.connected.tolist() == [False, False, False]
    assert bool(jnp.all(several.v == state.v))


@pytest.mark.slow
def test_batched_runs_equal_single_runs(pair):
    """Batched runs with different initial structures, grips and event times equal the single runs
    to 1e-10."""
    rng = np.random.default_rng(3)
    start = pair.state(
        {"limb": 0.3}, {"a": rng.normal(size=6), "b": rng.normal(size=6), "limb": 1.0}
    )
    starts = [start, svkc.connect(pair, start, "weld", here=True), svkc.cut(pair, start, "limb")]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *starts)
    first, second = jnp.array([0.05, 0.12, 0.2]), jnp.array([0.22, 0.04, 0.15])
    real_pos = jnp.array([[-0.2, 0, 0], [0.1, 0.05, 0], [0, 0, 0.1]])

    @eqx.filter_jit
    def run(state, first, second, real_pos):
        events = [
            svkc.at(first, bind=svkc.Grip("limb", "b", joint="ball", real_pos=real_pos)),
            svkc.at(second, cut=("weld", "limb")),
            svkc.at(0.25, unbind="spare_0"),
        ]
        return svkc.simulate(
            pair, state, 0.3, ts=jnp.linspace(0, 0.3, 4), events=events, dt=0.01, throw=False
        )

    batch = eqx.filter_vmap(run)(stacked, first, second, real_pos)
    for i in range(3):
        one = run(starts[i], first[i], second[i], real_pos[i])
        np.testing.assert_allclose(batch.states.q[i], one.states.q, atol=1e-10)
        np.testing.assert_allclose(batch.final.v[i], one.final.v, atol=1e-10)
        np.testing.assert_allclose(batch.events.energy_lost[i], one.events.energy_lost, atol=1e-10)
        assert batch.events.which[i].tolist() == one.events.which.tolist()
        assert batch.phases.freedoms[i].tolist() == one.phases.freedoms.tolist()


def box():
    """Return a box of 2 kg that slides vertically and is connected to the ground."""
    xml = models.MJCF.format(
        '<body name="box"><joint name="z" type="slide" axis="0 0 1"/><geom type="box" size="0.1 0.1'
        ' 0.1" mass="2"/></body>'
    )
    xml = xml.replace("0.3 -0.2 -9.81", "0 0 -10")
    return svkc.load(
        xml, virtual_links=[svkc.VirtualLink("ground", "world", "box", "weld", connected=True)]
    )


def test_values_of_guards():
    """Guards called as functions: the ground carries the weight of 20 N less the pull of 5 N,
    which is 1.5 times the limit of 10 N; the distance of the box from the ground is zero."""
    chain = box()
    state, pull = chain.state(), jnp.array([5.0])
    np.testing.assert_allclose(
        svkc.leaves(chain, "ground")(0.0, state, tau=pull), 15, rtol=ROUND_OFF
    )
    np.testing.assert_allclose(
        svkc.overload(chain, "ground", force=10.0)(0.0, state, tau=pull), 0.5, rtol=ROUND_OFF
    )
    np.testing.assert_allclose(
        svkc.touch(chain, "ground", 0.02, axes="z")(0.0, state), -0.02, rtol=ROUND_OFF
    )


@pytest.mark.slow
def test_unilateral_support():
    """A box on the ground under a growing upward force leaves the ground when the ground would have
    to pull, at the time that Newton's law gives.

    Two guards without actions record when the contact force falls below 10 N and when the box
    passes a height.
    """
    chain = box()
    pull = lambda t, state, args: jnp.where(jnp.arange(1) == 0, 40 * t, 0.0)
    observers = [
        svkc.when(svkc.overload(chain, "ground", force=10.0), direction=False),
        svkc.when(svkc.touch(chain, "ground", 0.02, axes="z"), direction=True),
    ]

    def run(t0, t1, again):
        events = [
            svkc.at(again, connect="ground"),
            svkc.when(svkc.leaves(chain, "ground"), cut="ground", direction=False),
            *observers,
        ]
        return svkc.simulate(
            chain,
            chain.state(),
            t1,
            t0=t0,
            control=pull,
            events=events,
            rtol=1e-9,
            atol=1e-11,
            max_events=6,
        )

    traj = run(0.0, 0.7, 2.0)
    assert traj.events.which[: int(traj.events.count)].tolist() == [2, 1, 3]
    np.testing.assert_allclose(
        traj.events.time[:3], [0.25, 0.5, 0.5 + (0.02 * 6 / 20) ** (1 / 3)], atol=REFERENCE
    )
    # z'' = 20 t - 10 from 0.5 s on
    np.testing.assert_allclose(traj.final.q[0], 20 / 6 * 0.2**3, rtol=1e-8)
    # a link that would have to pull as soon as it connects is cut at once
    early = run(0.55, 0.6, 0.55)
    assert early.events.which[: int(early.events.count)].tolist() == [0, 1]
    assert abs(float(early.events.time[1]) - 0.55) < REFERENCE
