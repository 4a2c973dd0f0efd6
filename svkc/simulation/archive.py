"""Trajectories on disk: one .npz file for each run, written atomically.

A file holds every array of the trajectory by name, a JSON line of metadata, and, if the user passes
the chain, the chain's model and arrays.
"""

import dataclasses
import json
import os
import pathlib
import threading
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from svkc._jax.enumerations import member_names, with_value
from svkc.mjcf.load import load
from svkc.model.annotations import Path
from svkc.model.chain import Chain
from svkc.model.chain_names import ChainNames
from svkc.model.checked_jit import check_chain
from svkc.model.state import State, Structure
from svkc.model.virtual_link import VirtualLink
from svkc.simulation.codes import CODES
from svkc.simulation.records import Events, Phases
from svkc.simulation.trajectory import Trajectory

# Increase the schema whenever a stored array is added, renamed or changes its meaning: files of
# schemas that are not readable are refused.
SCHEMA = 7
# Schema 6 numbers the arrays of the chain. Schema 5 lacks the names, too. Schema 4 stores result
# codes as integers, the indices of these names.
READABLE = (4, 5, 6, SCHEMA)
_CODES_OF_SCHEMA_4 = (
    "successful", "stopped", "max_events", "max_steps", "step_too_small", "not_in_place",
    "loop_open", "non_finite", "grazing", "jump", "together", "rank_lost", "no_slot",
)  # fmt: skip
_NESTED = {
    "states": State,
    "final": State,
    "structure": Structure,
    "events": Events,
    "phases": Phases,
}


def _flatten(node, prefix: str = "") -> dict[str, np.ndarray]:
    """Return {"states.q": array, ...}. Codes, names and fields that are None are left out."""
    out = {}
    for field in dataclasses.fields(node):
        value, name = getattr(node, field.name), prefix + field.name
        if field.name in _NESTED:
            out |= _flatten(value, name + ".")
        elif field.name not in (*CODES, "names") and value is not None:
            out[name] = np.asarray(value)
    return out


def _build(cls, arrays: dict[str, Any], prefix: str = "", **known):
    """Return an object of a class from arrays as `_flatten` names them.

    known: fields that are not stored as arrays.
    """
    fields = dict(known)
    for field in dataclasses.fields(cls):
        name = prefix + field.name
        if field.name in _NESTED:
            fields[field.name] = _build(_NESTED[field.name], arrays, name + ".")
        elif field.name not in fields:
            fields[field.name] = jnp.asarray(arrays[name]) if name in arrays else None
    return cls(**fields)


def save(
    traj: Trajectory, path: Path, chain: Chain | None = None, options: dict[str, Any] | None = None
) -> None:
    """Write one .npz file; see `Trajectory.save`.

    The metadata are the schema, the results, the versions, the certificate, the options, the names,
    and the model of the chain.
    """
    import svkc

    if chain is not None:
        check_chain(chain)
    meta = {
        "schema": SCHEMA,
        "svkc": svkc.__version__,
        "jax": jax.__version__,
        "units": "SI, rad, wxyz",
    }
    for field, enumeration in CODES.items():
        values = np.asarray(getattr(traj, field)._value)
        meta[field] = np.array(member_names(enumeration))[values].tolist()
    certify = Trajectory.report
    for _ in range(np.ndim(traj.ts) - 1):
        # a batch of runs
        certify = jax.vmap(certify)
    report = certify(jax.tree.map(jnp.asarray, traj))
    meta["certificate"] = {
        f.name: np.asarray(getattr(report, f.name)).tolist()
        for f in dataclasses.fields(report)
        if f.name not in (*CODES, "names")
    }
    meta["options"] = options or {}
    meta["names"] = traj.names and dataclasses.asdict(traj.names)
    arrays: dict[str, Any] = _flatten(traj)
    if chain is not None:
        meta |= {"model": chain.model.text, "arguments": _as_json(chain.model.arguments)}
        stored = dict(_fields(chain)[0])
        arrays |= {name: np.asarray(x) for name, x in stored.items() if x is not None}
    path = pathlib.Path(path)
    # in the same folder, so that os.replace is atomic; `tempfile` would deny other users access
    temporary = path.with_name(f"{path.name}.{os.getpid()}.{threading.get_ident()}.part")
    try:
        with open(temporary, "wb") as file:
            np.savez_compressed(file, metadata=np.array(json.dumps(meta, default=str)), **arrays)
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def _array_names(cls, prefix: str = "") -> set[str]:
    """Return the names of all arrays that `_build` needs; fields with a default are left out."""
    out = set()
    for field in dataclasses.fields(cls):
        if field.name in _NESTED:
            out |= _array_names(_NESTED[field.name], prefix + field.name + ".")
        elif field.name not in CODES and field.default is dataclasses.MISSING:
            out.add(prefix + field.name)
    return out


def _check_complete(path, arrays: dict[str, Any], names: set[str]) -> None:
    """Raise ValueError if one of the named arrays is missing."""
    missing = names - set(arrays)
    if missing:
        raise ValueError(
            f"{path} lacks {', '.join(sorted(missing))}; it is not a trajectory file written by"
            " svkc"
        )


def _as_json(value):
    """Return an argument of `load` as JSON values."""
    if isinstance(value, VirtualLink):
        value = dataclasses.asdict(value)
    if isinstance(value, dict):
        return {key: _as_json(x) for key, x in value.items()}
    if isinstance(value, (list, tuple, set, frozenset, np.ndarray, jax.Array)):
        return [_as_json(x) for x in value]
    return value.item() if isinstance(value, np.generic) else value


