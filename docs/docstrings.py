"""Reference entries from the docstrings of svkc, for `sphinx.ext.autodoc`; used by conf.py.

Annotations are written as the sources have them, with their shapes. A docstring's lines
`name: description` become a list of parameters or fields. Each entry ends with links to pages whose
code uses the name.
"""

import ast
import functools
import inspect
import pathlib
import re
import textwrap

import svkc

DOCS = pathlib.Path(__file__).parent
NAMESPACES = (
    "accuracy",
    "dynamics",
    "integrators",
    "interop",
    "stabilization",
    "types",
)
# classes whose methods and properties have entries, and the names of their objects in examples
OBJECTS_IN_EXAMPLES = {
    "Chain": ("chain",),
    "State": ("state",),
    "Trajectory": ("traj", "lanes"),
    "types.InverseDynamics": ("along",),
    "types.Report": ("report",),
}
# classes that users do not construct; their entries have no signature
MADE_BY_FUNCTIONS = (
    "Chain",
    "State",
    "Structure",
    "Trajectory",
    "RESULTS",
    "accuracy.Tuning",
)
# types that examples do not name: the expression that gives one
GIVEN_BY = {
    "State": "Chain.state",
    "Structure": "State.structure",
    "accuracy.Tuning": "accuracy.tune",
    "Chain": "load",
    "Trajectory": "simulate",
    "types.AbstractDynamics": "dynamics.CompositeBodies",
    "types.AbstractGuard": "touch",
    "types.Actuation": "actuation",
    "types.BodyParameters": "Chain.body",
    "types.CenterOfMass": "center_of_mass",
    "types.ChainNames": "Chain.names",
    "types.Coordinates": "coordinates",
    "types.DERIVATIVE": "Trajectory.derivative",
    "types.Events": "Trajectory.events",
    "types.GradientCheck": "check_grad",
    "types.Jacobian": "loop_jacobian",
    "types.InverseDynamics": "inverse_dynamics_along",
    "types.JointState": "Chain.joint",
    "types.LoopForces": "loop_forces",
    "types.Mobility": "mobility",
    "types.Momentum": "momentum",
    "types.Phases": "Trajectory.phases",
    "types.Poses": "poses",
    "types.Report": "Trajectory.report",
    "types.Velocities": "velocities",
}


def public_names() -> dict[str, object]:
    """Return every public object by its path below `svkc`, fields of results included."""
    names = {name: getattr(svkc, name) for name in svkc.__all__ if name not in NAMESPACES}
    for space in NAMESPACES:
        members = vars(getattr(svkc, space)).items()
        names |= {f"{space}.{n}": x for n, x in members if n[0] != "_" and not inspect.ismodule(x)}
    for path in OBJECTS_IN_EXAMPLES:
        bases = [base for base in names[path].__mro__ if base.__module__.startswith("svkc.")]
        members = [name for base in bases for name in [*base.__annotations__, *vars(base)]]
        names |= {
            f"{path}.{name}": inspect.getattr_static(names[path], name, None)
            for name in members
            if name[0] != "_"
        }
    return names


PUBLIC = public_names()


def python_blocks(page: pathlib.Path) -> list[tuple[int, str]]:
    """Return (number of the first line, code) of each Python block of a page."""
    text = page.read_text()
    return [
        (text[: block.start(1)].count("\n") + 1, block[1])
        for block in re.finditer(r"^```python\n(.*?)^```$", text, re.S | re.M)
    ]


def names_in(code: str) -> set[str]:
    """Return the paths of the public names that a piece of code uses."""
    used = set()
    for node in ast.walk(ast.parse(code)):
        if not isinstance(node, ast.Attribute):
            continue
        root, _, path = ast.unparse(node).partition(".")
        if root == "svkc":
            used.add(path)
        used |= {
            f"{cls}.{path.split('.')[0]}"
            for cls, variables in OBJECTS_IN_EXAMPLES.items()
            if root in variables
        }
    return used & set(PUBLIC)


def examples() -> dict[str, list[str]]:
    """Return the pages whose code uses a name, by the path of the name; how-tos come first."""
    pages: dict[str, list[str]] = {}
    order = lambda page: ("howto" not in page.parts, "reference" in page.parts, page)
    for page in sorted(DOCS.rglob("*.md"), key=order):
        used = set().union(*(names_in(code) for _, code in python_blocks(page)))
        for name in used:
            pages.setdefault(name, []).append(page.relative_to(DOCS).with_suffix("").as_posix())
    for name, source in GIVEN_BY.items():
        pages.setdefault(name, pages.get(source, []))
    return pages


EXAMPLES = examples()


class _Plain(ast.NodeTransformer):
    """Replace `Checked[X]`, whose values svkc validates itself, by X."""

    def visit_Subscript(self, node):
        self.generic_visit(node)
        return node.slice if ast.unparse(node.value) == "Checked" else node


def _annotation(node) -> str:
    """Return an annotation as text: shapes in double quotes, forward references in none."""
    if node is None:
        return ""
    node = _Plain().visit(node)
    text = node.value if isinstance(node, ast.Constant) and node.value else ast.unparse(node)
    return text.replace("' ", "'").replace("'", '"')


