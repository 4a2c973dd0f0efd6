"""What the library raises, read from its sources and from the page that lists it, and what a call looks like without the tests' own type checks."""

import ast
import contextlib
import pathlib
import re

import jaxtyping

import svkc

FOLDER = pathlib.Path(svkc.__file__).parent


def _text(node) -> str:
    """A message as written, with ... for what it names."""
    if isinstance(node, ast.Constant):
        return str(node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(_text(part) for part in node.values)
    return _text(node.left) + _text(node.right) if isinstance(node, ast.BinOp) else "..."


def messages() -> set[str]:
    """Of every exception that is raised with one, on one line."""
    found = set()
    for path in FOLDER.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and node.exc.args:
                found.add(" ".join(_text(node.exc.args[0]).split()))
    return found


PAGE = (pathlib.Path(__file__).parent.parent / "docs" / "errors.md").read_text()
_LINES = PAGE.split("| message | raised by | what to do |\n|---|---|---|\n")[1].splitlines()
ROWS = [line.removeprefix("| ").split(" | ")[0].replace("&lt;", "<") for line in _LINES]


def pattern(row: str) -> str:
    """A regular expression for the messages that a row of the page stands for, on one line."""
    return r"[\s\S]*".join(map(re.escape, re.split(r"\.{3,}", row)))


@contextlib.contextmanager
def as_users_see():
    """Annotations are not checked, as outside of the tests."""
    jaxtyping.config.update("jaxtyping_disable", True)
    try:
        yield
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)
