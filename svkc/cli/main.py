"""The command line. `svkc` or `python -m svkc` without arguments runs the high bar."""

import argparse
import math
import pathlib
import sys
from collections.abc import Sequence

from svkc.cli import inspect, run

IGNORE_HELP = "kinds of model elements to leave out, separated by commas, or all; may be repeated"


def _event_parser(kind: str):
    """Return a parser of NAME@TIME, for argparse, that returns (kind, link, seconds).

    kind: "release" or "catch".
    """

    def parse(text: str):
        link, _, time = text.rpartition("@")
        try:
            seconds = float(time)
        except ValueError:
            seconds = math.nan
        if not link or not math.isfinite(seconds):
            raise argparse.ArgumentTypeError(
                f"expected NAME@TIME, a virtual link and seconds, got {text!r}"
            )
        return kind, link, seconds

    return parse


def _argument_parser() -> argparse.ArgumentParser:
    """Return the parser of all commands."""
    parser = argparse.ArgumentParser(
        "svkc",
        description=(
            "Structure-varying kinematic chains. Without a command: the high bar, release and all."
        ),
    )
    add = parser.add_subparsers(dest="command", metavar="COMMAND", required=True).add_parser
    _add_run_options(
        add(
            "run",
            help="simulate a scene, or a model from its load pose: table, npz, pictures, page",
        )
    )
    info = add("info", help="print what svkc reads from a model")
    info.add_argument("model", help="MJCF or URDF file")
    info.add_argument("--ignore", action="append", default=[], metavar="KINDS", help=IGNORE_HELP)
    view = add("view", help="table, curves and page of a saved run")
    view.add_argument("file", type=pathlib.Path, help="an .npz written by traj.save(path, chain)")
    view.add_argument("--no-open", action="store_true", help="write the page and do not open it")
    add("scenes", help="list the scenes that ship with svkc")
    return parser


def _add_run_options(parser: argparse.ArgumentParser):
    """Add the arguments of `svkc run` to its parser."""
    add = parser.add_argument
    add(
        "what",
        nargs="?",
        default="high_bar",
        metavar="SCENE|MODEL",
        help="a name that `svkc scenes` lists (default: high_bar), or an MJCF or URDF file",
    )
    add("--t1", type=float, help="end time, s")
    for kind, purpose in (
        ("release", "cut a virtual link"),
        ("catch", "connect a virtual link at the poses of its bodies"),
    ):
        add(
            f"--{kind}",
            dest="events",
            action="append",
            default=[],
            type=_event_parser(kind),
            metavar="NAME@TIME",
            help=f"{purpose} at a time, s; may be repeated; replaces the scene's own events",
        )
    add("--ignore", action="append", default=[], metavar="KINDS", help=IGNORE_HELP)
    folder = pathlib.Path("out")
    add("--out", type=pathlib.Path, default=folder, help="folder for results (default: out)")
    add("--mp4", action="store_true", help="write an mp4 as well (needs the extra svkc[video])")
    add("--quiet", action="store_true", help="no progress bar")


def _kinds(words: list[str]) -> tuple[str, ...]:
    """Return the kinds of `--ignore`, each of whose words may hold several."""
    return tuple(kind for word in words for kind in word.split(",") if kind)


def main(argv: Sequence[str] | None = None) -> int:
    """Parse the command line, run the command, and return the exit status."""
    argv = list(sys.argv[1:] if argv is None else argv)
    # `run` is the default command
    if (
        not argv
        or argv[0] in run.SCENES
        or (argv[0].startswith("-") and argv[0] not in ("-h", "--help"))
    ):
        argv = ["run", *argv]
    options = _argument_parser().parse_args(argv)
    if options.command == "run":
        return run.run(
            options.what,
            t1=options.t1,
            events=options.events,
            ignore=_kinds(options.ignore),
            out=options.out,
            video=options.mp4,
            quiet=options.quiet,
        )
    if options.command == "info":
        return inspect.info(options.model, _kinds(options.ignore))
    if options.command == "view":
        return inspect.view(options.file, not options.no_open)
    return run.scenes()
