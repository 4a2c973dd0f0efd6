"""Random calls of the public functions: what comes out is a good value, a message of
docs/errors.md, or a NaN that can be seen.

The suite makes a few hundred, the same every time; `SVKC_FUZZ=10000 python -m pytest
tests/project/test_fuzz.py -n 0` makes that many, others each time.
What counts is what users see: annotations are not checked while these tests call
(`error_page.as_users_see`), and jax promotes types as it does by default.
Programs are compiled for a handful of fixed scenes alone; where a call would compile another
(`simulate`, `rollout`, `tune`), it is only traced.
"""

import functools
import math
import os
import pathlib
import re
import sys
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

pytestmark = pytest.mark.slow

LONG = int(os.environ.get("SVKC_FUZZ", "0"))
DOCUMENTED = [re.compile(error_page.pattern(row)) for row in error_page.ROWS]
CALLS = {"count": 0, "raised": 0}


def examples(share: float):
    """Of all examples this part, for one test."""
    settings = hypothesis.settings(
        max_examples=max(1, round(share * (LONG or 250))),
        deadline=None,
        database=None,
        derandomize=not LONG,
        suppress_health_check=list(hypothesis.HealthCheck),
        report_multiple_bugs=bool(LONG),
        print_blob=False,
    )
    return lambda test: settings(test)


def is_documented(error: Exception) -> bool:
    text = " ".join(str(error).split())
    return isinstance(error, ValueError | RuntimeError) and any(
        row.fullmatch(text) for row in DOCUMENTED
    )


NOTHING = object()


def outcome(call, *others):
    """What the call gives; NOTHING where it raises what the page, or the list `others`, has."""
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
            return NOTHING
        except Exception as error:
            if not is_documented(error):
                raise
            CALLS["raised"] += 1
            return NOTHING


def floats(tree) -> list[np.ndarray]:
    return [np.asarray(x) for x in jax.tree.leaves(tree) if eqx.is_inexact_array_like(x)]


def all_finite(tree) -> bool:
    return all(np.isfinite(x).all() for x in floats(tree))


# ---- what is given

ODD = [math.nan, math.inf, -math.inf, 1e300, -1e300, 5e-324, 1e-12, 0.0, -1.0, 1.0, 10**30]
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
THINGS = [
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
    st.sampled_from(THINGS),
    st.sampled_from(TEXTS),
    st.sampled_from(ODD),
    arrays,
    st.text(max_size=6),
)
vectors = lambda n: st.lists(
    st.one_of(st.floats(-1.5, 1.5), st.sampled_from(ODD[:-1])), min_size=n, max_size=n
)


def or_anything(good, part: int = 3):
    """Mostly what is right: a strategy with one wrong value in `part`."""
    return st.integers(1, part).flatmap(lambda i: anything if i == 1 else good)


def some_of(**strategies):
    """A few of these arguments."""
    return st.fixed_dictionaries({}, optional=strategies)


# ---- models

number = st.one_of(
    st.floats(0.01, 2).map("{:.3f}".format),
    st.sampled_from("0 -1 1e-14 1e-300 1e300 1e160 nan inf -inf 1e999 abc".split()),
    st.floats(-2, 2).map(str),
)
good_number = st.floats(0.05, 2).map("{:.3f}".format)
label = st.one_of(
    st.integers(0, 9).map("b{}".format),
    st.sampled_from(
        ["", "world", "joint_0", "joint_1", "body_1", "b1_free", "a.b", "\u00e9", "a b", "spare_0"]
    ),
    st.text(max_size=3),
)


def escaped(text: str) -> str:
    return text.translate({ord(c): f"&#{ord(c)};" for c in "<>&\"'"})


@st.composite
def attributes(draw, usual: dict, odd: dict):
    """XML attributes: the usual ones, and now and then odd ones."""
    chosen = dict(usual)
    for name, strategy in odd.items():
        if draw(st.integers(0, 7)) == 0:
            chosen[name] = draw(strategy)
    return "".join(f' {name}="{escaped(value)}"' for name, value in chosen.items())


