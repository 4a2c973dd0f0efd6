"""Batches of runs: lanes are distributed over chunks, and chunks over devices and processes."""

import json
import os
import pathlib
import sys
import time
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from svkc._jax.content_digest import content_digest
from svkc._jax.functions import call_with_comparable
from svkc.integration.replay import Replay
from svkc.model.annotations import Checked, Function, Integer, Numbers, Path, Scalar
from svkc.model.chain import Chain, State
from svkc.model.checked_jit import check_chain
from svkc.model.validation import check_function, finite_array, integer, scalar
from svkc.simulation.archive import SCHEMA, load_trajectory
from svkc.simulation.simulate import simulate
from svkc.simulation.trajectory import Trajectory


def rollout(
    chain: Chain, states: Checked[State], t1: Scalar, *, data: Any = None,
    lane: Function | None = None, cost: Numbers | None = None, chunk: Integer | None = None,
    out: Path | None = None, devices: Any = None, progress: bool = True, **options: Any,
) -> Trajectory:  # fmt: skip
    """Run `svkc.simulate` for every lane of `states`; return one batch of numpy arrays (no grad).

    Lanes are the elements of the batch. Each device runs its lanes without waiting for others.
    Under `jax.distributed` each process runs a share of the chunks, and all return all lanes.

    states: a State with a leading axis of lanes. t1: end time (s).
    data: pytree with a leading axis of lanes: the data in which lanes differ.
    lane: function (chain, data of one lane) that returns a dict of arguments of `simulate`, such as
        events, args, control, t1, or `chain` with other floats. Compared as in `simulate`, so that
        a lambda in the call is not compiled again.
    cost: expected run time of each lane [lanes], by which lanes are sorted into chunks.
    chunk: lanes that a device runs at once; memory grows with them. Default: 4096, on a CPU 64.
    out: folder for finished chunks (chunk_00000.npz and so on, readable by `svkc.load_trajectory`).
        An equal call loads the finished chunks and runs the others. All arguments are compared by
        content: functions by code and by the values that they read, functions of installed packages
        by name.
    devices: devices to use. Default: all devices of this process. For several CPU devices call
        `jax.config.update("jax_num_cpu_devices", n)` before the first use of jax.
    progress: whether to print progress.
    options: further arguments of `simulate`, for all lanes. `throw` is False by default: the result
        codes of failed lanes are in `result`.

    Raises ValueError if leading axes differ, an option is invalid, `out` holds another rollout.
    Raises RuntimeError if a chunk does not fit into memory or another process ended early.
    """
    check_chain(chain)
    lanes = _count_lanes(states, data, cost)
    scalar("t1", t1)
    devices, chunk = _prepare_devices(devices, chunk, lanes)
    size = chunk * len(devices)
    order = np.arange(lanes) if cost is None else np.argsort(np.asarray(cost), kind="stable")
    chunks = _assign_chunks(order, size)
    run = _chunk_runner(chain, jnp.asarray(t1, states.q.dtype), lane, options, devices)
    inputs = {"chain": chain, "states": states, "t1": t1, "data": data, "lane": lane, **options}
    folder = _prepare_folder(out, inputs | {"cost": order, "chunk": size, "schema": SCHEMA})
    own_chunks = range(jax.process_index(), len(chunks), jax.process_count())
    done, start = {}, time.perf_counter()
    for count, i in enumerate(own_chunks, 1):
        own_lanes = jax.tree.map(lambda x, i=i: x[chunks[i]], (states, data))
        file = folder and folder / f"chunk_{i:05d}.npz"
        done[i] = _load_or_run(run, own_lanes, file, chain, chunk)
        if progress:
            _print_progress(count, len(own_chunks), lanes, time.perf_counter() - start)
    all_chunks = _gather_chunks(done, len(chunks))
    return jax.tree.map(lambda *x: np.concatenate(x)[np.argsort(order)], *all_chunks)


