"""The layout: the order of imports, internals of JAX in one package, sizes, repetitions."""

import ast
import functools
import itertools
import pathlib
import re

from processes import run

ROOT = pathlib.Path(__file__).parents[2] / "svkc"
TESTS = pathlib.Path(__file__).parents[1]
# a package may import from itself and from packages to its left
ORDER = (
    "_jax model mjcf tree loops transitions integration simulation optimize tools viz scenes cli"
).split()
# (file, method, imported file) of the public methods that import upwards when called
UPWARD_IMPORTS = {
    ("model/chain", "state", "transitions/initial_state"),
    ("model/chain", "to_mjcf", "mjcf/convert"),
    ("simulation/trajectory", "save", "simulation/archive"),
    ("simulation/trajectory", "plot", "viz/render"),
}
INTERNALS = (
    "jax.interpreters",
    "jax.extend",
    "jax._src",
    "equinox.internal",
    "jax.custom_batching",
)
FILES = sorted(
    str(path.relative_to(ROOT).with_suffix(""))
    for path in ROOT.rglob("*.py")
    if path.parent != ROOT
)


@functools.cache
def imports(file: str) -> list[tuple[str, str | None]]:
    """Return (full name, enclosing function or None) of each import in a file."""
    result = []

    def visit(node, function):
        if isinstance(node, ast.FunctionDef):
            function = node.name
        if isinstance(node, ast.Import):
            result.extend((alias.name, function) for alias in node.names)
        if isinstance(node, ast.ImportFrom):
            result.extend((f"{node.module}.{alias.name}", function) for alias in node.names)
        for child in ast.iter_child_nodes(node):
            visit(child, function)

    visit(ast.parse((ROOT / f"{file}.py").read_text()), None)
    return result


def targets(file: str) -> set[tuple[str, str | None]]:
    """Return (imported file of svkc, enclosing function or None) of each import in a file."""
    result = set()
    for name, function in imports(file):
        parts = name.split(".")[1:] if name.startswith("svkc.") else []
        for end in range(len(parts), 0, -1):
            candidate = "/".join(parts[:end])
            if candidate in FILES or f"{candidate}/__init__" in FILES:
                result.add((candidate if candidate in FILES else f"{candidate}/__init__", function))
                break
    return result


def package(file: str) -> str:
    """Return the package of a file."""
    return file.split("/")[0]


def test_imports_only_go_down():
    for file in FILES:
        for target, function in targets(file):
            if (file, function, target) not in UPWARD_IMPORTS:
                assert ORDER.index(package(target)) <= ORDER.index(package(file)), (
                    f"{file} imports {target}, which is above it"
                )


def test_no_upward_import_is_obsolete():
    """`UPWARD_IMPORTS` lists no import that has been removed."""
    for file, function, target in UPWARD_IMPORTS:
        assert (target, function) in targets(file)


def test_no_import_cycles():
    imports_of = {
        file: {t for t, function in targets(file) if (file, function, t) not in UPWARD_IMPORTS}
        for file in FILES
    }
    while free := {file for file, needed in imports_of.items() if not needed}:
        imports_of = {
            file: needed - free for file, needed in imports_of.items() if file not in free
        }
    assert not imports_of, f"in a cycle of imports: {sorted(imports_of)}"


def test_packages_import_only_the_libraries_of_their_subject():
    """Who imports JAX's internals and MuJoCo, and that `__init__` files import nothing.

    `_jax` alone imports JAX's internals. Only mjcf, viz, scenes and cli import MuJoCo. The packages
    from tree to integration do not import mjcf. The `__init__` of scenes and of optimize may
    import.
    """
    for file in FILES:
        names, package_name = [name for name, _ in imports(file)], package(file)
        if package_name != "_jax":
            assert not [
                name
                for name, inside in itertools.product(names, INTERNALS)
                if name.startswith(inside)
            ], file
        if package_name in (
            "_jax",
            "model",
            "tree",
            "loops",
            "transitions",
            "integration",
            "simulation",
            "optimize",
            "tools",
        ):
            assert not [name for name in names if name.split(".")[0] == "mujoco"], file
        if package_name in ("tree", "loops", "transitions", "integration"):
            assert not [target for target, _ in targets(file) if package(target) == "mjcf"], file
        if file.endswith("__init__") and package_name not in ("scenes", "optimize"):
            assert not names, file


