"""Random arguments of runs, rollouts and files. Most calls are only traced."""

import functools
import math
import sys

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fuzzing import (
    RAISED,
    all_finite,
    anything,
    defects,
    examples,
    or_anything,
    outcome,
    prepared_scenes,  # noqa: F401 (a fixture)
    scenes,
    some_of,
    vectors,
    with_defect,
)
from hypothesis import given as over_examples, strategies as st

import svkc

pytestmark = pytest.mark.slow


class RunStarted(Exception):
    """Raised in place of a run, after the arguments have been accepted."""


@pytest.fixture
def only_traced(monkeypatch):
    """Trace runs for their shapes instead of compiling them."""
    trace = functools.partial(
        eqx.filter_eval_shape, sys.modules["svkc.simulation.simulate"]._run.__wrapped__
    )

    def run(*args):
        trace(*args)
        raise RunStarted

    monkeypatch.setattr(sys.modules["svkc.simulation.simulate"], "_run", run)
    rollout = sys.modules["svkc.tools.rollout"]
    monkeypatch.setattr(
        rollout,
        "_run_chunk",
        functools.partial(eqx.filter_eval_shape, rollout._run_chunk.__wrapped__),
    )


RETURN_VALUES = [
    None,
    3,
    1.0,
    "a",
    1j,
    math.nan,
    [0.0] * 4,
    (0, 0, 0),
    np.zeros(4),
    np.zeros(3),
    np.zeros(9),
    np.zeros((4, 1)),
    np.zeros(4, bool),
    {},
    np.float32(1),
    jnp.zeros(()),
    jnp.ones(1),
]
functions = st.sampled_from(RETURN_VALUES).map(lambda value: lambda t, state, args: value)
good_guard = st.just(lambda t, state, args: state.q[0] + t)
link_names = or_anything(st.sampled_from(["pin", "spare_0", ("pin", "spare_0"), ["pin"], ()]), 6)
grips = st.builds(
    lambda options: outcome(lambda: svkc.Grip(**({"parent": "world", "real": "rocker"} | options))),
    some_of(
        parent=or_anything(st.just("crank")),
        joint=or_anything(st.just("ball")),
        axis=or_anything(vectors(3)),
        real_pos=or_anything(vectors(3)),
        slot=or_anything(st.just("spare_0")),
    ),
)
actions = some_of(
    connect=link_names,
    cut=link_names,
    lock=or_anything(st.just("crank")),
    unlock=or_anything(st.just("crank")),
    here=or_anything(st.booleans()),
    stop=or_anything(st.booleans(), 6),
    bind=or_anything(st.lists(grips, max_size=1), 6),
    unbind=or_anything(st.sampled_from(["spare_0", ("world", "rocker")])),
)


@st.composite
def events(draw):
    """Draw an event, or RAISED."""
    options = draw(actions)
    if draw(st.booleans()):
        time = draw(or_anything(st.sampled_from([0.0, 0.5, jnp.asarray(0.5)])))
        return outcome(lambda: svkc.at(time, **options))
    guard = draw(st.one_of(good_guard, good_guard, functions, anything, sensors()))
    direction = draw(or_anything(st.sampled_from([None, True, np.False_])))
    return outcome(lambda: svkc.when(guard, direction=direction, **options))


@st.composite
def sensors(draw):
    """Draw one of svkc's guards, or RAISED."""
    chain, _ = scenes()["spare"]
    link = draw(or_anything(st.just("pin"), 6))
    number = or_anything(st.floats(0.1, 1))
    call = draw(
        st.sampled_from(
            [
                lambda: svkc.touch(
                    chain,
                    link,
                    **draw(
                        some_of(distance=number, axes=or_anything(st.sampled_from(["xy", "z"])))
                    ),
                ),
                lambda: svkc.leaves(chain, link, **draw(some_of(axis=or_anything(vectors(3))))),
                lambda: svkc.overload(chain, link, **draw(some_of(force=number, torque=number))),
            ]
        )
    )
    return outcome(call)


def built_by_one_of(*makers):
    """Return a strategy of the results of these functions, which a test calls."""
    return or_anything(st.sampled_from(makers).map(outcome))


