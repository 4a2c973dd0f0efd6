"""benchmarks/gpu.py: what it does with failures and differences, the bound of round-off, its table,
and all of it with a few lanes on the CPU."""

import csv
import subprocess
import sys
import types

import gpu
import gpu_kernels
import gpu_table
import jax
import jax.numpy as jnp
import numpy as np
import processes
import pytest
import round_off


def test_roundings_on_the_longest_path():
    function = lambda x: jnp.sin(x * x)[::-1] + jnp.sum(x)
    assert round_off.count_roundings(function, jnp.ones(2)) == 3
    assert round_off.count_roundings(function, jnp.ones(7)) == 8
    assert round_off.count_roundings(lambda A: A @ A + A, jnp.ones((5, 5))) == 6
    called = jax.jit(lambda x: x / 3)
    assert round_off.count_roundings(lambda x: called(called(x)), jnp.ones(2)) == 2
    for refused in (lambda x: jax.lax.fori_loop(0, 3, lambda _, y: y * x, x), jnp.linalg.cholesky):
        with pytest.raises(ValueError, match="count_roundings"):
            round_off.count_roundings(refused, jnp.ones((2, 2)))


def test_bound_of_round_off():
    """float32 is within the bound; products rounded to the eleven bits of TF32 are not."""
    A = np.random.default_rng(0).normal(size=(20, 20)) / 4 + np.eye(20)
    power = lambda A, rounded=lambda x: x: A @ rounded(A @ rounded(A @ A))
    conditioning = round_off.condition(power, jnp.asarray(A))
    assert 1 < conditioning < 100
    bound = round_off.bound("float32", 60, conditioning)
    single = jnp.asarray(A, jnp.float32)
    exact = power(np.asarray(single, float))
    tf32 = lambda x: jax.lax.reduce_precision(x, 8, 10)
    assert 0 < round_off.relative_difference(power(single), exact) < bound
    assert round_off.relative_difference(power(tf32(single), tf32), exact) > bound
    assert round_off.relative_difference(np.full((20, 20), np.nan), exact) == np.inf


def library(step):
    """Return a library whose state is one array, which is both q and v."""
    return lambda name, lanes: gpu.Model(
        step=step,
        states=jnp.ones((lanes, 8)),
        read=lambda x: (x, x),
        with_velocity=lambda x, v: x + v,
    )


def run_out_of_memory(x):
    raise RuntimeError("RESOURCE_EXHAUSTED: Out of memory while trying to allocate 9 bytes")


class FailsLater:
    """A step that fails in a call after the first ones."""

    def __init__(self, calls: int):
        self.calls = calls

    def __call__(self, x):
        def count(x):
            self.calls -= 1
            if self.calls < 0:
                raise RuntimeError("no more calls")
            return x

        return jax.pure_callback(count, x, x, vmap_method="expand_dims")


def test_failures_of_calls_are_in_their_own_rows(monkeypatch, tmp_path):
    """A library that fails in its first call, or when it is timed, leaves out no other one."""
    steps, rounds = 3, 4
    libraries = {"A": FailsLater(0), "svkc": lambda x: 0.9 * x, "B": FailsLater(2 * steps)}
    monkeypatch.setattr(gpu, "LIBRARIES", {who: library(f) for who, f in libraries.items()})
    expected = [np.full((gpu.COMPARED_LANES, 8), 0.9**steps)] * 2
    monkeypatch.setattr(gpu, "reference_on_cpu", lambda *_: (expected, 1e-4))
    options = types.SimpleNamespace(
        by=list(libraries), precision="float64", steps=steps, rounds=rounds, out=tmp_path
    )
    first, ours, later = gpu.measure_group("open", "steps", 4, options)
    assert not ours.note
    assert ours.rates
    for row in (first, later):
        assert "callback" in row.note.lower()
        assert not row.rates


def test_misspelt_names():
    for arguments in (["opne"], ["--by", "mjx"]):
        with pytest.raises(SystemExit):
            gpu.parse(arguments)


@pytest.mark.parametrize("what", gpu.KINDS)
def test_failures_and_differences_are_in_the_rows(what, monkeypatch, tmp_path):
    libraries = {"svkc": lambda x: 0.9 * x, "A": run_out_of_memory, "B": lambda x: x + "text"}
    monkeypatch.setattr(gpu, "LIBRARIES", {who: library(f) for who, f in libraries.items()})
    expected = np.full((gpu.COMPARED_LANES, 8), 0.9**3)
    expected = np.where(np.arange(8) < 7, expected, 0) if what == "gradient" else [expected] * 2
    options = types.SimpleNamespace(
        by=list(libraries), precision="float64", steps=3, rounds=2, out=tmp_path
    )
    for factor, note in ((1.0, ""), (1.001, "differs from the CPU")):
        reference = jax.tree.map(lambda x, factor=factor: factor * x, expected)
        monkeypatch.setattr(gpu, "reference_on_cpu", lambda *_, r=reference: (r, 1e-4))
        ours, *others = gpu.measure_group("two ball grips", what, 4, options)
        assert ours.note == note
        assert abs(ours.difference - (factor - 1)) < 2e-6
        assert 0 < ours.rates[1] <= ours.rates[0] <= ours.rates[2]
        assert others[0].note == "out of memory"
        assert others[1].note.startswith("TypeError: ")
        assert not any(row.rates for row in others)


