"""Reference entries from the docstrings of svkc, for `sphinx.ext.autodoc`; used by conf.py.

Annotations are written as the sources have them, with their shapes. A docstring's lines
`name: description` become a list of parameters or fields. Each entry ends with links to pages whose
code uses the name.
"""

import ast
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
    "types.CenterOfMass": "center_of_mass",
    "types.ChainNames": "Chain.names",
    "types.Coordinates": "coordinates",
    "types.DERIVATIVE": "Trajectory.derivative",
    "types.Events": "Trajectory.events",
    "types.GradientCheck": "check_grad",
    "types.Jacobian": "loop_jacobian",
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


def parameters(thing) -> dict[str, str]:
    """Return the annotation of each parameter of a function, or field of a class, as written.

    Functions have their return annotation under "return".
    """
    if inspect.isclass(thing):
        bases = [
            parameters(base) for base in thing.__bases__ if base.__module__.startswith("svkc.")
        ]
        body = ast.parse(textwrap.dedent(inspect.getsource(thing))).body[0].body
        found = {
            node.target.id: node.annotation
            for node in body
            if isinstance(node, ast.AnnAssign) and node.target.id[0] != "_"
        }
    else:
        bases = []
        function = ast.parse(textwrap.dedent(inspect.getsource(inspect.unwrap(thing)))).body[0]
        every = [
            *function.args.posonlyargs,
            *function.args.args,
            *function.args.kwonlyargs,
        ]
        every += [x for x in (function.args.vararg, function.args.kwarg) if x]
        found = {x.arg: x.annotation for x in every} | {"return": function.returns}
    own = {name: _annotation(node) for name, node in found.items()}
    return {name: text for base in bases for name, text in base.items()} | own


def _annotation(node) -> str:
    """Return an annotation as text, without the marker `Checked` and quotation marks."""
    if node is None:
        return ""
    text = ast.unparse(node)
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        text = node.value
    while match := re.search(r"\bChecked\[", text):
        depth, end = 1, match.end()
        while depth:
            depth += {"[": 1, "]": -1}.get(text[end], 0)
            end += 1
        text = text[: match.start()] + text[match.end() : end - 1] + text[end:]
    return text.replace("' ", "'").replace("'", '"')


def format_signature(app, what, path, thing, options, signature, returned):
    """Return the signature of an entry with the annotations of the source."""
    name = path.removeprefix("svkc.")
    if name in MADE_BY_FUNCTIONS or name.startswith("types."):
        return "", ""
    if what not in ("function", "method", "class") or not callable(thing):
        return None
    annotations = parameters(thing)
    parts, keyword_only = [], False
    for parameter in inspect.signature(thing).parameters.values():
        if parameter.name == "self":
            continue
        if parameter.kind is parameter.KEYWORD_ONLY and not keyword_only:
            keyword_only = True
            parts.append("*")
        stars = {parameter.VAR_POSITIONAL: "*", parameter.VAR_KEYWORD: "**"}.get(parameter.kind, "")
        keyword_only |= stars == "*"
        text = stars + parameter.name
        if annotations.get(parameter.name):
            text += f": {_linked(annotations[parameter.name])}"
        if parameter.default is not parameter.empty:
            text += f" = {parameter.default!r}"
        parts.append(text)
    return f"({', '.join(parts)})", _linked(annotations.get("return", ""))


def _linked(annotation: str) -> str:
    """Return an annotation in which result types have the paths of their entries."""
    results = "|".join(name.split(".")[1] for name in PUBLIC if "." in name and "types." in name)
    return re.sub(rf"(?<![\w.])({results})\b", r"~svkc.types.\1", annotation)


def _text(line: str, own: set[str]) -> str:
    """Return a line of a docstring as reStructuredText; names in backticks become links.

    own: parameters of the object, which are no links.
    """
    parts = re.split(r"`([^`]*)`", line)
    for i, part in enumerate(parts):
        if i % 2 == 0:
            text = re.sub(r"([*|\\])|(?<=\w)_(?=\W|$)", r"\\\g<0>", part)
            parts[i] = re.sub(r"^(?=\w)", r"\\ ", text) if i else text  # a role ends at a space
            continue
        name = re.sub(r"\(.*\)$", "", part).removeprefix("svkc.")
        first, _, rest = name.partition(".")
        for cls, variables in OBJECTS_IN_EXAMPLES.items():
            name = f"{cls}.{rest}" if first in variables and rest else name
        matches = [path for path in PUBLIC if path == name or path.endswith(f".{name}")]
        role = (
            "func" if matches and inspect.isfunction(inspect.unwrap(PUBLIC[matches[0]])) else "obj"
        )
        exists = len(matches) == 1 and name not in own and "." + matches[0] not in FIELDS
        parts[i] = f":py:{role}:`{part} <svkc.{matches[0]}>`" if exists else f"``{part}``"
    return "".join(parts)


# fields of results are described in the entries of their classes
FIELDS = {f".{path}.{field}" for path in OBJECTS_IN_EXAMPLES for field in parameters(PUBLIC[path])}


def format_docstring(app, what, path, thing, options, lines):
    """Replace a docstring's lines `name: description` by a list of parameters or fields.

    Lines that follow are part of a description up to an empty line or a line that starts with
    "Raises". An entry ends with links to pages that use the name.
    """
    described = thing.fget if isinstance(thing, property) else thing
    own = {}
    if what != "module" and (inspect.isclass(thing) or callable(described)):
        own = parameters(described)
    returned = own.pop("return", "")
    name = re.compile(rf"`?({'|'.join(own) or '(?!)'})`?(?=[:,])")
    rows: list[tuple[str | None, list[str]]] = [(None, [])]
    text = "\n".join(lines)
    # several descriptions on one line
    text = re.sub(rf"(?<=[.;]) (?={name.pattern}:)", "\n", text)
    for line in text.split("\n"):
        head = re.match(rf"({name.pattern}(, {name.pattern})*): ?", line)
        if head:
            rows.append((head[1].replace("`", ""), [line[head.end() :].strip()]))
        elif rows[-1][0] and (not line.strip() or line.startswith("Raises ")):
            rows.append((None, ["", line]))
        else:
            rows[-1][1].append(line.strip() if rows[-1][0] else line)
    is_class = inspect.isclass(thing)
    heading = ["", f".. rubric:: {'Fields' if is_class else 'Parameters'}", ""]
    result = [f"``{returned}``", ""] if isinstance(thing, property) else []
    for names, description in rows:
        content = [_text(line, set(own)) for line in description]
        if names is None:
            result += content
            continue
        types = {own[name] for name in names.split(", ")}
        shape = f" : ``{types.pop()}``" if is_class else ""
        term = ", ".join(f"``{name}``" for name in names.split(", "))
        result += [*heading, term + shape, *(f"    {line}" for line in content), ""]
        heading = []
    pages = EXAMPLES.get(path.removeprefix("svkc."), [])[:3]
    if pages:
        result += [
            "",
            "*Examples:* " + ", ".join(f":doc:`/{page}`" for page in pages),
            "",
        ]
    lines[:] = result
