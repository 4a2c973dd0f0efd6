"""Random states, and random calls of public functions on them."""

import math

import jax.numpy as jnp
import numpy as np
import pytest
from fuzzing import (
    NOTHING,
    NUMBER_OF,
    TREE_NUMBER_OF,
    all_finite,
    anything,
    broken,
    examples,
    or_anything,
    outcome,
    ready,  # noqa: F401 (a fixture)
    scene,
    scenes,
    some_of,
    vectors,
    wrongs,
)
from hypothesis import given as over_examples, strategies as st

import svkc

pytestmark = pytest.mark.slow


@st.composite
def coordinate_arguments(draw, which: int, name: str):
    """q or v for `chain.state`: an array, now and then near a good one, or a dict."""
    chain, state = scenes()[name]
    size = draw(st.sampled_from([NUMBER_OF[name][which], TREE_NUMBER_OF[name][which], 2]))
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
def test_states(data):
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
    if state is not NOTHING:
        assert all_finite(state)
        starts, _ = chain.topology.quaternion_starts
        norms = np.linalg.norm(np.asarray(state.q)[starts[:, None] + np.arange(4)], axis=1)
        np.testing.assert_allclose(norms, 1, atol=1e-12)
        # (lengths up to 1e300 m are let through: what is closed is so in their round-off)
        assert np.abs(svkc.loop_gaps(chain, state)).max(initial=0) < 1e-6 * max(
            1, np.abs(state.q).max()
        )


# what each reads besides the state, and whether a NaN in q, v or that shows
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
    "jacobian": ((), ""),
    "loop_gaps": ((), ""),
    "velocity_gaps": ((), ""),
    "mobility": ((), ""),
    "forward_dynamics": (("tau",), "qvx"),
    "inverse_dynamics": (("tau",), "qvx"),
    "loop_forces": (("tau",), ""),
    "actuation": (("tau",), ""),
    "step": (("tau", "dt"), "qvx"),
    "integrate": (("q", "v"), "x"),
    "difference": (("q", "q"), "x"),
    "tangent": (("q", "q"), ""),
    "xyzw": (("q",), "x"),
}
WITHOUT_STATE = ("integrate", "difference", "tangent", "xyzw")


@st.composite
def arguments(draw, name: str):
    """Draw one argument, and whether it is valid, invalid, or valid except for a NaN."""
    counts = {"tau": NUMBER_OF, "v": NUMBER_OF, "q": NUMBER_OF}

    def one(kind):
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

    return one


@examples(0.14)
@over_examples(st.data())
def test_verbs(data):
    name, function, wrong, value = (
        data.draw(st.sampled_from(["tree", "spare"])),
        data.draw(st.sampled_from(sorted(FUNCTIONS))),
        data.draw(wrongs),
        data.draw(anything),
    )
    chain, state = scenes()[name]
    kinds, shows = FUNCTIONS[function]
    if function in WITHOUT_STATE:
        wrong = ""
    one = data.draw(arguments(name))
    rest, kept = zip(*map(one, kinds), strict=True) if kinds else ((), ())
    first = () if function in WITHOUT_STATE else (broken(state, wrong, value),)
    called = data.draw(or_anything(st.just(chain), 20))
    done = outcome(lambda: getattr(svkc, function)(called, *first, *rest))
    if done is NOTHING:
        assert called is not chain or wrong not in ("", "q", "v") or None in kept, (
            function,
            wrong,
            rest,
        )
    elif wrong == "" and not any(kept) and None not in kept:
        assert all_finite(done), (function, rest)
    elif ("x" in kept and "x" in shows) or (wrong in shows and wrong != ""):
        assert not all_finite(done), (function, wrong, rest)


@examples(0.03)
@over_examples(st.data())
def test_changes_of_structure(data):
    chain, state = scenes()["spare"]
    wrong, value = data.draw(wrongs), data.draw(anything)
    name = or_anything(st.sampled_from(["pin", "spare_0", "crank", "rocker"]))
    broken_state = broken(state, wrong, value)
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
        "prefer": lambda: svkc.with_independent(chain, broken_state, data.draw(name)),
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
    done = outcome(calls[data.draw(st.sampled_from(sorted(calls)))])
    if done is not NOTHING:
        assert isinstance(done, svkc.State)
        assert all_finite(done) == (wrong == ""), wrong
