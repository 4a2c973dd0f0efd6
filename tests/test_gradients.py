"""Derivatives through every change of structure: against differences, against closed forms, at the hard points, under every transformation."""

import derivatives
import jax
import jax.numpy as jnp
import models
import numpy as np
import pytest

import svkc

SLOPE = models.MJCF.replace("0.3 -0.2 -9.81", "0 0 -9.81")
TIGHT = derivatives.TIGHT


@pytest.mark.parametrize("name", derivatives.CASES)
def test_against_differences(name):
    """Both modes, along a random direction of each parameter; forward and reverse to 1e-10."""
    f, x, limit = derivatives.CASES[name]()
    found = svkc.check_grad(f, x, directions=1, step=0.2 if limit == derivatives.ALGEBRA else 0.05)
    assert found.error <= limit, found
    assert found.modes <= 1e-10, found


BALL = '<body name="{0}" pos="{1}"><joint name="{0}" type="slide" axis="1 0 0"/><geom type="sphere" size="0.05" mass="{2}" contype="0"/></body>'


@pytest.fixture(scope="module")
def balls():
    """Two balls on a line, which a weld may join."""
    weld = svkc.VirtualLink("weld", "a", "b", "weld")
    return svkc.load(models.MJCF.format(BALL.format("a", "0 0 0", 1) + BALL.format("b", "1 0 0", 2)).replace("0.3 -0.2 -9.81", "0 0 0"), virtual_links=[weld])


def meeting(chain, x, **kw):
    """Balls at x[:2] with velocities x[2:] until their centres meet."""
    state = svkc.State(x[:2], x[2:], chain.state(connected=()).structure)
    met = lambda t, s, args: s.q[1] + 1.0 - s.q[0]
    return state, met


def test_a_catch_with_a_closed_form(balls):
    """They meet at T = gap / closing speed and go on together: where and when, and every derivative, as the formula says; second ones, too."""
    start = jnp.array([0.1, 0.2, 1.0, -0.5])

    def simulated(x):
        state, met = meeting(balls, x)
        traj = svkc.simulate(balls, state, 2.0, events=[svkc.when(met, connect="weld", here=True)], **TIGHT)
        return jnp.array([traj.final.q[0], traj.events.time[0], traj.events.energy_lost[0]])

    def formula(x):
        gap, closing = 1 + x[1] - x[0], x[2] - x[3]
        time = gap / closing
        together = (x[2] + 2 * x[3]) / 3
        return jnp.array([x[0] + x[2] * time + together * (2.0 - time), time, closing**2 / 3])

    np.testing.assert_allclose(simulated(start), formula(start), atol=1e-11)
    for jacobian in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(jacobian(simulated)(start), jacobian(formula)(start), atol=1e-10)
    # a second derivative, along one direction, of what a guard decides
    v = jnp.array([1.0, -0.5, 0.3, 0.7])
    twice = lambda f: jax.jvp(jax.grad(lambda x: jnp.sum(f(x) ** 2)), (start,), (v,))[1]
    np.testing.assert_allclose(twice(simulated), twice(formula), atol=1e-8)


def test_a_collision_that_swaps_velocities(balls):
    """Equal balls, elastic: the exact Jacobian is a permutation. Two runs, the second from the time and state where the first one's guard stopped it."""
    start = jnp.array([0.1, 0.2, 1.0, -0.5])

    def bounced(x):
        state, met = meeting(balls, x)
        first = svkc.simulate(balls, state, 2.0, events=[svkc.when(met, stop=True)], **TIGHT)
        swapped = svkc.State(first.final.q, first.final.v[::-1], first.final.structure)
        return svkc.simulate(balls, swapped, 2.0, t0=first.t_final, **TIGHT).final.q

    expected = np.array([[0, 1, 0, 2], [1, 0, 2, 0]])
    np.testing.assert_allclose(jax.jacrev(bounced)(start), expected, atol=1e-9)
    np.testing.assert_allclose(jax.jacfwd(bounced)(start), expected, atol=1e-9)


