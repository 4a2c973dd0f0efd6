"""The pages of the documentation: their code runs, the reference is complete, the site is whole."""

import ast
import re
import runpy
import shutil

import jax
import nbformat
import pytest
from processes import ROOT, run
from test_public_api import public_objects

DOCS = ROOT / "docs"
# pages whose code takes less than four seconds
FAST = ("reference/bodies", "reference/derivatives", "reference/interop")


conf = runpy.run_path(str(DOCS / "conf.py"))
docstrings = conf["docstrings"]


def pages_with_code() -> list:
    """Return the names of the pages with Python blocks, as parameters of a test."""
    names = [
        page.relative_to(DOCS).with_suffix("").as_posix()
        for page in sorted(DOCS.rglob("*.md"))
        # tests/mjcf/test_load.py runs the gallery's
        if "\n```python\n" in page.read_text() and page.stem != "gallery"
    ]
    return [name if name in FAST else pytest.param(name, marks=pytest.mark.slow) for name in names]


@pytest.mark.parametrize("name", pages_with_code())
def test_the_code_of_a_page_runs(name, tmp_path, monkeypatch):
    """The Python blocks of a page run one after another, with JAX's own settings but float64.

    The models of docs/models are in the working directory.
    """
    shutil.copytree(DOCS / "models", tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    namespace = {"__name__": "page"}
    page = DOCS / f"{name}.md"
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        for line, code in docstrings.python_blocks(page):
            # errors name the line of the page
            exec(compile("\n" * line + code, page, "exec"), namespace)
    if "plt" in namespace:
        namespace["plt"].close("all")


def literal_subscripts(code: str) -> list[str]:
    """Return the subscripts of q, v and tau by literal numbers, such as `state.q[7:23]`."""
    return [
        ast.unparse(node)
        for node in ast.walk(ast.parse(code))
        if isinstance(node, ast.Subscript)
        and re.search(r"\b(q|v|tau)(\.at)?$", ast.unparse(node.value))
        and any(isinstance(getattr(x, "value", None), int) for x in ast.walk(node.slice))
    ]


def code_of_examples() -> list[tuple[str, str]]:
    """Return (place, code) of every example, and of every cell of the notebook."""
    files = sorted((ROOT / "examples").glob("*.py"))
    cells = nbformat.read(ROOT / "examples" / "tour.ipynb", 4).cells
    code = [cell.source for cell in cells if cell.cell_type == "code"]
    # lines of IPython are no Python
    code = [re.sub(r"^%.*", "", source, flags=re.M) for source in code]
    return [(f.name, f.read_text()) for f in files] + [("tour", source) for source in code]


def test_no_page_or_example_reads_coordinates_by_number():
    assert literal_subscripts("state.q[7:23], tau[0], run.v[:, 2]; q[f('x')] + v[j]") == [
        "state.q[7:23]",
        "tau[0]",
        "run.v[:, 2]",
    ]
    for page in (ROOT / "README.md", *DOCS.rglob("*.md")):
        for line, code in docstrings.python_blocks(page):
            assert not literal_subscripts(code), f"{page}:{line}"
    examples = code_of_examples()
    assert len(examples) > 15
    for place, code in examples:
        assert not literal_subscripts(code), place


def test_every_public_name_has_an_entry_with_an_example():
    text = "\n".join(page.read_text() for page in (DOCS / "reference").glob("*.md"))
    entries = re.findall(r"^\.\. auto\w+:: svkc\.([\w.]+)(\n +:members:)?", text, re.M)
    assert len(entries) == len(dict(entries)), "a name has two entries"
    with_members = {name.split(".")[-1] for name, members in entries if members}
    without_entry = {
        name
        for name in public_objects()
        if name not in dict(entries) and name.split(".")[0] not in with_members
    }
    assert not without_entry
    paths = {name: re.sub(r"^Report\.", "types.Report.", name) for name in public_objects()}
    without_example = {name for name, path in paths.items() if not docstrings.EXAMPLES.get(path)}
    assert not without_example


@pytest.mark.slow
def test_the_site_is_built_without_warnings(tmp_path):
    """`-W` makes warnings errors; the build itself checks the links of the built pages."""
    done = run(*f"-m sphinx -q -W -b html {DOCS} {tmp_path}".split())
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "searchindex.js").stat().st_size > 10_000
    assert 'id="svkc.poses"' in (tmp_path / "reference" / "bodies.html").read_text()


def test_broken_links_are_reported(tmp_path):
    (tmp_path / "b.html").write_text('<h1 id="here">b</h1><a name="there"></a>')
    (tmp_path / "a.html").write_text(
        '<a href="b.html#here">1</a><a href="b.html#there">2</a><a href="https://x.y/z">3</a>'
        '<a href="b.html#nowhere">4</a><img src="c.png"><a href="#missing">5</a><a href="#">6</a>'
    )
    assert conf["broken_links"](tmp_path) == [
        "a.html: b.html#nowhere",
        "a.html: c.png",
        "a.html: #missing",
    ]