times = st.sampled_from([0.0, 0.5, 1.0, 1, np.float32(0.5), jnp.asarray(0.5)])
SIMULATE_OPTIONS = dict(
    t0=or_anything(st.sampled_from([0.0, -1.0, 0])),
    ts=or_anything(st.sampled_from([[0.0, 0.5], jnp.linspace(0, 0.5, 3), (0,), np.zeros((1, 1))])),
    events=or_anything(st.one_of(st.lists(events(), max_size=2), events()), 6),
    control=or_anything(functions, 6),
    dt=or_anything(st.sampled_from([0.1, 1e-2, jnp.asarray(0.1)])),
    rtol=or_anything(st.sampled_from([1e-3, jnp.asarray(1e-3)])),
    atol=or_anything(st.just(1e-6)),
    solver=built_by_one_of(
        diffrax.Tsit5,
        lambda: diffrax.Tsit5,
        diffrax.Euler,
        svkc.integrators.RodriguesEuler,
        diffrax.Kvaerno3,
    ),
    stepsize_controller=built_by_one_of(
        lambda: diffrax.PIDController(rtol=1e-3, atol=1e-6),
        diffrax.ConstantStepSize,
        lambda: diffrax.StepTo(jnp.linspace(0, 1, 3)),
    ),
    stabilization=built_by_one_of(
        svkc.stabilization.Projection,
        svkc.stabilization.CoordinatePartitioning,
        svkc.stabilization.NoStabilization,
        svkc.stabilization.Baumgarte,
        lambda: svkc.stabilization.Baumgarte("a"),
        lambda: svkc.stabilization.Projection(-1),
    ),
    dynamics=built_by_one_of(
        svkc.dynamics.CompositeBodies,
        svkc.dynamics.ArticulatedBodies,
        lambda: svkc.dynamics.CompositeBodies(3),
        lambda: svkc.dynamics.CompositeBodies(hold="a"),
        lambda: svkc.dynamics.CompositeBodies(hold=math.nan),
    ),
    adjoint=built_by_one_of(
        svkc.integrators.Replay,
        lambda: svkc.integrators.Replay(every=0),
        lambda: svkc.integrators.Replay(every="a"),
        diffrax.ForwardMode,
        diffrax.DirectAdjoint,
        diffrax.RecursiveCheckpointAdjoint,
    ),
    max_events=or_anything(st.integers(0, 4)),
    max_steps=or_anything(st.integers(1, 64)),
    progress_meter=built_by_one_of(diffrax.NoProgressMeter),
    args=anything,
)


@st.composite
def some_items(draw, strategies: dict, max_size: int = 3):
    """Draw a dict with a few of these arguments."""
    names = draw(st.lists(st.sampled_from(sorted(strategies)), max_size=max_size, unique=True))
    return {name: draw(strategies[name]) for name in names}


@examples(0.04)
@over_examples(
    t1=or_anything(times, 8), options=some_items(SIMULATE_OPTIONS), defect=defects, value=anything
)
def test_arguments_of_simulate(only_traced, t1, options, defect, value):
    chain, state = scenes()["spare"]
    broken_state = with_defect(state, defect, value)
    outcome(lambda: svkc.simulate(chain, broken_state, t1, **options), RunStarted)


LANE_VALUES = [
    {},
    {"t1": 0.1},
    {"t1": "a"},
    {"events": 3},
    {"control": 3},
    3,
    None,
    [("t1", 0.1)],
    {"args": 1.0},
    {"chain": 3},
]
ROLLOUT_OPTIONS = dict(
    data=or_anything(
        st.sampled_from([jnp.zeros(2), np.zeros((2, 3)), {"a": jnp.ones(2)}, jnp.zeros(3), ()])
    ),
    lane=or_anything(st.sampled_from(LANE_VALUES).map(lambda own: lambda chain, data: own)),
    cost=or_anything(st.sampled_from([[1.0, 2.0], np.zeros(2), np.zeros((2, 2)), [math.nan, 1.0]])),
    chunk=or_anything(st.integers(0, 3)),
    devices=or_anything(st.just(jax.devices())),
    dt=or_anything(st.just(0.1)),
    events=or_anything(st.lists(events(), max_size=1), 6),
    control=or_anything(functions, 6),
)


@examples(0.02)
@over_examples(
    t1=or_anything(times, 6),
    options=some_items(ROLLOUT_OPTIONS),
    states=or_anything(st.just("lanes"), 4),
)
def test_rollouts_and_tuning(only_traced, t1, options, states):
    chain, state = scenes()["spare"]
    lanes = (
        jax.tree.map(lambda x: jnp.stack([x, x]), state)
        if isinstance(states, str) and states == "lanes"
        else states
    )
    outcome(lambda: svkc.rollout(chain, lanes, t1, progress=False, **options), RunStarted)


CAMERA_OPTIONS = ["size", "lookat", "distance", "azimuth", "camera", "trails"]
CALL_NAMES = st.sampled_from(
    [
        "tune",
        "estimate_error",
        "check_grad",
        "to_mujoco",
        "from_mujoco",
        "render",
        "motors",
        "bounds",
        "weight",
        "actuated",
        "load_trajectory",
        "save",
        "plot",
        *CAMERA_OPTIONS,
    ]
)