@pytest.fixture(scope="module")
def pendulum():
    hook = svkc.VirtualLink("hook", "world", "arm", "weld")
    return svkc.load(SLOPE.format(models.bar("arm", models.Y, "0 0 -1")), virtual_links=[hook])


def held(chain, x, ts=None):
    """Swings from x[0], held at the angle x[1] if it comes by, let go at the time x[2], until x[3]."""
    state = chain.state({"arm": 1.2})
    state = svkc.State(state.q.at[0].set(x[0]), state.v, state.structure)
    events = [svkc.when(lambda t, s, a: s.q[0] - a, connect="hook", here=True), svkc.at(x[2], cut="hook")]
    return svkc.simulate(chain, state, x[3], ts=ts, events=events, args=x[1], **TIGHT)


def test_the_end_an_event_at_the_start_and_at_a_save_time(pendulum):
    """dL/dt1 is the rate at the end; an event at t0; an event that coincides with a save time."""
    x = jnp.array([1.2, 0.3, 0.8, 1.3])
    traj = held(pendulum, x)
    by_end = jax.grad(lambda x: held(pendulum, x).final.q[0])(x)[3]
    np.testing.assert_allclose(by_end, traj.final.v[0], rtol=1e-9)

    def early(time):
        """Caught at once, then let go: what the delay of the first event changes is a velocity taken away."""
        state = pendulum.state({"arm": 1.2}, {"arm": 0.7})
        events = [svkc.at(time, connect="hook", here=True), svkc.at(0.4, cut="hook")]
        return svkc.simulate(pendulum, state, 0.9, events=events, **TIGHT).final.q[0]

    at_start = jax.jacfwd(early)(jnp.asarray(0.0))
    # one-sided, for there is no earlier time
    h = 1e-3
    ahead = (-11 * early(0.0) + 18 * early(h) - 9 * early(2 * h) + 2 * early(3 * h)) / (6 * h)
    np.testing.assert_allclose(at_start, ahead, rtol=1e-6)
    np.testing.assert_allclose(jax.grad(early)(jnp.asarray(0.0)), at_start, rtol=1e-10)

    together = lambda x: held(pendulum, jnp.concatenate([x, jnp.array([0.8, 1.3])]), ts=jnp.array([0.8, 1.3])).states.q
    found = svkc.check_grad(together, x[:2], directions=2)
    assert found.error <= 1e-6, found


def test_every_order_of_the_transformations(pendulum):
    """Lanes with other structures, numbers of events and times: vmap(grad), grad(vmap), jit, jacfwd, jacrev, in a scan: all the same."""
    lanes = jnp.array([[1.2, 0.3, 0.8, 1.3], [1.2, -2.0, 0.5, 0.6], [0.4, 0.3, 0.35, 1.0]])
    loss = lambda x: held(pendulum, x).final.q[0]
    counts = [int(held(pendulum, x).events.count) for x in lanes]
    assert len(set(counts)) > 1
    single = np.stack([jax.grad(loss)(x) for x in lanes])
    assert np.isfinite(single).all()
    looped = lambda x: jax.lax.scan(lambda total, lane: (total + loss(lane), None), jnp.zeros(()), x)[0]
    for name, got in {
        "vmap(grad)": jax.vmap(jax.grad(loss))(lanes),
        "jit(vmap(grad))": jax.jit(jax.vmap(jax.grad(loss)))(lanes),
        "grad(vmap)": jax.grad(lambda x: jnp.sum(jax.vmap(loss)(x)))(lanes),
        "vmap(jacfwd)": jax.vmap(jax.jacfwd(loss))(lanes),
        "vmap(jacrev)": jax.vmap(jax.jacrev(loss))(lanes),
        "grad(scan)": jax.grad(looped)(lanes),
    }.items():
        np.testing.assert_allclose(got, single, atol=1e-9, err_msg=name)


