"""README, pages and changelog: size, links, paths, public names and versions."""

import importlib.metadata
import pathlib
import re
import tomllib

import pytest

import svkc
from svkc import _deprecated

ROOT = pathlib.Path(__file__).parents[2]
PAGES = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").rglob("*.md"))]
PACKAGES = {path.parent.name for path in (ROOT / "svkc").glob("*/__init__.py")}
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def page_id(page: pathlib.Path) -> str:
    """Return the path of a page within the project."""
    return page.relative_to(ROOT).with_suffix("").as_posix()


def anchors(page: pathlib.Path) -> set[str]:
    """Return the anchors that GitHub makes of a page's headings."""
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.S)
    headings = re.findall(r"^#+ (.*)$", text, re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_bytes()) <= 9500


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_links_have_targets(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if target.startswith("http"):
            continue
        path, _, anchor = target.partition("#")
        file = page.parent / path if path else page
        assert file.exists(), target
        assert not anchor or anchor in anchors(file), target


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_paths_exist(page):
    """Files of the project that a page names exist. The changelog may name removed files."""
    named = re.findall(r"`((?:svkc|tests|benchmarks|examples|docs)/[\w/.]+\.\w+)", page.read_text())
    missing = [path for path in named if not (ROOT / path).exists()]
    assert page.stem == "CHANGELOG" or not missing, missing


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_public_names_exist(page):
    """Every `svkc.name` of a page exists. The changelog and the page of errors have old names."""
    if page.stem == "CHANGELOG":
        return
    old = {*_deprecated.RENAMED, *_deprecated.SUPERSEDED} if page.stem == "errors" else set()
    for name in re.findall(r"\bsvkc\.([A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*)", page.read_text()):
        thing, parts = svkc, name.split(".")
        if name in old or parts[0] in PACKAGES or parts[-1] in ("npz", "xml", "invalid"):
            continue
        for part in parts:
            assert hasattr(thing, part), f"svkc.{name}"
            thing = getattr(thing, part)


def test_one_version_everywhere():
    version = PROJECT["version"]
    assert re.search(rf"^## {re.escape(version)}$", (ROOT / "CHANGELOG.md").read_text(), re.M)
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()


def test_every_dependency_has_a_lower_bound():
    extras = PROJECT["optional-dependencies"].values()
    for line in [*PROJECT["dependencies"], *(line for extra in extras for line in extra)]:
        assert line.startswith("svkc[") or re.search(r">=|~=|==", line), line


def test_licences_are_packaged():
    for file in PROJECT["license-files"]:
        assert (ROOT / file).exists(), file
    assert "three.js" in (ROOT / "svkc/viz/web/LICENSE.three").read_text()
    assert importlib.metadata.metadata("svkc")["Name"] == "svkc"
