"""Derivatives through every change of structure: against differences, against closed forms, at the hard points, under every transformation."""

import derivatives
import equinox as eqx
import jax
import jax.numpy as jnp
import models
import numpy as np
import pytest

import svkc

SLOPE = models.MJCF.replace("0.3 -0.2 -9.81", "0 0 -9.81")
TIGHT = derivatives.TIGHT


@pytest.mark.parametrize("name", [*derivatives.ALGEBRAIC, "breaking", "four_bar_turning", "high_bar"])
def test_against_differences(name):
    """Both modes, along a random direction of each parameter; forward and reverse to 1e-10. Other runs: `python tests/derivatives.py`."""
    f, x, limit = derivatives.CASES[name]()
    found = svkc.check_grad(f, x, directions=1, step=0.1 if name in derivatives.ALGEBRAIC else 0.05)
    assert found.error <= limit, found
    assert found.modes <= 1e-10, found


BALL = '<body name="{0}" pos="{1}"><joint name="{0}" type="slide" axis="1 0 0"/><geom type="sphere" size="0.05" mass="{2}" contype="0"/></body>'


@pytest.fixture(scope="module")
def balls():
    """Two balls on a line, which a weld may join."""
    weld = svkc.VirtualLink("weld", "a", "b", "weld")
    return svkc.load(models.MJCF.format(BALL.format("a", "0 0 0", 1) + BALL.format("b", "1 0 0", 2)).replace("0.3 -0.2 -9.81", "0 0 0"), virtual_links=[weld])


def meeting(chain, x):
    """Balls at x[:2] with velocities x[2:] until their centres meet."""
    state = svkc.State(x[:2], x[2:], chain.state(connected=()).structure)
    met = lambda t, s, args: s.q[1] + 1.0 - s.q[0]
    return state, met


def test_a_catch_with_a_closed_form(balls):
    """They meet at T = gap / closing speed and go on together: where and when, and every derivative, as the formula says."""
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


def test_times_that_coincide(balls):
    """t0 and its save time, an event and its save time, t1 and its save time, an event at t0: each of them is to be differentiated by alone, twice too."""

    def simulated(x):
        state, _ = meeting(balls, jnp.concatenate([jnp.zeros(2), x["v"]]))
        events = [svkc.at(x["event"], connect="weld", here=True)]
        traj = svkc.simulate(balls, state, x["t1"], t0=x["t0"], ts=x["ts"], events=events, **TIGHT)
        return jnp.append(traj.states.q[:, 0], traj.final.q[0])

    def formula(x):
        together = (x["v"][0] + 2 * x["v"][1]) / 3
        before = lambda t: x["v"][0] * (t - x["t0"])
        after = lambda t: before(x["event"]) + together * (t - x["event"])
        return jnp.stack([before(x["ts"][0]), after(x["ts"][1]), after(x["ts"][2]), after(x["t1"])])

    twice = lambda f: jax.jit(lambda x: jax.jvp(jax.grad(lambda x: jnp.sum(f(x) ** 2)), (x,), (jax.tree.map(jnp.cos, x),))[1])
    both = jax.jit(lambda x: (simulated(x), jax.jacfwd(simulated)(x), jax.jacrev(simulated)(x)))
    for event in (0.5, 0.0):
        x = {"v": jnp.array([1.0, -0.5]), "t0": jnp.zeros(()), "event": jnp.asarray(event), "t1": jnp.asarray(2.0), "ts": jnp.array([0.0, 0.5, 2.0])}
        if event == 0.0:
            # what is saved at the time of an event is the state after it
            x["ts"] = jnp.array([0.1, 0.5, 2.0])
            formula_here = lambda x: formula(x).at[0].set(formula(x)[1] + (x["v"][0] + 2 * x["v"][1]) / 3 * (x["ts"][0] - x["ts"][1]))
        else:
            formula_here = formula
        value, forward, backward = both(x)
        np.testing.assert_allclose(value, formula_here(x), atol=1e-12)
        for mode in (forward, backward):
            jax.tree.map(lambda got, want: np.testing.assert_allclose(got, want, atol=1e-10), mode, jax.jacfwd(formula_here)(x))
        jax.tree.map(lambda got, want: np.testing.assert_allclose(got, want, atol=1e-9), twice(simulated)(x), twice(formula_here)(x))


