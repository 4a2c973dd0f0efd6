"""Tables of text: what `print` shows of chains and results, and a notebook as HTML."""

import abc
import dataclasses
import html
from collections.abc import Iterable, Sequence
from typing import Any, TypeAlias

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer


@dataclasses.dataclass(frozen=True)
class Table:
    """Rows of cells under a header. Columns of numbers are aligned to the right.

    header: titles of the columns, with units, of one line or several; none: no header.
    rows: cells of each row.
    most: number of rows shown; a last line counts the others.
    """

    header: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    most: int = 40

    @property
    def remainder(self) -> str:
        """The line that counts the rows that are not shown; "" if all are shown."""
        more = len(self.rows) - self.most
        return f"... {count(more, 'more row')}" if more > 0 else ""

    @property
    def columns_of_numbers(self) -> list[bool]:
        """Whether each column has numbers only; "" and "-" stand for none."""
        return [
            any(map(_is_number, column)) and all(x in ("", "-") or _is_number(x) for x in column)
            for column in zip(*self.rows, strict=True)
        ]

    def as_text(self) -> str:
        """Return the table as lines of text."""
        titles = [title.split("\n") for title in self.header]
        height = max(map(len, titles), default=0)
        lines = [tuple(t[i] if i < len(t) else "" for t in titles) for i in range(height)]
        lines += self.rows[: self.most]
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        right = self.columns_of_numbers or [False] * len(widths)
        align = lambda cell, width, right: cell.rjust(width) if right else cell.ljust(width)
        text = ["  ".join(map(align, line, widths, right)).rstrip() for line in lines]
        return "\n".join([*text, *filter(None, [self.remainder])])

    def as_html(self) -> str:
        """Return the table as HTML."""
        sides = ["right" if right else "left" for right in self.columns_of_numbers]
        sides = sides or ["left"] * len(self.header)

        def row(tag, cells):
            return "<tr>{}</tr>".format(
                "".join(
                    f'<{tag} style="text-align:{side}">{_escape(cell)}</{tag}>'
                    for cell, side in zip(cells, sides, strict=True)
                )
            )

        head = f"<thead>{row('th', self.header)}</thead>" if self.header else ""
        body = "".join(row("td", cells) for cells in self.rows[: self.most])
        rest = f"<p>{self.remainder}</p>" if self.remainder else ""
        return f"<table>{head}<tbody>{body}</tbody></table>{rest}"


Block: TypeAlias = str | Table


class Printed(eqx.Module):
    """Base of the objects that `print` and notebooks show as lines and tables.

    An object with traced or missing arrays is shown by its `repr`.
    """

    @abc.abstractmethod
    def _blocks(self) -> list[Block]:
        """Return the lines and tables to show, from top to bottom."""

    def __str__(self) -> str:
        if not is_readable(self):
            return repr(self)
        return as_text(self._blocks())

    def _repr_html_(self) -> str:
        if not is_readable(self):
            return f"<pre>{html.escape(repr(self))}</pre>"
        return "\n".join(
            f"<p>{_escape(b)}</p>" if isinstance(b, str) else b.as_html() for b in self._blocks()
        )


def as_text(blocks: list[Block]) -> str:
    """Return lines and tables as text, with an empty line between two tables."""
    text = ""
    for block, following in zip(blocks, [*blocks[1:], ""], strict=True):
        text += (block if isinstance(block, str) else block.as_text()) + "\n"
        text += "\n" * (isinstance(block, Table) and isinstance(following, Table))
    return text.removesuffix("\n")


def is_readable(value: Any) -> bool:
    """Return whether every array of an object is present and has values: none is traced."""
    if dataclasses.is_dataclass(value):
        return all(
            is_readable(part) or (part is None and field.default is None)
            for field in dataclasses.fields(value)
            if not field.metadata.get("static")
            for part in [getattr(value, field.name)]
        )
    numbers = float | int | np.ndarray | np.generic | jax.Array
    return isinstance(value, numbers) and not isinstance(value, Tracer)


def number(x: Any) -> str:
    """Return a number with four significant digits."""
    return f"{float(x):.4g}"


def count(many: Any, noun: str) -> str:
    """Return a number and its noun, such as "1 event" and "2 events"."""
    return f"{int(many)} {noun}" + "s" * (int(many) != 1)


def join_names(names: Iterable[str], none: str = "-", most: int = 4) -> str:
    """Return names separated by commas, and the number of those beyond the first few.

    none: text for no names.
    """
    names = list(names)
    more = len(names) - most
    return (", ".join(names[:most]) or none) + (f" and {more} more" if more > 0 else "")


def lane_name(lane: Any, shape: tuple[int, ...]) -> str:
    """Return the indices of a lane of a batch, such as "17" or "0, 2".

    lane: index of the lane in the flattened batch.
    """
    return ", ".join(map(str, np.unravel_index(int(lane), shape)))


def lane_index(lane: Any, shape: tuple[int, ...]) -> Any:
    """Return an index over the lanes of a batch, as numpy and JAX accept it.

    shape: of the lanes. Raises ValueError for a single run or an index of another kind, IndexError
    if there is no such lane; JAX would return the nearest lane instead.
    """
    if not shape:
        raise ValueError(f"traj[{lane!r}]: this is a single run; only a batch of runs has lanes")
    parts = lane if isinstance(lane, tuple) else (lane,)
    if any(part is None or part is Ellipsis for part in parts):
        raise ValueError(f"traj[{lane!r}]: expected indices, slices, arrays or masks over lanes")
    index = tuple(np.asarray(part) if isinstance(part, list) else part for part in parts)
    if not any(isinstance(part, Tracer) for part in parts):
        try:
            np.broadcast_to(0, shape)[index]
        except IndexError as error:
            raise IndexError(f"traj[{lane!r}]: no such lane of {shape}: {error}") from error
    return index


def ranges(values: dict[str, Any], most: int = 40) -> Table:
    """Return a table of the least, the median and the largest value over the lanes of a batch.

    values: by name and unit, the values of the lanes. A row without a finite value is left out.
    most: number of rows shown.
    """
    rows = []
    for name, of_lanes in values.items():
        of_lanes = np.asarray(of_lanes)
        finite = of_lanes[np.isfinite(of_lanes)]
        if finite.size:
            largest = np.argmax(np.where(np.isfinite(of_lanes), of_lanes, -np.inf))
            bounds = finite.min(), np.median(finite), finite.max()
            rows.append((name, *map(number, bounds), lane_name(largest, of_lanes.shape)))
    return Table(("", "min", "median", "max", "lane of max"), rows, most)


def _is_number(cell: str) -> bool:
    """Return whether a cell has a number."""
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _escape(text: str) -> str:
    """Return a text as HTML, with its line breaks."""
    return html.escape(text).replace("\n", "<br>")
