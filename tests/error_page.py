"""docs/errors.md, the messages in the library's sources, and calls without the tests' type
checks."""

import ast
import contextlib
import pathlib
import re

import jaxtyping

import svkc

FOLDER = pathlib.Path(svkc.__file__).parent


def _text(node) -> str:
    """Return a message as written, with ... for formatted values."""
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
    """Return the message of every exception that is raised or returned, on one line.

    `unknown_name` returns one, of which the arguments are no messages.
    """
    raised = [node.exc for node in _nodes(ast.Raise)]
    returned = [node.value for node in _nodes(ast.Return)]
    name = lambda call: ast.unparse(call.func)
    return {
        " ".join(_text(call.args[0]).split())
        for call in [*raised, *returned]
        if isinstance(call, ast.Call)
        and call.args
        and (name(call).endswith("Error") if call in returned else name(call) != "unknown_name")
    }


def messages_of(function: str, argument: int) -> set[str]:
    """Return the messages passed to a function by this name, such as eqx.error_if."""
    calls = (
        node
        for node in _nodes(ast.Call)
        if isinstance(node.func, ast.Attribute) and node.func.attr == function
    )
    return {_text(call.args[argument]) for call in calls if len(call.args) > argument}


PAGE = (pathlib.Path(__file__).parent.parent / "docs" / "errors.md").read_text()


def _rows(head: str) -> list[str]:
    """Return the first cells of the table with this head."""
    lines = PAGE.split(f"| {head} |\n|---|---|---|\n")[1].split("\n\n")[0].splitlines()
    return [line.removeprefix("| ").split(" | ")[0].replace("&lt;", "<") for line in lines]


def codes(enumeration: str) -> list[str]:
    """Return the codes of the table below the heading that names an enumeration."""
    table = PAGE.split(f"{enumeration}`\n")[1].split("\n## ")[0]
    return re.findall(r"^\| `(\w+)` \|", table, re.M)


ROWS = _rows("message | raised by | what to do")
COMPILED = _rows("message inside compiled programs | raised by | what to do")
OTHERS = _rows("message | from | what to do")


def pattern(row: str) -> str:
    """Return a regular expression for the messages that a row stands for."""
    return r"[\s\S]*".join(map(re.escape, re.split(r"\.{3,}", row)))


@contextlib.contextmanager
def as_users_see():
    """Disable the checks of annotations, as for users."""
    jaxtyping.config.update("jaxtyping_disable", True)
    try:
        yield
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)
