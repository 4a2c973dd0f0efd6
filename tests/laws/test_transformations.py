"""Derivatives of runs with a guard: under transformations, of second order, by every adjoint.

Also the verdicts where a derivative does not exist.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import models
import numpy as np
import parameters
import pytest
from tolerances import DIFFERENCE, REFERENCE

import svkc

SLOPE = models.MJCF.replace("0.3 -0.2 -9.81", "0 0 -9.81")


@pytest.fixture(scope="module")
def pendulum():
    hook = svkc.VirtualLink("hook", "world", "arm", "weld")
    return svkc.load(SLOPE.format(models.bar("arm", models.Y, "0 0 -1")), virtual_links=[hook])


def angle(t, state, args):
    return state.q[0] - args


def hooked_run(chain, x, ts=None, **kw):
    """Run from angle x[0] to time x[3], hooked at angle x[1] if reached, released at time x[2]."""
    state = chain.state({"arm": 1.2})
    state = svkc.State(state.q.at[0].set(x[0]), state.v, state.structure)
    events = [svkc.when(angle, connect="hook", here=True), svkc.at(x[2], cut="hook")]
    return svkc.simulate(
        chain,
        state,
        x[3],
        ts=ts,
        events=events,
        args=x[1],
        max_events=2,
        **(kw or parameters.TIGHT),
    )


@pytest.mark.slow
def test_the_end_and_an_event_at_a_save_time(pendulum):
    """The derivative with respect to t1 is the rate at the end, also with events and save times."""

    def f(x):
        traj = hooked_run(
            pendulum,
            jnp.stack([x["start"], x["angle"], jnp.asarray(0.8), x["t1"]]),
            ts=jnp.array([0.5, 0.8]),
        )
        return {"end": traj.final.q[0], "saved": traj.states.q[:, 0], "rate": traj.final.v[0]}

    x = {"start": jnp.asarray(1.2), "angle": jnp.asarray(0.3), "t1": jnp.asarray(1.3)}
    check = svkc.check_grad(f, x)
    assert check.error <= 1e-8, check
    assert check.modes <= 1e-10, check
    direction = {"start": jnp.zeros(()), "angle": jnp.zeros(()), "t1": jnp.ones(())}
    value, rate = jax.jvp(f, (x,), (direction,))
    np.testing.assert_allclose(rate["end"], value["rate"], rtol=REFERENCE)


@pytest.mark.slow
def test_every_order_of_the_transformations(pendulum):
    """The orders of transformations agree: vmap(grad), vmap(jacfwd), grad(vmap), grad(scan).

    Lanes differ in structures, numbers of events and times.

    (The gradient of one run alone, in both modes and against differences:
    `test_the_end_and_an_event_at_a_save_time`.)
    """
    lanes = jnp.array([[1.2, 0.3, 0.8, 1.3], [1.2, -2.0, 0.5, 0.6]])
    com, both = pendulum.com, (0, 1)

    def loss(x, com):
        """Return the final angle and the number of events, of lane x with a shared com."""
        traj = hooked_run(parameters.with_model_floats(pendulum, {"com": com}), x)
        return traj.final.q[0], traj.events.count

    one = lambda x, com: loss(x, com)[0]
    looped = lambda x, com: jax.lax.scan(
        lambda total, lane: (total + one(lane, com), None), jnp.zeros(()), x
    )[0]
    lanewise = lambda derivative, f, **kw: jax.jit(jax.vmap(derivative(f, both, **kw), (0, None)))
    (single, shares), counts = lanewise(jax.grad, loss, has_aux=True)(lanes, com)
    assert len(set(counts.tolist())) == len(lanes)
    assert np.isfinite(single).all()
    assert np.abs(shares).max() > 0
    for name, (got, share) in {
        "vmap(jacfwd)": lanewise(jax.jacfwd, one)(lanes, com),
        "grad(vmap)": jax.jit(
            jax.grad(lambda x, com: jnp.sum(jax.vmap(one, (0, None))(x, com)), both)
        )(lanes, com),
        "grad(scan)": jax.jit(jax.grad(looped, both))(lanes, com),
    }.items():
        np.testing.assert_allclose(got, single, atol=REFERENCE, err_msg=name)
        # gradients with respect to shared parameters add up
        np.testing.assert_allclose(
            share, shares if share.ndim > com.ndim else shares.sum(0), atol=REFERENCE, err_msg=name
        )


def twice(f, x):
    """Return the largest relative error of the gradient's derivative, by one program.

    It is that of `svkc.check_grad(jax.grad(f), x, "forward", directions=1)`.
    """
    return parameters.worst_relative_error(
        jax.jit(lambda x, along: jax.jvp(jax.grad(f), (x,), (along,))), x
    )


@pytest.mark.slow
def test_second_derivatives_of_forward_dynamics():
    """Hessian-vector products of forward dynamics, with a loop that `state` closes."""
    chain = models.four_bar()

    def power(x):
        c = parameters.with_model_floats(chain, x)
        c = eqx.tree_at(
            lambda c: c.structure.real_pos, c, chain.structure.real_pos.at[:, ::2].add(x["pin"])
        )
        s = c.state({"crank": x["angle"]}, {"crank": x["speed"]})
        return jnp.sum(svkc.forward_dynamics(c, s, x["tau"]) ** 2) / 1e4

    x = {
        "angle": jnp.asarray(0.2),
        "speed": jnp.asarray(4.0),
        "tau": jnp.ones(chain.dofs),
        "mass": chain.mass,
        "pin": jnp.zeros((1, 2)),
    }
    assert twice(power, x) <= 1e-8


@pytest.mark.slow
def test_second_derivatives_of_a_run(pendulum):
    """Hessian-vector products of a run with a guard and a scheduled event."""

    def loss(x):
        traj = hooked_run(parameters.with_model_floats(pendulum, x), x["held"])
        return traj.final.q[0] ** 2 + traj.final.v[0] + traj.events.time[0]

    assert twice(loss, {"held": jnp.array([1.2, 0.3, 0.8, 1.0]), "com": pendulum.com}) <= DIFFERENCE


@pytest.mark.slow
def test_adjoints_pass_through(pendulum):
    """Adjoints of diffrax, and a replay with fewer checkpoints, give the same gradient."""
    import diffrax

    x = jnp.array([1.2, 0.3, 0.8, 1.3])

    def loss(x, adjoint):
        traj = hooked_run(
            pendulum, x, ts=jnp.array([0.5, 0.9]), dt=0.01, adjoint=adjoint, max_steps=300
        )
        return traj.final.q[0] + jnp.sum(traj.states.q)

    expected = jax.grad(loss)(x, svkc.integrators.Replay(every=5))
    np.testing.assert_allclose(
        jax.grad(loss)(x, diffrax.RecursiveCheckpointAdjoint()), expected, atol=1e-7
    )
    forward = jax.jvp(lambda x: loss(x, diffrax.ForwardMode()), (x,), (jnp.ones(4),))[1]
    np.testing.assert_allclose(forward, jnp.sum(expected), atol=1e-7)


class Choice(eqx.Module):
    """A guard that `args` weights: a constant, a jump in time, a joint's angle, the time."""

    which: int = eqx.field(static=True)

    def __call__(self, t, state, args):
        rest, jump, turned, clock = args[self.which]
        return (
            rest
            + jump * jnp.where(t > 0.5, 1.0, -1.0)
            + turned * (state.q[0] - 0.3)
            + clock * (t - 0.5)
        )