@pytest.fixture(scope="module")
def pendulum():
    hook = svkc.VirtualLink("hook", "world", "arm", "weld")
    return svkc.load(SLOPE.format(models.bar("arm", models.Y, "0 0 -1")), virtual_links=[hook])


def held(chain, x, ts=None, **kw):
    """Swings from x[0], held at the angle x[1] if it comes by, let go at the time x[2], until x[3]."""
    state = chain.state({"arm": 1.2})
    state = svkc.State(state.q.at[0].set(x[0]), state.v, state.structure)
    events = [svkc.when(lambda t, s, a: s.q[0] - a, connect="hook", here=True), svkc.at(x[2], cut="hook")]
    return svkc.simulate(chain, state, x[3], ts=ts, events=events, args=x[1], **(kw or TIGHT))


def test_the_end_and_an_event_at_a_save_time(pendulum):
    """dL/dt1 is the rate at the end; what is saved at the time of an event moves with what came before."""

    def f(x):
        traj = held(pendulum, jnp.stack([x["start"], x["angle"], jnp.asarray(0.8), x["t1"]]), ts=jnp.array([0.5, 0.8]))
        return {"end": traj.final.q[0], "saved": traj.states.q[:, 0], "rate": traj.final.v[0]}

    x = {"start": jnp.asarray(1.2), "angle": jnp.asarray(0.3), "t1": jnp.asarray(1.3)}
    found = svkc.check_grad(f, x)
    assert found.error <= 1e-8, found
    assert found.modes <= 1e-10, found
    along = {"start": jnp.zeros(()), "angle": jnp.zeros(()), "t1": jnp.ones(())}
    value, rate = jax.jvp(f, (x,), (along,))
    np.testing.assert_allclose(rate["end"], value["rate"], rtol=1e-9)


def test_every_order_of_the_transformations(pendulum):
    """Lanes with other structures, numbers of events and times: vmap(grad), grad(vmap), jit, jacfwd, jacrev, in a scan: all the same."""
    lanes = jnp.array([[1.2, 0.3, 0.8, 1.3], [1.2, -2.0, 0.5, 0.6], [0.4, 0.3, 0.35, 1.0]])
    loss = lambda x: held(pendulum, x).final.q[0]
    counts = [int(held(pendulum, x).events.count) for x in lanes]
    assert len(set(counts)) > 1
    alone = jax.jit(jax.jacrev(loss))
    single = np.stack([alone(x) for x in lanes])
    assert np.isfinite(single).all()
    looped = lambda x: jax.lax.scan(lambda total, lane: (total + loss(lane), None), jnp.zeros(()), x)[0]
    for name, got in {
        "jit(vmap(grad))": jax.jit(jax.vmap(jax.grad(loss)))(lanes),
        "grad(vmap)": jax.grad(lambda x: jnp.sum(jax.vmap(loss)(x)))(lanes),
        "vmap(jacfwd)": jax.jit(jax.vmap(jax.jacfwd(loss)))(lanes),
        "grad(scan)": jax.jit(jax.grad(looped))(lanes),
    }.items():
        np.testing.assert_allclose(got, single, atol=1e-9, err_msg=name)
    # what the lanes share: their gradients add up
    shared = lambda com, x: held(derivatives.changed(pendulum, {"com": com}), x).final.q[0]
    apart = sum(jax.jit(jax.grad(shared))(pendulum.com, x) for x in lanes)
    together = jax.jit(jax.grad(lambda com: jnp.sum(jax.vmap(lambda x: shared(com, x))(lanes))))(pendulum.com)
    np.testing.assert_allclose(together, apart, atol=1e-9)


def test_second_derivatives(pendulum):
    """Hessian-vector products: of forward dynamics with a loop, and of a run with a guard and a scheduled event."""
    chain = models.four_bar()

    def power(x):
        c = derivatives.changed(chain, x)
        c = eqx.tree_at(lambda c: c.structure.real_pos, c, chain.structure.real_pos.at[:, ::2].add(x["pin"]))
        s = c.state({"crank": x["angle"]}, {"crank": x["speed"]})
        return jnp.sum(svkc.forward_dynamics(c, s, x["tau"]) ** 2) / 1e4

    x = {"angle": jnp.asarray(0.2), "speed": jnp.asarray(4.0), "tau": jnp.ones(chain.dofs), "mass": chain.mass, "pin": jnp.zeros((1, 2))}
    found = svkc.check_grad(jax.grad(power), x, mode="forward", directions=1)
    assert found.error <= 1e-8, found

    def loss(x):
        traj = held(derivatives.changed(pendulum, x), x["held"])
        return traj.final.q[0] ** 2 + traj.final.v[0] + traj.events.time[0]

    x = {"held": jnp.array([1.2, 0.3, 0.8, 1.0]), "com": pendulum.com}
    found = svkc.check_grad(jax.grad(loss), x, mode="forward", directions=1)
    assert found.error <= 1e-6, found