def test_second_derivatives(pendulum):
    """Hessian-vector products: of forward dynamics with a loop, and of a run with a scheduled event."""
    chain = models.four_bar()
    state = chain.state(v={"crank": 4.0})

    def power(x):
        s = svkc.State(state.q, x["v"], state.structure)
        return jnp.sum(svkc.forward_dynamics(derivatives.changed(chain, x), s, x["tau"]) ** 2)

    x = {"v": state.v, "tau": jnp.ones(chain.dofs), "mass": chain.mass}
    found = svkc.check_grad(jax.grad(power), x, mode="forward", directions=1, step=0.2)
    assert found.error <= 1e-8, found

    def loss(x):
        state = pendulum.state({"arm": 1.2}, connected=["hook"])
        start = svkc.State(state.q.at[0].set(x["angle"]), state.v, state.structure)
        traj = svkc.simulate(derivatives.changed(pendulum, x), start, 1.0, events=[svkc.at(x["time"], cut="hook")], **TIGHT)
        return traj.final.q[0] ** 2 + traj.final.v[0]

    x = {"angle": jnp.asarray(1.2), "time": jnp.asarray(0.3), "com": pendulum.com}
    found = svkc.check_grad(jax.grad(loss), x, mode="forward", directions=1)
    assert found.error <= 1e-6, found


def test_where_there_is_no_derivative(pendulum, balls):
    """A guard that grazes, one that jumps, two at one instant, a rank that is lost: a code says so; a grazing guard gives no number."""
    state = pendulum.state({"arm": 1.2})
    top = -1.2

    def event(guard, direction=None, **kw):
        return svkc.simulate(pendulum, state, 2.0, events=[svkc.when(guard, direction=direction, stop=True)], **TIGHT, **kw)

    smooth = event(lambda t, s, a: s.q[0] - 0.3)
    assert smooth.derivative == svkc.RESULTS.successful
    # the far turning point, less a hair: the angle goes through it at almost no rate
    touched = event(lambda t, s, a: s.q[0] - top - 1e-14)
    assert touched.derivative == svkc.RESULTS.grazing
    by_start = jax.grad(lambda q: svkc.simulate(
        pendulum, svkc.State(state.q.at[0].set(q), state.v, state.structure), 2.0, events=[svkc.when(lambda t, s, a: s.q[0] - top - 1e-14, stop=True)], **TIGHT
    ).events.time[0])(1.2)  # fmt: skip
    assert np.isnan(by_start)
    assert event(lambda t, s, a: jnp.where(t > 0.5, 1.0, -1.0)).derivative == svkc.RESULTS.jump
    guards = [svkc.when(lambda t, s, a, k=k: k * (s.q[0] - 0.3)) for k in (1.0, 2.0)]
    assert svkc.simulate(pendulum, state, 1.0, events=guards, **TIGHT).derivative == svkc.RESULTS.together
    timed = svkc.simulate(pendulum, state, 1.0, events=[svkc.when(lambda t, s, a: t - 0.5), svkc.at(0.5, connect="hook", here=True)], **TIGHT)
    assert timed.derivative == svkc.RESULTS.together
    # a parallelogram laid flat: its bars in one line
    flat = models.parallelogram(middle=False)
    lost = svkc.simulate(flat, flat.state({"leg0": np.pi / 2}, {"leg0": 1.0}), 0.0)
    assert lost.derivative == svkc.RESULTS.rank_lost
    assert float(lost.phases.margin[0]) < 1e-8


def test_nothing_is_not_a_number():
    """Zero velocity, identity rotations, a link of no length, an empty slot, a locked joint: every derivative is a number, in both modes."""
    rods = models.bar("base", 'type="ball"', "0 0 -0.5", inside=models.bar("fore", models.Y, "0 0 -0.3", "0 0 0"))
    chain = svkc.load(models.MJCF.format(rods), virtual_links=[svkc.VirtualLink("hook", "world", "fore", "ball", pos=(0, 0, -0.3))], spare=1)
    state = chain.state()

    def everything(x):
        c = derivatives.changed(chain, x)
        s = svkc.lock(c, svkc.State(x["q"], x["v"], state.structure), "fore")
        traj = svkc.simulate(c, s, 0.1, events=[svkc.at(x["time"], connect="hook", here=True), svkc.at(0.07, unlock="fore")], dt=0.02)
        return derivatives.motion(traj) | {"forces": svkc.loop_forces(c, traj.final, jnp.zeros(chain.dofs)).force, "gap": traj.gaps}

    x = {"q": state.q, "v": state.v, "time": jnp.asarray(0.05)} | derivatives.model(chain, "mass", "inertia", "com", "pos", "gravity")
    total = lambda x: sum(jnp.sum(leaf) for leaf in everything(x).values())
    backwards = jax.grad(total)(x)
    forwards = jax.jvp(total, (x,), (jax.tree.map(jnp.ones_like, x),))[1]
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(backwards))
    np.testing.assert_allclose(sum(float(jnp.sum(leaf)) for leaf in jax.tree.leaves(backwards)), forwards, rtol=1e-9)


