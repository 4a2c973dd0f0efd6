"""Derivatives through every change of structure: against differences, against closed forms, at the
hard points."""

import derivatives
import jax
import jax.numpy as jnp
import models
import numpy as np
import parameters
import pytest
from compile import count_instructions
from tolerances import DIFFERENCE, REFERENCE, ROUND_OFF

import svkc

BUDGET = 42500


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [*derivatives.ALGEBRAIC, "pendulum_cut", "breaking", "four_bar_turning"]
)
def test_against_differences(name):
    """Both modes, along a random direction of each parameter; forward and reverse to 1e-10.
    Figures: examples 05 and 06, and
    `python tests/derivatives.py`."""
    f, x, limit = derivatives.CASES[name]()
    found = svkc.check_grad(f, x, directions=1, step=0.1 if name in derivatives.ALGEBRAIC else 0.05)
    assert found.error <= limit, found
    assert found.modes <= 1e-10, found


def test_a_release_against_differences():
    """A rod comes off its pivot at an angle and flies: the gradient of where and how fast it ends
    and of the time, along a direction in which all change.

    It is one program, whose size is that of a gradient through a change of structure.
    """
    chain = svkc.load(models.MJCF.format(models.bar("rod", models.Y, "0.2 0 -1")), cuttable="rod")
    state = chain.state({"rod": 1.2}, {"rod": 0.5})

    def loss(x):
        events = [svkc.when(lambda t, s, args: svkc.poses(chain, s)[1][1, 2] - args, cut="rod")]
        start = svkc.State(state.q, x["speed"] * state.v, state.structure)
        c = parameters.changed(chain, x)
        traj = svkc.simulate(
            c,
            start,
            0.6,
            events=events,
            args=x["sine"],
            max_events=1,
            adjoint=svkc.integrators.Replay(),
            **parameters.TIGHT,
        )
        # (without the event its time is infinite, and so is this)
        return traj.events.time[0] + jnp.sum(jnp.sin(traj.final.q)) + jnp.sum(traj.final.v**2) / 10

    x = {"sine": jnp.asarray(0.3), "speed": jnp.asarray(1.0)} | parameters.heavier(chain)
    rng = np.random.default_rng(0)
    way = {name: jnp.asarray(rng.normal(size=leaf.shape)) for name, leaf in x.items()}

    @jax.jit
    def program(part, along):
        value, slope = jax.value_and_grad(loss)(
            {name: leaf + part["part"] * way[name] for name, leaf in x.items()}
        )
        return value, along["part"] * sum(jnp.vdot(slope[name], way[name]) for name in x)

    part = {"part": jnp.asarray(0.0)}
    lowered = program.lower(part, part)
    # 10 % above what was counted with jax 0.10.1
    assert count_instructions(lowered.compiler_ir("hlo").as_hlo_text()) <= BUDGET
    assert parameters.worst(lowered.compile(), part) <= derivatives.RUN


def both_ways(f):
    """The value, the Jacobian forwards, from whose program the value is, and the Jacobian
    backwards."""

    def given(x):
        forward, value = jax.jacfwd(lambda x: (f(x),) * 2, has_aux=True)(x)
        return value, forward, jax.jacrev(f)(x)

    return jax.jit(given)


BALL = (
    '<body name="{0}" pos="{1}"><joint name="{0}" type="slide" axis="1 0 0"/><geom type="sphere"'
    ' size="0.05" mass="{2}" contype="0"/></body>'
)


@pytest.fixture(scope="module")
def balls():
    """Two balls on a line, which a weld may join."""
    weld = svkc.VirtualLink("weld", "a", "b", "weld")
    return svkc.load(
        models.MJCF.format(BALL.format("a", "0 0 0", 1) + BALL.format("b", "1 0 0", 2)).replace(
            "0.3 -0.2 -9.81", "0 0 0"
        ),
        virtual_links=[weld],
    )


def meeting(chain, x):
    """Balls at x[:2] with velocities x[2:] until their centres meet."""
    state = svkc.State(x[:2], x[2:], chain.state(connected=()).structure)
    met = lambda t, s, args: s.q[1] + 1.0 - s.q[0]
    return state, met


