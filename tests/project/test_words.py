"""No identifier contains one of the words that earlier versions used as private terms."""

import ast
import pathlib
import re

ROOT = pathlib.Path(__file__).parents[2]
FOLDERS = ("svkc", "tests", "benchmarks", "examples")
PRIVATE_WORDS = frozenset(
    """
    agree agreed agreeing ahead asked brought carried chosen emptied filled found given going hit
    holding how joining jumped late listed looked looking made march marching met moving said seen
    settle settled sizes staged still taking tally tried verb wanted watched whole wish world
    """.split()
)
# identifiers of the interfaces of other libraries
OF_LIBRARIES = frozenset({"FileNotFoundError", "made_jump", "slice_sizes"})


def words(identifier: str) -> list[str]:
    """Return the words of an identifier, split at underscores and capitals."""
    parts = re.findall(r"[A-Z]+(?![a-z])|[A-Z][a-z0-9]*|[a-z0-9]+", identifier)
    return [part.lower() for part in parts]


def identifiers(path: pathlib.Path):
    """Yield (line, identifier) for every identifier of a file."""
    for node in ast.walk(ast.parse(path.read_text())):
        match node:
            case ast.Name(id=name) | ast.Attribute(attr=name) | ast.arg(arg=name):
                yield node.lineno, name
            case ast.FunctionDef(name=name) | ast.ClassDef(name=name):
                yield node.lineno, name
            case ast.keyword(arg=str(name)) | ast.alias(asname=str(name)):
                yield node.lineno, name
            case ast.alias(name=name):
                yield from ((node.lineno, part) for part in name.split("."))


def private(path: pathlib.Path) -> list[str]:
    """Return "file:line: identifier" for each identifier that holds a private word."""
    return sorted(
        {
            f"{path.relative_to(ROOT)}:{line}: {name}"
            for line, name in identifiers(path)
            if name not in OF_LIBRARIES and PRIVATE_WORDS & set(words(name))
        }
    )


def test_no_identifier_holds_a_private_word():
    paths = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")]
    assert len(paths) > 150
    uses = [line for path in paths for line in private(path)]
    assert not uses, "\n".join(uses)


def test_every_kind_of_identifier_is_searched(tmp_path, monkeypatch):
    monkeypatch.setattr("test_words.ROOT", tmp_path)
    file = tmp_path / "module.py"
    file.write_text(
        "import a.marching\nfrom b import c as settled\nclass TallyOf:\n    how_long: int\n"
        "def given(x_said, *, made):\n    World = x_said.agree\n    f(sizes=1)\n"
    )
    assert [line.split(": ")[1] for line in private(file)] == [
        "marching", "settled", "TallyOf", "how_long", "given", "made", "x_said", "World", "agree",
        "x_said", "sizes",
    ]  # fmt: skip
