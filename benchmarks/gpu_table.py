"""The table and the picture of gpu.py."""

import contextlib
import csv
import dataclasses
import pathlib

import jax
import numpy as np
import speed_cases
from programs import Program, machine

HEAD = [
    "case", "dtype", "lanes", "what", "by", "M steps per s", "least", "most", "trace s", "lower s",
    "compile s", "memory MB", "difference", "bound", "note",
]  # fmt: skip
# columns that say what a row measures
KEY = ("case", "dtype", "lanes", "what", "by")


@dataclasses.dataclass
class Row:
    """One row; what was not measured is empty."""

    case: str
    dtype: str
    lanes: int
    what: str
    by: str
    rates: tuple[float, ...] = ()
    compile_seconds: tuple[float, ...] = ()
    memory: float | None = None
    difference: float | None = None
    bound: float | None = None
    note: str = ""

    def compiled(self, program: Program):
        """Take over compile times and memory of a program."""
        self.compile_seconds = tuple(program.compile_stats[:3])
        plan = program.program.memory_analysis()
        assert plan is not None
        total = plan.argument_size_in_bytes + plan.output_size_in_bytes + plan.temp_size_in_bytes
        self.memory = (total - plan.alias_size_in_bytes) / 1e6

    def timed(self, rates: np.ndarray):
        """Take over the rates of all rounds."""
        self.rates = tuple(float(f(rates)) for f in (np.median, np.min, np.max))

    def cells(self) -> list[str]:
        """Return the row as text, a cell for each entry of `HEAD`."""
        number = lambda x, form: "" if x is None else format(x, form)
        return [
            *(self.case, self.dtype, str(self.lanes), self.what, self.by),
            *([format(x, ".4g") for x in self.rates] or [""] * 3),
            *([format(x, ".2f") for x in self.compile_seconds] or [""] * 3),
            number(self.memory, ".1f"),
            number(self.difference, ".1e"),
            number(self.bound, ".1e"),
            self.note,
        ]


def print_row(row: Row):
    """Print one row."""
    print("| " + " | ".join(row.cells()) + " |", flush=True)


@contextlib.contextmanager
def folder_lock(folder: pathlib.Path):
    """Hold the lock of a folder; create the folder if it is missing.

    Processes that save to one folder use the device and the table one at a time.
    """
    folder.mkdir(parents=True, exist_ok=True)
    try:
        import fcntl
    except ImportError:  # Windows: one process at a time is up to the user
        yield
        return
    with (folder / "gpu.lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def save(folder: pathlib.Path, group: list[Row]):
    """Replace rows of gpu.csv that measure the same."""
    here = machine() | {"device": jax.devices()[0].device_kind}
    rows = [dict(zip(HEAD, row.cells(), strict=True)) | here for row in group]
    key = lambda row: tuple(str(row[name]) for name in KEY)
    replaced = {key(row) for row in rows}
    with folder_lock(folder):
        rows += [row for row in saved(folder) if key(row) not in replaced]
        rows.sort(key=_order)
        with (folder / "gpu.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, [*HEAD, *here], lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)


def saved(folder: pathlib.Path) -> list[dict]:
    """Return the rows of gpu.csv; none if there is no such file."""
    path = folder / "gpu.csv"
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def _order(row: dict) -> tuple:
    """Return the sort key of a row: cases as in speed_cases.py, svkc before MJX."""
    case = speed_cases.CASES.index(row["case"])
    return case, row["dtype"], row["what"] != "steps", int(row["lanes"]), row["by"] != "svkc"


def draw(folder: pathlib.Path):
    """Draw gpu.png from gpu.csv: rates against lanes, a column of panels for each case, steps above
    and gradients below.

    Left out if matplotlib is not installed. Call it under `folder_lock`.
    """
    try:
        import matplotlib.pyplot as plt
    except ImportError:
        return
    rows = saved(folder)
    cases = list(dict.fromkeys(row["case"] for row in rows))
    figure, axes = plt.subplots(
        2, len(cases), figsize=(3.5 * len(cases), 5.5), layout="constrained", squeeze=False
    )
    for i, what in enumerate(("steps", "gradient")):
        for ax, case in zip(axes[i], cases, strict=True):
            for who, color in (("svkc", "C0"), ("MJX", "C4")):
                for dtype, style in (("float32", "s--"), ("float64", "o-")):
                    key = [case, dtype, what, who]
                    points = [
                        (int(row["lanes"]), float(row["M steps per s"]))
                        for row in rows
                        if [row[name] for name in ("case", "dtype", "what", "by")] == key
                        and row["M steps per s"]
                    ]
                    label = f"{who}, {dtype}"
                    ax.loglog(*zip(*points), style, color=color, label=label) if points else None
            ax.set(title=f"{case}: {what}", xlabel="lanes")
            ax.grid(alpha=0.3)
        axes[i, 0].set_ylabel("million steps per s")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), fontsize=8, loc="outside right center")
    figure.savefig(folder / "gpu.png", dpi=110)
    plt.close(figure)