@pytest.mark.slow
def test_a_catch_with_a_closed_form(balls):
    """They meet at T = gap / closing speed and go on together: where and when, and every
    derivative, as the formula says."""
    start = jnp.array([0.1, 0.2, 1.0, -0.5])

    def simulated(x):
        state, met = meeting(balls, x)
        traj = svkc.simulate(
            balls,
            state,
            2.0,
            events=[svkc.when(met, connect="weld", here=True)],
            **parameters.TIGHT,
        )
        return jnp.array([traj.final.q[0], traj.events.time[0], traj.events.energy_lost[0]])

    def formula(x):
        gap, closing = 1 + x[1] - x[0], x[2] - x[3]
        time = gap / closing
        together = (x[2] + 2 * x[3]) / 3
        return jnp.array([x[0] + x[2] * time + together * (2.0 - time), time, closing**2 / 3])

    value, *jacobians = both_ways(simulated)(start)
    np.testing.assert_allclose(value, formula(start), atol=1e-11)
    for jacobian in jacobians:
        np.testing.assert_allclose(jacobian, jax.jacfwd(formula)(start), atol=1e-10)


@pytest.mark.slow
def test_a_collision_that_swaps_velocities(balls):
    """Equal balls, elastic: the exact Jacobian is a permutation. Two runs, the second from the time
    and state where the first one's guard stopped it."""
    start = jnp.array([0.1, 0.2, 1.0, -0.5])

    def bounced(x):
        state, met = meeting(balls, x)
        first = svkc.simulate(
            balls, state, 2.0, events=[svkc.when(met, stop=True)], **parameters.TIGHT
        )
        swapped = svkc.State(first.final.q, first.final.v[::-1], first.final.structure)
        return svkc.simulate(balls, swapped, 2.0, t0=first.t_final, **parameters.TIGHT).final.q

    for jacobian in both_ways(bounced)(start)[1:]:
        np.testing.assert_allclose(jacobian, np.array([[0, 1, 0, 2], [1, 0, 2, 0]]), atol=REFERENCE)


@pytest.mark.slow
def test_times_that_coincide(balls):
    """t0 and its save time, an event and its save time, t1 and its save time, an event at t0: each
    of them is to be differentiated by alone, twice too."""

    def simulated(x):
        state, _ = meeting(balls, jnp.concatenate([jnp.zeros(2), x["v"]]))
        events = [svkc.at(x["event"], connect="weld", here=True)]
        traj = svkc.simulate(
            balls, state, x["t1"], t0=x["t0"], ts=x["ts"], events=events, **parameters.TIGHT
        )
        return jnp.append(traj.states.q[:, 0], traj.final.q[0])

    def formula(x):
        together = (x["v"][0] + 2 * x["v"][1]) / 3
        before = lambda t: x["v"][0] * (t - x["t0"])
        after = lambda t: before(x["event"]) + together * (t - x["event"])
        return jnp.stack([before(x["ts"][0]), after(x["ts"][1]), after(x["ts"][2]), after(x["t1"])])

    twice = lambda f: jax.jit(
        lambda x: jax.jvp(
            jax.grad(lambda x: jnp.sum(f(x) ** 2)), (x,), (jax.tree.map(jnp.cos, x),)
        )[1]
    )
    twice_simulated = twice(simulated)
    both = both_ways(simulated)
    for event in (0.5, 0.0):
        x = {
            "v": jnp.array([1.0, -0.5]),
            "t0": jnp.zeros(()),
            "event": jnp.asarray(event),
            "t1": jnp.asarray(2.0),
            "ts": jnp.array([0.0, 0.5, 2.0]),
        }
        if event == 0.0:
            # what is saved at the time of an event is the state after it
            x["ts"] = jnp.array([0.1, 0.5, 2.0])
            formula_here = lambda x: (
                formula(x)
                .at[0]
                .set(formula(x)[1] + (x["v"][0] + 2 * x["v"][1]) / 3 * (x["ts"][0] - x["ts"][1]))
            )
        else:
            formula_here = formula
        value, forward, backward = both(x)
        np.testing.assert_allclose(value, formula_here(x), atol=ROUND_OFF)
        for mode in (forward, backward):
            jax.tree.map(
                lambda got, want: np.testing.assert_allclose(got, want, atol=1e-10),
                mode,
                jax.jacfwd(formula_here)(x),
            )
        jax.tree.map(
            lambda got, want: np.testing.assert_allclose(got, want, atol=REFERENCE),
            twice_simulated(x),
            twice(formula_here)(x),
        )


