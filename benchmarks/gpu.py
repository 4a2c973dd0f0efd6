"""Steps and reverse gradients of batches on an accelerator: svkc beside MJX.

`python benchmarks/gpu.py [case ...] [--by ..] [--dtype ..] [--lanes ..] [--gradient-lanes ..]`
(extras `bench` and `viz`, and a jax for the accelerator) prints and writes gpu.csv and draws
gpu.png, in results/ or in `--out FOLDER`. Each group of rows is saved when it is measured; a later
call replaces rows of the same measurement and keeps the others. Several calls at once that save to
one folder (with XLA_PYTHON_CLIENT_PREALLOCATE=false) compile side by side, and measure in turns.
Each keeps the device memory that it has used: if a row lacks memory, measure it alone. `--small`
runs all of it with a few lanes on any machine, and writes to out/.

Cases, models and initial states are those of speed_cases.py, dt is 2 ms. Both libraries take the
steps in one `lax.scan` of a `vmap`, in this process, in turns. Grips are hard in svkc and soft in
MJX. A gradient is that of the base's position and orientation after GRADIENT_STEPS steps, with
respect to the initial velocity; each step is a `jax.checkpoint`.

Columns: million steps per second, all lanes together (median, least, most of ROUNDS; of gradients,
    steps of the run that is differentiated); seconds of tracing, lowering and compilation; memory,
    that of XLA's plan for the program: arguments, results, temporaries. `difference`: of the
    measured program's result, in its first lanes, from svkc's in float64 on the CPU, relative to
    the largest entry; for MJX where its model is svkc's (open). `bound`: the most that
    round-off may cause (round_off.py). `note`: why a row has no numbers, or that svkc's difference
    exceeds the bound; then the exit status is 1.
"""

import argparse
import collections
import contextlib
import functools
import os
import pathlib
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import peers
import round_off
import speed_cases
from gpu_table import Row, draw, folder_lock, print_row, save
from programs import Program, scan_steps, time_in_turns

import svkc

HERE = pathlib.Path(__file__).parent
LANES, GRADIENT_LANES = (1024, 4096, 16384, 65536), (4096,)
STEPS, GRADIENT_STEPS, ROUNDS = 50, 10, 5
# the first lanes of a batch are compared with the CPU
COMPARED_LANES = 2
# (lanes, lanes of gradients, steps, rounds) of --small
SMALL = ((2, 5), (2,), 2, 1)


class Model(NamedTuple):
    """One library's model of a case.

    step: of one state. states: a batch. read: states -> (q, v), the tree's coordinates.
    with_velocity: (states, v) -> states.
    """

    step: Callable
    states: Any
    read: Callable
    with_velocity: Callable


def svkc_model(chain, states) -> Model:
    """Return svkc's model of a case."""
    tau = jnp.zeros(chain.nv, states.q.dtype)

    def with_velocity(states, v):
        of_links = states.v[..., chain.nv :]
        return svkc.State(states.q, jnp.concatenate([v, of_links], -1), states.structure)

    return Model(
        step=lambda s: svkc.step(chain, s, tau, speed_cases.DT),
        states=states,
        read=lambda s: (s.q[..., : chain.nq], s.v[..., : chain.nv]),
        with_velocity=with_velocity,
    )


def load_svkc(name: str, lanes: int) -> Model:
    """Return svkc's model of a case with a batch of states."""
    chain, state = speed_cases.load_case(name)
    return svkc_model(chain, speed_cases.random_states(chain, state, lanes))


def load_mjx(name: str, lanes: int) -> Model:
    """Return MJX's model of a case with the same states."""
    step, states = peers.mjx_steps(name, lanes)
    return Model(
        step=step,
        states=states,
        read=lambda d: (d.qpos, d.qvel),
        with_velocity=lambda d, v: d.replace(qvel=v),
    )


LIBRARIES = {"svkc": load_svkc, "MJX": load_mjx}


