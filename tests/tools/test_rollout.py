"""Rollouts: lanes that differ in all arguments, chunks, devices, processes, interruptions."""

import os
import pathlib
import signal
import socket
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import models
import numpy as np
import pytest
from tolerances import ROUND_OFF

import svkc

LANES = 11


def lane(chain, x):
    """Return a lane's own release, torque, gravity and end time."""
    chain = eqx.tree_at(lambda c: c.gravity, chain, chain.gravity * x["gravity"])
    return {
        "chain": chain,
        "events": [svkc.at(x["release"], cut="grip")],
        "args": x["torque"],
        "t1": x["end"],
    }


def control(t, state, torque):
    return torque * jnp.ones_like(state.v)


def held_rods():
    """Return two rods whose far end a grip holds until a release, states, and data of the lanes."""
    rods = models.bar(
        "upper",
        models.Y,
        "0.5 0 -0.8",
        inside=models.bar("lower", models.Y, "0.5 0 0.8", "0.5 0 -0.8"),
    )
    grip = svkc.VirtualLink(
        "grip",
        "world",
        "lower",
        "hinge",
        pos=(1.0, 0, 0),
        axis=(0, 1, 0),
        real_pos=(0.5, 0, 0.8),
        connected=True,
    )
    chain = svkc.load(models.MJCF.format(rods), virtual_links=[grip])
    share = jnp.linspace(0, 1, LANES)
    # the grip of every other lane is cut from the start
    starts = [chain.state({"upper": 0.0}), chain.state({"upper": 0.3}, connected=())]
    states = jax.tree.map(lambda *x: jnp.stack([x[i % 2] for i in range(LANES)]), *starts)
    return (
        chain,
        states,
        {
            "release": 0.05 + 0.3 * share,
            "torque": share,
            "gravity": 1 + share,
            "end": 0.2 + 0.2 * share,
        },
    )


def run_rollout(chain, states, data, **options):
    return svkc.rollout(
        chain, states, 0.4, data=data, lane=lane, control=control, rtol=1e-6, atol=1e-8, **options
    )


def main(rank, count, port, out, dies=""):
    """Run one process of several; the one of rank `dies` is killed after its first chunk."""
    if rank == dies:
        save = svkc.Trajectory.save
        svkc.Trajectory.save = lambda *args: (save(*args), os.kill(os.getpid(), signal.SIGKILL))
    jax.distributed.initialize(
        f"localhost:{port}", int(count), int(rank), heartbeat_timeout_seconds=10
    )
    traj = run_rollout(*held_rods(), chunk=2, out=out, progress=False)
    np.savez(
        pathlib.Path(out) / f"results_{rank}.npz",
        q=traj.final.q,
        times=traj.events.time,
        result=traj.result._value,
    )


@pytest.fixture(scope="module")
def case():
    return held_rods()


@pytest.fixture(scope="module")
def single_runs(case):
    """Run each lane alone."""
    chain, states, data = case
    simulate_lane = lambda s, own: svkc.simulate(
        own.pop("chain"), s, control=control, rtol=1e-6, atol=1e-8, throw=False, **own
    )
    run = jax.jit(lambda s, x: simulate_lane(s, dict(lane(chain, x))))
    return [run(*jax.tree.map(lambda x, i=i: x[i], (states, data))) for i in range(LANES)]


def assert_equal_to_single_runs(traj, single_runs):
    for i, one in enumerate(single_runs):
        np.testing.assert_allclose(traj.final.q[i], one.final.q, atol=ROUND_OFF)
        np.testing.assert_allclose(traj.events.time[i], one.events.time)
        assert float(traj.t_final[i]) == pytest.approx(float(one.t_final))
    assert np.all(traj.result == svkc.RESULTS.successful)
    assert traj.states.q.shape[:2] == (LANES, 2)
    assert traj.names == single_runs[0].names
    assert traj.names.links == ("grip",)


@pytest.mark.slow
def test_lanes_equal_single_runs(case, single_runs, capsys):
    """Lanes equal single runs, for several chunks and an order by cost."""
    traj = run_rollout(*case, chunk=4, cost=-np.arange(LANES) % 3)
    assert_equal_to_single_runs(traj, single_runs)
    assert "3 of 3 chunks (11 lanes)" in capsys.readouterr().err


@pytest.mark.slow
def test_all_lanes_at_once(case, single_runs, capsys):
    """One chunk gives equal results, without progress output."""
    assert_equal_to_single_runs(run_rollout(*case, progress=False), single_runs)
    assert capsys.readouterr().err == ""


def test_out_of_memory_names_the_chunk(case, monkeypatch):
    """The message names the chunk size, given or default; other XLA errors are raised unchanged."""
    chain, states, data = case
    more_lanes = jax.tree.map(lambda x: jnp.concatenate([x] * 8), (states, data))

    def fail_with(words):
        def run_chunk(*args):
            raise jax.errors.JaxRuntimeError(words)

        monkeypatch.setattr(sys.modules["svkc.tools.rollout"], "_run_chunk", run_chunk)

    fail_with("RESOURCE_EXHAUSTED: Out of memory allocating 1099511627776 bytes.")
    for options, chunk in (({"chunk": 4}, 4), ({}, 64)):
        with pytest.raises(
            RuntimeError, match=rf"^chunk={chunk} lanes .* give a smaller chunk="
        ) as raised:
            run_rollout(chain, *more_lanes, devices=jax.local_devices()[:1], **options)
        assert "RESOURCE_EXHAUSTED" in str(raised.value.__cause__)
    fail_with("INTERNAL: something else")
    with pytest.raises(jax.errors.JaxRuntimeError, match="INTERNAL"):
        run_rollout(*case)


