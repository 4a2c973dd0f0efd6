"""Cost of the first call: tracing, lowering and XLA's compilation, each program in its own process.

`python benchmarks/compile.py [PROGRAM ...] [--beside FOLDER] [--rounds N] [--no-run]` prints a row
for each program and writes results/compile.csv. FOLDER is another checkout; the two alternate.

Columns: `instructions`, of the HLO module before XLA's passes, with every call inlined; `kernels`,
    the fusions that are left after them; CPU seconds of tracing, lowering and XLA; `first`, CPU and
    wall seconds of a user's first call, from imports and loading done to the result; `again`, the
    wall milliseconds of a second call. With several rounds, medians. XLA's options are the default
    ones.
"""

import argparse
import collections
import csv
import json
import os
import pathlib
import platform
import re
import statistics
import subprocess
import sys
import time
from functools import cache

HERE = pathlib.Path(__file__).resolve().parent
RESULTS = HERE / "results" / "compile.csv"
COUNTS, SECONDS = (
    ("instructions", "kernels"),
    ("trace", "lower", "xla", "first cpu", "first wall", "again ms"),
)
HEAD = ["program", "version", *COUNTS, *SECONDS, "rounds", "python", "jax", "machine"]
MODELS = ("high bar", "four-bar")


def count_instructions(text: str) -> int:
    """Count the instructions of an HLO module with every call inlined."""
    size, calls, current = collections.Counter(), collections.defaultdict(collections.Counter), None
    for line in text.splitlines():
        if line and not line.startswith(" ") and line.rstrip().endswith("{"):
            current = re.match(r"(?:ENTRY )?%?([\w.\-]+)", line)[1]
            entry = current if line.startswith("ENTRY") else None
        elif current and " = " in line:
            size[current] += 1
            inner = re.findall(
                r"(?:to_apply|body|condition|calls|true_computation|false_computation)=%?([\w.\-]+)",
                line,
            )
            inner += [
                x.strip().lstrip("%")
                for group in re.findall(r"branch_computations=\{([^}]*)\}", line)
                for x in group.split(",")
            ]
            calls[current].update(inner)

    @cache
    def total(name: str) -> int:
        return size[name] + sum(count * total(other) for other, count in calls[name].items())

    return total(entry)


def count_kernels(text: str) -> int:
    """Count the fusions of a compiled module: XLA's CPU backend compiles each in some 20 ms."""
    return len(re.findall(r" = [^=]*? fusion\(", text))


def clocks() -> tuple[float, float]:
    """Return CPU seconds and wall seconds."""
    return time.process_time(), time.perf_counter()


def measure_program(name: str, run: bool) -> dict:
    """Trace, lower, compile and run one program, in this process."""
    import compile_cases
    import jax

    function, args = compile_cases.PROGRAMS[name]()
    jax.block_until_ready(args)
    marks = [clocks()]
    traced = jax.jit(function).trace(*args)
    marks.append(clocks())
    lowered = traced.lower()
    marks.append(clocks())
    program = lowered.compile()
    marks.append(clocks())
    row = {stage: b[0] - a[0] for stage, a, b in zip(SECONDS, marks, marks[1:], strict=False)}
    if run:
        jax.block_until_ready(program(*args))
        marks.append(clocks())
        row["first cpu"], row["first wall"] = (
            b - a for a, b in zip(marks[0], marks[-1], strict=True)
        )
        start = time.perf_counter()
        jax.block_until_ready(program(*args))
        row["again ms"] = 1e3 * (time.perf_counter() - start)
    return {
        name: row
        | {
            "instructions": count_instructions(lowered.compiler_ir("hlo").as_hlo_text()),
            "kernels": count_kernels(program.as_text()),
        }
    }


def measure_eager(model: str) -> dict:
    """Call the public functions one after another, in this process."""
    import compile_cases
    import jax

    rows = {}
    for name, call in compile_cases.eager_calls(model).items():
        before = clocks()
        jax.block_until_ready(call())
        cpu, wall = (b - a for a, b in zip(before, clocks(), strict=True))
        start = time.perf_counter()
        jax.block_until_ready(call())
        rows[f"{model}: {name}"] = {
            "first cpu": cpu,
            "first wall": wall,
            "again ms": 1e3 * (time.perf_counter() - start),
        }
    return rows


