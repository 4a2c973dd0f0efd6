"""Trajectory files: stored files of the readable schemas, rejected schemas, and round trips.

saved/schema_4.npz to saved/schema_7.npz were written by `traj.save(path, chain)` with these
schemas.
"""

import dataclasses
import json
import pathlib

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tolerances import REFERENCE, ROUND_OFF

import svkc

FILES = [pathlib.Path(__file__).parent / "saved" / f"schema_{i}.npz" for i in (4, 5, 6, 7)]
FILE = FILES[-1]
ROD = """<mujoco><worldbody>
  <body name="rod"><joint name="pivot" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -1"
    size="0.03"/></body>
</worldbody></mujoco>"""


def simulate(chain, state):
    events = [svkc.at(0.2, connect="hook", here=True)]
    return svkc.simulate(chain, state, 0.3, ts=jnp.linspace(0, 0.3, 4), dt=0.01, events=events)


@pytest.fixture(scope="module")
def run():
    """Return the chain and the trajectory of the stored file, simulated again."""
    chain = svkc.load(
        ROD, virtual_links=[svkc.VirtualLink("hook", parent="world", real="rod", joint="weld")]
    )
    return chain, simulate(chain, chain.state({"pivot": 1.2}))


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_load_file_of_every_readable_schema(file):
    traj = svkc.load_trajectory(file)
    np.testing.assert_allclose(traj.ts, [0, 0.1, 0.2, 0.3])
    np.testing.assert_allclose(traj.states.q[0, 0], 1.2)
    np.testing.assert_allclose(traj.events.time[:1], [0.2])
    assert traj.connected[:, 0].tolist() == [False, False, False, True]
    assert traj.result == svkc.RESULTS.successful
    assert traj.derivative == svkc.types.DERIVATIVE.successful
    assert (traj.names is None) == (file in FILES[:2])
    assert svkc.load_chain(file).link_names == ("hook",)


@pytest.mark.slow
def test_stored_file_equals_a_new_run(run, tmp_path):
    """The stored file, a new run and its own file hold equal numbers."""
    chain, traj = run
    traj.save(tmp_path / "again.npz", chain)
    old, new = svkc.load_trajectory(FILE), svkc.load_trajectory(tmp_path / "again.npz")
    assert jax.tree.structure(old) == jax.tree.structure(new) == jax.tree.structure(traj)
    for a, b, c in zip(*map(jax.tree.leaves, (old, new, traj)), strict=True):
        np.testing.assert_allclose(a, c, atol=REFERENCE)
        np.testing.assert_array_equal(b, c)
    loaded = svkc.load_chain(FILE)
    assert jax.tree.structure(loaded) == jax.tree.structure(chain)
    for a, b in zip(*map(jax.tree.leaves, (loaded, chain)), strict=True):
        np.testing.assert_allclose(a, b, rtol=ROUND_OFF)


def rewritten(file, path, **metadata):
    """Write a copy of a trajectory file with other metadata."""
    with np.load(file) as stored:
        arrays = dict(stored)
    metadata = json.loads(str(arrays["metadata"])) | metadata
    np.savez(path, **arrays | {"metadata": np.array(json.dumps(metadata))})
    return path


# name and integer of each code, as schema 4 stored them
OF_SCHEMA_4 = [
    ("result", name, value)
    for name, value in {
        "successful": 0, "stopped": 1, "max_events": 2, "max_steps": 3, "step_too_small": 4,
        "not_in_place": 5, "loop_open": 6, "non_finite": 7, "no_slot": 12,
    }.items()
] + [
    ("derivative", name, value)
    for name, value in
    {"successful": 0, "grazing": 8, "jump": 9, "together": 10, "rank_lost": 11}.items()
]  # fmt: skip


@pytest.mark.parametrize(("field", "name", "value"), OF_SCHEMA_4)
def test_integer_codes_of_schema_4_are_read_by_their_meaning(field, name, value, tmp_path):
    traj = svkc.load_trajectory(rewritten(FILES[0], tmp_path / "x.npz", **{field: value}))
    enumeration = {"result": svkc.RESULTS, "derivative": svkc.types.DERIVATIVE}[field]
    assert getattr(traj, field) == getattr(enumeration, name)


@pytest.mark.slow
def test_files_hold_the_names_of_codes(run, tmp_path):
    """Of a batch as well; an unknown name is an error that says so, and leaves the chain."""
    chain, traj = run
    names = {"result": ["successful", "stopped"], "derivative": ["grazing", "successful"]}
    batch = jax.tree.map(lambda x: jnp.stack([x, x]), traj)
    codes = svkc.RESULTS.stopped._value, svkc.types.DERIVATIVE.grazing._value
    values = jnp.array([0, codes[0]]), jnp.array([codes[1], 0])
    batch = eqx.tree_at(lambda t: (t.result._value, t.derivative._value), batch, values)
    batch.save(tmp_path / "batch.npz", chain)
    with np.load(tmp_path / "batch.npz") as file:
        metadata = json.loads(str(file["metadata"]))
    assert {field: metadata[field] for field in names} == names
    assert bool(eqx.tree_equal(svkc.load_trajectory(tmp_path / "batch.npz"), batch))
    newer = rewritten(FILE, tmp_path / "newer.npz", result="exploded")
    with pytest.raises(ValueError, match="has the result exploded, which this version"):
        svkc.load_trajectory(newer)
    assert svkc.load_chain(newer).link_names == ("hook",)


