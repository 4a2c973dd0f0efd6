"""Shared parts of tests/project/test_fuzz_*.py: random arguments, scenes, outcomes of calls.

A call must return a valid value, raise an error that docs/errors.md lists, or return NaN where its
input is NaN. The suite makes a few hundred calls with fixed seeds. `SVKC_FUZZ=10000 python -m
pytest tests/project/test_fuzz_*.py -m slow -n 0` makes ten thousand, with new seeds each time.

Calls run as for users: annotations are not checked (`error_page.as_users_see`), and JAX promotes
types by its default. Programs are compiled for a few fixed scenes only. Calls that would compile
other programs (`simulate`, `rollout`, `tune`) are only traced.
"""

import functools
import math
import os
import pathlib
import re
import types
import warnings

import diffrax
import equinox as eqx
import error_page
import hypothesis
import jax
import jax.numpy as jnp
import models
import numpy as np
import pytest
from hypothesis import strategies as st

import svkc

REQUESTED_EXAMPLES = int(os.environ.get("SVKC_FUZZ", "0"))
DOCUMENTED = [re.compile(error_page.pattern(row)) for row in error_page.ROWS]
CALLS = {"count": 0, "raised": 0}


def examples(share: float):
    """Return a decorator that sets a test's number of examples, as a share of that of the suite."""
    settings = hypothesis.settings(
        max_examples=max(1, round(share * (REQUESTED_EXAMPLES or 250))),
        deadline=None,
        database=None,
        derandomize=not REQUESTED_EXAMPLES,
        suppress_health_check=list(hypothesis.HealthCheck),
        report_multiple_bugs=bool(REQUESTED_EXAMPLES),
        print_blob=False,
    )
    return lambda test: settings(test)


def is_documented(error: Exception) -> bool:
    """Return whether docs/errors.md lists the message of an error of a documented type."""
    text = " ".join(str(error).split())
    return isinstance(error, ValueError | RuntimeError) and any(
        row.fullmatch(text) for row in DOCUMENTED
    )


RAISED = object()


def outcome(call, *others):
    """Return the result of a call, or RAISED if it raises a documented error.

    others: further exception types that the call may raise.
    """
    CALLS["count"] += 1
    with (
        warnings.catch_warnings(),
        jax.numpy_dtype_promotion("standard"),
        jax.numpy_rank_promotion("allow"),
    ):
        warnings.simplefilter("ignore")
        try:
            return call()
        except others:
            CALLS["raised"] += 1
            return RAISED
        except Exception as error:
            if not is_documented(error):
                raise
            CALLS["raised"] += 1
            return RAISED


def floats(tree) -> list[np.ndarray]:
    """Return the floating-point leaves of a pytree."""
    return [np.asarray(x) for x in jax.tree.leaves(tree) if eqx.is_inexact_array_like(x)]


def all_finite(tree) -> bool:
    """Return whether all floating-point leaves of a pytree are finite."""
    return all(np.isfinite(x).all() for x in floats(tree))


# random arguments

