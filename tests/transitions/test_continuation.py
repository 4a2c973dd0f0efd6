"""`chain.state`: branches by continuation, names that are held, velocities that stay."""

import equinox as eqx
import jax
import jax.numpy as jnp
import linkages
import models
import numpy as np
import pytest
from optimized import optimized_jit
from references import continuation
from tolerances import ROUND_OFF

import svkc


@pytest.fixture(scope="module")
def four_bar():
    return models.four_bar()


def sweep(chain, angles):
    return jax.jit(jax.vmap(lambda x: chain.state({"crank": x}).q))(jnp.asarray(angles))


@pytest.mark.slow
def test_neighbours_are_on_one_branch(four_bar):
    """A crank turned in small steps: every joint moves in small steps, through several turns."""
    angles = np.concatenate([np.arange(0, 0.8, 2e-2), np.arange(0.8, 14, 0.1)])
    q = np.asarray(sweep(four_bar, angles))
    assert np.array_equal(q[:, 0], angles)
    rates = np.diff(q, axis=0) / np.diff(angles)[:, None]
    assert np.abs(rates).max() < 3


@pytest.mark.slow
def test_the_sweep_of_the_issue(four_bar):
    angles = np.arange(0, 0.8, 1e-3)
    q = np.asarray(sweep(four_bar, angles))
    assert np.abs(np.diff(q, axis=0)).max() < 3e-3


def test_names_are_held_or_an_error(four_bar):
    assert float(four_bar.state({"crank": 3.0}).q[0]) == 3.0
    with pytest.raises(ValueError, match=r"q: .*rocker by 0\.78 rad"):
        four_bar.state({"crank": 0.3, "rocker": 1.0})
    with pytest.raises(ValueError, match=r"v: .*rocker by .* rad/s"):
        four_bar.state(v={"crank": 1.0, "rocker": 2.0})
    with pytest.raises(ValueError, match=r"q: .*rocker by"):
        four_bar.state({"rocker": 3.0})
    close = four_bar.state({"crank": 0.3}).q
    q = {"crank": 0.3, "rocker": float(close[2]) + 1e-5}
    np.testing.assert_allclose(four_bar.state(q, tolerance=1e-4).q, close, atol=ROUND_OFF)
    with pytest.raises(ValueError, match="rocker by 1e-05 rad"):
        four_bar.state(q)


PLATE = """<mujoco><worldbody>
<body name="plate" pos="0 0 1"><freejoint name="plate"/><geom type="box" size=".3 .3 .02"
 contype="0"/></body>{}</worldbody></mujoco>"""
LEG = """<body name="leg{0}" pos="{1} {2} 0"><joint name="foot{0}" type="ball"/><geom size="0.02"
 contype="0"/><body name="rod{0}"><joint name="slide{0}" type="slide" axis="0 0 1"/>
 <geom size="0.02" contype="0"/></body></body>"""


@pytest.mark.slow
def test_a_plate_on_legs_keeps_its_pose():
    """All six coordinates of a free joint, which the legs allow."""
    places = ((0.3, 0), (-0.2, 0.3), (-0.2, -0.3))
    links = [
        svkc.VirtualLink(f"top{i}", "plate", f"rod{i}", "ball", (x, y, 0), connected=True)
        for i, (x, y) in enumerate(places)
    ]
    legs = "".join(LEG.format(i, *place) for i, place in enumerate(places))
    chain = svkc.load(PLATE.format(legs), virtual_links=links)
    pose = [0.1, -0.2, 1.1, np.cos(0.1), 0, np.sin(0.1), 0]
    state = chain.state({"plate": pose}, {"plate": [0.1, 0.2, 0.3, 1, 2, 3]})
    np.testing.assert_allclose(state.q[:7], pose, atol=1e-15)
    assert state.v[:6].tolist() == [0.1, 0.2, 0.3, 1, 2, 3]


def test_arrays_are_guesses_unless_held(four_bar):
    state = four_bar.state({"crank": 0.7}, {"crank": 2.0})
    for q, v in ((state.q, state.v), (state.q[:3], state.v[:3])):
        again = four_bar.state(q, v)
        np.testing.assert_allclose(again.q, state.q, atol=ROUND_OFF)
        np.testing.assert_allclose(again.v, state.v, atol=ROUND_OFF)
    open_ = np.add(state.q[:3], (0.01, 0, 0))
    moved = four_bar.state(open_)
    assert 1e-4 < np.abs(moved.q[:3] - open_).max() < 0.01
    with pytest.raises(ValueError, match="q: "):
        four_bar.state(open_, hold=True)
    np.testing.assert_allclose(four_bar.state(state.q, hold=True).q, state.q, atol=ROUND_OFF)
    guess = {"crank": 0.71, "coupler": float(state.q[1]), "rocker": float(state.q[2])}
    assert float(four_bar.state(guess, hold=False).q[0]) != 0.71


