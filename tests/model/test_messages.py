"""docs/errors.md lists every message of the library, and a test raises each message."""

import pathlib
import re

import error_page
import jax
import jax.numpy as jnp
import models
import numpy as np
import pytest
import wrong_calls
from error_page import ROWS

import svkc

TESTS = pathlib.Path(__file__).parents[1]

# beginning of a message -> (file of the test that raises it, text in that file)
ELSEWHERE = {
    "rollout: another process": ("tools/test_rollout.py", "another process"),
    "out: ... holds another": ("tools/test_rollout.py", "holds another rollout"),
    "expected NAME@TIME": ("project/test_commands.py", "expected NAME@TIME"),
    "optimize needs IPOPT": ("optimize/test_solvers.py", "optimize needs IPOPT"),
    "multistart in several": ("optimize/test_solution.py", "needs cloudpickle"),
    "multistart: start": ("optimize/test_solution.py", "failed in its process"),
    "multistart: all": ("optimize/test_solution.py", "all processes ended"),
    "module ... has no": ("project/test_public_api.py", "has no attribute"),
}

# The calls that raise these messages compile for seconds. They are in the slow tier.
LONGEST = (
    "... holds no model",
    "simulate stopped",
    "connect: the bodies",
    "at the guess ... is",
    "bind: ... is connected",
    "inverse_dynamics_along: at t = ... s the joints",
    "inverse_dynamics_along: at t = ... s:",
    "target: ... cannot",
    "... depends on fixed",
    "camera: no",
    "pictures need",
)


@pytest.fixture(scope="module")
def setting(tmp_path_factory):
    return wrong_calls.Setting(tmp_path_factory.mktemp("errors"))


def _row(opening: str) -> str:
    """Return the one row that begins with `opening` and with no longer opening of another case."""
    rows = [
        row
        for row in ROWS
        if row.startswith(opening)
        and not any(
            len(o) > len(opening) and row.startswith(o) for o in (*wrong_calls.CASES, *ELSEWHERE)
        )
    ]
    assert len(rows) == 1, (opening, rows)
    return rows[0]


def test_the_page_has_every_message():
    assert sorted(ROWS) == sorted(error_page.messages())
    assert set(LONGEST) < set(wrong_calls.CASES)
    assert sorted(map(_row, [*wrong_calls.CASES, *ELSEWHERE])) == sorted(ROWS)
    for file, words in ELSEWHERE.values():
        assert words in (TESTS / file).read_text(), file
    for enumeration in (svkc.RESULTS, svkc.types.DERIVATIVE):
        assert error_page.codes(enumeration.__name__) == list(enumeration._name_to_item)


@pytest.mark.parametrize(
    "opening",
    [pytest.param(o, marks=pytest.mark.slow) if o in LONGEST else o for o in wrong_calls.CASES],
)
def test_each_message(setting, opening):
    with (
        error_page.as_users_see(),
        pytest.raises((ValueError, RuntimeError, NotImplementedError, IndexError)) as caught,
    ):
        wrong_calls.CASES[opening](setting)
    assert re.fullmatch(error_page.pattern(_row(opening)), " ".join(str(caught.value).split())), (
        caught.value
    )


@pytest.mark.parametrize(("words", "call"), wrong_calls.ALSO, ids=range(len(wrong_calls.ALSO)))
def test_other_calls_that_raise_them(setting, words, call):
    with (
        error_page.as_users_see(),
        pytest.raises((ValueError, RuntimeError), match=words) as caught,
    ):
        call(setting)
    text = " ".join(str(caught.value).split())
    assert any(re.fullmatch(error_page.pattern(row), text) for row in ROWS), text


@pytest.mark.slow
def test_inside_compiled_programs(setting):
    """Errors that depend on traced values are raised by the compiled program."""
    assert sorted(error_page.COMPILED) == sorted(error_page.messages_of("error_if", 2))
    apart = setting.load(virtual_links=[wrong_calls.link(pos=(5, 0, 0), real_pos=(0, 0, 0))])
    beyond = wrong_calls.unclosable_loop(setting)
    calls = {
        "bind: the spare slot": lambda: jax.jit(
            lambda s: svkc.bind(setting.spare, s, "spare_0", "world", "crank")
        )(setting.gripping()),
        "connect: a loop": lambda: jax.jit(lambda s: svkc.connect(setting.spare, s, "spare_0"))(
            svkc.bind(setting.spare, setting.empty, "spare_0", "world", "crank", pos=(0, 1e-3, 0))
        ),
        "connect: a spare slot": lambda: jax.jit(
            lambda s: svkc.connect(setting.spare, s, "spare_0", here=True)
        )(setting.empty),
        "connect: the bodies": lambda: jax.jit(lambda s: svkc.connect(apart, s, "x"))(
            apart.state()
        ),
        "the loops of": lambda: jax.jit(lambda q: beyond.state({"crank": q}))(0.1),
        str(svkc.RESULTS[svkc.RESULTS.max_steps]): lambda: jax.jit(
            lambda t: setting.simulate(t1=t, dt=1e-3, max_steps=2).t_final
        )(1e-2),
    }
    for row in error_page.COMPILED:
        assert any(row.startswith(opening) for opening in calls)
    for opening, call in calls.items():
        with error_page.as_users_see(), pytest.raises(RuntimeError, match=re.escape(opening)):
            call()


@pytest.mark.slow
def test_warnings_and_errors_of_other_libraries(setting, tmp_path):
    in_float64, again, another, deprecated, missing, unlike = error_page.OTHERS
    assert error_page.messages_of("warn", 0) == {in_float64, again, another, deprecated}
    # raised after two compilations, tested in tests/_jax/test_functions.py
    assert "a new function object" in again
    assert "a new function object" in (TESTS / "_jax/test_functions.py").read_text()
    with jax.enable_x64(False):
        chain = models.four_bar()
        with pytest.warns(UserWarning, match=error_page.pattern(in_float64)):
            chain.state(v=np.array([1.0, 0.0, 0.0]))
    heavier = setting.four.replace(mass={"crank": 9.0})
    with pytest.warns(UserWarning, match=error_page.pattern(another)):
        svkc.show(heavier, setting.short())
    with pytest.warns(UserWarning, match=error_page.pattern(another)):
        setting.short().plot(heavier)
    with pytest.warns(DeprecationWarning, match=error_page.pattern(deprecated)):
        assert svkc.prefer is svkc.with_independent
    for read in (svkc.load_trajectory, svkc.load_chain):
        with pytest.raises(FileNotFoundError, match=error_page.pattern(missing)):
            read(tmp_path / "none.npz")
    lighter = setting.load(models.MJCF.format(models.FOUR_BAR).replace("-9.81", "-1.62"))
    with pytest.raises(ValueError, match=error_page.pattern(unlike)):
        jax.tree.map(lambda *x: jnp.stack(x), setting.load(), lighter)
