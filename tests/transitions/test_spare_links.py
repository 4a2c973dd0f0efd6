"""Spare slots: connecting, binding and clearing them, outside of runs and in events."""

import equinox as eqx
import jax
import jax.numpy as jnp
import models
import numpy as np
import pytest
from tolerances import ROUND_OFF

import svkc


def _slider(name: str, x: int) -> str:
    return (
        f'<body name="{name}" pos="{x} 0 0"><joint name="{name}" type="slide" axis="1 0 0"/>'
        f"{models.BOX.format('0.1 0.1 0.1')}</body>"
    )


@pytest.fixture(scope="module")
def sliders():
    """Return two equal boxes that slide along one line, with two spare slots, and a state."""
    text = models.MJCF.format(_slider("a", 0) + _slider("b", 1))
    chain = svkc.load(text.replace("0.3 -0.2 -9.81", "0 0 -10"), spare=2)
    return chain, chain.state(v={"a": 1.0, "b": 3.0})


def run(chain, state, *events, t1=0.2, **options):
    """Simulate with fixed steps; the velocities are constant between events."""
    return svkc.simulate(chain, state, t1, events=events, dt=0.1, throw=False, **options)


def test_a_pair_of_bodies_is_not_taken_for_two_slots():
    """Bodies may have names that begin as those of spare slots."""
    text = models.MJCF.format(_slider("spare_wheel", 0) + _slider("spare_tire", 1))
    chain = svkc.load(text, spare=1)
    pair = ("spare_wheel", "spare_tire")
    change = [svkc.at(0.1, bind=svkc.Grip(*pair)), svkc.at(0.15, unbind=pair)]
    traj = run(chain, chain.state(), *change)
    assert traj.phases.connected[:3, 0].tolist() == [False, True, False]


@pytest.mark.slow
def test_connecting_a_slot_that_is_not_bound_is_an_error(sliders):
    chain, state = sliders
    with pytest.raises(ValueError, match=r"connect: spare slots that are not bound.*spare_0.*bind"):
        svkc.connect(chain, state, "spare_0", here=True)
    with pytest.raises(ValueError, match="spare_1"):
        svkc.transition(chain, state, np.array([False, True]))
    with pytest.raises(ValueError, match="spare_1"):
        chain.state(connected="spare_1")
    with pytest.raises(RuntimeError, match="not bound"):
        eqx.filter_jit(lambda s: svkc.connect(chain, s, "spare_0", here=True))(state)
    bound = svkc.bind(chain, state, "spare_0", "a", "b", real_pos=(-1, 0, 0))
    np.testing.assert_allclose(svkc.connect(chain, bound, "spare_0").v[:2], 2.0, atol=ROUND_OFF)
    with pytest.raises(ValueError, match="spare_1"):
        svkc.connect(chain, bound, "spare_0", "spare_1")


@pytest.mark.slow
def test_an_event_that_connects_a_slot_that_is_not_bound_ends_the_run(sliders):
    """In a batch only the lane whose slot is not bound stops, before the change."""
    chain, state = sliders
    bound = svkc.bind(chain, state, "spare_0", "a", "b", real_pos=(-1, 0, 0))
    lanes = jax.tree.map(lambda *x: jnp.stack(x), state, bound)

    @eqx.filter_jit
    @eqx.filter_vmap
    def connected_at(state):
        return run(chain, state, svkc.at(0.1, connect="spare_0", here=True))

    traj = connected_at(lanes)
    assert (traj.result == svkc.RESULTS.not_bound).tolist() == [True, False]
    assert (traj.result == svkc.RESULTS.successful).tolist() == [False, True]
    np.testing.assert_allclose(traj.t_final, [0.1, 0.2])
    assert traj.final.structure.connected.tolist() == [[False, False], [True, False]]
    assert traj.events.count.tolist() == [0, 1]
    np.testing.assert_allclose(traj.final.v[:, :2], [[1, 3], [2, 2]], atol=ROUND_OFF)