@pytest.mark.parametrize("schema", [1, 3, 8])
def test_other_schemas_are_rejected(schema, tmp_path):
    path = rewritten(FILE, tmp_path / "other.npz", schema=schema)
    for load in (svkc.load_trajectory, svkc.load_chain):
        with pytest.raises(
            ValueError, match=f"has schema {schema}, .* reads schemas 4 to 7; load it"
        ):
            load(path)


def test_save_and_load_round_trip(run, tmp_path):
    """A loaded trajectory equals the saved one bit for bit; truncated files are rejected, and no
    temporary file is left."""
    chain, traj = run
    traj.save(tmp_path / "run.npz", chain)
    again = svkc.load_trajectory(tmp_path / "run.npz")
    assert bool(eqx.tree_equal(traj, again))
    assert again.names == chain.names
    assert str(again.report()) == str(traj.report())
    content = (tmp_path / "run.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(content[: len(content) // 2])
    (tmp_path / "text.npz").write_text("no")
    for name in ("cut.npz", "text.npz"):
        with pytest.raises(ValueError, match="not a complete trajectory"):
            svkc.load_trajectory(tmp_path / name)
    assert [p.name for p in tmp_path.glob("*.part")] == []


def test_a_changed_chain_is_stored_by_the_names_of_its_fields(run, tmp_path):
    """Fields that the model file lacks are kept, and so are fields that were removed."""
    chain, traj = run
    for changed in (
        chain.replace(damping={"pivot": 0.3}),
        dataclasses.replace(chain, anchor=None, stiffness=jnp.array([7.0])),
    ):
        traj.save(tmp_path / "run.npz", changed)
        assert bool(eqx.tree_equal(svkc.load_chain(tmp_path / "run.npz"), changed))


def test_a_file_with_another_chain_is_rejected(run, tmp_path):
    """With an array of an unknown name, or with none."""
    chain, traj = run
    traj.save(tmp_path / "run.npz", chain)
    with np.load(tmp_path / "run.npz") as file:
        arrays = dict(file)
    without = {name: x for name, x in arrays.items() if not name.startswith("chain.")}
    for content, difference in (
        (arrays | {"chain.size": 1.0}, "chain.size"),
        (without, "no arrays"),
    ):
        np.savez(tmp_path / "other.npz", **content)
        with pytest.raises(ValueError, match=f"its chain has {difference}"):
            svkc.load_chain(tmp_path / "other.npz")


def test_continue_a_saved_run(run, tmp_path):
    """A run continued from a file equals one continued from memory, bit for bit, although the
    chain's arrays differ from those of its model. Options are stored as metadata."""
    chain, _ = run
    heavier = eqx.tree_at(lambda c: c.mass, chain, chain.mass * 1.1)
    traj = simulate(heavier, chain.state({"pivot": 1.2}))
    traj.save(tmp_path / "run.npz", heavier, rtol=1e-8, solver=diffrax.Tsit5())
    loaded = svkc.load_chain(tmp_path / "run.npz")
    assert bool(eqx.tree_equal(loaded, heavier))
    assert loaded.model.text == chain.model.text
    again = simulate(loaded, svkc.load_trajectory(tmp_path / "run.npz").final)
    assert bool(eqx.tree_equal(again, simulate(heavier, traj.final)))
    with np.load(tmp_path / "run.npz") as file:
        metadata = json.loads(str(file["metadata"]))
    assert metadata["options"] == {"rtol": 1e-8, "solver": "Tsit5()"}
    assert metadata["certificate"]["gap"] == float(traj.report().gap)
    assert "<mujoco" in metadata["model"]


@pytest.mark.parametrize("read", [svkc.load_trajectory, svkc.load_chain])
def test_a_path_that_is_none_names_the_function_called(read):
    with pytest.raises(ValueError, match=f"^{read.__name__}: expected a path, got 5$"):
        read(5)


def test_a_loaded_chain_does_not_retrace(run, tmp_path):
    """A chain loaded with all arguments of `load` equals the saved chain and is traced once."""
    link = svkc.VirtualLink("hold", "world", "rod", "ball", axis=np.array([0, 1e-3, 1 / 3]))
    arguments = {"cuttable": "pivot", "ignore": "all", "ignore_armature": {"pivot"}}
    chain = svkc.load(ROD, virtual_links=link, spare=np.int64(1), **arguments)
    run[1].save(tmp_path / "run.npz", chain)
    again = svkc.load_chain(tmp_path / "run.npz")
    assert bool(eqx.tree_equal(again, chain))
    total = jax.jit(eqx.debug.assert_max_traces(lambda chain: chain.mass.sum(), max_traces=1))
    assert total(again) == total(chain)