def parameters(thing) -> dict[str, str]:
    """Return the annotation of each parameter of a function, or field of a class, as written.

    Functions have their return annotation under "return".
    """
    definition = ast.parse(textwrap.dedent(inspect.getsource(inspect.unwrap(thing)))).body[0]
    found = {}
    if isinstance(definition, ast.ClassDef):
        for base in thing.__bases__:
            found |= parameters(base) if base.__module__.startswith("svkc.") else {}
        fields = [node for node in definition.body if isinstance(node, ast.AnnAssign)]
        own = [node for node in definition.body if getattr(node, "name", "") == "__init__"]
        if own and not fields:
            every = [node for node in ast.walk(own[0].args) if isinstance(node, ast.arg)]
            return {node.arg: _annotation(node.annotation) for node in every}
        return found | {
            field.target.id: _annotation(field.annotation)
            for field in fields
            if field.target.id[0] != "_"
        }
    every = [node for node in ast.walk(definition.args) if isinstance(node, ast.arg)]
    found = {node.arg: _annotation(node.annotation) for node in every}
    return found | {"return": _annotation(definition.returns)}


def _linked(annotation: str) -> str:
    """Return an annotation in which result types have the paths of their entries."""
    results = "|".join(name.removeprefix("types.") for name in PUBLIC if name.startswith("types."))
    return re.sub(rf"(?<![\w.])({results})\b", r"~svkc.types.\1", annotation)


def format_signature(app, what, path, thing, options, signature, returned):
    """Return the signature of an entry with the annotations of the source."""
    name = path.removeprefix("svkc.")
    if name in MADE_BY_FUNCTIONS or name.startswith("types."):
        return ("", "") if what == "class" else None
    if what not in ("function", "method", "class"):
        return None
    annotations = parameters(thing)
    parts, star = [], False
    for x in inspect.signature(thing).parameters.values():
        if x.name == "self":
            continue
        if x.kind is x.KEYWORD_ONLY and not star:
            parts.append("*")
        star |= x.kind in (x.KEYWORD_ONLY, x.VAR_POSITIONAL)
        text = {x.VAR_POSITIONAL: "*", x.VAR_KEYWORD: "**"}.get(x.kind, "") + x.name
        text += f": {_linked(annotations[x.name])}" if annotations.get(x.name) else ""
        text += f" = {x.default!r}" if x.default is not x.empty else ""
        parts.append(text)
    return f"({', '.join(parts)})", _linked(annotations.get("return", ""))


# fields of results are described in the entries of their classes
FIELDS = {f"{path}.{field}" for path in OBJECTS_IN_EXAMPLES for field in parameters(PUBLIC[path])}


def _link(code: str, own: set[str]) -> str:
    """Return a piece of code as a link to its entry, or as a literal if it has none.

    own: parameters of the object described, which are no links.
    """
    name = re.sub(r"\(.*\)$", "", code).removeprefix("svkc.")
    first, _, rest = name.partition(".")
    for cls, variables in OBJECTS_IN_EXAMPLES.items():
        name = f"{cls}.{rest}" if rest and first in (*variables, cls.split(".")[-1]) else name
    # classes of namespaces are linked by their names alone
    matches = [path for path in PUBLIC if name[:1].isupper() and path.endswith(f".{name}")]
    path = name if name in PUBLIC else matches[0] if len(matches) == 1 else ""
    linked = path and name not in own and path not in FIELDS
    return f":py:obj:`{code} <svkc.{path}>`" if linked else f"``{code}``"


def _text(line: str, own: set[str]) -> str:
    """Return a line of a docstring as reStructuredText; names in backticks become links."""
    parts = re.split(r"`([^`]*)`", line)
    for i in range(0, len(parts), 2):
        parts[i] = re.sub(r"([*|\\])|(?<=\w)_(?=\W|$)", r"\\\g<0>", parts[i])
        if i:  # a link ends at a space
            parts[i] = re.sub(r"^(?=\w)", r"\\ ", parts[i])
    parts[1::2] = [_link(code, own) for code in parts[1::2]]
    return "".join(parts)


def _rows(text: str, own: set[str]) -> list[tuple[list[str], list[str]]]:
    """Return (names described, lines) of each part of a docstring; text has no names.

    A description ends at an empty line, or at a line that starts with "Raises".
    """
    name = rf"`?(?:{'|'.join(own) or '(?!)'})`?"
    text = re.sub(rf"(?<=[.;]) (?={name}: )", "\n", text)  # several descriptions on one line
    rows: list[tuple[list[str], list[str]]] = [([], [])]
    for line in text.split("\n"):
        if head := re.match(rf"({name}(?:, {name})*): ?", line):
            names = head[1].replace("`", "").split(", ")
            rows.append((names, [line[head.end() :].strip()]))
        elif rows[-1][0] and (not line.strip() or line.startswith("Raises ")):
            rows.append(([], ["", line]))
        else:
            rows[-1][1].append(line.strip() if rows[-1][0] else line)
    return rows


def format_docstring(app, what, path, thing, options, lines):
    """Replace a docstring's lines `name: description` by a list of parameters or fields.

    An entry ends with links to pages that use the name.
    """
    cached = isinstance(thing, functools.cached_property)
    is_property, is_class = cached or isinstance(thing, property), inspect.isclass(thing)
    getter = thing.func if cached else thing.fget if is_property else thing
    own = parameters(getter)
    returned = own.pop("return", "")
    heading = ["", f".. rubric:: {'Fields' if is_class else 'Parameters'}", ""]
    result = [f"``{returned}``", ""] if is_property else []
    for names, description in _rows("\n".join(lines), set(own)):
        content = [_text(line, set(own)) for line in description]
        if not names:
            result += content
            continue
        shape = f" : ``{own[names[0]]}``" if is_class else ""
        term = ", ".join(f"``{name}``" for name in names) + shape
        result += [*heading, term, *(f"    {line}" for line in content), ""]
        heading = []
    pages = EXAMPLES.get(path.removeprefix("svkc."), [])[:3]
    links = ", ".join(f":doc:`/{page}`" for page in pages)
    lines[:] = [*result, "", f"*Examples:* {links}", ""] if pages else result