def test_a_loop_that_is_open_by_a_large_angle_closes():
    """Seven hinges whose end is turned by two radians."""
    chain, _ = linkages.linkage("seven hinges in space")
    turned = jnp.array([[np.cos(1.0), 0, np.sin(1.0), 0]])
    state = eqx.tree_at(lambda c: c.structure.quat, chain, turned).state()
    assert np.abs(state.q - chain.q_load).max() > 1


def test_a_state_to_start_from(four_bar):
    """The other branch is reached from a state on it, and turns are counted from there."""
    crossed = four_bar.state(np.array([0.0, 2.6, -2.8]))
    there = four_bar.state({"crank": 0.4}, near=crossed)
    assert np.abs(there.q - crossed.q).max() < 1
    assert np.abs(there.q - four_bar.state({"crank": 0.4}).q).max() > 1
    far = four_bar.state({"crank": 7.0})
    near = four_bar.state({"crank": 7.1}, near=far)
    np.testing.assert_allclose(near.q, four_bar.state({"crank": 7.1}).q, atol=ROUND_OFF)


@pytest.mark.slow
def test_lanes_that_fail_are_nan_alone(four_bar):
    q = jax.jit(jax.vmap(lambda x: four_bar.state({"rocker": x}, throw=False).q))(
        jnp.array([0.1, 3.0, -0.1])
    )
    assert np.isnan(q).all(1).tolist() == [False, True, False]
    assert np.isnan(four_bar.state({"rocker": 3.0}, throw=False).q).all()
    alone = four_bar.state({"rocker": 0.1}).q
    np.testing.assert_allclose(q[0], alone, atol=ROUND_OFF)
    with pytest.raises(Exception, match="cannot be closed"):
        jax.jit(lambda x: four_bar.state({"rocker": x}).q)(3.0)


@pytest.mark.slow
def test_runs_from_unreachable_states_end_with_their_code(four_bar):
    def run(rocker):
        state = four_bar.state({"rocker": rocker}, throw=False)
        traj = svkc.simulate(four_bar, state, 0.1, dt=0.05, throw=False)
        return traj.result, traj.t_final

    result, t_final = jax.jit(jax.vmap(run))(jnp.array([0.1, 3.0]))
    assert (result == svkc.RESULTS.non_finite).tolist() == [False, True]
    assert (result == svkc.RESULTS.successful).tolist() == [True, False]
    assert t_final[0] == 0.1
    with pytest.raises(ValueError, match="must be finite"):
        svkc.simulate(four_bar, four_bar.state({"rocker": 3.0}, throw=False), 0.1)


@pytest.mark.slow
def test_a_control_that_closes_loops_is_smooth(four_bar):
    """The crank is driven along a path of closed states; derivative of the run by the amplitude."""
    start = four_bar.state({"crank": 0.3})

    def control(t, state, amplitude):
        target = four_bar.state({"crank": 0.3 + amplitude * jnp.sin(3 * t)}, near=start)
        return jnp.zeros(four_bar.dofs).at[2].set(20 * (target.q[2] - state.q[2]) - state.v[2])

    def end(amplitude):
        run = svkc.simulate(
            four_bar, start, 0.5, control=control, args=amplitude, rtol=1e-10, atol=1e-12
        )
        return run.final.q

    slope = jax.jit(jax.jacrev(end))(0.2)
    h = 1e-3
    run = jax.jit(end)
    difference = (8 * (run(0.2 + h) - run(0.2 - h)) - run(0.2 + 2 * h) + run(0.2 - 2 * h)) / 12 / h
    np.testing.assert_allclose(slope, difference, atol=1e-8)


def compare_states(name, q):
    """Compare the states q [count q] of the first geometries with the reference."""
    chain, _ = linkages.linkage(name)
    scalars, balls, turns, reached = linkages.expected(name, len(q))
    assert np.isfinite(q).all(1).tolist() == reached.tolist()
    assert reached.sum() > len(q) / 5
    top = chain.topology
    for iq, iv in zip(*top.scalar_coordinates, strict=True):
        if iv < chain.nv:
            np.testing.assert_allclose(q[reached, iq], scalars[reached, iv], atol=1e-9)
    for i, row in enumerate(top.rows_of_kind(continuation.BALL)):
        R = continuation.matrix(q[:, top.q_start[row] : top.q_start[row] + 4])
        np.testing.assert_allclose(R[reached], balls[reached, i], atol=1e-9)
    for i, freedoms in enumerate(top.link_freedoms):
        if sum(freedoms) == 1:
            angle = q[reached, top.links.angle[i, 2]]
            np.testing.assert_allclose(angle, turns[reached, i], atol=1e-9)


def state_of_geometry(name):
    """Return (pos, link_pos, target) -> q of a topology."""
    chain, names = linkages.linkage(name)

    def state(pos, link_pos, target):
        changed = linkages.changed(chain, pos, link_pos)
        return changed.state(dict(zip(names, target, strict=True)), throw=False).q

    return state


@pytest.mark.parametrize(
    "name",
    [
        n if n == "five-bar" else pytest.param(n, marks=pytest.mark.slow)
        for n in linkages.TOPOLOGIES
    ],
)
def test_states_of_twenty_geometries(name):
    numbers = (x[:20] for x in linkages.geometries(name))
    compare_states(name, np.asarray(jax.jit(jax.vmap(state_of_geometry(name)))(*numbers)))


