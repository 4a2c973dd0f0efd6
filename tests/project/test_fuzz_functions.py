"""Random arguments of `chain.state` and of public functions of a state."""

import math
import operator

import jax.numpy as jnp
import numpy as np
import pytest
from fuzzing import (
    COORDINATE_COUNTS,
    RAISED,
    TREE_COORDINATE_COUNTS,
    all_finite,
    anything,
    defects,
    examples,
    or_anything,
    outcome,
    prepared_scenes,  # noqa: F401 (a fixture)
    scene,
    scenes,
    some_of,
    vectors,
    with_defect,
)
from hypothesis import given as over_examples, strategies as st

import svkc

pytestmark = pytest.mark.slow


@st.composite
def coordinate_arguments(draw, which: int, name: str):
    """Draw q or v for `chain.state`: a valid array, an array near a valid one, or a dict.

    which: 0 for q, 1 for v.
    name: name of the scene.
    """
    chain, state = scenes()[name]
    size = draw(
        st.sampled_from([COORDINATE_COUNTS[name][which], TREE_COORDINATE_COUNTS[name][which], 2])
    )
    if draw(st.booleans()):
        good = np.asarray(state.v if which else state.q)[:size].copy()
        return (good + 1e-2 * draw(st.integers(0, 1)) * np.arange(len(good))).astype(
            draw(st.sampled_from([np.float64, np.float32, np.int64]))
        )
    joint = st.sampled_from([*chain.joint_names, "pin", "nobody", ""])
    return draw(
        st.one_of(
            vectors(size),
            st.dictionaries(joint, st.one_of(st.floats(-1, 1), vectors(4), anything), max_size=2),
        )
    )


@examples(0.06)
@over_examples(st.data())
def test_chain_state(data):
    name = data.draw(scene)
    chain, _ = scenes()[name]
    state_arguments = data.draw(
        some_of(
            q=or_anything(coordinate_arguments(0, name)),
            v=or_anything(coordinate_arguments(1, name)),
        )
    )
    state_arguments |= data.draw(
        some_of(
            connected=or_anything(
                st.one_of(
                    st.just("pin"),
                    st.lists(st.booleans(), max_size=2).map(lambda x: np.array(x, bool)),
                )
            )
        )
    )
    state = outcome(lambda: chain.state(**state_arguments))
    if state is not RAISED:
        assert all_finite(state)
        starts, _ = chain.topology.quaternion_starts
        norms = np.linalg.norm(np.asarray(state.q)[starts[:, None] + np.arange(4)], axis=1)
        np.testing.assert_allclose(norms, 1, atol=1e-12)
        # coordinates may be up to 1e300 m: gaps are bounded by their round-off
        assert np.abs(svkc.loop_gaps(chain, state)).max(initial=0) < 1e-6 * max(
            1, np.abs(state.q).max()
        )


# kinds of the arguments after chain and state; and the inputs of which a NaN must appear in the
# result: "q" and "v" of the state, "x" an argument
FUNCTIONS = {
    "poses": ((), "q"),
    "velocities": ((), "qv"),
    "energy": ((), "qv"),
    "kinetic_energy": ((), "v"),
    "potential_energy": ((), "q"),
    "momentum": ((), "qv"),
    "bias_force": ((), "qv"),
    "mass_matrix": ((), ""),
    "coordinates": ((), ""),
    "loop_jacobian": ((), ""),
    "loop_gaps": ((), ""),
    "loop_gap_rates": ((), ""),
    "mobility": ((), ""),
    "forward_dynamics": (("tau",), "qvx"),
    "inverse_dynamics": (("tau",), "qvx"),
    "loop_forces": (("tau",), ""),
    "actuation": (("tau",), ""),
    "step": (("tau", "dt"), "qvx"),
    "integrate": (("q", "v"), "x"),
    "difference": (("q", "q"), "x"),
    "tangent_gradient": (("q", "q"), ""),
    "interop.quaternions_xyzw": (("q",), "x"),
}
WITHOUT_STATE = ("integrate", "difference", "tangent_gradient", "interop.quaternions_xyzw")


