"""docs/errors.md and the messages that the library raises, read from its sources,
and what a call looks like without the tests' own type checks."""

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


def _nodes(kind):
    return (
        node
        for path in FOLDER.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, kind)
    )


def messages() -> set[str]:
    """Of every exception that is raised with one, on one line."""
    raised = (node.exc for node in _nodes(ast.Raise))
    return {
        " ".join(_text(call.args[0]).split())
        for call in raised
        if isinstance(call, ast.Call) and call.args
    }


def messages_of(function: str, argument: int) -> set[str]:
    """What calls of a function by this name, such as eqx.error_if, are given to say."""
    calls = (
        node
        for node in _nodes(ast.Call)
        if isinstance(node.func, ast.Attribute) and node.func.attr == function
    )
    return {_text(call.args[argument]) for call in calls if len(call.args) > argument}


PAGE = (pathlib.Path(__file__).parent.parent / "docs" / "errors.md").read_text()


def _rows(head: str) -> list[str]:
    """First cells of the table that begins so."""
    lines = PAGE.split(f"| {head} |\n|---|---|---|\n")[1].split("\n\n")[0].splitlines()
    return [line.removeprefix("| ").split(" | ")[0].replace("&lt;", "<") for line in lines]


ROWS = _rows("message | raised by | what to do")
COMPILED = _rows("message inside compiled programs | raised by | what to do")
OTHERS = _rows("message | from | what to do")


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