@pytest.mark.slow
def test_nothing_is_not_a_number():
    """Zero velocity, identity rotations, a link of no length, an empty slot, a locked joint: every
    derivative is a number, in both modes."""
    rods = models.bar(
        "base", 'type="ball"', "0 0 -0.5", inside=models.bar("fore", models.Y, "0 0 -0.3", "0 0 0")
    )
    chain = svkc.load(
        models.MJCF.format(rods),
        virtual_links=[svkc.VirtualLink("hook", "world", "fore", "ball", pos=(0, 0, -0.3))],
        spare=1,
    )
    state = chain.state()

    def everything(x):
        c = parameters.changed(chain, x)
        s = svkc.lock(c, svkc.State(x["q"], x["v"], state.structure), "fore")
        traj = svkc.simulate(
            c,
            s,
            0.1,
            events=[svkc.at(x["time"], connect="hook", here=True), svkc.at(0.07, unlock="fore")],
            dt=0.02,
        )
        return parameters.motion(traj) | {
            "forces": svkc.loop_forces(c, traj.final, jnp.zeros(chain.dofs)).force,
            "gap": traj.gaps,
        }

    x = {"q": state.q, "v": state.v, "time": jnp.asarray(0.05)} | parameters.model(
        chain, "mass", "inertia", "com", "pos", "gravity"
    )
    total = lambda x: sum(jnp.sum(leaf) for leaf in jax.tree.leaves(everything(x)))
    backwards = jax.grad(total)(x)
    forwards = jax.jvp(total, (x,), (jax.tree.map(jnp.ones_like, x),))[1]
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(backwards))
    np.testing.assert_allclose(
        sum(float(jnp.sum(leaf)) for leaf in jax.tree.leaves(backwards)), forwards, rtol=REFERENCE
    )


def test_gradients_in_the_tangent():
    """Of a ball's quaternion: along integrate(q, dv), three numbers; steps along it keep unit
    length and go downhill."""
    chain = svkc.load(models.MJCF.format(models.bar("arm", 'type="ball"', "0.3 0.2 -1")))
    state = chain.state()

    def height(q):
        return svkc.potential_energy(chain, svkc.State(q, state.v, state.structure))

    slope = svkc.tangent_gradient(chain, state.q, jax.grad(height)(state.q))
    assert slope.shape == (3,)
    found = svkc.check_grad(
        lambda dv: height(svkc.integrate(chain, state.q, dv)), jnp.zeros(3), step=0.2
    )
    assert found.error <= 1e-8, found
    np.testing.assert_allclose(
        jax.grad(lambda dv: height(svkc.integrate(chain, state.q, dv)))(jnp.zeros(3)),
        slope,
        atol=ROUND_OFF,
    )
    lower = svkc.integrate(chain, state.q, -0.01 * slope)
    assert float(height(lower)) < float(height(state.q))
    assert abs(float(jnp.linalg.norm(lower)) - 1) < 1e-14


def test_the_check_finds_what_is_wrong():
    """A wrong derivative is named by both paths."""

    @jax.custom_jvp
    def wrong(x):
        return x**2

    wrong.defjvp(lambda p, t: (p[0] ** 2, 2.1 * p[0] * t[0]))
    found = svkc.check_grad(
        lambda x: {"good": x["a"] * x["b"], "bad": wrong(x["b"])},
        {"a": jnp.arange(3.0), "b": jnp.ones(3), "count": 4},
    )
    assert found.error == pytest.approx(0.1 / 2.1, rel=DIFFERENCE)
    assert "bad" in found.output
    assert "'b'" in found.input
    for part in ("bad", "'b'", "by differentiation"):
        assert part in str(found)
    assert svkc.check_grad(jnp.sin, 1.0).error < REFERENCE
    # a derivative that is no number is as wrong as can be
    found = svkc.check_grad(
        lambda x: {"a": x, "root": jnp.where(x > 0, jnp.sqrt(x), x)}, jnp.zeros(())
    )
    assert found.modes == np.inf
