"""Configuration of the documentation's site: Sphinx reads the pages of this folder.

`python -m sphinx -W -b html docs out/docs` builds the site. docstrings.py makes the entries of the
reference. The functions below give links to files outside of this folder their pages, and check the
links of the built pages.
"""

import html.parser
import importlib.metadata
import pathlib
import re
import sys
import urllib.parse

from docutils import nodes
from sphinx import addnodes, errors

DOCS = pathlib.Path(__file__).parent
sys.path.insert(0, str(DOCS))
import docstrings

project = "svkc"
author = "the authors of svkc"
version = release = importlib.metadata.version("svkc")
extensions = ["myst_parser", "sphinx.ext.autodoc"]
html_theme = "furo"
html_title = f"svkc {version}"
html_css_files = ["site.css"]
html_static_path = ["_static"]
html_show_copyright = html_show_sphinx = False
highlight_language = "none"
maximum_signature_line_length = 88
html_copy_source = False
myst_heading_anchors = 4
myst_enable_extensions = ["alert"]
myst_links_external_new_tab = False
nitpicky = True
nitpick_ignore = [
    ("py:class", name)
    for name in """
    Any Array Bool Callable Float Int MuJoCo Sequence pathlib.Path
    At When Touch Leaves Overload Page
    Guess AbstractSolver Program SolverResult Check Between Constraint Limits Mapping[str
    PhaseMotion Multipliers LinearMaps LinkRows AbstractControls np.ndarray
    """.split()
]
autodoc_typehints = "none"  # `format_signature` writes annotations as the sources have them
autodoc_member_order = "bysource"
# files outside of this folder that have a page of the site
PAGES_OF_FILES = {
    "README": "index",
    "CONTRIBUTING": "contributing",
    "CHANGELOG": "changelog",
    "benchmarks/README": "benchmarks",
}


class _Links(html.parser.HTMLParser):
    """The targets of a page's links, images and scripts, and the anchors of the page."""

    def __init__(self):
        super().__init__()
        self.links, self.anchors = [], set()

    def handle_starttag(self, tag, attrs):
        for key, value in attrs:
            if key in ("href", "src") and value:
                self.links.append(value)
            elif key == "id" or (key == "name" and tag == "a"):
                self.anchors.add(value)


def broken_links(folder: pathlib.Path) -> list[str]:
    """Return "page: link" for each link within a built site that leads nowhere."""
    pages = {}
    for path in folder.rglob("*.html"):
        pages[path] = _Links()
        pages[path].feed(path.read_text())
    broken = []
    for path, page in pages.items():
        for link in page.links:
            url = urllib.parse.urlsplit(link)
            if url.scheme or url.netloc or (not url.path and url.fragment in ("", "top")):
                continue
            target = (path.parent / urllib.parse.unquote(url.path)).resolve() if url.path else path
            anchor = urllib.parse.unquote(url.fragment)
            if not target.exists() or (
                target in pages and anchor and anchor not in pages[target].anchors
            ):
                broken.append(f"{path.relative_to(folder)}: {link}")
    return broken


def check_links(app, exception):
    """Fail the build if a link within the site leads nowhere."""
    if exception is None and app.builder.format == "html":
        if broken := broken_links(pathlib.Path(app.outdir).resolve()):
            raise errors.ExtensionError("links that lead nowhere:\n" + "\n".join(broken))


def mend_tree(app, tree):
    """Point links to files outside of this folder at their pages; write shapes in double quotes."""
    for link in tree.findall(addnodes.pending_xref):
        target, _, anchor = (link["reftarget"] or "").partition("#")
        file = re.sub(rf"^({re.escape(str(DOCS.parent))}/|(\.\./)+)|\.md$", "", target)
        if link.get("reftype") == "myst" and file in PAGES_OF_FILES:
            link["refdomain"], link["reftarget"] = "doc", PAGES_OF_FILES[file]
            link["reftargetid"] = link.get("reftargetid") or anchor or None
    for shape in tree.findall(addnodes.desc_sig_literal_string):
        shape.children = [nodes.Text(shape.astext().replace("'", '"'))]


def setup(app):
    """Connect the functions of this file."""
    app.connect("autodoc-process-signature", docstrings.format_signature)
    app.connect("autodoc-process-docstring", docstrings.format_docstring)
    app.connect("doctree-read", mend_tree)
    app.connect("build-finished", check_links)