def test_the_stored_reference_is_the_recomputed_one():
    stored = linkages.expected("five-bar, one name", 5)
    for old, new in zip(stored, linkages.recompute("five-bar, one name", 5), strict=True):
        np.testing.assert_allclose(old, new, atol=1e-12)


def compare_with_derivatives(name, count):
    """Return the largest relative error of the derivative of each state against fourth-order
    differences, after a comparison of the states."""
    state, numbers = state_of_geometry(name), tuple(x[:count] for x in linkages.geometries(name))
    # from one geometry to another, so that a planar one stays planar
    direction = tuple(np.roll(x, 1, 0) - x for x in numbers)

    @optimized_jit
    @jax.vmap
    def program(x, x_dot):
        shifted = lambda h: state(*(y + h * w for y, w in zip(x, x_dot, strict=True)))
        q, q_dot = jax.jvp(state, x, x_dot)
        ends = jax.lax.map(shifted, 1e-4 * jnp.array([-2.0, -1.0, 1.0, 2.0]))
        return q, q_dot, (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / 12e-4

    q, q_dot, difference = map(np.asarray, program(numbers, direction))
    compare_states(name, q)
    both = np.isfinite(q).all(1) & np.isfinite(difference).all(1)
    size = 1 + np.abs(q_dot[both]).max(1, keepdims=True)
    return (np.abs(q_dot[both] - difference[both]) / size).max(1)


@pytest.mark.slow
def test_derivatives_of_twenty_geometries():
    """With a freedom left, by least change."""
    assert compare_with_derivatives("five-bar, one name", 20).max() < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("name", linkages.TOPOLOGIES)
def test_states_and_derivatives_of_every_geometry(name):
    assert compare_with_derivatives(name, 200).max() < 1e-6


@pytest.mark.slow
def test_derivatives_of_both_modes_and_second_ones():
    """Of least change where one name leaves a freedom."""
    chain, _ = linkages.linkage("five-bar, one name")
    f = lambda x: jnp.sum(jnp.sin(chain.state({"crank0": x}, {"crank0": 1.0 + x}).q))
    g = lambda x: f(x) + jnp.sum(chain.state({"crank0": x}, {"crank0": 1.0 + x}).v)
    forward, backward = jax.jit(jax.jacfwd(g)), jax.jit(jax.grad(g))
    np.testing.assert_allclose(forward(0.3), backward(0.3), rtol=1e-12)
    second = jax.jit(jax.jacfwd(jax.grad(g)))(0.3)
    h = 1e-4
    np.testing.assert_allclose(second, (forward(0.3 + h) - forward(0.3 - h)) / (2 * h), rtol=1e-6)


@pytest.fixture(scope="module")
def on_a_locked_base():
    """Return a four-bar on a turntable, with the joint of the turntable locked, and the state."""
    inside = models.FOUR_BAR.replace('"crank" pos="0 0 0"', '"crank" pos="0.3 0 0"')
    text = models.MJCF.format(models.bar("base", models.Y, "0.3 0 0", inside=inside))
    chain = svkc.load(text, virtual_links=[models.pin(pos=(1.5, 0, 0))])
    return chain, svkc.lock(chain, chain.state(), "base")


@pytest.mark.slow
def test_locked_coordinates_move_to_their_requested_values(on_a_locked_base):
    """`chain.state` moves a locked joint and closes the loops. Runs never move it."""
    chain, locked = on_a_locked_base
    for angle in (0.01, 0.5):
        state = chain.state({"base": angle}, near=locked)
        assert float(state.q[0]) == angle
        assert float(jnp.abs(svkc.loop_gaps(chain, state)).max()) < ROUND_OFF
    with pytest.raises(ValueError, match=r"v: .*base by 1 rad/s"):
        chain.state(v={"base": 1.0}, near=locked)
    np.testing.assert_allclose(chain.state(v=np.ones(4), near=locked).v[0], 0, atol=ROUND_OFF)


@pytest.mark.slow
def test_derivatives_by_a_locked_coordinate(on_a_locked_base):
    chain, locked = on_a_locked_base
    q = lambda x: chain.state(jnp.array([x, -0.1, 0.05, 0.0]), near=locked).q
    check = svkc.check_grad(q, jnp.asarray(0.1))
    assert check.error < 1e-8, check
    assert float(jnp.abs(jax.jacfwd(q)(0.1)[1:]).min()) > 1e-3


def test_locked_joints_of_open_chains_are_at_rest():
    chain = svkc.load(models.MJCF.format(models.TWO_RODS))
    locked = svkc.lock(chain, chain.state(), "upper")
    assert chain.state({"upper": 0.3}, np.ones(2), near=locked).v.tolist() == [0, 1]
    inside_jit = jax.jit(lambda v: chain.state(v=v, near=locked).v)
    assert inside_jit(jnp.ones(2)).tolist() == [0, 1]
    failed = chain.state(v={"upper": 5.0}, near=locked, throw=False)
    assert np.isnan(failed.v).all()