several = lambda n: st.lists(
    st.one_of(good_number, good_number, good_number, number), min_size=n, max_size=n
).map(" ".join)


@st.composite
def joints(draw):
    kind = draw(st.sampled_from(["hinge", "slide", "ball", "free", "hinge", "wheel"]))
    odd = {
        n: number for n in ("stiffness", "damping", "armature", "ref", "springref", "frictionloss")
    }
    odd |= {
        "axis": several(3),
        "pos": several(3),
        "range": several(2),
        "limited": st.sampled_from(["true", "false", "maybe"]),
    }
    fixed = {"type": kind, "name": draw(label)} if draw(st.booleans()) else {"type": kind}
    return f"<joint{draw(attributes(fixed, odd))}/>"


@st.composite
def bodies(draw, budget: int):
    """A body with several joints, a geom or an inertial of its own, and children."""
    own = "".join(draw(st.lists(joints(), max_size=3)))
    geoms = st.builds(
        "<geom{}/>".format,
        attributes(
            {"size": "0.1 0.1 0.1"},
            {
                "size": several(3),
                "mass": number,
                "density": number,
                "type": st.sampled_from(["box", "sphere", "mesh"]),
            },
        ),
    )
    inertials = st.builds(
        "<inertial{}/>".format,
        attributes(
            {"pos": "0 0 0", "mass": "1", "diaginertia": "1 1 1"},
            {"mass": number, "diaginertia": several(3), "pos": several(3)},
        ),
    )
    mass = "".join(draw(st.lists(st.one_of(geoms, geoms, inertials), max_size=2)))
    children = draw(st.integers(0, 2)) if budget > 1 else 0
    inside = "".join(draw(bodies(budget // 2)) for _ in range(children))
    named = {"name": draw(label)} if draw(st.booleans()) else {}
    own_frame = draw(attributes(named, {"pos": several(3), "quat": several(4), "gravcomp": number}))
    return f"<body{own_frame}>{own}{mass}{inside}</body>"


EXTRAS = [
    "",
    "",
    "",
    "<actuator><motor joint='b1' gear='1e300'/></actuator>",
    "<equality><weld body1='b1' body2='b2'/><connect body1='b0' anchor='0 0 nan'/></equality>",
    "<equality><connect body1='b1' body2='b2' anchor='1 2 3'/></equality>",
    "<option gravity='0 0 1e400' density='3'/>",
    "<option gravity='nan 0 0'/>",
    "<tendon><fixed><joint joint='b1' coef='1'/></fixed></tendon>",
    "<include file='nowhere.xml'/>",
    "<compiler angle='grad'/>",
    "<size memory='-1'/>",
    "<option timestep='nan'/>",
]


@st.composite
def texts(draw):
    """MJCF, URDF, and what is neither."""
    kind = draw(st.integers(0, 9))
    inside = "".join(draw(st.lists(bodies(draw(st.integers(1, 6))), max_size=2)))
    text = f"<mujoco>{draw(st.sampled_from(EXTRAS))}<worldbody>{inside}</worldbody></mujoco>"
    if kind == 0:
        links = "".join(
            f"<link name='{escaped(draw(label))}'><inertial><mass value='{draw(number)}'/><inertia"
            f" ixx='1' iyy='1' izz='{draw(number)}'/></inertial></link>"
            for _ in range(2)
        )
        kind = draw(st.sampled_from(["revolute", "fixed", "floating", "x"]))
        text = (
            f"<robot name='r'>{links}<joint name='j' type='{kind}'><parent link='b1'/><child"
            " link='b2'/></joint></robot>"
        )
    elif kind == 1:
        text = text[: draw(st.integers(0, len(text)))]
    elif kind == 2:
        at = draw(st.integers(0, len(text)))
        text = text[:at] + draw(st.text(max_size=4)) + text[at + draw(st.integers(0, 6)) :]
    elif kind == 3:
        text = draw(st.text(max_size=30))
    return text


def load_options(link):
    return some_of(
        virtual_links=or_anything(st.lists(link, max_size=2)),
        cuttable=or_anything(st.lists(label, max_size=2)),
        ignore_armature=or_anything(st.lists(label, max_size=2)),
        spare=or_anything(st.integers(-1, 3)),
        ignore=or_anything(
            st.one_of(
                st.just("all"),
                st.lists(st.sampled_from(["all", "equality", "limit", "nothing"]), max_size=2),
            ),
            6,
        ),
    )


link_arguments = some_of(
    name=or_anything(label),
    parent=or_anything(st.sampled_from(["world", "b1", "crank", ""])),
    real=or_anything(st.sampled_from(["b2", "rocker"])),
    joint=or_anything(
        st.one_of(
            st.sampled_from(["weld", "hinge", "free", "planar", "screw"]),
            st.lists(st.booleans(), min_size=5, max_size=6),
        )
    ),
    pos=or_anything(vectors(3)),
    quat=or_anything(st.just((1, 0, 0, 0))),
    real_pos=or_anything(vectors(3)),
    real_quat=or_anything(st.just((0, 1, 0, 0))),
    axis=or_anything(vectors(3)),
    connected=or_anything(st.booleans()),
    actuated=or_anything(st.booleans()),
)


def made_link(given):
    return outcome(
        lambda: svkc.VirtualLink(**({"name": "x", "parent": "world", "real": "rocker"} | given))
    )


links = link_arguments.map(made_link)


def look_at(chain):
    """Every chain that loads is whole."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(chain):
        assert not np.isnan(leaf).any(), path
        assert np.isfinite(leaf).all() or jax.tree_util.keystr(path) in (
            ".control_range",
            ".force_range",
            ".limit",
        ), path
    assert len(set(chain.dof_names)) <= len(chain.dof_names) == chain.dofs
    assert len(set(chain.body_names)) == len(chain.body_names)
    assert len(set(chain.joint_names)) == len(chain.joint_names)
    assert (
        len(chain.parent)
        == len(chain.child)
        == len(chain.brother)
        == len(chain.real)
        == len(chain.body_names) + len(chain.link_names)
    )


@examples(0.5)
@hypothesis.given(st.one_of(texts(), texts(), texts(), texts(), anything), load_options(links))
def test_models(source, options):
    chain = outcome(lambda: svkc.load(source, **options))
    if chain is not NOTHING:
        look_at(chain)


@examples(0.02)
@hypothesis.given(st.binary(max_size=60), st.booleans())
def test_files_that_are_no_models(tmp_path_factory, data, folder):
    path = tmp_path_factory.mktemp("models") / "model.xml"
    path.mkdir() if folder else path.write_bytes(data)
    outcome(lambda: svkc.load(path))


@examples(0.1)
@hypothesis.given(st.lists(links, max_size=2), load_options(links))
def test_links(given, options):
    chain = outcome(
        lambda: svkc.load(models.MJCF.format(models.FOUR_BAR), **options | {"virtual_links": given})
    )
    if chain is not NOTHING:
        look_at(chain)


# ---- states of fixed scenes

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
    """Names to (chain, state): a closed loop; a tree that has none, nor slots; a loop and an empty
    slot."""
    return {
        name: (chain, chain.state())
        for name, chain in (
            ("four", models.four_bar()),
            ("tree", svkc.load(TREE)),
            ("spare", models.four_bar(spare=1)),
        )
    }


@pytest.fixture(scope="module", autouse=True)
def ready():
    """The scenes are made before anything is drawn, and annotations are not checked."""
    scenes()
    with error_page.as_users_see():
        yield
    if LONG:
        print(
            f"\n{CALLS['count']} calls, of which {CALLS['raised']} raised what docs/errors.md has"
        )


scene = st.sampled_from(["four", "tree", "spare"])
NUMBER_OF = {"four": (4, 4), "tree": (12, 10), "spare": (11, 10)}
TREE_NUMBER_OF = {"four": (3, 3), "tree": (12, 10), "spare": (3, 3)}


@st.composite
def coordinates_given(draw, which: int, name: str):
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
@hypothesis.given(st.data())
def test_states(data):
    name = data.draw(scene)
    chain, _ = scenes()[name]
    given = data.draw(
        some_of(
            q=or_anything(coordinates_given(0, name)), v=or_anything(coordinates_given(1, name))
        )
    )
    given |= data.draw(
        some_of(
            connected=or_anything(
                st.one_of(
                    st.just("pin"),
                    st.lists(st.booleans(), max_size=2).map(lambda x: np.array(x, bool)),
                )
            )
        )
    )
    state = outcome(lambda: chain.state(**given))
    if state is not NOTHING:
        assert all_finite(state)
        starts, _ = chain.topology.quaternions
        norms = np.linalg.norm(np.asarray(state.q)[starts[:, None] + np.arange(4)], axis=1)
        np.testing.assert_allclose(norms, 1, atol=1e-12)
        # (lengths up to 1e300 m are let through: what is closed is so in their round-off)
        assert np.abs(svkc.loop_gaps(chain, state)).max(initial=0) < 1e-6 * max(
            1, np.abs(state.q).max()
        )


# ---- verbs

# what each reads besides the state, and whether a NaN in q, v or that shows
VERBS = {
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
    """One argument of a verb, and whether it is good: finite, of the right size, or good but for a
    NaN."""
    sizes = {"tau": NUMBER_OF, "v": NUMBER_OF, "q": NUMBER_OF}

    def one(kind):
        if kind == "dt":
            return draw(
                st.sampled_from([(1e-3, ""), (0.1, ""), (0.1, ""), (math.nan, "x"), ("a", None)])
            )
        n = sizes[kind][name][0 if kind == "q" else 1]
        how = draw(st.integers(0, 7))
        if how == 0:
            return draw(anything), None
        good = (
            np.asarray(scenes()[name][1].q)
            if kind == "q"
            else np.array(draw(st.lists(st.floats(-3, 3), min_size=n, max_size=n)))
        )
        if how == 1:
            good = good.copy()
            good[0] = draw(st.sampled_from([math.nan, math.inf]))
            return good, "x"
        return (jnp.asarray(good), list(good), good, good.astype(np.float32), good.astype(int))[
            how % 5
        ], ("" if how % 5 != 4 or kind != "q" else None)

    return one


def broken(state, how: str, value):
    """The state with something wrong: a NaN, or another thing in its place."""
    # (of what is free in space an angle, for nothing depends on where it is)
    at = 3 if state.q.shape == (12,) else 0
    if how == "q":
        return svkc.State(state.q.at[at].set(jnp.nan), state.v, state.structure)
    if how == "v":
        return svkc.State(state.q, state.v.at[at].set(jnp.nan), state.structure)
    return {
        "thing": value,
        "q of a thing": svkc.State(value, state.v, state.structure),
        "structure": svkc.State(state.q, state.v, value),
        "whole": svkc.State(jnp.arange(state.q.shape[0]), state.v, state.structure),
        "lanes": jax.tree.map(lambda x: x[None], state),
        "": state,
    }[how]


wrongs = st.sampled_from(
    ["", "", "", "", "", "q", "v", "thing", "q of a thing", "structure", "whole", "lanes"]
)


@examples(0.14)
@hypothesis.given(st.data())
def test_verbs(data):
    name, verb, wrong, value = (
        data.draw(st.sampled_from(["tree", "spare"])),
        data.draw(st.sampled_from(sorted(VERBS))),
        data.draw(wrongs),
        data.draw(anything),
    )
    chain, state = scenes()[name]
    kinds, shows = VERBS[verb]
    if verb in WITHOUT_STATE:
        wrong = ""
    one = data.draw(arguments(name))
    rest, kept = zip(*map(one, kinds), strict=True) if kinds else ((), ())
    first = () if verb in WITHOUT_STATE else (broken(state, wrong, value),)
    called = data.draw(or_anything(st.just(chain), 20))
    done = outcome(lambda: getattr(svkc, verb)(called, *first, *rest))
    if done is NOTHING:
        assert called is not chain or wrong not in ("", "q", "v") or None in kept, (
            verb,
            wrong,
            rest,
        )
    elif wrong == "" and not any(kept) and None not in kept:
        assert all_finite(done), (verb, rest)
    elif ("x" in kept and "x" in shows) or (wrong in shows and wrong != ""):
        assert not all_finite(done), (verb, wrong, rest)


@examples(0.03)
@hypothesis.given(st.data())
def test_changes_of_structure(data):
    chain, state = scenes()["spare"]
    wrong, value = data.draw(wrongs), data.draw(anything)
    name = or_anything(st.sampled_from(["pin", "spare_0", "crank", "rocker"]))
    given = broken(state, wrong, value)
    body = or_anything(st.sampled_from(["world", "rocker", "crank"]), 6)
    calls = {
        "connect": lambda: svkc.connect(
            chain,
            given,
            *data.draw(st.lists(name, max_size=2)),
            here=data.draw(or_anything(st.booleans())),
        ),
        "cut": lambda: svkc.cut(chain, given, *data.draw(st.lists(name, max_size=2))),
        "lock": lambda: svkc.lock(chain, given, data.draw(name)),
        "unlock": lambda: svkc.unlock(chain, given, data.draw(name)),
        "unbind": lambda: svkc.unbind(chain, given, data.draw(name)),
        "transition": lambda: svkc.transition(
            chain, given, data.draw(or_anything(st.just("pin"), 2))
        ),
        "prefer": lambda: svkc.prefer(chain, given, data.draw(name)),
        "bind": lambda: svkc.bind(
            chain,
            given,
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


# ---- runs, as they are asked for: looked at and traced, but not computed


class Asked(Exception):
    """A run would begin."""


@pytest.fixture
def only_traced(monkeypatch):
    """Runs are traced for their shapes, and not compiled."""
    whole = functools.partial(
        eqx.filter_eval_shape, sys.modules["svkc.simulation.simulate"]._run.__wrapped__
    )

    def run(*args):
        whole(*args)
        raise Asked

    monkeypatch.setattr(sys.modules["svkc.simulation.simulate"], "_run", run)
    rollout = sys.modules["svkc.tools.rollout"]
    monkeypatch.setattr(
        rollout, "_piece", functools.partial(eqx.filter_eval_shape, rollout._piece.__wrapped__)
    )


RETURNS = [
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
functions = st.sampled_from(RETURNS).map(lambda value: lambda t, state, args: value)
good_guard = st.just(lambda t, state, args: state.q[0] + t)
link_names = or_anything(st.sampled_from(["pin", "spare_0", ("pin", "spare_0"), ["pin"], ()]), 6)
grips = st.builds(
    lambda given: outcome(lambda: svkc.Grip(**({"parent": "world", "real": "rocker"} | given))),
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
    options = draw(actions)
    if draw(st.booleans()):
        time = draw(or_anything(st.sampled_from([0.0, 0.5, jnp.asarray(0.5)])))
        return outcome(lambda: svkc.at(time, **options))
    guard = draw(st.one_of(good_guard, good_guard, functions, anything, sensors()))
    direction = draw(or_anything(st.sampled_from([None, True, np.False_])))
    return outcome(lambda: svkc.when(guard, direction=direction, **options))


@st.composite
def sensors(draw):
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


def one_of_these(*makers):
    """What one of these functions gives, made where annotations are not checked."""
    return or_anything(st.sampled_from(makers).map(outcome))


times = st.sampled_from([0.0, 0.5, 1.0, 1, np.float32(0.5), jnp.asarray(0.5)])
simulations = dict(
    t0=or_anything(st.sampled_from([0.0, -1.0, 0])),
    ts=or_anything(st.sampled_from([[0.0, 0.5], jnp.linspace(0, 0.5, 3), (0,), np.zeros((1, 1))])),
    events=or_anything(st.one_of(st.lists(events(), max_size=2), events()), 6),
    control=or_anything(functions, 6),
    dt=or_anything(st.sampled_from([0.1, 1e-2, jnp.asarray(0.1)])),
    rtol=or_anything(st.sampled_from([1e-3, jnp.asarray(1e-3)])),
    atol=or_anything(st.just(1e-6)),
    solver=one_of_these(
        diffrax.Tsit5, lambda: diffrax.Tsit5, diffrax.Euler, svkc.RodriguesEuler, diffrax.Kvaerno3
    ),
    stepsize_controller=one_of_these(
        lambda: diffrax.PIDController(rtol=1e-3, atol=1e-6),
        diffrax.ConstantStepSize,
        lambda: diffrax.StepTo(jnp.linspace(0, 1, 3)),
    ),
    stabilization=one_of_these(
        svkc.Projection,
        svkc.stabilization.CoordinatePartitioning,
        svkc.stabilization.NoStabilization,
        svkc.Baumgarte,
        lambda: svkc.Baumgarte("a"),
        lambda: svkc.Projection(-1),
    ),
    dynamics=one_of_these(
        svkc.Dynamics,
        lambda: svkc.Dynamics(svkc.by_bodies),
        lambda: svkc.Dynamics(3),
        lambda: svkc.Dynamics(hold="a"),
        lambda: svkc.Dynamics(hold=math.nan),
    ),
    adjoint=one_of_these(
        svkc.Replay,
        lambda: svkc.Replay(every=0),
        lambda: svkc.Replay(every="a"),
        diffrax.ForwardMode,
        diffrax.DirectAdjoint,
        diffrax.RecursiveCheckpointAdjoint,
    ),
    max_events=or_anything(st.integers(0, 4)),
    max_steps=or_anything(st.integers(1, 64)),
    progress_meter=one_of_these(diffrax.NoProgressMeter),
    args=anything,
)


@st.composite
def few(draw, strategies: dict, most: int = 3):
    names = draw(st.lists(st.sampled_from(sorted(strategies)), max_size=most, unique=True))
    return {name: draw(strategies[name]) for name in names}


@examples(0.04)
@hypothesis.given(t1=or_anything(times, 8), options=few(simulations), wrong=wrongs, value=anything)
def test_requests(only_traced, t1, options, wrong, value):
    chain, state = scenes()["spare"]
    given = broken(state, wrong, value)
    outcome(lambda: svkc.simulate(chain, given, t1, **options), Asked)


LANES = [
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
rollouts = dict(
    data=or_anything(
        st.sampled_from([jnp.zeros(2), np.zeros((2, 3)), {"a": jnp.ones(2)}, jnp.zeros(3), ()])
    ),
    lane=or_anything(st.sampled_from(LANES).map(lambda own: lambda chain, data: own)),
    cost=or_anything(st.sampled_from([[1.0, 2.0], np.zeros(2), np.zeros((2, 2)), [math.nan, 1.0]])),
    chunk=or_anything(st.integers(0, 3)),
    devices=or_anything(st.just(jax.devices())),
    dt=or_anything(st.just(0.1)),
    events=or_anything(st.lists(events(), max_size=1), 6),
    control=or_anything(functions, 6),
)


@examples(0.02)
@hypothesis.given(
    t1=or_anything(times, 6), options=few(rollouts), states=or_anything(st.just("lanes"), 4)
)
def test_rollouts_and_tuning(only_traced, t1, options, states):
    chain, state = scenes()["spare"]
    lanes = (
        jax.tree.map(lambda x: jnp.stack([x, x]), state)
        if isinstance(states, str) and states == "lanes"
        else states
    )
    outcome(lambda: svkc.rollout(chain, lanes, t1, progress=False, **options), Asked)


SEEN = ["size", "lookat", "distance", "azimuth", "camera", "trails"]
calls = st.sampled_from(
    [
        "tune",
        "halved",
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
        *SEEN,
    ]
)


@examples(0.045)
@hypothesis.given(call=calls, value=anything, other=anything)
def test_other_calls(only_traced, place, call, value, other):
    chain, state = scenes()["spare"]
    zero, path = np.zeros(chain.dofs), place.with_name("seen.gif")
    traj = svkc.load_trajectory(place)
    # (what is no fault is drawn)
    seen = {
        name: lambda name=name: svkc.render(
            chain, traj, path, **({"size": (64, 48)} | {name: value})
        )
        for name in SEEN
    }
    made = {
        "tune": lambda: svkc.tune(chain, state, value, target=other),
        "halved": lambda: svkc.halved(chain, state, value, dt=other),
        "check_grad": lambda: svkc.check_grad(
            jnp.sin if isinstance(value, float) else value, other
        ),
        "to_mujoco": lambda: svkc.to_mujoco(chain, state, value),
        "from_mujoco": lambda: svkc.from_mujoco(chain, value),
        "render": lambda: svkc.render(chain, value, other if isinstance(other, str) else "x.png"),
        "motors": lambda: chain.motors(value),
        "bounds": lambda: svkc.actuation(
            chain, state, zero, bounds=(value, other) if isinstance(other, float) else value
        ),
        "weight": lambda: svkc.actuation(chain, state, zero, weight=value),
        "actuated": lambda: svkc.actuation(chain, state, zero, actuated=value),
        "load_trajectory": lambda: svkc.load_trajectory(value),
        "save": lambda: traj.save(place.with_name("saved.npz"), value),
        "plot": lambda: traj.plot(value),
    } | seen
    outcome(made[call], Asked, FileNotFoundError)


# ---- runs


def pulled(t, state, args):
    return args * jnp.cos(3 * t) * jnp.arange(1.0, state.v.shape[0] + 1)


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """A file that holds a run."""
    path = tmp_path_factory.mktemp("fuzz") / "run.npz"
    chain, state = scenes()["spare"]
    svkc.simulate(chain, state, 0.1, dt=0.05).save(path, chain)
    return path.read_bytes(), path


@pytest.fixture(scope="module")
def place(kept):
    """Of that file. (What a test is given is printed whole where it fails.)"""
    return kept[1]


@examples(0.015)
@hypothesis.given(
    q=st.floats(-0.3, 0.3),
    v=st.floats(-3, 3),
    pull=st.sampled_from([0.0, 1.0, -3.0, 1e3, 1e8, 1e300, math.nan, math.inf, 5e-324]),
    t1=st.sampled_from([0.0, 1e-12, 0.1, 0.3]),
    dt=st.sampled_from([1e-300, 1e-9, 1e-3, 1e-2, 0.1, 1e300, math.inf]),
    at=st.sampled_from([0.0, 0.05, 0.3, 10.0, 1e300]),
    lossy=st.booleans(),
)
def test_runs(q, v, pull, t1, dt, at, lossy):
    """What comes to its end is finite and closed; what is not finite says so."""
    chain, _ = scenes()["spare"]
    state = outcome(lambda: chain.state({"crank": q}, {"crank": v}))
    event = [svkc.at(jnp.asarray(at), cut="pin")]
    steps = {"dt": jnp.asarray(dt)} if lossy else {"rtol": jnp.asarray(min(max(dt, 1e-9), 1.0))}
    traj = outcome(
        lambda: svkc.simulate(
            chain,
            state,
            t1,
            events=event,
            control=pulled,
            args=jnp.asarray(pull),
            max_steps=400,
            throw=False,
            **steps,
        )
    )
    assert traj is not NOTHING
    good = bool((traj.result == svkc.RESULTS.successful) | (traj.result == svkc.RESULTS.stopped))
    assert all_finite((traj.states, traj.final)), svkc.RESULTS[traj.result]
    if good:
        assert float(traj.t_final) == t1
        assert math.isfinite(pull) or t1 == 0
        held = np.asarray(traj.connected).any(1)
        assert np.asarray(traj.gaps)[held].max(initial=0) < 1e-5


@examples(0.035)
@hypothesis.given(data=st.data())
def test_files(kept, data):
    """A file that was cut short, written over, or made of other arrays."""
    whole, path = kept
    how = data.draw(st.integers(0, 3))
    path = path.with_name("changed.npz")
    if how == 0:
        content = whole[: data.draw(st.integers(0, len(whole)))]
    elif how == 1:
        at = data.draw(st.integers(0, len(whole) - 1))
        piece = data.draw(st.binary(min_size=1, max_size=8))
        content = whole[:at] + piece + whole[at + len(piece) :]
    elif how == 2:
        content = data.draw(st.binary(max_size=100))
    if how < 3:
        path.write_bytes(content)
    else:
        with np.load(kept[1]) as file:
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