@examples(0.045)
@over_examples(call=CALL_NAMES, value=anything, other=anything)
def test_other_calls(only_traced, saved_run_path, call, value, other):
    chain, state = scenes()["spare"]
    zero, path = np.zeros(chain.dofs), saved_run_path.with_name("seen.gif")
    traj = svkc.load_trajectory(saved_run_path)
    # calls with valid options draw the picture
    camera_options = {
        name: lambda name=name: svkc.render(
            chain, traj, path, **({"size": (64, 48)} | {name: value})
        )
        for name in CAMERA_OPTIONS
    }
    call_by_name = {
        "tune": lambda: svkc.accuracy.tune(chain, state, value, target=other),
        "estimate_error": lambda: svkc.accuracy.estimate_error(chain, state, value, dt=other),
        "check_grad": lambda: svkc.check_grad(
            jnp.sin if isinstance(value, float) else value, other
        ),
        "to_mujoco": lambda: svkc.interop.to_mujoco(chain, state, value),
        "from_mujoco": lambda: svkc.interop.from_mujoco(chain, value),
        "render": lambda: svkc.render(chain, value, other if isinstance(other, str) else "x.png"),
        "motors": lambda: chain.motors(value),
        "bounds": lambda: svkc.actuation(
            chain, state, zero, bounds=(value, other) if isinstance(other, float) else value
        ),
        "weight": lambda: svkc.actuation(chain, state, zero, weight=value),
        "actuated": lambda: svkc.actuation(chain, state, zero, actuated=value),
        "load_trajectory": lambda: svkc.load_trajectory(value),
        "save": lambda: traj.save(saved_run_path.with_name("saved.npz"), value),
        "plot": lambda: traj.plot(value),
    } | camera_options
    outcome(call_by_name[call], RunStarted, FileNotFoundError)


# computed runs


def oscillating_torques(t, state, args):
    """Return torques of amplitude args."""
    return args * jnp.cos(3 * t) * jnp.arange(1.0, state.v.shape[0] + 1)


@pytest.fixture(scope="module")
def saved_run(tmp_path_factory):
    """Return the content and the path of a file that holds a run."""
    path = tmp_path_factory.mktemp("fuzz") / "run.npz"
    chain, state = scenes()["spare"]
    svkc.simulate(chain, state, 0.1, dt=0.05).save(path, chain)
    return path.read_bytes(), path


@pytest.fixture(scope="module")
def saved_run_path(saved_run):
    """Return the path alone, because pytest prints the arguments of a failing test in full."""
    return saved_run[1]


@examples(0.015)
@over_examples(
    q=st.floats(-0.3, 0.3),
    v=st.floats(-3, 3),
    amplitude=st.sampled_from([0.0, 1.0, -3.0, 1e3, 1e8, 1e300, math.nan, math.inf, 5e-324]),
    t1=st.sampled_from([0.0, 1e-12, 0.1, 0.3]),
    dt=st.sampled_from([1e-300, 1e-9, 1e-3, 1e-2, 0.1, 1e300, math.inf]),
    cut_time=st.sampled_from([0.0, 0.05, 0.3, 10.0, 1e300]),
    fixed_steps=st.booleans(),
)
def test_runs(q, v, amplitude, t1, dt, cut_time, fixed_steps):
    """All states are finite, and a run that ends at t1 has closed loops and finite torques."""
    chain, _ = scenes()["spare"]
    state = outcome(lambda: chain.state({"crank": q}, {"crank": v}))
    event = [svkc.at(jnp.asarray(cut_time), cut="pin")]
    step_options = (
        {"dt": jnp.asarray(dt)} if fixed_steps else {"rtol": jnp.asarray(min(max(dt, 1e-9), 1.0))}
    )
    traj = outcome(
        lambda: svkc.simulate(
            chain,
            state,
            t1,
            events=event,
            control=oscillating_torques,
            args=jnp.asarray(amplitude),
            max_steps=400,
            throw=False,
            **step_options,
        )
    )
    assert traj is not RAISED
    completed = bool(
        (traj.result == svkc.RESULTS.successful) | (traj.result == svkc.RESULTS.stopped)
    )
    assert all_finite((traj.states, traj.final)), svkc.RESULTS[traj.result]
    if completed:
        assert float(traj.t_final) == t1
        assert math.isfinite(amplitude) or t1 == 0
        has_links = np.asarray(traj.connected).any(1)
        assert np.asarray(traj.gaps)[has_links].max(initial=0) < 1e-5


@examples(0.035)
@over_examples(data=st.data())
def test_corrupted_files(saved_run, data):
    """A truncated, overwritten or random file, or one with another array, is refused or loaded."""
    original, path = saved_run
    corruption = data.draw(st.integers(0, 3))
    path = path.with_name("changed.npz")
    if corruption == 0:
        content = original[: data.draw(st.integers(0, len(original)))]
    elif corruption == 1:
        position = data.draw(st.integers(0, len(original) - 1))
        replacement = data.draw(st.binary(min_size=1, max_size=8))
        content = original[:position] + replacement + original[position + len(replacement) :]
    elif corruption == 2:
        content = data.draw(st.binary(max_size=100))
    if corruption < 3:
        path.write_bytes(content)
    else:
        with np.load(saved_run[1]) as file:
            arrays = dict(file)
        name = data.draw(st.sampled_from(sorted(arrays)))
        new = data.draw(
            st.one_of(
                st.none(),
                st.sampled_from(
                    [
                        np.zeros(3),
                        np.array("{}"),
                        np.array('{"schema": "a"}'),
                        np.array("[4]"),
                        np.array("a"),
                        np.zeros((2, 2), complex),
                        np.array(4),
                    ]
                ),
            )
        )
        arrays = {n: x for n, x in arrays.items() if n != name} | (
            {} if new is None else {name: new}
        )
        np.savez(path, **arrays)
    outcome(lambda: svkc.load_trajectory(path))
