"""Function objects created in a loop: functions with equal content share a program, and each call
uses the arrays of its own function."""

import enum
import functools
import gc
import math
import sys
import types

import equinox as eqx
import jax
import jax.numpy as jnp
import models
import numpy as np
import pytest
from tolerances import ROUND_OFF

import svkc
from svkc._jax.function_values import FunctionPytree
from svkc._jax.functions import comparable

DT = {"dt": 0.05, "solver": svkc.integrators.SymplecticEuler(), "max_events": 1, "max_steps": 8}
GAIN, LIST = 1.0, []


@pytest.fixture(scope="module")
def arm():
    chain = svkc.load(models.ARM)
    return chain, chain.state({"arm": 0.3})


@pytest.fixture
def programs(monkeypatch):
    """Return a list with one item for each program of `simulate` that is traced."""
    conversions, module = [], sys.modules["svkc.simulation.simulate"]
    original = module._closure_convert
    monkeypatch.setattr(
        module, "_closure_convert", lambda *args: (conversions.append(0), original(*args))[1]
    )
    return conversions


def end(arm, control=None, **kw):
    chain, state = arm
    return float(svkc.simulate(chain, state, 0.1, control=control, **(DT | kw)).final.q[0])


def fixed_torque(t, state, args):
    return args * jnp.ones_like(state.v)


@pytest.fixture(scope="module")
def expected(arm):
    """Return results for constant torques passed by `args`."""
    return [end(arm, fixed_torque, args=jnp.asarray(gain)) for gain in (1.0, 2.0)]


def static(function):
    """Return the static part of a function; None if it is compared by identity."""
    try:
        return jax.tree.flatten(eqx.filter(comparable(function), eqx.is_array, inverse=True))
    except Exception:
        return None


def same(one, other) -> bool:
    """Return whether two functions share a program."""
    return isinstance(comparable(one), FunctionPytree) and static(one) == static(other)


def torque(gain):
    return lambda t, state, args: gain * jnp.ones_like(state.v)


def nested(gain, scale=1.0):
    def inner(v, by=scale, *, sign=1):
        return sign * gain * by * jnp.ones_like(v)

    return lambda t, state, args: inner(state.v)


def helper():
    return 3 * GAIN


@jax.jit
def wrapped(gain, v):
    return gain * jnp.ones_like(v)


class Opaque:
    def torque(self, t, state, args):
        return jnp.ones_like(state.v)


class Kind(enum.Enum):
    ONE = 1
    TWO = 2


class Pair(eqx.Module):
    gain: jax.Array
    scale: float = eqx.field(static=True, default=1.0)

    def torque(self, t, state, args):
        return self.gain * self.scale * jnp.ones_like(state.v)


def test_equal_content_compares_equal():
    """Static values compare by type and value, integer arrays by content, and floating-point arrays
    are data."""
    small, large, key = np.ones(2), 3 * np.ones(2), jax.random.key(0)
    makers = {
        torque: [
            (small, large),
            (jnp.ones(2), jnp.zeros(2)),
            ({"a": small, "b": [1, 2]}, {"a": large, "b": [1, 2]}),
            (math.nan, math.nan),
        ],
        nested: [
            (small, large),
            (1.5, 1.5),
            ((1, "a", None, b"c"), (1, "a", None, b"c")),
            (slice(1, 2), slice(1, 2)),
            (Kind.ONE, Kind.ONE),
        ],
        lambda x: nested(1, x): [
            (small, large),
            (1.5, 1.5),
            (np.float64(1), np.float64(2)),
            (np.dtype("f4"), np.dtype("f4")),
        ],
        lambda x: functools.partial(fixed_torque, args=x): [(small, large), (2, 2)],
        lambda x: torque(Pair(x)): [(small, large)],
        lambda x: torque(Pair(x).torque): [(small, large)],
        lambda x: torque(eqx.nn.MLP(1, 1, 2, 1, key=x)): [(key, jax.random.key(1))],
        lambda x: torque(
            [
                x,
                jnp.where,
                np.sin,
                math.sin,
                len,
                jax,
                jax.lax.scan,
                jnp.float32,
                jax.nn.relu,
                wrapped,
                svkc.touch,
                jnp.add,
            ]
        ): [(small, large)],
    }
    for make, cases in makers.items():
        for one, other in cases:
            assert same(make(one), make(other)), (make, one)
    different = [
        (1, 1.0),
        (1, True),
        (0.0, -0.0),
        (1j, 2j),
        ([1], [2]),
        ({"a": 1}, {"b": 1}),
        ((1,), [1]),
        (Kind.ONE, Kind.TWO),
        (slice(1), slice(2)),
    ]
    different += [
        ({"a": 1, "b": 2}, {"b": 2, "a": 1}),
        (np.array([1]), np.array([2])),
        (np.array([True]), np.array([False])),
        (jnp.sin, jnp.cos),
    ]
    different += [
        (np.int32(1), np.int64(1)),
        (Pair(small), Pair(small, 2.0)),
        (torque(1), torque(2)),
        (Pair(small), small),
        (None, small),
    ]
    for one, other in different:
        assert not same(torque(one), torque(other)), (one, other)
    assert same(torque(np.array([1])), torque(np.array([1])))
    assert not same(torque(1.0), nested(1.0))
    assert same(torque({"b": small, "a": large}), torque({"b": large, "a": small}))
    module = eqx.nn.MLP(1, 1, 2, 1, key=key)
    for thing in (module, jnp.sin, wrapped, svkc.touch, None, 1.0):
        assert comparable(thing) is thing