def test_adjoints_pass_through(pendulum):
    """diffrax's own give the same gradient; one that keeps fewer states, too; what does not fit is refused with words."""
    import diffrax

    x = jnp.array([1.2, 0.3, 0.8, 1.3])

    def loss(x, adjoint):
        state = pendulum.state({"arm": 1.2})
        state = svkc.State(state.q.at[0].set(x[0]), state.v, state.structure)
        events = [svkc.when(lambda t, s, a: s.q[0] - a, connect="hook", here=True), svkc.at(x[2], cut="hook")]
        return svkc.simulate(pendulum, state, x[3], events=events, args=x[1], dt=0.01, adjoint=adjoint, max_steps=300).final.q[0]

    expected = jax.grad(loss)(x, None)
    for adjoint in (svkc.Replay(every=5), diffrax.RecursiveCheckpointAdjoint()):
        np.testing.assert_allclose(jax.grad(loss)(x, adjoint), expected, atol=1e-8)
    with pytest.raises(ValueError, match="adjoint"):
        loss(x, "replay")
    with pytest.raises(ValueError, match="needs dt or an adaptive"):
        svkc.simulate(pendulum, pendulum.state(), 1.0, stepsize_controller=diffrax.StepTo(jnp.linspace(0, 1, 5)), adjoint=svkc.Replay())


def test_gradients_in_the_tangent():
    """Of a ball's quaternion: along integrate(q, dv), three numbers; steps along it keep unit length and go downhill."""
    chain = svkc.load(models.MJCF.format(models.bar("arm", 'type="ball"', "0.3 0.2 -1")))
    state = chain.state()

    def height(q):
        return svkc.potential_energy(chain, svkc.State(q, state.v, state.structure))

    slope = svkc.tangent(chain, state.q, jax.grad(height)(state.q))
    assert slope.shape == (3,)
    found = svkc.check_grad(lambda dv: height(svkc.integrate(chain, state.q, dv)), jnp.zeros(3), step=0.2)
    assert found.error <= 1e-8, found
    np.testing.assert_allclose(jax.grad(lambda dv: height(svkc.integrate(chain, state.q, dv)))(jnp.zeros(3)), slope, atol=1e-12)
    lower = svkc.integrate(chain, state.q, -0.01 * slope)
    assert float(height(lower)) < float(height(state.q))
    assert abs(float(jnp.linalg.norm(lower)) - 1) < 1e-14


def test_the_check_finds_what_is_wrong():
    """A wrong derivative is named by both paths; bad calls are refused."""

    @jax.custom_jvp
    def wrong(x):
        return x**2

    wrong.defjvp(lambda p, t: (p[0] ** 2, 2.1 * p[0] * t[0]))
    found = svkc.check_grad(lambda x: {"good": x["a"] * x["b"], "bad": wrong(x["b"])}, {"a": jnp.arange(3.0), "b": jnp.ones(3), "count": 4})
    assert found.error == pytest.approx(0.1 / 2.1, rel=1e-6)
    assert "bad" in found.output
    assert "'b'" in found.input
    for part in ("bad", "'b'", "by differentiation"):
        assert part in str(found)
    for f, x, kw in ((jnp.sin, 3, {}), (jnp.sin, 1.0, {"mode": "sideways"}), (jnp.log, jnp.asarray(-1.0), {})):
        with pytest.raises(ValueError, match=r"check_grad|mode"):
            svkc.check_grad(f, x, **kw)
    assert svkc.check_grad(jnp.sin, 1.0).error < 1e-9