@st.composite
def argument_strategy(draw, name: str):
    """Draw a function that draws an argument of a kind, and a verdict.

    The verdict is "" for a valid argument, "x" for one with a non-finite number, None for one that
    may be invalid.
    """
    counts = {"tau": COORDINATE_COUNTS, "v": COORDINATE_COUNTS, "q": COORDINATE_COUNTS}

    def draw_argument(kind):
        if kind == "dt":
            return draw(
                st.sampled_from([(1e-3, ""), (0.1, ""), (0.1, ""), (math.nan, "x"), ("a", None)])
            )
        n = counts[kind][name][0 if kind == "q" else 1]
        choice = draw(st.integers(0, 7))
        if choice == 0:
            return draw(anything), None
        good = (
            np.asarray(scenes()[name][1].q)
            if kind == "q"
            else np.array(draw(st.lists(st.floats(-3, 3), min_size=n, max_size=n)))
        )
        if choice == 1:
            good = good.copy()
            good[0] = draw(st.sampled_from([math.nan, math.inf]))
            return good, "x"
        return (jnp.asarray(good), list(good), good, good.astype(np.float32), good.astype(int))[
            choice % 5
        ], ("" if choice % 5 != 4 or kind != "q" else None)

    return draw_argument


@examples(0.14)
@over_examples(st.data())
def test_functions_of_a_state(data):
    name, function, defect, value = (
        data.draw(st.sampled_from(["tree", "spare"])),
        data.draw(st.sampled_from(sorted(FUNCTIONS))),
        data.draw(defects),
        data.draw(anything),
    )
    chain, state = scenes()[name]
    kinds, nan_shows = FUNCTIONS[function]
    if function in WITHOUT_STATE:
        defect = ""
    draw_argument = data.draw(argument_strategy(name))
    arguments, verdicts = zip(*map(draw_argument, kinds), strict=True) if kinds else ((), ())
    state_argument = () if function in WITHOUT_STATE else (with_defect(state, defect, value),)
    chain_argument = data.draw(or_anything(st.just(chain), 20))
    result = outcome(
        lambda: operator.attrgetter(function)(svkc)(chain_argument, *state_argument, *arguments)
    )
    if result is RAISED:
        assert chain_argument is not chain or defect not in ("", "q", "v") or None in verdicts, (
            function,
            defect,
            arguments,
        )
    elif defect == "" and not any(verdicts) and None not in verdicts:
        assert all_finite(result), (function, arguments)
    elif ("x" in verdicts and "x" in nan_shows) or (defect in nan_shows and defect != ""):
        assert not all_finite(result), (function, defect, arguments)


@examples(0.03)
@over_examples(st.data())
def test_changes_of_structure(data):
    chain, state = scenes()["spare"]
    defect, value = data.draw(defects), data.draw(anything)
    name = or_anything(st.sampled_from(["pin", "spare_0", "crank", "rocker"]))
    broken_state = with_defect(state, defect, value)
    body = or_anything(st.sampled_from(["world", "rocker", "crank"]), 6)
    calls = {
        "connect": lambda: svkc.connect(
            chain,
            broken_state,
            *data.draw(st.lists(name, max_size=2)),
            here=data.draw(or_anything(st.booleans())),
        ),
        "cut": lambda: svkc.cut(chain, broken_state, *data.draw(st.lists(name, max_size=2))),
        "lock": lambda: svkc.lock(chain, broken_state, data.draw(name)),
        "unlock": lambda: svkc.unlock(chain, broken_state, data.draw(name)),
        "unbind": lambda: svkc.unbind(chain, broken_state, data.draw(name)),
        "transition": lambda: svkc.transition(
            chain, broken_state, data.draw(or_anything(st.just("pin"), 2))
        ),
        "with_independent": lambda: svkc.with_independent(chain, broken_state, data.draw(name)),
        "bind": lambda: svkc.bind(
            chain,
            broken_state,
            data.draw(or_anything(st.just("spare_0"), 6)),
            data.draw(body),
            data.draw(body),
            **data.draw(
                some_of(
                    joint=or_anything(st.just("ball")),
                    axis=or_anything(vectors(3)),
                    pos=or_anything(vectors(3)),
                    real_pos=or_anything(vectors(3)),
                )
            ),
        ),
    }
    result = outcome(calls[data.draw(st.sampled_from(sorted(calls)))])
    if result is not RAISED:
        assert isinstance(result, svkc.State)
        assert all_finite(result) == (defect == ""), defect