@pytest.mark.slow
def test_where_there_is_no_derivative(pendulum):
    """The code of a run tells why it has no derivative.

    The cases are a guard that grazes, one that jumps, two at one time, and a lost rank. A grazing
    guard has the derivative NaN.
    """

    def grazed(size):
        """Stop at a guard that is positive for a moment only, around a save time."""
        above = lambda t, s, args: args - (t - 0.5) ** 2
        state = pendulum.state({"arm": 1.2})
        traj = svkc.simulate(
            pendulum,
            state,
            1.0,
            ts=jnp.array([0.5]),
            events=[svkc.when(above, stop=True)],
            args=size,
            **parameters.TIGHT,
        )
        return traj.events.time[0], traj.derivative

    # at 0.4 s its rate is not zero; 3e-8 s before 0.5 s it nearly is
    slopes, codes = jax.jit(jax.vmap(jax.grad(grazed, has_aux=True)))(jnp.array([0.01, 1e-15]))
    assert (codes == svkc.types.DERIVATIVE.successful).tolist() == [True, False]
    assert (codes == svkc.types.DERIVATIVE.grazing).tolist() == [False, True]
    np.testing.assert_allclose(slopes[0], -5.0, rtol=REFERENCE)
    assert np.isnan(slopes[1])

    @jax.jit
    def code(first, second, at, at_second):
        """Return the code of a run with two guards, given by their weights, and two events.

        The first event connects the hook. Events after the end of the run do not occur.
        """
        events = [
            svkc.when(Choice(0)),
            svkc.when(Choice(1)),
            svkc.at(at, connect="hook", here=True),
            svkc.at(at_second),
        ]
        return svkc.simulate(
            pendulum,
            pendulum.state({"arm": 1.2}),
            2.0,
            events=events,
            args=(first, second),
            max_events=6,
            **parameters.TIGHT,
        ).derivative

    rest, never = jnp.array([1.0, 0, 0, 0]), 9.0
    jump, turned, clock = (
        jnp.array([0, 1.0, 0, 0]),
        jnp.array([0, 0, 1.0, 0]),
        jnp.array([0, 0, 0, 1.0]),
    )
    assert code(jump, rest, never, never) == svkc.types.DERIVATIVE.jump
    assert code(turned, 2 * turned, never, never) == svkc.types.DERIVATIVE.together
    assert code(rest, rest, 0.5, 0.5) == svkc.types.DERIVATIVE.together
    assert code(clock, rest, 0.5, never) == svkc.types.DERIVATIVE.together
    # a single guard that crosses zero at a finite rate has a derivative
    assert code(clock, rest, never, never) == svkc.types.DERIVATIVE.successful
    # a flat parallelogram, with its bars in line, is singular
    flat = models.parallelogram(middle=False)
    in_line = dict.fromkeys(("leg0", "leg1", "leg2"), np.pi / 2) | {"plate": -np.pi / 2}
    lost = svkc.simulate(flat, flat.state(in_line, {"leg0": 1.0}), 1e-3, throw=False)
    assert lost.derivative == svkc.types.DERIVATIVE.rank_lost
    assert float(lost.phases.margin[0]) < np.sqrt(np.finfo(float).eps)
