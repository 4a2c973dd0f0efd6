"""What the library raises, read from its sources."""

import ast
import pathlib

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
