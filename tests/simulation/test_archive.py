"""Trajectory files: a stored file of the current schema, rejected schemas, and round trips.

saved/schema_4.npz was written by `traj.save(path, chain)` with schema 4.
"""

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

FILE = pathlib.Path(__file__).parent / "saved" / "schema_4.npz"
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


def test_load_file_of_current_schema():
    traj = svkc.load_trajectory(FILE)
    np.testing.assert_allclose(traj.ts, [0, 0.1, 0.2, 0.3])
    np.testing.assert_allclose(traj.states.q[0, 0], 1.2)
    np.testing.assert_allclose(traj.events.time[:1], [0.2])
    assert traj.connected[:, 0].tolist() == [False, False, False, True]
    assert traj.result == svkc.RESULTS.successful
    assert svkc.load_chain(FILE).link_names == ("hook",)


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


@pytest.mark.parametrize("schema", [1, 3, 5])
def test_other_schemas_are_rejected(schema, tmp_path):
    with np.load(FILE) as file:
        arrays = dict(file)
    metadata = json.loads(str(arrays["metadata"])) | {"schema": schema}
    path = tmp_path / "other.npz"
    np.savez(path, **arrays | {"metadata": np.array(json.dumps(metadata))})
    for load in (svkc.load_trajectory, svkc.load_chain):
        with pytest.raises(ValueError, match=f"has schema {schema}, .* reads schema 4; load it"):
            load(path)


def test_save_and_load_round_trip(run, tmp_path):
    """A loaded trajectory equals the saved one bit for bit; truncated files are rejected, and no
    temporary file is left."""
    chain, traj = run
    traj.save(tmp_path / "run.npz", chain)
    again = svkc.load_trajectory(tmp_path / "run.npz")
    assert bool(eqx.tree_equal(traj, again))
    assert str(again.report()) == str(traj.report())
    content = (tmp_path / "run.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(content[: len(content) // 2])
    (tmp_path / "text.npz").write_text("no")
    for name in ("cut.npz", "text.npz"):
        with pytest.raises(ValueError, match="not a complete trajectory"):
            svkc.load_trajectory(tmp_path / name)
    assert [p.name for p in tmp_path.glob("*.part")] == []


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