def test_functions_compared_by_identity():
    """One incomparable value makes the function incomparable."""

    def writes():
        nonlocal assigned
        assigned = 1

    def deletes():
        global GAIN
        del GAIN

    def imports():
        import models as m

        return m.Y

    def recursive(n):
        return recursive(n - 1)

    def attributed():
        return attributed_too

    attributed.count, attributed_too, loop = 1, 2, [1]
    loop.append(loop)
    inside = [
        Opaque(),
        Opaque,
        Opaque().torque,
        models,
        iter([1]),
        {1},
        [].append,
        loop,
        np.array([None]),
        jax.jit(lambda x: x),
        np.ma.ones(2),
    ]
    unhashable = Pair(jnp.ones(1), scale=[1])
    for function in (
        writes,
        deletes,
        imports,
        recursive,
        attributed,
        Opaque().torque,
        torque(recursive),
        *map(torque, (*inside, unhashable)),
    ):
        assert static(function) is None, function
    assigned = 1

    def inner():
        def own():
            nonlocal mine
            mine = 2

        mine = 1
        own()
        return mine

    assert comparable(inner)() == 2


def test_globals_of_libraries_are_static():
    """Globals count that the code names, also through other functions; a function object keeps its
    first static part."""
    global GAIN, LIST
    read = lambda: [static(f) for f in (lambda: GAIN * 2, lambda: helper(), lambda: LIST[0] + 1)]
    first, kept = read(), lambda: GAIN + 1
    before = static(kept)
    assert read() == first
    GAIN = 2.0
    assert [a == b for a, b in zip(first, read(), strict=True)] == [False, False, True]
    assert static(kept) == before
    GAIN, LIST = 1.0, [3]
    assert [a == b for a, b in zip(first, read(), strict=True)] == [True, True, False]
    GAIN = np.ones(2)
    second, GAIN = comparable(lambda: helper()), np.full(2, 2.0)
    third = comparable(lambda: helper())
    np.testing.assert_array_equal(second(), 3 * np.ones(2))
    np.testing.assert_array_equal(third(), 6 * np.ones(2))
    GAIN, LIST = {"b": np.ones(1), "a": np.ones(1)}, []
    assert list(comparable(lambda: GAIN)()) == ["b", "a"]
    GAIN = 1.0
    many = {f"f{i}": 0 for i in range(60)}
    for i in range(60):
        code = f"def f{i}(x):\n    return " + (f"f{i - 1}(x) + f{i - 2}(x)" if i > 1 else "x")
        exec(code, many)
    assert comparable(types.FunctionType(many["f9"].__code__, many))(1) == 55
    assert same(many["f59"], many["f59"])


@pytest.mark.slow
def test_a_loop_compiles_once(arm, expected, programs):
    """Arrays may be in any container; each run uses the arrays of its own function."""
    module = lambda pair: lambda t, state, args: pair.torque(t, state, args)
    holds = [
        nested,
        lambda g: functools.partial(lambda g, t, s, a: g * jnp.ones_like(s.v), g),
        lambda g: module(Pair(g)),
    ]
    for hold in holds:
        for kind in (np.asarray, jnp.asarray):
            assert [end(arm, hold(kind([gain]))) for gain in (1.0, 2.0)] == expected
    assert len(programs) == 3
    assert [end(arm, torque(gain)) for gain in (1.0, 2.0, 1.0)] == [*expected, expected[0]]
    assert len(programs) == 5


@pytest.mark.slow
def test_a_global_that_changes(arm, expected, programs):
    """A changed number is another program, a changed array is not."""
    global GAIN
    ends = []
    for gain in (1.0, 2.0, np.asarray([1.0]), np.asarray([2.0])):
        GAIN = gain
        ends.append(end(arm, lambda t, state, args: helper() / 3 * jnp.ones_like(state.v)))
    GAIN = 1.0
    np.testing.assert_allclose(ends, expected * 2, rtol=1e-15)
    assert len(programs) == 3


def test_a_list_that_counts(arm, expected, programs):
    """The function writes to the original list, and stays one program."""
    traces = []
    control = lambda t, state, args: (traces.append(0), jnp.ones_like(state.v))[1]
    assert [end(arm, control), end(arm, control)] == expected[:1] * 2
    assert len(traces) == len(programs) == 1


