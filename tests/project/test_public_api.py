"""The public names: their list, their documentation, the cost of importing them, old names."""

import importlib
import inspect
import pathlib
import pkgutil
import re
import typing

import jax
import models
import pytest
from processes import run

import svkc
from svkc import _deprecated as deprecated

ROOT = pathlib.Path(__file__).parents[2]
NAMESPACES = ("accuracy", "dynamics", "integrators", "interop", "stabilization", "types")
# classes whose public methods are public names as well
CLASSES = (svkc.Chain, svkc.State, svkc.Trajectory, svkc.types.Report)
# parameters that need no description
EXPLAINED = {"self", "chain", "state", "args", "kwargs"}


def public_objects() -> dict[str, object]:
    """Return every documented object by its path below `svkc`."""
    out = {name: getattr(svkc, name) for name in svkc.__all__ if name not in NAMESPACES}
    for space in NAMESPACES:
        module = getattr(svkc, space)
        out |= {
            f"{space}.{name}": x
            for name, x in vars(module).items()
            if name[0] != "_" and not inspect.ismodule(x)
        }
    for cls in CLASSES:
        bases = [base for base in cls.__mro__ if base.__module__.startswith("svkc.")]
        for name in sorted({name for base in bases for name in vars(base)}):
            x = inspect.getattr_static(cls, name)
            if name[0] != "_" and (inspect.isfunction(x) or isinstance(x, property)):
                out[f"{cls.__name__}.{name}"] = x
    return out


def test_importing_loads_no_heavy_package_and_changes_no_setting():
    code = (
        "import sys, jax; before = dict(jax.config.values); import svkc; import jax._src.xla_bridge"
        " as b;assert 'mujoco' not in sys.modules and 'matplotlib' not in sys.modules,"
        " 'heavy';assert {k: jax.config.values[k] for k in before} == before, 'settings'; assert"
        " not b._backends, 'backend'"
    )
    done = run("-W", "error", "-c", code)
    assert done.returncode == 0, done.stderr


def test_the_flat_names_are_those_of_all():
    names = {
        name for name in vars(svkc) if name[0] != "_" and not inspect.ismodule(vars(svkc)[name])
    }
    assert names | set(NAMESPACES) == set(svkc.__all__)
    assert len(svkc.__all__) == len(set(svkc.__all__)) <= 65


@pytest.mark.parametrize("name", public_objects())
def test_every_public_object_is_documented(name):
    """The docstring of a public object has a first sentence and names every parameter.

    The first sentence ends with a period. The first word of a function's docstring is an imperative
    verb.
    """
    thing = public_objects()[name]
    text = inspect.getdoc(thing)
    assert text, name
    first = text.split("\n\n")[0]
    assert re.search(r"[.:]$", first.strip()), first
    if not inspect.isfunction(inspect.unwrap(thing)):
        return
    assert not re.match(r"(The|A|An|This|It|What|How|Which|Whether)\b", first), first
    assert not re.match(r"\w+[^s]s\b", first), f"not an imperative verb: {first}"
    missing = [
        parameter
        for parameter in inspect.signature(thing).parameters
        if parameter not in EXPLAINED and not re.search(rf"\b{parameter}\b", text)
    ]
    assert not missing, f"{name} does not name {missing}"


def test_public_functions_say_what_they_return():
    for name, thing in public_objects().items():
        function = inspect.unwrap(thing)
        if inspect.isfunction(function):
            assert "return" in typing.get_type_hints(function) or "return" in vars(function).get(
                "__annotations__", {}
            ), f"{name} has no return annotation"


def test_the_readme_lists_the_public_names():
    page = (ROOT / "README.md").read_text()
    assert not [name for name in svkc.__all__ if not re.search(rf"\b{name}\b", page)]


@pytest.mark.parametrize("name", [*deprecated.RENAMED, *deprecated.SUPERSEDED])
def test_every_old_name_warns_and_works(name):
    use = f"svkc.{deprecated.RENAMED[name]}" if name in deprecated.RENAMED else "svkc.dynamics"
    with pytest.warns(DeprecationWarning, match=rf"svkc.{name} is deprecated.*{re.escape(use)}"):
        old = pkgutil.resolve_name(f"svkc.{name}")
    if name in deprecated.RENAMED:
        assert old is pkgutil.resolve_name(use)
    else:
        assert callable(old)


def test_the_jacobian_without_a_body_warns_and_is_that_of_the_loops():
    chain = models.four_bar()
    state = chain.state()
    with pytest.warns(DeprecationWarning, match=r"svkc.jacobian without a body.*loop_jacobian"):
        old = svkc.jacobian(chain, state)
    assert (old.linear == svkc.loop_jacobian(chain, state).linear).all()


def test_warnings_point_at_the_line_that_uses_an_old_name():
    """In a process of its own: the tests' type checks add frames to the stack."""
    uses = ("svkc.prefer", "svkc.jacobian(c, c.state())", "svkc.page.show", "svkc.RESULTS.jump",
            "svkc.RESULTS[d]", "d == svkc.RESULTS.successful",
            "svkc.RESULTS.successful != d")  # fmt: skip
    code = "\n".join(
        [f"import svkc; d = svkc.types.DERIVATIVE.jump; c = svkc.load({models.ARM!r})", *uses]
    )
    done = run("-W", "always::DeprecationWarning", "-c", code)
    lines = re.findall(r"^<string>:(\d+): DeprecationWarning: svkc", done.stderr, re.M)
    assert lines == [str(2 + i) for i in range(len(uses))], done.stderr


def test_unknown_names_are_attribute_errors():
    with pytest.raises(AttributeError, match=r"module 'svkc' has no attribute 'nothing'"):
        svkc.nothing
    with pytest.raises(AttributeError, match=r"module 'svkc.page' has no attribute 'nothing'"):
        importlib.import_module("svkc.page").nothing


def test_parts_of_results_have_names():
    chain = models.four_bar()
    functions = (
        svkc.poses,
        svkc.velocities,
        svkc.momentum,
        svkc.center_of_mass,
        svkc.loop_jacobian,
    )
    shapes = jax.eval_shape(lambda state: [f(chain, state) for f in functions], chain.state())
    assert [(type(x).__name__, *x._fields) for x in shapes] == [
        ("Poses", "position", "quaternion"),
        ("Velocities", "linear", "angular"),
        ("Momentum", "linear", "angular"),
        ("CenterOfMass", "position", "velocity", "mass"),
        ("Jacobian", "linear", "angular"),
    ]
    position, quaternion = shapes[0]
    assert (position.shape, quaternion.shape) == ((4, 3), (4, 4))


def test_scenes_are_imported_at_their_first_use():
    code = "import sys, svkc; before = 'svkc.scenes' in sys.modules; svkc.scenes.high_bar; "
    done = run("-W", "error", "-c", code + "print(before)")
    assert done.stdout.strip() == "False", done.stderr
