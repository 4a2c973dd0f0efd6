"""The two tiers: the fast tier, without tests marked `slow`, covers every public function. Read
from the sources of the tests."""

import ast
import functools
import pathlib

import pytest

import svkc

pytest_plugins = ["pytester"]

TESTS = pathlib.Path(__file__).parents[1]
FILES = {path.stem: path for path in TESTS.rglob("*.py")}
# calls that are there to be refused
REFUSED = ("test_messages", "test_fuzz_models", "test_fuzz_functions", "test_fuzz_runs")
# nouns that are made by a function, not by their name
CREATED_BY = {
    "Chain": "load",
    "Check": "check_grad",
    "Structure": "transition",
    "Trajectory": "simulate",
}


@functools.cache
def parsed(name: str) -> ast.Module:
    return ast.parse(FILES[name].read_text())


@functools.cache
def defined(name: str) -> dict[str, ast.AST]:
    """What a file defines by name: functions, classes, constants, and the helper files that it
    imports."""
    definitions: dict[str, ast.AST] = {}
    for node in parsed(name).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            definitions[node.name] = node
        elif isinstance(node, ast.Assign):
            definitions |= {
                target.id: node.value for target in node.targets if isinstance(target, ast.Name)
            }
    return definitions


def says(node: ast.AST, what: str) -> bool:
    return any(
        isinstance(part, ast.Attribute) and ast.unparse(part) == what for part in ast.walk(node)
    )


def slow(test: ast.FunctionDef, file: str) -> bool:
    """As a whole: a test of which only some parameters are marked has others in the fast tier."""
    is_slow = any(
        isinstance(node, ast.Assign) and ast.unparse(node) == "pytestmark = pytest.mark.slow"
        for node in parsed(file).body
    )
    return is_slow or any(
        ast.unparse(decorator) == "pytest.mark.slow" for decorator in test.decorator_list
    )


class Names(ast.NodeVisitor):
    """Collects the public names of svkc that a definition uses, directly, or through its file,
    fixtures and helpers. Calls that the definition expects to raise do not count."""

    def __init__(self):
        self.public, self.visited = set(), set()

    def follow(self, file: str, name: str):
        node = defined(file).get(name)
        if node is None or (file, name) in self.visited:
            return
        self.visited.add((file, name))
        before, self.file = getattr(self, "file", None), file
        if isinstance(node, ast.FunctionDef) and says(node, "pytest.raises"):
            # parameters of such a test are the calls that it has refused
            for part in (node.args, *node.body):
                self.visit(part)
        else:
            self.visit(node)
        self.file = before

    def visit_With(self, node):
        if not any(says(item, "pytest.raises") for item in node.items):
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
    """That a test of it reaches the name in code that is to succeed; what the test looks at there,
    this does not say."""
    names = Names()
    for path in sorted(TESTS.rglob("test_*.py")):
        if path.stem in (*REFUSED, "test_tiers"):
            continue
        for name, node in defined(path.stem).items():
            if (
                name.startswith("test_")
                and isinstance(node, ast.FunctionDef)
                and not slow(node, path.stem)
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
    """Without -m the fast one, by the project's own settings; -m on the command line comes last and
    holds."""
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