def _prepare_devices(devices, chunk: Integer | None, lanes: int) -> tuple[list[Any], int]:
    """Return the devices and how many lanes each runs at once.

    Raises ValueError if either is invalid.
    """
    if chunk is not None:
        chunk = integer("chunk", chunk, 1)
    if devices is None:
        devices = jax.local_devices()
    devices = list(devices) if np.iterable(devices) else [devices]
    if not devices or not all(isinstance(device, jax.Device) for device in devices):
        raise ValueError(f"devices: expected some of jax.local_devices(), got {devices!r}")
    most_lanes = max(1, lanes // (len(devices) * jax.process_count()))
    default = 64 if devices[0].platform == "cpu" else 4096
    return devices, min(chunk or default, most_lanes)


def _assign_chunks(order: np.ndarray, size: int) -> np.ndarray:
    """Return the lanes of each chunk [chunks size]. Copies of the last lane fill the last chunk.

    Raises ValueError if there are fewer chunks than processes.
    """
    chunks = np.pad(order, (0, -len(order) % size), mode="edge").reshape(-1, size)
    if len(chunks) < jax.process_count():
        raise ValueError(
            f"states: {len(order)} lanes are {len(chunks)} chunks, too few for"
            f" {jax.process_count()} processes; start fewer, or give fewer devices"
        )
    return chunks


def _chunk_runner(chain: Chain, t1, lane: Callable | None, options: dict, devices) -> Callable:
    """Return the function that runs a chunk: (states, data) of its lanes -> Trajectory.

    Functions with equal code and data share a compiled program.
    """
    if lane is not None:
        check_function("lane", lane, "chain", "data")
    if options.get("control") is not None:
        check_function("control", options["control"], "t", "state", "args")
    common = {"throw": False, "adjoint": Replay(every=1 << 30), **options}
    mesh = Mesh(np.array(devices), ("lanes",))
    functions = {"control": options.get("control"), "events": options.get("events", ())}

    def run(lanes):
        run_with = lambda lane, **other: _run_chunk((chain, t1, common | other, lane), lanes, mesh)
        return call_with_comparable(run_with, lane=lane, **functions)

    return run


def _count_lanes(states, data, cost) -> int:
    """Return the number of lanes. Raise ValueError if leading axes differ."""
    if not isinstance(states, State):
        raise ValueError(
            f"states: expected a svkc.State with a leading axis, got {type(states).__name__}"
        )
    lane_counts = {
        np.shape(x)[0] if np.ndim(x) else None for x in jax.tree.leaves((states, data, cost))
    }
    lanes = next(iter(lane_counts))
    if len(lane_counts) != 1 or not lanes or states.q.ndim != 2:
        raise ValueError(
            "states, data, cost: expected one leading axis of lanes, got sizes"
            f" {sorted(map(str, lane_counts))} and q of shape {states.q.shape}"
        )
    if cost is not None and finite_array("cost", cost).ndim != 1:
        raise ValueError(f"cost: got shape {np.shape(cost)}, expected one number for each lane")
    return lanes


@eqx.filter_jit
def _run_chunk(common, lanes, mesh: Mesh) -> Trajectory:
    """Run the lanes of one chunk on all devices of the mesh.

    `shard_map` instead of a sharded `vmap`: devices exchange nothing, so none waits for the steps
    of another.
    """
    arrays, static = eqx.partition(common, eqx.is_array)

    def run_lane(arrays, state, data):
        chain, t1, options, lane = eqx.combine(arrays, static)
        own = {} if lane is None else lane(chain, data)
        if not isinstance(own, dict):
            raise ValueError(f"lane: expected a dict of arguments of simulate from it, got {own!r}")
        own = dict(own)
        return simulate(own.pop("chain", chain), state, own.pop("t1", t1), **{**options, **own})

    replicated, by_lanes = PartitionSpec(), PartitionSpec("lanes")
    parts = jax.shard_map(
        jax.vmap(run_lane, (None, 0, 0)),
        mesh=mesh,
        in_specs=(replicated, by_lanes, by_lanes),
        out_specs=by_lanes,
        check_vma=False,
    )
    return parts(arrays, *lanes)


def _prepare_folder(out, inputs: dict[str, Any]) -> pathlib.Path | None:
    """Create the folder and label it with a digest of each input of the rollout, by name.

    Return the folder, or None if `out` is None.

    Raises ValueError if an input has no digest, or if the folder is labelled with other digests.
    """
    if out is None:
        return None
    folder = pathlib.Path(out)
    # A progress meter changes no result.
    compared = {name: x for name, x in inputs.items() if x is not None and name != "progress_meter"}
    description = {"inputs": {name: _digest(name, compared[name]) for name in sorted(compared)}}
    folder.mkdir(parents=True, exist_ok=True)
    label_path = folder / "rollout.json"
    if label_path.exists():
        new, old = description["inputs"], json.loads(label_path.read_text()).get("inputs", {})
        other = sorted(name for name in new | old if new.get(name) != old.get(name))
        if other:
            raise ValueError(
                f"out: {folder} holds another rollout, with other {', '.join(other)}; give another"
                " folder, or empty it"
            )
    temporary = folder / f"rollout.{os.getpid()}.part"
    temporary.write_text(json.dumps(description))
    temporary.replace(label_path)
    return folder


def _digest(name: str, value) -> str:
    """Return the digest of an input. Raise ValueError if its content cannot be compared."""
    try:
        return content_digest(value)
    # An object of the user may raise any error when it is read.
    except Exception as error:
        raise ValueError(
            f"out: {name} cannot be compared with that of a later call ({error}); let it hold"
            " numbers, arrays, containers and functions only"
        ) from error


def _load_or_run(
    run: Callable, lanes, path: pathlib.Path | None, chain: Chain, chunk: int
) -> Trajectory:
    """Return one chunk as numpy arrays, loaded from its file if that exists, else run and saved.

    The result is moved to the host so that the device's memory is free for the next chunk.
    """
    if path is not None and path.exists():
        return load_trajectory(path)
    try:
        # calls are asynchronous: some errors appear only when results are read
        traj = jax.tree.map(np.asarray, run(lanes))
    except jax.errors.JaxRuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        raise RuntimeError(
            f"chunk={chunk} lanes at once on one device need more memory than there is; give a"
            " smaller chunk=, or fewer times ts="
        ) from error
    if path is not None:
        traj.save(path, chain)
    return traj


def _print_progress(done: int, chunks: int, lanes: int, seconds: float) -> None:
    """Print how many chunks are done, the seconds so far, and the estimated remaining seconds."""
    remaining = seconds / done * (chunks - done)
    end = "\n" if done == chunks else ""
    print(
        f"\rrollout: {done} of {chunks} chunks ({lanes} lanes), {seconds:.1f} s, {remaining:.0f} s"
        " to go ",
        end=end,
        file=sys.stderr,
        flush=True,
    )


def _gather_chunks(done: dict[int, Trajectory], count: int) -> list[Trajectory]:
    """Return all chunks in order, including those of other processes."""
    if jax.process_count() == 1:
        return [done[i] for i in range(count)]
    from jax.experimental import multihost_utils

    processes, process = jax.process_count(), jax.process_index()
    chunks = []
    for first in range(0, count, processes):
        # All processes take part in every round. A process without a new chunk sends an old one.
        own_chunk = done.get(first + process, next(iter(done.values())))
        try:
            round_chunks = multihost_utils.process_allgather(own_chunk)
        except Exception as error:
            raise RuntimeError(
                "rollout: another process has ended before its chunks did; the same call with the"
                " same `out` goes on from those"
            ) from error
        chunks += [
            jax.tree.map(lambda x, p=p: x[p], round_chunks)
            for p in range(min(processes, count - first))
        ]
    return chunks