def test_arrays_whose_values_python_reads_are_static(arm, expected, programs):
    """Each value has its own program, and later calls find the program; other errors are raised
    unchanged."""
    conditional = lambda gain: (
        lambda t, s, a: float(np.linalg.norm(gain)) * jnp.ones_like(s.v) if gain[0] > 0 else None
    )
    assert [end(arm, conditional(np.asarray([gain]))) for gain in (1.0, 2.0, 2.0)] == [
        *expected,
        expected[1],
    ]
    # the first was tried with the array as data
    assert len(programs) == 3
    with pytest.raises(ZeroDivisionError):
        end(arm, (lambda gain: lambda t, s, a: gain * s.v / (1 // 0))(np.ones(1)))
    with pytest.raises(jax.errors.TracerBoolConversionError):
        end(arm, lambda t, s, a: s.v if s.v[0] > 0 else -s.v)
    assert len(programs) == 5


def test_guards(arm, programs):
    """The time at which the angle reaches a level, from one program."""
    chain, state = arm

    def time(level):
        return float(
            svkc.simulate(
                chain,
                state,
                0.5,
                events=[svkc.when(lambda t, state, args: state.q[0] - level, stop=True)],
                **DT,
            ).t_final
        )

    assert time(np.asarray(0.25)) < time(np.asarray(0.2)) < time(np.asarray(0.1)) < 0.5
    assert len(programs) == 1


@pytest.mark.slow
def test_rollout(arm, programs):
    """A lambda in the call shares a program."""
    chain, state = arm
    starts = jax.tree.map(lambda x: jnp.stack([x] * 3), state)

    def run(gain):
        guard = svkc.when(lambda t, state, args: state.q[0] - gain, stop=True)
        lane, control = (
            lambda chain, x: {"args": x},
            lambda t, state, args: args * gain * jnp.ones_like(state.v),
        )
        return svkc.rollout(
            chain,
            starts,
            0.1,
            data=jnp.arange(3.0),
            lane=lane,
            control=control,
            events=guard,
            progress=False,
            **DT,
        ).final.q[:, 0]

    first, count = run(np.asarray(5.0)), len(programs)
    assert np.all(np.diff(run(np.asarray(6.0)) - first) > 0)
    assert len(programs) == count > 0


@pytest.mark.slow
def test_incomparable_functions_warn_when_compiled_again(arm):
    """One warning after the second compilation, with the name of the argument."""

    def run(**kw):
        thing = Opaque()
        return end(arm, lambda t, state, args: thing.torque(t, state, args), **kw)

    run()
    warned = (
        r"^control: a new function object .* is compiled again; an object of type Opaque cannot be"
        r" compared. Define it outside the loop.$"
    )
    with pytest.warns(UserWarning, match=warned):
        run()
    run()
    # the same object stays what it is
    thing = Opaque()
    kept = lambda t, state, args: thing.torque(t, state, args)
    assert end(arm, kept) == end(arm, kept)


@pytest.mark.slow
def test_derivatives_and_lanes(arm):
    """Derivatives by closed-over arrays, and batches, equal differences of runs that pass the
    arrays by `args`."""
    chain, state = arm
    closed = lambda gain: svkc.simulate(
        chain, state, 0.1, control=lambda t, s, a: gain**2 * jnp.ones_like(s.v), **DT
    ).final.q[0]
    gains, step = np.array([1.5, 3.0]), 1e-4
    values, slopes = jax.vmap(jax.value_and_grad(closed))(jnp.asarray(gains))
    by_args = lambda gains: np.array(
        [end(arm, fixed_torque, args=jnp.asarray(gain**2)) for gain in gains]
    )
    np.testing.assert_allclose(values, by_args(gains), rtol=ROUND_OFF)
    np.testing.assert_allclose(
        slopes, (by_args(gains + step) - by_args(gains - step)) / (2 * step), rtol=1e-7
    )


@pytest.mark.slow
def test_no_tracer_or_function_is_leaked():
    """Static parts hold no tracer, and deleted functions leave the table of static parts."""
    programs, tracers, gone = [], [], []

    def traced(x):
        for make in (
            torque,
            lambda x: torque({"a": [x]}),
            nested,
            lambda x: functools.partial(fixed_torque, args=x),
            lambda x: torque(Pair(x)),
        ):
            assert [
                y is x for y in jax.tree.leaves(eqx.filter(comparable(make(x)), eqx.is_array))
            ] == [True]
            programs.append(static(make(x)))
        tracers.append(x)
        return x

    jax.jit(traced)(1.0)
    visited, todo = set(), list(programs)
    while todo:
        x = todo.pop()
        if id(x) in visited or isinstance(x, types.ModuleType | type) or x is globals():
            continue
        visited.add(id(x))
        assert x is not tracers[0]
        todo += gc.get_referents(x)
    notes = sys.modules["svkc._jax.functions"]._first_static
    before = len(notes)
    for gain in (1.0, np.ones(1)):
        gone.append(torque(gain))
        comparable(gone[-1])
    assert len(notes) == before + 2
    gone.clear()
    assert len(notes) == before
