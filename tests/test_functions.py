"""Functions made anew by a loop: programs are shared where the functions can be compared, and results are those of each function."""

import functools
import gc
import types

import equinox as eqx
import jax
import jax.numpy as jnp
import models
import numpy as np
import pytest

import svkc
from svkc.functions import Function, comparable

# one program for all tests that count: whatever is traced once more is the function's doing
DT = {"dt": 0.05, "solver": svkc.SemiImplicitEuler(), "max_events": 1}
GAIN, LIST, SPACE = 1.0, [], types.SimpleNamespace(gain=1.0)


@pytest.fixture(scope="module")
def arm():
    chain = svkc.load(models.MJCF.format(models.bar("arm", models.Y, "0 0 -1")))
    return chain, chain.state({"arm": 0.3})


def end(arm, control=None, **kw):
    chain, state = arm
    return float(svkc.simulate(chain, state, 0.1, control=control, **(DT | kw)).final.q[0])


def turned(arm, gain):
    """What a constant torque gives."""
    return end(arm, fixed_torque, args=jnp.asarray(gain, jnp.float64))


def fixed_torque(t, state, args):
    return args * jnp.ones_like(state.v)


def same(one, other) -> bool:
    """Whether both are one program."""
    one, other = comparable(one), comparable(other)
    return isinstance(one, Function) and one.recipe == other.recipe


def torque(gain):
    return lambda t, state, args: gain * jnp.ones_like(state.v)


class Controller:
    def __init__(self, gain):
        self.gain = gain

    def torque(self, t, state, args):
        return self.gain * jnp.ones_like(state.v)

    def __call__(self, t, state, args):
        return self.torque(t, state, args)


class Opaque:
    """Says nothing of what it holds."""

    def __reduce__(self):
        raise TypeError


def falling(gain, depth):
    def fall(n):
        return gain if n == 0 else 2 * fall(n - 1)

    return lambda t, state, args: fall(depth) * jnp.ones_like(state.v)


def nested(gain, scale):
    def inner(v, by=scale):
        return gain * by * jnp.ones_like(v)

    return lambda t, state, args: inner(state.v)


def test_what_is_compared():
    """By type and value, arrays of floats not at all, those of whole numbers by content."""
    small, large = np.float64(1.0) * np.ones(2), 3 * np.ones(2)
    makers = {
        torque: [(small, large), (jnp.ones(2), jnp.zeros(2)), ({"a": small, "b": [1, 2]}, {"a": large, "b": [1, 2]}), (float("nan"), float("nan"))],
        Controller: [(small, large), (1.0, 1.0)],
        lambda x: Controller(x).torque: [(small, large), ("a", "a")],
        lambda x: functools.partial(fixed_torque, args=x): [(small, large), (2, 2)],
        lambda x: falling(x, 2): [(small, large)],
        lambda x: nested(x, 3.0): [(small, large)],
        lambda x: nested(1, x): [(small, large), (1.5, 1.5)],
        lambda x: jax.vmap(torque(x)): [(small, large)],
    }
    for make, cases in makers.items():
        for one, other in cases:
            assert same(make(one), make(other)), (make, one)
    for one, other in [(1, 1.0), (1, True), (0.0, -0.0), (1j, 2j), (np.float32(1), np.float64(1)), ([1], [2]), ({"a": 1}, {"b": 1}), ((1,), [1]), ({1}, {2})]:
        assert not same(torque(one), torque(other)), (one, other)
    for one, other in [(small, np.ones(3)), (np.array([1]), np.array([2])), (np.array([True]), np.array([False])), (np.ones(1, int), np.ones(1, np.int32))]:
        assert same(torque(one), torque(other)) == (one is small)
        assert same(torque(one), torque(one.copy()))
    functions = [(jnp.sin, jnp.cos), (np.sin, np.cos), (torque, nested), (torque(1.0), torque(2.0))]
    for one, other in [*functions, (Controller(1), Controller(2)), (Opaque(), Opaque())]:
        assert not same(torque(one), torque(other))
    assert not same(falling(1.0, 2), falling(1.0, 3))
    assert not same(functools.partial(fixed_torque, args=1), functools.partial(fixed_torque, args=2))
    opaque = Controller(Opaque())
    assert same(opaque.torque, opaque.torque)
    module = eqx.nn.MLP(1, 1, 2, 1, key=jax.random.key(0))
    assert comparable(module) is module
    assert comparable(jax.jit(fixed_torque)).__class__ is not Function