@pytest.mark.slow
def test_an_interrupted_rollout_resumes(case, single_runs, tmp_path, monkeypatch):
    chain, states, data = case
    saved_names = []
    save = svkc.Trajectory.save

    def interrupted_save(self, path, chain=None):
        saved_names.append(path.name)
        if len(saved_names) == 2:
            raise KeyboardInterrupt
        save(self, path, chain)

    monkeypatch.setattr(svkc.Trajectory, "save", interrupted_save)
    with pytest.raises(KeyboardInterrupt):
        run_rollout(*case, chunk=4, out=tmp_path / "run")
    first_chunk = tmp_path / "run" / "chunk_00000.npz"
    stamp = first_chunk.stat().st_mtime_ns
    assert_equal_to_single_runs(run_rollout(*case, chunk=4, out=tmp_path / "run"), single_runs)
    # the finished chunk was loaded, not run again
    assert saved_names == [
        "chunk_00000.npz",
        "chunk_00001.npz",
        "chunk_00001.npz",
        "chunk_00002.npz",
    ]
    assert first_chunk.stat().st_mtime_ns == stamp
    assert svkc.load_trajectory(first_chunk).final.q.shape == (4, chain.topology.nq_all)
    with pytest.raises(ValueError, match="holds another rollout"):
        run_rollout(
            chain, states, {**data, "torque": data["torque"] + 1}, chunk=4, out=tmp_path / "run"
        )


def scaled(gain):
    return lambda t, state, args: gain * args * state.v


@pytest.mark.slow
def test_a_folder_continues_the_same_rollout_only(tmp_path):
    """Another value in `control` or `lane`, another body of either, and other options are refused
    by name; equal functions that are new objects are not."""
    chain = svkc.load(models.ARM)
    state = chain.state({"arm": 0.3})
    own = lambda end, options=None: lambda chain, data: {"t1": end, **(options or {})}

    def run(**other):
        options = {"control": scaled(2.0), "lane": own(0.02), "args": 1.0, "dt": 0.01} | other
        chains = options.pop("chain", chain)
        states = jax.tree.map(lambda x: x[None], options.pop("states", state))
        return svkc.rollout(chains, states, 0.02, out=tmp_path, progress=False, **options)

    first = run()
    label = tmp_path / "rollout.json"
    stamp = (tmp_path / "chunk_00000.npz").stat().st_mtime_ns
    assert run().final.q.tolist() == first.final.q.tolist()
    assert (tmp_path / "chunk_00000.npz").stat().st_mtime_ns == stamp
    others = {
        "control": {"control": scaled(3.0)},
        "lane": {"lane": own(0.01)},
        "args": {"args": 2.0},
        "solver": {"solver": svkc.integrators.SymplecticEuler()},
        "dt": {"dt": 0.005},
        "events": {"events": [svkc.when(lambda t, state, args: state.q[0] - 1)]},
        "chain": {"chain": eqx.tree_at(lambda c: c.mass, chain, chain.mass * 2)},
        "states": {"states": chain.state({"arm": 0.4})},
        "data": {"data": jnp.zeros(1)},
        "control, lane": {
            "control": lambda t, state, args: 2.0 * args + state.v,
            "lane": lambda chain, data: {},
        },
    }
    for name, other in others.items():
        with pytest.raises(ValueError, match=f"holds another rollout, with other {name}; give"):
            run(**other)
    # of an older version, which did not compare functions
    label.write_text('{"rollout": "0123", "lanes in a chunk": 1}')
    with pytest.raises(ValueError, match="holds another rollout, with other args, chain, chunk"):
        run()


def start_processes(count, out, dies=""):
    with socket.socket() as s:
        s.bind(("localhost", 0))
        port = s.getsockname()[1]
    paths = os.pathsep.join(map(str, pathlib.Path(__file__).parents[:2]))
    env = {**os.environ, "JAX_ENABLE_X64": "1", "PYTHONPATH": paths}
    line = "import sys, test_rollout; test_rollout.main(*sys.argv[1:])"
    return [
        subprocess.Popen(
            [sys.executable, "-c", line, str(i), str(count), str(port), str(out), dies],
            env=env,
            stderr=subprocess.PIPE,
            text=True,
        )
        for i in range(count)
    ]


@pytest.mark.slow
@pytest.mark.parametrize("count", [2, 4])
def test_several_processes(single_runs, tmp_path, count):
    """Each process runs a share of the chunks, and all return the complete result."""
    for process in start_processes(count, tmp_path):
        _, stderr = process.communicate(timeout=600)
        assert process.returncode == 0, stderr[-3000:]
    for i in range(count):
        results = np.load(tmp_path / f"results_{i}.npz")
        np.testing.assert_allclose(
            results["q"], [one.final.q for one in single_runs], atol=ROUND_OFF
        )
        assert results["result"].tolist() == [0] * LANES
    assert len(list(tmp_path.glob("chunk_*.npz"))) == 6


@pytest.mark.slow
def test_a_killed_process_keeps_its_chunks(case, single_runs, tmp_path):
    """The surviving process ends with an explanation, and the next rollout uses the finished
    chunks.
    """
    surviving, killed = start_processes(2, tmp_path, dies="1")
    _, stderr = surviving.communicate(timeout=600)
    killed.communicate(timeout=600)
    assert killed.returncode == -signal.SIGKILL
    assert surviving.returncode != 0
    # the message is svkc's or jax's, whichever notices first
    assert "another process has ended" in stderr or "another task died" in stderr
    finished = sorted(path.name for path in tmp_path.glob("chunk_*.npz"))
    assert finished == ["chunk_00000.npz", "chunk_00001.npz", "chunk_00002.npz", "chunk_00004.npz"]
    assert_equal_to_single_runs(
        run_rollout(*case, chunk=2, out=tmp_path, progress=False), single_runs
    )