EXTREME_NUMBERS = [
    math.nan,
    math.inf,
    -math.inf,
    1e300,
    -1e300,
    5e-324,
    1e-12,
    0.0,
    -1.0,
    1.0,
    10**30,
]
TEXTS = [
    "",
    "pin",
    "nobody",
    "crank",
    "spare_0",
    "world",
    "rocker",
    "all",
    "\u00e9\n\0",
    "weld",
    "hinge",
    "universal",
    "xyz",
    "a.b",
    "x" * 5000,
    "\ud800",
]
WRONG_TYPES = [
    None,
    True,
    False,
    0,
    1,
    -1,
    3,
    2.5,
    b"pin",
    b"",
    (),
    [],
    {},
    set(),
    object(),
    1j,
    [[1.0], [1.0, 2.0]],
    ["pin"],
    ["nobody", 3],
    {"crank": 1.0},
    {3: "a"},
    ["spare_0"],
    [None],
    ["a", "b", "c"],
    np.array("a"),
    np.array(["a", "b", "c"]),
    np.array([None] * 3),
    np.zeros(3, complex),
    np.ones(3, bool),
    np.ones(1, bool),
    np.float64(0.5),
    np.zeros((2, 2)),
    np.zeros(0),
    range(3),
    types.SimpleNamespace(q=1),
    svkc,
    pathlib.Path("nowhere"),
    diffrax.Tsit5(),
]
arrays = st.builds(
    lambda n, kind, fill: (
        np.full(n, fill, dtype=kind) if kind != np.int32 else np.arange(n, dtype=np.int32)
    ),
    st.integers(0, 8),
    st.sampled_from([np.float64, np.float32, np.int32]),
    st.sampled_from([0.0, 1.0, 0.3, math.nan, math.inf]),
)
anything = st.one_of(
    st.sampled_from(WRONG_TYPES),
    st.sampled_from(TEXTS),
    st.sampled_from(EXTREME_NUMBERS),
    arrays,
    st.text(max_size=6),
)
vectors = lambda n: st.lists(
    st.one_of(st.floats(-1.5, 1.5), st.sampled_from(EXTREME_NUMBERS[:-1])), min_size=n, max_size=n
)


def or_anything(good, part: int = 3):
    """Return a strategy that draws from `good`, and one time in `part` from `anything`."""
    return st.integers(1, part).flatmap(lambda i: anything if i == 1 else good)


def some_of(**strategies):
    """Return a strategy that draws a dict with some of these arguments."""
    return st.fixed_dictionaries({}, optional=strategies)


TREE = models.MJCF.format(
    models.bar(
        "base",
        'type="free"',
        "0 0 1",
        inside=models.bar(
            "arm", models.Y + ' stiffness="2" range="-1 1" limited="true"', "0 0 1", "0 0 1"
        ),
    )
    + models.bar("b", 'type="ball"', "0.5 0 1")
)


@functools.cache
def scenes() -> dict:
    """Return {name: (chain, state)} of the three scenes.

    "four": a four-bar. "tree": a tree without virtual links. "spare": a four-bar with a spare slot.
    """
    return {
        name: (chain, chain.state())
        for name, chain in (
            ("four", models.four_bar()),
            ("tree", svkc.load(TREE)),
            ("spare", models.four_bar(spare=1)),
        )
    }


@pytest.fixture(scope="module", autouse=True)
def prepared_scenes():
    """Build the scenes before hypothesis draws, and disable the checks of annotations."""
    scenes()
    with error_page.as_users_see():
        yield
    if REQUESTED_EXAMPLES:
        print(
            f"\n{CALLS['count']} calls, of which {CALLS['raised']} raised errors of docs/errors.md"
        )


scene = st.sampled_from(["four", "tree", "spare"])
# numbers of coordinates and of velocities: of the chain, and of its tree alone
COORDINATE_COUNTS = {"four": (4, 4), "tree": (12, 10), "spare": (11, 10)}
TREE_COORDINATE_COUNTS = {"four": (3, 3), "tree": (12, 10), "spare": (3, 3)}


def with_defect(state, field: str, value):
    """Return the state with one defect.

    field: kind of the defect; "" returns the state unchanged.
    value: what replaces the state or a field of it, for some kinds.
    """
    # for the scene with a free base an angle, because no energy depends on its horizontal position
    at = 3 if state.q.shape == (12,) else 0
    if field == "q":
        return svkc.State(state.q.at[at].set(jnp.nan), state.v, state.structure)
    if field == "v":
        return svkc.State(state.q, state.v.at[at].set(jnp.nan), state.structure)
    return {
        "other object": value,
        "other q": svkc.State(value, state.v, state.structure),
        "other structure": svkc.State(state.q, state.v, value),
        "integer q": svkc.State(jnp.arange(state.q.shape[0]), state.v, state.structure),
        "batch": jax.tree.map(lambda x: x[None], state),
        "": state,
    }[field]


defects = st.sampled_from(
    [""] * 5 + ["q", "v", "other object", "other q", "other structure", "integer q", "batch"]
)
