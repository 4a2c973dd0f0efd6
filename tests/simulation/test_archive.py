"""Files of trajectories: saved/schema_4.npz was written by `traj.save(path, chain)` when schema 4
was the current one, and other schemas are refused."""

import json
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import svkc

FILE = pathlib.Path(__file__).parent / "saved" / "schema_4.npz"
ROD = """<mujoco><worldbody>
  <body name="rod"><joint name="pivot" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -1"
    size="0.03"/></body>
</worldbody></mujoco>"""


def run():
    """The chain and the run that the file holds."""
    chain = svkc.load(
        ROD, virtual_links=[svkc.VirtualLink("hook", parent="world", real="rod", joint="weld")]
    )
    events = [svkc.at(0.2, connect="hook", here=True)]
    traj = svkc.simulate(
        chain, chain.state({"pivot": 1.2}), 0.3, ts=jnp.linspace(0, 0.3, 4), dt=0.01, events=events
    )
    return chain, traj


def test_a_file_of_the_current_schema_is_read():
    traj = svkc.load_trajectory(FILE)
    np.testing.assert_allclose(traj.ts, [0, 0.1, 0.2, 0.3])
    np.testing.assert_allclose(traj.states.q[0, 0], 1.2)
    np.testing.assert_allclose(traj.events.time[:1], [0.2])
    assert traj.connected[:, 0].tolist() == [False, False, False, True]
    assert traj.result == svkc.RESULTS.successful
    assert svkc.load_chain(FILE).link_names == ("hook",)


@pytest.mark.slow
def test_its_numbers_are_those_of_the_run(tmp_path):
    """And those that it has when it is saved again."""
    chain, traj = run()
    traj.save(tmp_path / "again.npz", chain)
    old, new = svkc.load_trajectory(FILE), svkc.load_trajectory(tmp_path / "again.npz")
    assert jax.tree.structure(old) == jax.tree.structure(new) == jax.tree.structure(traj)
    for a, b, c in zip(*map(jax.tree.leaves, (old, new, traj)), strict=True):
        np.testing.assert_allclose(a, c, atol=1e-9)
        np.testing.assert_array_equal(b, c)
    loaded = svkc.load_chain(FILE)
    assert jax.tree.structure(loaded) == jax.tree.structure(chain)
    for a, b in zip(*map(jax.tree.leaves, (loaded, chain)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12)


@pytest.mark.parametrize("schema", [1, 3, 5])
def test_other_schemas_are_refused(schema, tmp_path):
    with np.load(FILE) as file:
        arrays = dict(file)
    metadata = json.loads(str(arrays["metadata"])) | {"schema": schema}
    path = tmp_path / "other.npz"
    np.savez(path, **arrays | {"metadata": np.array(json.dumps(metadata))})
    for load in (svkc.load_trajectory, svkc.load_chain):
        with pytest.raises(ValueError, match=f"has schema {schema}, .* reads schema 4; load it"):
            load(path)
