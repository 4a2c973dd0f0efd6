"""Derivatives of runs with a guard: under every transformation, twice, by every adjoint, and where there are none."""

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


@pytest.mark.slow
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


@pytest.mark.slow
def test_every_order_of_the_transformations(pendulum):
    """Lanes with other structures, numbers of events and times: vmap(grad), grad(vmap), jit, jacfwd, jacrev, in a scan: all the same."""
    lanes = jnp.array([[1.2, 0.3, 0.8, 1.3], [1.2, -2.0, 0.5, 0.6], [0.4, 0.3, 0.35, 1.0]])
    # of the lanes' own starts and times, and of what they share
    loss = lambda x, com: held(derivatives.changed(pendulum, {"com": com}), x).final.q[0]
    counts = [int(held(pendulum, x).events.count) for x in lanes]
    assert len(set(counts)) > 1
    com, both = pendulum.com, (0, 1)
    alone = jax.jit(jax.jacrev(loss, both))
    single, shares = (np.stack(x) for x in zip(*(alone(x, com) for x in lanes), strict=True))
    assert np.isfinite(single).all()
    assert np.abs(shares).max() > 0
    looped = lambda x, com: jax.lax.scan(lambda total, lane: (total + loss(lane, com), None), jnp.zeros(()), x)[0]
    lanewise = lambda derivative: jax.jit(jax.vmap(derivative(loss, both), (0, None)))
    for name, (got, share) in {
        "jit(vmap(grad))": lanewise(jax.grad)(lanes, com),
        "vmap(jacfwd)": lanewise(jax.jacfwd)(lanes, com),
        "grad(vmap)": jax.grad(lambda x, com: jnp.sum(jax.vmap(loss, (0, None))(x, com)), both)(lanes, com),
        "grad(scan)": jax.jit(jax.grad(looped, both))(lanes, com),
    }.items():
        np.testing.assert_allclose(got, single, atol=1e-9, err_msg=name)
        # gradients by what is shared add up
        np.testing.assert_allclose(share, shares if share.ndim > com.ndim else shares.sum(0), atol=1e-9, err_msg=name)


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
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