def steps_of(model: Model, steps: int) -> Callable:
    """Return the function of states that gives (q, v) of all lanes after the steps."""
    run = scan_steps(jax.vmap(model.step), steps)
    return lambda states: model.read(run(states))


def gradient_of(model: Model, steps: int) -> Callable:
    """Return the function of states that gives the derivative with respect to the velocity."""
    run = scan_steps(jax.checkpoint(jax.vmap(model.step)), steps)

    def base(v, states):
        return jnp.sum(model.read(run(model.with_velocity(states, v)))[0][:, :7])

    return lambda states: jax.grad(base)(model.read(states)[1], states)


KINDS = {"steps": steps_of, "gradient": gradient_of}


def first_lanes(tree):
    """Return the first lanes of a batch, those that are compared with the CPU."""
    return jax.tree.map(lambda x: x[:COMPARED_LANES], tree)


def as_float64(tree):
    """Return a pytree with its floating numbers in float64."""

    def convert(x):
        x = np.asarray(x)
        return jnp.asarray(x.astype(np.float64) if np.issubdtype(x.dtype, np.floating) else x)

    return jax.tree.map(convert, tree)


@functools.cache
def cpu_program(name: str, what: str, steps: int) -> tuple[Callable, int]:
    """Return svkc's program in float64 for the CPU, and its roundings in a row.

    The program maps (chain, states of the compared lanes) to the result.
    """

    def evaluate(inputs):
        chain, states = inputs
        return KINDS[what](svkc_model(chain, states), steps)(states)

    chain, state = speed_cases.load_case(name)
    inputs = as_float64((chain, speed_cases.random_states(chain, state, COMPARED_LANES)))
    # the gradient of a step evaluates it and transposes it
    once = step = jax.vmap(svkc_model(*inputs).step)
    if what == "gradient":
        once = lambda s: jax.vjp(lambda v: step(svkc.State(s.q, v, s.structure)), s.v)[1](s)
    roundings = steps * round_off.count_roundings(once, inputs[1])
    return jax.jit(evaluate).lower(inputs).compile(), roundings


def reference_on_cpu(name: str, what: str, lanes: int, steps: int) -> tuple[Any, float]:
    """Return svkc's result in float64 on the CPU, and the bound of the differences from it.

    The inputs are those of the current precision, so that only the evaluation differs.
    """
    chain, state = speed_cases.load_case(name)
    states = first_lanes(speed_cases.random_states(chain, state, lanes))
    with jax.enable_x64(True), jax.default_device(jax.devices("cpu")[0]):
        program, roundings = cpu_program(name, what, steps)
        inputs = as_float64((chain, states))
        conditioning = round_off.condition(program, inputs)
        limit = round_off.bound(str(states.q.dtype), roundings, conditioning)
        return program(inputs), limit


def describe(error: Exception) -> str:
    """Return the note of a row that failed: out of memory, or the first line of the error."""
    text = str(error).strip() or repr(error)
    if "RESOURCE_EXHAUSTED" in text or isinstance(error, MemoryError):
        return "out of memory"
    return f"{type(error).__name__}: {text.splitlines()[0][:120]}"


def measure_group(name: str, what: str, lanes: int, options) -> list[Row]:
    """Return a row for each library: one case, precision, number of lanes; steps or a gradient.

    A library that fails has a row that says so.
    """
    rows = {
        who: Row(case=name, dtype=options.precision, lanes=lanes, what=what, by=who)
        for who in options.by
    }
    steps = options.steps if what == "steps" else min(options.steps, GRADIENT_STEPS)
    programs, results = {}, {}
    for who, row in rows.items():
        with note_failure(row):
            model = LIBRARIES[who](name, lanes)
            programs[who] = Program(KINDS[what](model, steps), model.states)
            row.compiled(programs[who])
    with folder_lock(options.out):
        for who, program in programs.items():
            # a lack of memory shows in the first call
            with note_failure(rows[who]):
                results[who] = jax.device_get(first_lanes(program.program(program.states)))
        timed = {who: leave_out_if_failed(programs[who], rows[who]) for who in results}
        seconds = time_in_turns(timed, options.rounds)
    for who, times in seconds.items():
        rows[who].timed(steps * lanes / times / 1e6)
        if who == "svkc" or name == "open":
            with note_failure(rows[who]):
                compare(rows[who], results[who], steps)
    return list(rows.values())


