"""The two tiers of the tests: tests marked `slow`, and the fast tier, which is run by default.

The fast tier names every public function, according to the sources of the tests.
"""

import ast
import functools
import pathlib

import pytest

import svkc

pytest_plugins = ["pytester"]

TESTS = pathlib.Path(__file__).parents[1]
FILES = {path.stem: path for path in TESTS.rglob("*.py")}
# files whose calls are to raise errors
FILES_OF_REFUSED_CALLS = (
    "test_messages",
    "test_fuzz_models",
    "test_fuzz_functions",
    "test_fuzz_runs",
)
# public classes that users create by a function
CREATED_BY = {
    "Chain": "load",
    "Check": "check_grad",
    "Structure": "transition",
    "Trajectory": "simulate",
}


@functools.cache
def parse(name: str) -> ast.Module:
    """Return the syntax tree of a file of the tests."""
    return ast.parse(FILES[name].read_text())


@functools.cache
def definitions_of(name: str) -> dict[str, ast.AST]:
    """Return the functions, classes and constants of a file, by name."""
    definitions: dict[str, ast.AST] = {}
    for node in parse(name).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            definitions[node.name] = node
        elif isinstance(node, ast.Assign):
            definitions |= {
                target.id: node.value for target in node.targets if isinstance(target, ast.Name)
            }
    return definitions


def has_attribute(node: ast.AST, what: str) -> bool:
    """Return whether a dotted name such as `pytest.raises` occurs in a syntax tree."""
    return any(
        isinstance(part, ast.Attribute) and ast.unparse(part) == what for part in ast.walk(node)
    )


def is_marked_slow(test: ast.FunctionDef, file: str) -> bool:
    """Return whether a whole test is marked slow, not only some of its parameters."""
    is_slow = any(
        isinstance(node, ast.Assign) and ast.unparse(node) == "pytestmark = pytest.mark.slow"
        for node in parse(file).body
    )
    return is_slow or any(
        ast.unparse(decorator) == "pytest.mark.slow" for decorator in test.decorator_list
    )


class Names(ast.NodeVisitor):
    """Visitor that collects the public names of svkc that a test uses.

    Names used by the fixtures and helpers of the test count. Calls in `pytest.raises` do not.
    """

    def __init__(self):
        self.public, self.visited = set(), set()

    def follow(self, file: str, name: str):
        node = definitions_of(file).get(name)
        if node is None or (file, name) in self.visited:
            return
        self.visited.add((file, name))
        before, self.file = getattr(self, "file", None), file
        if isinstance(node, ast.FunctionDef) and has_attribute(node, "pytest.raises"):
            # the decorators of such a test hold the calls that are to raise
            for part in (node.args, *node.body):
                self.visit(part)
        else:
            self.visit(node)
        self.file = before

    def visit_With(self, node):
        if not any(has_attribute(item, "pytest.raises") for item in node.items):
            self.generic_visit(node)

    def visit_arg(self, node):
        # a fixture
        self.follow(self.file, node.arg)
        self.follow("conftest", node.arg)

    def visit_Name(self, node):
        self.follow(self.file, node.id)

    def visit_Attribute(self, node):
        if isinstance(node.value, ast.Name):
            if node.value.id == "svkc":
                self.public.add(node.attr)
            elif node.value.id in FILES:
                self.follow(node.value.id, node.attr)
        self.generic_visit(node)


def test_the_fast_tier_names_every_public_function():
    """A fast test uses each public function in code that is to succeed.

    Whether the test checks the result is not tested here.
    """
    names = Names()
    for path in sorted(TESTS.rglob("test_*.py")):
        if path.stem in (*FILES_OF_REFUSED_CALLS, "test_tiers"):
            continue
        for name, node in definitions_of(path.stem).items():
            if (
                name.startswith("test_")
                and isinstance(node, ast.FunctionDef)
                and not is_marked_slow(node, path.stem)
            ):
                names.follow(path.stem, name)
    public = {
        name for name in dir(svkc) if not name.startswith("_") and callable(getattr(svkc, name))
    }
    expected = {CREATED_BY.get(name, name) for name in public}
    missing = expected - names.public
    assert not missing, ", ".join(sorted(missing))


@pytest.mark.parametrize(
    ("arguments", "collected"),
    [((), ["fast"]), (("-m", "slow"), ["slow"]), (("-m", "slow or not slow"), ["fast", "slow"])],
)
def test_which_tier_is_run(pytester, arguments, collected):
    """By default pytest collects the fast tier; `-m` on the command line overrides the default."""
    settings = (TESTS.parent / "pyproject.toml").read_text()
    pytester.makepyprojecttoml(
        settings[settings.index("[tool.pytest.ini_options]") : settings.index("[tool.ruff]")]
    )
    pytester.makepyfile(
        "import pytest\ndef test_fast(): pass\n@pytest.mark.slow\ndef test_slow(): pass\n"
    )
    reports = pytester.inline_run("-n", "0", "test_which_tier_is_run.py", *arguments).getreports(
        "pytest_runtest_logreport"
    )
    assert (
        sorted(report.nodeid.split("::test_")[1] for report in reports if report.when == "call")
        == collected
    )