def test_what_globals_are():
    """Of the module those that the code reads, also through other functions, classes and changing things."""
    global GAIN, LIST

    def read():
        return [comparable(f).recipe for f in (lambda: GAIN * 2, lambda: helper(), lambda: SPACE.gain, lambda: LIST[0] + 1, lambda: Settings().gain)]

    first = read()
    assert read() == first
    GAIN = 2.0
    assert [a == b for a, b in zip(first, read(), strict=True)] == [False, False, True, True, True]
    GAIN, SPACE.gain, Settings.gain, LIST = 1.0, 2.0, 2.0, [3]
    assert [a == b for a, b in zip(first, read(), strict=True)] == [True, True, False, False, False]
    GAIN = np.ones(2)
    second, made = comparable(lambda: helper()), np.full(2, 2.0)
    GAIN = made
    third = comparable(lambda: helper())
    np.testing.assert_array_equal(third(), 6 * np.ones(2))
    np.testing.assert_array_equal(second(), 3 * np.ones(2))
    GAIN = 1.0


class Settings:
    gain = 1.0


def helper():
    return 3 * GAIN


def test_a_loop_compiles_once(arm):
    """Whatever holds the arrays; each run is that of its own ones."""
    expected = [turned(arm, gain) for gain in (1.0, 2.0)]
    traces = []

    def counted(hold):
        def made(gain):
            held = hold(gain)

            def control(t, state, args):
                traces.append(0)
                return held(t, state, args)

            return control

        return made

    holds = [torque, nested, falling, lambda g: Controller(g).torque, lambda g: functools.partial(lambda g, t, s, a: g * jnp.ones_like(s.v), g)]
    holds[1:3] = [lambda g: nested(g, 1.0), lambda g: falling(g, 0)]
    for hold in holds:
        make = counted(hold)
        for kind in (np.asarray, jnp.asarray):
            assert [end(arm, make(kind([gain]))) for gain in (1.0, 2.0)] == expected
    assert len(traces) == len(holds)
    numbers = counted(torque)
    assert [end(arm, numbers(gain)) for gain in (1.0, 2.0, 1.0)] == [*expected, expected[0]]
    assert len(traces) == len(holds) + 2


def test_a_global_that_changes(arm):
    """A number: another program; an array: the same one."""
    global GAIN
    expected, traces, found = [turned(arm, gain) for gain in (1.0, 2.0)], [], []
    for gain in (1.0, 2.0, np.asarray([1.0]), np.asarray([2.0])):
        GAIN = gain
        found.append(end(arm, lambda t, state, args: (traces.append(0), helper() / 3 * jnp.ones_like(state.v))[1]))
    GAIN = 1.0
    assert found == expected * 2
    assert len(traces) == 3