@contextlib.contextmanager
def note_failure(row: Row):
    """Write an error into the note of a row: a failure is a result, and belongs in the table."""
    try:
        yield
    except Exception as error:
        row.note = describe(error)


def leave_out_if_failed(program: Callable, row: Row) -> Callable:
    """Return a program whose failure is noted, and ends its own timing alone (`time_in_turns`)."""

    def run():
        with note_failure(row):
            return program()
        raise TimeoutError(f"{row.by}: {row.note}")

    return run


def compare(row: Row, result, steps: int):
    """Write into a row how far a result is from that of the CPU."""
    reference, row.bound = reference_on_cpu(row.case, row.what, row.lanes, steps)
    row.difference = round_off.relative_difference(result, reference)
    if row.by == "svkc" and not row.difference <= row.bound:
        row.note = "differs from the CPU"


def main(options) -> int:
    """Measure, print and save all groups; return how many of svkc's rows failed."""
    rows = []
    print(f"on {jax.devices()[0].device_kind}, {jax.default_backend()}", flush=True)
    for precision in options.dtype:
        options.precision = precision
        with jax.enable_x64(precision == "float64"):
            for name in options.cases:
                groups = [("steps", n) for n in options.lanes]
                groups += [("gradient", n) for n in options.gradient_lanes]
                for what, lanes in groups:
                    group = measure_group(name, what, lanes, options)
                    for row in group:
                        print_row(row)
                    save(options.out, group)
                    rows += group
                    jax.clear_caches()
    notes = collections.Counter(row.note for row in rows if row.by == "svkc" and row.note)
    if "svkc" in options.by:
        print("svkc:", dict(notes) or "all rows within the bound of round-off")
    with folder_lock(options.out):
        draw(options.out)
    return notes.total()


def parse(arguments: list[str]):
    """Return the options of the command line."""
    parser = argparse.ArgumentParser()
    parser.add_argument(
        "cases", nargs="*", metavar="case", help=f"of {', '.join(speed_cases.CASES)}; none: all"
    )
    parser.add_argument("--small", action="store_true", help="a few lanes, on any machine")
    parser.add_argument("--dtype", nargs="+", default=["float32", "float64"])
    parser.add_argument("--by", nargs="+", default=list(LIBRARIES), help="libraries")
    parser.add_argument("--lanes", nargs="+", type=int)
    parser.add_argument("--gradient-lanes", nargs="*", type=int)
    parser.add_argument("--out", type=pathlib.Path, help="folder of the table and the picture")
    options = parser.parse_args(arguments)
    for names, known in ((options.cases, speed_cases.CASES), (options.by, LIBRARIES)):
        for name in set(names) - set(known):
            parser.error(f"got {name!r}, expected one of {', '.join(known)}")
    lanes, gradient_lanes, options.steps, options.rounds = (
        SMALL if options.small else (LANES, GRADIENT_LANES, STEPS, ROUNDS)
    )
    options.cases = options.cases or list(speed_cases.CASES)
    options.lanes = options.lanes or lanes
    if options.gradient_lanes is None:
        options.gradient_lanes = gradient_lanes
    options.out = options.out or (pathlib.Path("out") if options.small else HERE / "results")
    return options


if __name__ == "__main__":
    options = parse(sys.argv[1:])
    if options.small and hasattr(os, "sched_setaffinity"):
        # before the backend starts: on several cores MJX's batches deadlock (peers.py)
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    if jax.default_backend() == "cpu" and not options.small:
        sys.exit("jax finds no accelerator; --small runs on the CPU")
    sys.exit(min(1, main(options)))