def test_where_there_is_no_derivative(pendulum):
    """A guard that grazes, one that jumps, two at one instant, a rank that is lost: a code says so; a grazing guard gives no number."""

    def grazed(size):
        """A guard that is above zero for a moment only, at a time where the run stops to save."""
        above = lambda t, s, args: args - (t - 0.5) ** 2
        state = pendulum.state({"arm": 1.2})
        return svkc.simulate(pendulum, state, 1.0, ts=jnp.array([0.5]), events=[svkc.when(above, stop=True)], args=size, **TIGHT)

    # at 0.4 it goes through zero at a rate; 3e-8 s before 0.5 s at almost none
    assert grazed(jnp.asarray(0.01)).derivative == svkc.RESULTS.successful
    assert grazed(jnp.asarray(1e-15)).derivative == svkc.RESULTS.grazing
    slopes = jax.vmap(jax.grad(lambda size: grazed(size).events.time[0]))(jnp.array([0.01, 1e-15]))
    np.testing.assert_allclose(slopes[0], -5.0, rtol=1e-9)
    assert np.isnan(slopes[1])

    def code(*events):
        return svkc.simulate(pendulum, pendulum.state({"arm": 1.2}), 2.0, events=events, **TIGHT).derivative

    assert code(svkc.when(lambda t, s, a: jnp.where(t > 0.5, 1.0, -1.0))) == svkc.RESULTS.jump
    assert code(*(svkc.when(lambda t, s, a, k=k: k * (s.q[0] - 0.3)) for k in (1.0, 2.0))) == svkc.RESULTS.together
    assert code(svkc.at(0.5, connect="hook", here=True), svkc.at(0.5)) == svkc.RESULTS.together
    assert code(svkc.when(lambda t, s, a: t - 0.5), svkc.at(0.5, connect="hook", here=True)) == svkc.RESULTS.together
    # a parallelogram laid flat: its bars in one line
    flat = models.parallelogram(middle=False)
    lost = svkc.simulate(flat, flat.state({"leg0": np.pi / 2}, {"leg0": 1.0}), 1e-3, throw=False)
    assert lost.derivative == svkc.RESULTS.rank_lost
    assert float(lost.phases.margin[0]) < np.sqrt(np.finfo(float).eps)


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
    total = lambda x: sum(jnp.sum(leaf) for leaf in jax.tree.leaves(everything(x)))
    backwards = jax.grad(total)(x)
    forwards = jax.jvp(total, (x,), (jax.tree.map(jnp.ones_like, x),))[1]
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(backwards))
    np.testing.assert_allclose(sum(float(jnp.sum(leaf)) for leaf in jax.tree.leaves(backwards)), forwards, rtol=1e-9)


def test_adjoints_pass_through(pendulum):
    """diffrax's own give the same gradient; one that keeps fewer states, too; what does not fit is refused with words."""
    import diffrax

    x = jnp.array([1.2, 0.3, 0.8, 1.3])

    def loss(x, adjoint):
        traj = held(pendulum, x, ts=jnp.array([0.5, 0.9]), dt=0.01, adjoint=adjoint, max_steps=300)
        return traj.final.q[0] + jnp.sum(traj.states.q)

    expected = jax.grad(loss)(x, svkc.Replay(every=5))
    np.testing.assert_allclose(jax.grad(loss)(x, diffrax.RecursiveCheckpointAdjoint()), expected, atol=1e-7)
    forward = jax.jvp(lambda x: loss(x, diffrax.ForwardMode()), (x,), (jnp.ones(4),))[1]
    np.testing.assert_allclose(forward, jnp.sum(expected), atol=1e-7)
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
    # a derivative that is no number is as wrong as can be
    found = svkc.check_grad(lambda x: {"a": x, "root": jnp.where(x > 0, jnp.sqrt(x), x)}, jnp.zeros(()))
    assert found.modes == np.inf
