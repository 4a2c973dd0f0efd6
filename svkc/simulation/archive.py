"""Trajectories on disk: one npz, written whole or not at all."""

import dataclasses
import json
import os
import pathlib
import threading
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from svkc.mjcf.load import load
from svkc.model.chain import Chain, State, Structure
from svkc.model.checked_jit import check_chain
from svkc.model.virtual_link import VirtualLink
from svkc.simulation.records import RESULTS, Events, Phases
from svkc.simulation.trajectory import Trajectory

# Raise it whenever a stored array is added, renamed or changes its meaning: files of every other
# schema are refused.
SCHEMA = 4
_CODES = ("result", "derivative")
_PARTS = {
    "states": State,
    "final": State,
    "structure": Structure,
    "events": Events,
    "phases": Phases,
}


def _flatten(node, prefix: str = "") -> dict[str, np.ndarray]:
    """{"states.q": array, ...}; parts that are None are left out."""
    out = {}
    for field in dataclasses.fields(node):
        value, name = getattr(node, field.name), prefix + field.name
        if field.name in _PARTS:
            out |= _flatten(value, name + ".")
        elif field.name not in _CODES and value is not None:
            out[name] = np.asarray(value)
    return out


def _build(cls, arrays: dict[str, Any], prefix: str = "", **known):
    fields = dict(known)
    for field in dataclasses.fields(cls):
        name = prefix + field.name
        if field.name in _PARTS:
            fields[field.name] = _build(_PARTS[field.name], arrays, name + ".")
        elif field.name not in fields:
            fields[field.name] = jnp.asarray(arrays[name]) if name in arrays else None
    return cls(**fields)


def save(traj: Trajectory, path, chain=None, options=None) -> None:
    """Writes one .npz: every array by name, and a JSON line of metadata (schema, result, versions,
    certificate, options; names and model of the chain)."""
    import svkc

    if chain is not None:
        check_chain(chain)
    meta = {
        "schema": SCHEMA,
        "svkc": svkc.__version__,
        "jax": jax.__version__,
        "units": "SI, rad, wxyz",
    }
    meta |= {name: np.asarray(getattr(traj, name)._value).tolist() for name in _CODES}
    certify = Trajectory.report
    for _ in range(np.ndim(traj.ts) - 1):
        # lanes
        certify = jax.vmap(certify)
    report = certify(jax.tree.map(jnp.asarray, traj))
    meta["certificate"] = {
        f.name: np.asarray(getattr(report, f.name)).tolist()
        for f in dataclasses.fields(report)
        if f.name not in _CODES
    }
    meta["options"] = options or {}
    arrays = _flatten(traj)
    if chain is not None:
        meta |= {"bodies": chain.body_names, "joints": chain.joint_names, "links": chain.link_names}
        meta |= {"model": chain.model.text, "arguments": _plain(chain.model.arguments)}
        arrays |= {f"chain.{i}": np.asarray(x) for i, x in enumerate(jax.tree.leaves(chain))}
    path = pathlib.Path(path)
    # beside it, as readable as any file that the user makes
    temporary = path.with_name(f"{path.name}.{os.getpid()}.{threading.get_ident()}.part")
    try:
        with open(temporary, "wb") as file:
            np.savez_compressed(file, metadata=np.array(json.dumps(meta, default=str)), **arrays)
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def _named(cls, prefix: str = "") -> set[str]:
    """The names of all arrays that `_build` looks for, but for those that may be None."""
    out = set()
    for field in dataclasses.fields(cls):
        if field.name in _PARTS:
            out |= _named(_PARTS[field.name], prefix + field.name + ".")
        elif field.name not in (*_CODES, "locked", "independent"):
            out.add(prefix + field.name)
    return out


def _check_whole(path, arrays: dict[str, Any], names: set[str]) -> None:
    missing = names - set(arrays)
    if missing:
        raise ValueError(
            f"{path} lacks {', '.join(sorted(missing))}; it is not a trajectory written by svkc"
        )


def _plain(value):
    """What load was given, as JSON has it."""
    if isinstance(value, VirtualLink):
        value = dataclasses.asdict(value)
    if isinstance(value, dict):
        return {key: _plain(x) for key, x in value.items()}
    if isinstance(value, (list, tuple, set, frozenset, np.ndarray, jax.Array)):
        return [_plain(x) for x in value]
    return value.item() if isinstance(value, np.generic) else value


def load_chain(path) -> Chain:
    """The chain that a trajectory was saved with: loaded from its MJCF as it was then, with the
    floats that it had. Files of meshes are read where they were.

    ValueError: saved without a chain, or with one that came from a compiled model, which says not
    what it was compiled from; no whole file (as above).
    """
    arrays, meta, _ = _read(path)
    if not meta.get("model"):
        raise ValueError(
            f"{path} holds no model; save with traj.save(path, chain), the chain loaded from a"
            " path, text or MjSpec"
        )
    given = meta["arguments"]
    given["virtual_links"] = [VirtualLink(**link) for link in given["virtual_links"]]
    leaves, how = jax.tree.flatten(load(meta["model"], **given))
    return jax.tree.unflatten(how, [jnp.asarray(arrays[f"chain.{i}"]) for i in range(len(leaves))])


def load_trajectory(path) -> Trajectory:
    """The trajectory that `Trajectory.save` wrote. ValueError: not such a file, cut short, or of
    another schema. FileNotFoundError: no file."""
    arrays, _, codes = _read(path)
    arrays = {name: x for name, x in arrays.items() if not name.startswith("chain.")}
    _check_whole(path, arrays, _named(Trajectory))
    code = lambda value: eqx.tree_at(lambda item: item._value, RESULTS.successful, value)
    build = lambda arrays, codes: _build(
        Trajectory, arrays, **{name: code(value) for name, value in codes.items()}
    )
    for _ in range(arrays["ts"].ndim - 1):
        # lanes
        build = jax.vmap(build)
    try:
        return build(arrays, {name: jnp.asarray(code) for name, code in codes.items()})
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path} is not a whole trajectory written by svkc: {error}") from error


def _read(path) -> tuple[dict[str, np.ndarray], dict, dict[str, np.ndarray]]:
    """Arrays, metadata and result codes of a file of ours."""
    if not isinstance(path, str | bytes | os.PathLike):
        raise ValueError(f"load_trajectory: expected a path, got {path!r}")
    try:
        with open(path, "rb") as raw, np.load(raw, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        meta = json.loads(str(arrays.pop("metadata")))
        schema = int(meta["schema"])
        codes = (
            {name: np.asarray(meta[name], np.int32) for name in _CODES} if schema == SCHEMA else {}
        )
    except FileNotFoundError:
        raise
    # whatever the readers of zip, npy and JSON say of what is none
    except Exception as error:
        raise ValueError(f"{path} is not a whole trajectory written by svkc: {error}") from error
    if schema != SCHEMA:
        raise ValueError(
            f"{path} has schema {schema}, this version reads schema {SCHEMA}; load it with the"
            " version of svkc that wrote it"
        )
    return arrays, meta, codes