def test_an_event_binds_and_connects_a_slot(sliders):
    chain, state = sliders
    grip = svkc.Grip("a", "b", slot="spare_0")
    traj = run(chain, state, svkc.at(0.1, connect="spare_0", bind=grip))
    assert traj.result == svkc.RESULTS.successful
    assert traj.final.structure.connected.tolist() == [True, False]
    np.testing.assert_allclose(traj.final.v[:2], 2.0, atol=ROUND_OFF)


@pytest.mark.slow
def test_a_grip_replaces_the_one_that_its_event_ends(sliders):
    """The old grip ends, the new one is made in the same slot with its impact, in one event that
    unbinds or cuts, and in two events of one instant in either order."""
    chain, state = sliders
    held = svkc.connect(
        chain, svkc.bind(chain, state, "spare_0", "world", "a"), "spare_0", here=True
    )
    grip = svkc.Grip("a", "b", slot="spare_0")
    a, b = (svkc.at(0.1, unbind="spare_0"), svkc.at(0.1, bind=grip))
    cases = [
        [svkc.at(0.1, unbind="spare_0", bind=grip)],
        [svkc.at(0.1, unbind=("world", "a"), bind=svkc.Grip("a", "b"))],
        [svkc.at(0.1, cut="spare_0", bind=grip)],
        [a, b],
        [b, a],
        [a, svkc.when(lambda t, s, args: t - 0.1, bind=grip)],
    ]
    for events in cases:
        traj = run(chain, held, *events, max_events=2)
        assert traj.result == svkc.RESULTS.successful
        assert traj.final.structure.connected.tolist() == [True, False]
        # before, a is held at rest; after, both move with the mean velocity
        np.testing.assert_allclose(traj.final.v[:2], 1.5, atol=ROUND_OFF)
        np.testing.assert_allclose(traj.final.q[:2], [0.15, 0.45], atol=ROUND_OFF)
        assert float(traj.events.energy_lost.sum()) > 0


@pytest.mark.slow
def test_a_grip_in_a_slot_that_stays_connected_ends_with_no_slot(sliders):
    chain, state = sliders
    held = svkc.connect(
        chain, svkc.bind(chain, state, "spare_0", "world", "a"), "spare_0", here=True
    )
    traj = run(chain, held, svkc.at(0.1, bind=svkc.Grip("a", "b", slot="spare_0")))
    assert traj.result == svkc.RESULTS.no_slot
    assert traj.final.structure.connected.tolist() == [True, False]
    np.testing.assert_allclose(traj.final.v[:2], [0, 3], atol=ROUND_OFF)


@pytest.mark.parametrize(
    "changes",
    [
        {"connect": "spare_0", "cut": "spare_0"},
        {"connect": ("spare_1", "spare_0"), "unbind": "spare_0"},
        {"lock": "a", "unlock": ("b", "a")},
    ],
)
def test_an_event_that_contradicts_itself_is_an_error(changes):
    with pytest.raises(ValueError, match=r"both name '(spare_0|a)'"):
        svkc.at(0.1, **changes)
    with pytest.raises(ValueError, match="both name"):
        svkc.when(lambda t, s, args: t, **changes)