@pytest.mark.slow
def test_processes_take_turns(tmp_path):
    """A second process waits for the lock of a folder until the first has left it."""
    pytest.importorskip("fcntl")
    program = (
        "import pathlib, sys; sys.path.insert(0, 'benchmarks'); import gpu_table; print('ready')\n"
        "sys.stdout.flush()\n"
        f"with gpu_table.folder_lock(pathlib.Path({str(tmp_path)!r})): print('in turn')"
    )
    command = [sys.executable, "-c", program]
    with gpu_table.folder_lock(tmp_path):
        other = subprocess.Popen(command, cwd=processes.ROOT, stdout=subprocess.PIPE, text=True)
        assert other.stdout.readline() == "ready\n"
        with pytest.raises(subprocess.TimeoutExpired):
            other.wait(timeout=1)
    assert other.communicate()[0] == "in turn\n"


def rows_of(folder) -> list[dict]:
    with (folder / "gpu.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_saved_groups_replace_equal_ones(tmp_path):
    row = lambda lanes, by, note: gpu_table.Row(
        case="open", dtype="float32", lanes=lanes, what="steps", by=by, note=note
    )
    gpu_table.save(tmp_path / "new", [row(64, "svkc", "old"), row(64, "MJX", "old")])
    gpu_table.save(tmp_path / "new", [row(8, "svkc", "other"), row(8, "MJX", "kept")])
    gpu_table.save(tmp_path / "new", [row(8, "svkc", "again")])
    gpu_table.save(tmp_path / "new", [row(64, "MJX", "again"), row(64, "svkc", "again")])
    saved = [(row["lanes"], row["by"], row["note"]) for row in rows_of(tmp_path / "new")]
    assert saved == [
        ("8", "svkc", "again"),
        ("8", "MJX", "kept"),
        ("64", "svkc", "again"),
        ("64", "MJX", "again"),
    ]


def test_kernels_are_counted_in_loops():
    text = """HloModule m

%region_0.1 (a.1: (s32[], f32[8,3])) -> (s32[], f32[8,3]) {
  %a.1 = (s32[], f32[8,3]{0,1}) parameter(0), metadata={scheduling_name="a.1"}
  %i = s32[] get-tuple-element(%a.1), index=0
  %x = f32[8,3]{0,1} get-tuple-element(%a.1), index=1
  %sum = f32[8]{0} fusion(%x, %x), kind=kInput, calls=%fused_add.1
  %y = f32[8,3]{1,0} copy(%x)
  ROOT %t = (s32[], f32[8,3]{1,0}) tuple(%i, %y)
}

ENTRY %main (x: f32[8,3]) -> f32[8,3] {
  %x.2 = f32[8,3]{0,1} parameter(0)
  %z = f32[8,3]{1,0} copy(%x.2)
  ROOT %w = f32[8,3]{1,0} while(%z), condition=%region_1.1, body=%region_0.1
}
"""
    assert gpu_kernels.count_in_loops(text) == (2, 4 * (24 + 8 + 24 + 24))


@pytest.mark.slow
def test_all_of_it_with_a_few_lanes(tmp_path):
    """Steps and gradients of the open figure; MJX's rows are measured, or say why not."""
    few = "--small --dtype float32 --lanes 3 --gradient-lanes 2 --out".split()
    done = processes.run("benchmarks/gpu.py", "open", *few, tmp_path, optimized=False)
    assert done.returncode == 0, done.stdout + done.stderr
    rows = rows_of(tmp_path)
    groups = [(what, by) for what in ("steps", "gradient") for by in ("svkc", "MJX")]
    assert [(row["what"], row["by"]) for row in rows] == groups
    for row in rows:
        if row["by"] == "svkc":
            assert not row["note"]
            assert 0 < float(row["difference"]) < float(row["bound"]) < 1e-3
        assert row["note"] or float(row["M steps per s"]) > 0
        assert all(cell in done.stdout for cell in row.values() if cell == row["M steps per s"])
    processes.looks_drawn(tmp_path / "gpu.png")


@pytest.mark.slow
def test_without_an_accelerator():
    done = processes.run("benchmarks/gpu.py")
    assert done.returncode == 1
    assert "no accelerator" in done.stderr