def test_arrays_that_python_looks_at(arm):
    """As sizes, in conditions, by numpy: each value has its own program, the right one, and the next goes there at once."""
    expected, traces = [turned(arm, gain) for gain in (1.0, 2.0)], []

    def conditional(gain):
        def control(t, state, args):
            traces.append(0)
            return float(np.linalg.norm(gain)) * jnp.ones_like(state.v) if gain[0] > 0 else None

        return control

    assert [end(arm, conditional(np.asarray([gain]))) for gain in (1.0, 2.0, 2.0)] == [*expected, expected[1]]
    # the first was tried with the array as data
    assert len(traces) == 3
    index = lambda which: lambda t, state, args: float(sum(range(which[0] + 1))) * jnp.ones_like(state.v)
    assert end(arm, index(np.array([1]))) == expected[0]
    assert not same(index(np.array([1])), index(np.array([2])))

    def wrong(gain):
        def control(t, state, args):
            traces.append(0)
            return gain * state.v / (1 // 0)

        return control

    for tries in (5, 7):
        # an error of its own is told as it is, and nothing is remembered
        with pytest.raises(ZeroDivisionError):
            end(arm, wrong(np.ones(1)))
        assert len(traces) == tries


def test_guards(arm):
    """The time at which the angle reaches a level, from one program."""
    chain, state = arm
    traces = []

    def time(level):
        guard = lambda t, state, args: (traces.append(0), state.q[0] - level)[1]
        return float(svkc.simulate(chain, state, 0.5, events=[svkc.when(guard, stop=True)], **DT).t_final)

    first, seen = time(np.asarray(0.25)), len(traces)
    assert first < time(np.asarray(0.2)) < time(np.asarray(0.1)) < 0.5
    assert len(traces) == seen


def test_rollout(arm):
    """A lambda in the call itself."""
    chain, state = arm
    traces, starts = [], jax.tree.map(lambda x: jnp.stack([x] * 3), state)

    def run(gain):
        control = lambda t, state, args: (traces.append("control"), args * gain * jnp.ones_like(state.v))[1]
        lane = lambda chain, x: (traces.append("lane"), {"args": x})[1]
        guard = lambda t, state, args: (traces.append("guard"), state.q[0] - gain)[1]
        options = {"events": [svkc.when(guard, stop=True)], "progress": False, **DT}
        return svkc.rollout(chain, starts, 0.1, data=jnp.arange(3.0), lane=lane, control=control, **options).final.q[:, 0]

    first, seen = run(np.asarray(5.0)), len(traces)
    assert set(traces) == {"control", "lane", "guard"}
    assert np.all(np.diff(run(np.asarray(6.0)) - first) > 0)
    assert len(traces) == seen


def test_things_that_cannot_be_compared(arm):
    """A warning after the second compilation, once, and by the argument's name."""

    def run(**kw):
        thing = Opaque()
        control = lambda t, state, args: (thing, jnp.ones_like(state.v))[1]
        return end(arm, control, **kw)

    run()
    # more steps: a program for a good reason
    run(max_steps=7)
    with pytest.warns(UserWarning, match=r"^control: a new function object .* for an object of type Opaque in it cannot be compared; define it outside"):
        run()
    run()
    chain, state = arm

    def roll():
        thing, seen = jax.jit(lambda x: x), 0

        def lane(chain, x):
            nonlocal seen
            seen += 1
            return {"args": thing(x)}

        svkc.rollout(chain, jax.tree.map(lambda x: x[None], state), 0.1, data=jnp.ones(1), lane=lane, control=fixed_torque, progress=False, **DT)
        return seen

    assert roll() > 0
    with pytest.warns(UserWarning, match="^lane: a new function object with the same code"):
        roll()
    thing = Opaque()
    kept = lambda t, state, args: (thing, jnp.ones_like(state.v))[1]
    assert end(arm, kept) == end(arm, kept)


def test_derivatives_and_lanes(arm):
    """By what is closed over as by args, forwards, backwards and in lanes; no tracer stays behind."""
    chain, state = arm
    closed = lambda gain: svkc.simulate(chain, state, 0.1, control=lambda t, s, a: gain**2 * jnp.ones_like(s.v), **DT).final.q[0]
    told = lambda gain: svkc.simulate(chain, state, 0.1, control=lambda t, s, a: a**2 * jnp.ones_like(s.v), args=gain, **DT).final.q[0]
    at = jnp.asarray(1.5)
    slope = jax.grad(told)(at)
    np.testing.assert_allclose(jax.grad(closed)(at), slope, rtol=1e-12)
    lanes, slopes = jax.vmap(lambda x: jax.jvp(closed, (x,), (jnp.ones_like(x),)))(jnp.stack([at, 2 * at]))
    np.testing.assert_allclose(lanes, [told(at), told(2 * at)], rtol=1e-12)
    np.testing.assert_allclose(slopes[0], slope, rtol=1e-12)


def test_no_tracer_stays():
    """What programs are found by holds none, whatever held it."""
    found = []

    def traced(x):
        for make in (torque, Controller, lambda x: torque({"a": [x]}), lambda x: falling(x, 2), lambda x: functools.partial(fixed_torque, args=x)):
            made = comparable(make(x))
            assert [y is x for y in made.arrays] == [True]
            found.append(made.recipe)
        tracers.append(x)
        return x

    tracers = []
    jax.jit(traced)(1.0)
    seen, todo = set(), [x for recipe in found for x in (recipe.key, recipe.make)]
    while todo:
        x = todo.pop()
        if id(x) in seen or isinstance(x, types.ModuleType | type) or x is globals():
            continue
        seen.add(id(x))
        assert x is not tracers[0]
        todo += gc.get_referents(x)