@pytest.mark.slow
def test_a_run_with_more_events_than_rows_keeps_the_state_before_the_next_event(sliders):
    """Two events at one instant with one row left are both left out."""
    chain, state = sliders
    bound = svkc.bind(chain, state, "spare_0", "a", "b", real_pos=(-1, 0, 0))
    bound = svkc.bind(chain, bound, "spare_1", "world", "a")
    events = [
        svkc.at(0.05, connect="spare_0", here=True),
        svkc.at(0.1, cut="spare_0"),
        svkc.at(0.1, connect="spare_1", here=True),
    ]
    ts = jnp.array([0.0, 0.1, 0.2])
    for rows in (1, 2):
        traj = run(chain, bound, *events, ts=ts, max_events=rows)
        assert traj.result == svkc.RESULTS.max_events
        assert float(traj.t_final) == 0.1
        assert int(traj.events.count) == 1
        assert traj.events.which.tolist() == [0, -1][:rows]
        assert traj.final.structure.connected.tolist() == [True, False]
        assert traj.connected.tolist() == [[False, False], [True, False], [True, False]]
        np.testing.assert_allclose(traj.final.v[:2], 2.0, atol=ROUND_OFF)
        np.testing.assert_allclose(traj.states.v[-1], traj.final.v)
        assert int(traj.phases.count) == 2
    with pytest.raises(RuntimeError, match=r"t = 0\.1 s.*before this event"):
        svkc.simulate(chain, bound, 0.2, events=events, ts=ts, max_events=2, dt=0.1)


def test_a_slot_keeps_nothing_of_an_earlier_grip(sliders):
    """A slot that was connected at the current poses is bound, and cleared, as a fresh one. The
    declared placement is one at which the frames of the two bodies are parallel."""
    chain, state = sliders
    bind = lambda s: svkc.bind(
        chain, s, "spare_0", "a", "b", joint="hinge", axis=(0, 1, 0), real_pos=(-1, 0, 0)
    )
    fresh = bind(state)
    other = svkc.bind(chain, state, "spare_0", "world", "b", joint="ball", axis=(1, 0, 0))
    used = svkc.connect(chain, other, "spare_0", here=True)
    placement = lambda s: eqx.tree_at(
        lambda x: (x.rank, x.margin, x.connected), s.structure, (0, 0, 0)
    )
    for free in (svkc.cut(chain, used, "spare_0"), svkc.unbind(chain, used, "spare_0")):
        assert eqx.tree_equal(placement(bind(free)), placement(fresh))
    assert eqx.tree_equal(placement(svkc.unbind(chain, used, "spare_0")), placement(state))
    np.testing.assert_allclose(svkc.connect(chain, fresh, "spare_0").v[:2], 2.0, atol=ROUND_OFF)


def test_binding_a_slot_that_is_connected_is_an_error(sliders):
    chain, state = sliders
    held = svkc.connect(
        chain, svkc.bind(chain, state, "spare_0", "world", "a"), "spare_0", here=True
    )
    with pytest.raises(ValueError, match="'spare_0' is connected; cut or unbind it first"):
        svkc.bind(chain, held, "spare_0", "a", "b")
    move = eqx.filter_jit(lambda s: svkc.bind(chain, s, "spare_0", "a", "b"))
    assert eqx.tree_equal(move(state), svkc.bind(chain, state, "spare_0", "a", "b"))
    with pytest.raises(RuntimeError, match="connected; cut or unbind"):
        move(held)


@pytest.mark.slow
def test_a_loop_that_cannot_be_closed_is_an_error_under_jit_and_in_runs(sliders):
    """The placement is 4 mm beside the line on which the boxes slide: near, but out of reach."""
    chain, state = sliders
    beside = svkc.bind(chain, state, "spare_0", "a", "b", real_pos=(-1, 0, 0.004))
    connect = lambda s: svkc.connect(chain, s, "spare_0")
    with pytest.raises(ValueError, match=r"cannot be closed.*spare_0 by 0\.004 m"):
        connect(beside)
    with pytest.raises(RuntimeError, match="connect: a loop cannot be closed"):
        eqx.filter_jit(connect)(beside)
    with pytest.raises(RuntimeError, match="connect: a loop cannot be closed"):
        eqx.filter_jit(lambda s, m: svkc.transition(chain, s, m))(beside, jnp.array([True, False]))
    traj = run(chain, beside, svkc.at(0.0, connect="spare_0"))
    assert traj.result == svkc.RESULTS.loop_open
    assert float(traj.t_final) == 0
    assert traj.final.structure.connected.tolist() == [False, False]
    assert traj.final.v[:2].tolist() == [1, 3]