def _fields(chain: Chain):
    """Return (name, array or None) of each array of a chain, and the tree structure."""
    fields, structure = jax.tree_util.tree_flatten_with_path(chain, is_leaf=lambda x: x is None)
    return [("chain" + jax.tree_util.keystr(path), x) for path, x in fields], structure


def load_chain(path: Path) -> Chain:
    """Return the chain that a trajectory was saved with.

    The chain is loaded from the stored MJCF with the stored arguments of `svkc.load`; its arrays
    are then replaced by the stored ones. Mesh files are read from their original paths.

    path: file that `Trajectory.save` wrote with a chain.

    Raises ValueError if the file was saved without a chain or with a chain loaded from a compiled
    model (MjModel), is incomplete, or has another schema; FileNotFoundError if there is no file.
    """
    arrays, meta, _ = _read("load_chain", path)
    if not meta.get("model"):
        raise ValueError(
            f"{path} holds no model; save with traj.save(path, chain), the chain loaded from a"
            " path, text or MjSpec"
        )
    arguments = meta["arguments"]
    arguments["virtual_links"] = [VirtualLink(**link) for link in arguments["virtual_links"]]
    fields, structure = _fields(load(meta["model"], **arguments))
    stored = {name: jnp.asarray(x) for name, x in arrays.items() if name.startswith("chain.")}
    if meta["schema"] < 7:
        # the arrays are numbered, in the order of the fields that are not None
        names = [name for name, x in fields if x is not None]
        numbered = [f"chain.{i}" for i in range(len(names))]
        _check_complete(path, stored, set(numbered))
        stored = {name: stored[number] for name, number in zip(names, numbered, strict=True)}
    unknown = set(stored) - {name for name, _ in fields}
    if unknown or not stored:
        error = f"its chain has {', '.join(sorted(unknown)) or 'no arrays'}"
        raise ValueError(f"{path} is not a complete trajectory file written by svkc: {error}")
    return jax.tree.unflatten(structure, [stored.get(name) for name, _ in fields])


def load_trajectory(path: Path) -> Trajectory:
    """Return a trajectory, or a batch of trajectories, that `Trajectory.save` wrote.

    path: file that `Trajectory.save` wrote.

    Raises ValueError if the file is not one of svkc, is incomplete, or has another schema;
    FileNotFoundError if there is no file.
    """
    arrays, meta, codes = _read("load_trajectory", path)
    codes, names = _as_codes(path, codes), meta["names"]
    arrays = {name: x for name, x in arrays.items() if not name.startswith("chain.")}
    _check_complete(path, arrays, _array_names(Trajectory))
    build = lambda arrays, codes: _build(Trajectory, arrays, names=names, **codes)
    for _ in range(arrays["ts"].ndim - 1):
        # a batch of runs
        build = jax.vmap(build)
    try:
        return build(arrays, codes)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"{path} is not a complete trajectory file written by svkc: {error}"
        ) from error


def _as_tuple(value) -> Any:
    """Return nested lists as nested tuples."""
    return tuple(map(_as_tuple, value)) if isinstance(value, list) else value


def _as_codes(path, codes: dict[str, np.ndarray]) -> dict[str, Any]:
    """Return the codes as members of their enumerations. Raises ValueError for unknown names."""
    members = {}
    for field, names in codes.items():
        known = member_names(CODES[field])
        unknown = sorted(set(names.ravel().tolist()) - set(known))
        if unknown:
            raise ValueError(
                f"{path} has the {field} {', '.join(unknown)}, which this version of svkc does not"
                " know; load it with the version of svkc that wrote it"
            )
        values = np.vectorize(known.index, otypes=[np.int32])(names)
        members[field] = with_value(CODES[field].successful, jnp.asarray(values))
    return members


def _read(caller: str, path) -> tuple[dict[str, np.ndarray], dict, dict[str, np.ndarray]]:
    """Return the arrays, the metadata and the names of the codes of a file. Raises as
    `load_trajectory` does.

    caller: the function that the user called, for messages.
    """
    if not isinstance(path, str | bytes | os.PathLike):
        raise ValueError(f"{caller}: expected a path, got {path!r}")
    try:
        with open(path, "rb") as raw, np.load(raw, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        meta = json.loads(str(arrays.pop("metadata")))
        schema = int(meta["schema"])
        as_names = (lambda code: np.take(_CODES_OF_SCHEMA_4, code)) if schema == 4 else np.asarray
        codes = {name: np.asarray(as_names(meta[name])) for name in CODES if schema in READABLE}
        # files of schemas below 6 have no names
        names = meta.get("names")
        meta["names"] = names and ChainNames(**{k: _as_tuple(x) for k, x in names.items()})
    except FileNotFoundError:
        raise
    # the readers of zip, npy and JSON raise exceptions of many types for a damaged file
    except Exception as error:
        raise ValueError(
            f"{path} is not a complete trajectory file written by svkc: {error}"
        ) from error
    if schema not in READABLE:
        raise ValueError(
            f"{path} has schema {schema}, this version reads schemas {READABLE[0]} to {SCHEMA};"
            " load it with the version of svkc that wrote it"
        )
    return arrays, meta, codes