def test_only_jax_package_calls_lapack():
    """Batches of LAPACK calls can deadlock; `_jax/batched_lapack.py` has the safe forms.

    The blocks of `optimize/block_chain.py` are numpy arrays, factored outside of JAX.
    """
    calls = re.compile(r"(jnp|lax|scipy)\.linalg(?!\.norm)")
    users = [file for file in FILES if calls.search((ROOT / f"{file}.py").read_text())]
    assert users == ["_jax/batched_lapack", "optimize/block_chain"]


def test_each_package_has_several_files():
    assert {package(file) for file in FILES} == set(ORDER)
    for name in ORDER:
        assert sum(package(file) == name for file in FILES) > 2, name


def sources() -> list[pathlib.Path]:
    """Return every Python file of the project."""
    folders = ("svkc", "tests", "benchmarks", "examples")
    return sorted(path for folder in folders for path in (ROOT.parent / folder).rglob("*.py"))


def calls(path: pathlib.Path) -> list[ast.Call]:
    """Return every call in a file."""
    nodes = ast.walk(ast.parse(path.read_text()))
    return [node for node in nodes if isinstance(node, ast.Call)]


def test_files_and_functions_are_small():
    for path in ROOT.rglob("*.py"):
        text = path.read_text()
        assert text.count("\n") <= 300, path
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef):
                lines = node.end_lineno - node.lineno + 1
                assert lines <= 50, f"{path}: {node.name} has {lines} lines"


def test_calls_pass_at_most_six_arguments_by_position():
    wide = [
        f"{path}:{call.lineno}: {ast.unparse(call.func)}"
        for path in sources()
        for call in calls(path)
        if len(call.args) > 6
    ]
    assert not wide, "\n".join(wide)


def test_records_of_several_fields_are_built_by_keyword():
    """A record with more than three fields is never built by position.

    `VirtualLink(name, parent, real, joint, ...)` is the exception, by its public contract.
    """
    records = {
        node.name
        for path in ROOT.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ClassDef)
        and sum(isinstance(item, ast.AnnAssign) for item in node.body) > 3
    }
    wide = [
        f"{path}:{call.lineno}: {ast.unparse(call.func)}"
        for path in sources()
        for call in calls(path)
        if ast.unparse(call.func).split(".")[-1] in records - {"VirtualLink"} and len(call.args) > 3
    ]
    assert not wide, "\n".join(wide)


def test_no_ten_lines_stand_twice():
    first_place, repeated = {}, []
    for path in sources():
        lines = [line.strip() for line in path.read_text().splitlines()]
        lines = [(i, line) for i, line in enumerate(lines, 1) if line and line[0] != "#"]
        for start in range(len(lines) - 9):
            ten_lines = tuple(line for _, line in lines[start : start + 10])
            place = f"{path.relative_to(ROOT.parent)}:{lines[start][0]}"
            if first_place.setdefault(ten_lines, place) != place:
                repeated.append(f"{first_place[ten_lines]} and {place}")
    assert not repeated, "\n".join(repeated)


def test_the_architecture_page_names_existing_files():
    page = (ROOT.parent / "docs" / "architecture.md").read_text()
    assert not [
        path for path in re.findall(r"`(svkc/[\w/.]+)`", page) if not (ROOT.parent / path).exists()
    ]
    assert not [name for name in ORDER if not re.search(rf"\b{name}\b", page)]


def test_the_table_of_the_paper_names_existing_files_and_tests():
    page = (ROOT.parent / "docs" / "paper.md").read_text()
    table = page[page.index("| paper | where | test |") :].split("\n\n")[0]
    for file in re.findall(r"`((?:\w+/)+\w+\.\w+)", table):
        assert any((folder / file).exists() for folder in (ROOT, ROOT.parent, TESTS)), file
    for file, test in re.findall(r"`([\w/]+\.py)::(\w+)`", table):
        assert f"def {test}(" in (TESTS / file).read_text(), test


def test_ruff_passes():
    done = run(*"-m ruff check svkc tests examples benchmarks docs".split())
    assert done.returncode == 0, done.stdout