def child(name: str, run: bool) -> None:
    """Measure one program or model in this process and print the result as JSON."""
    import jax

    jax.config.update("jax_enable_x64", True)
    import diffrax  # noqa: F401
    import mujoco  # noqa: F401

    import svkc  # noqa: F401

    # the first operation of a process initializes the backend, which is not measured
    jax.block_until_ready(jax.numpy.zeros(3) + 1)
    print(json.dumps(measure_eager(name) if name in MODELS else measure_program(name, run)))


def in_process(name: str, folder: pathlib.Path, run: bool) -> dict:
    """Measure one program of the checkout in `folder` in a new process without a cache."""
    environment = {**os.environ, "PYTHONPATH": str(folder), "JAX_PLATFORMS": "cpu"}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    command = [
        sys.executable,
        str(HERE / "compile.py"),
        "--child",
        name,
        *([] if run else ["--no-run"]),
    ]
    out = subprocess.run(command, env=environment, cwd=HERE, capture_output=True, text=True)
    if out.returncode:
        raise SystemExit(f"{name} in {folder}:\n{out.stderr[-3000:]}")
    return json.loads(out.stdout.splitlines()[-1])


def version(folder: pathlib.Path) -> str:
    """Return the abbreviated commit of a checkout."""
    return subprocess.run(
        ["git", "-C", str(folder), "rev-parse", "--short", "HEAD"], capture_output=True, text=True
    ).stdout.strip()


def update_results(rows: dict) -> None:
    """Replace the rows of the measured programs in results/compile.csv."""
    import jax

    rows_of_file = list(csv.DictReader(RESULTS.open())) if RESULTS.exists() else []
    environment = {
        "python": platform.python_version(),
        "jax": jax.__version__,
        "machine": platform.machine(),
    }
    for (name, label), row in rows.items():
        rows_of_file = [
            r
            for r in rows_of_file
            if (r["program"], r["version"], r["jax"]) != (name, label, environment["jax"])
        ]
        columns = {
            k: "" if k not in row else f"{row[k]:.0f}" if k in COUNTS else f"{row[k]:.3g}"
            for k in (*COUNTS, *SECONDS)
        }
        rows_of_file.append(
            {"program": name, "version": label, **columns, "rounds": row["rounds"], **environment}
        )
    with RESULTS.open("w", newline="") as file:
        writer = csv.DictWriter(file, HEAD)
        writer.writeheader()
        writer.writerows(sorted(rows_of_file, key=lambda r: (r["program"], r["version"])))


def main() -> None:
    """Measure what the command line names."""
    import compile_cases

    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("programs", nargs="*", default=[*compile_cases.PROGRAMS, *MODELS])
    parser.add_argument(
        "--beside", type=pathlib.Path, help="another checkout, which takes turns with this one"
    )
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--no-run", action="store_true", help="compile only")
    parser.add_argument("--label", help="the version to write; default: the commit checked out")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        return child(options.child, not options.no_run)
    folders = [HERE.parent] + ([options.beside.resolve()] if options.beside else [])
    labels = [options.label or version(HERE.parent)] + [version(f) for f in folders[1:]]
    measured = collections.defaultdict(list)
    print(f"{'program':28}{'version':>10}" + "".join(f"{h:>13}" for h in (*COUNTS, *SECONDS)))
    for name in options.programs:
        for _ in range(options.rounds):
            for folder, label in zip(folders, labels, strict=True):
                for program, row in in_process(name, folder, not options.no_run).items():
                    measured[program, label].append(row)
        new_rows = {
            key: rows
            for key, rows in measured.items()
            if key[0] == name or key[0].startswith(f"{name}:")
        }
        for (program, label), rows in new_rows.items():
            median = {k: statistics.median(r[k] for r in rows) for k in rows[0]}
            print(
                f"{program:28}{label:>10}"
                + "".join(
                    f"{median[k]:13.5g}" if k in median else f"{'':13}" for k in (*COUNTS, *SECONDS)
                ),
                flush=True,
            )
            update_results({(program, label): median | {"rounds": len(rows)}})


if __name__ == "__main__":
    main()
