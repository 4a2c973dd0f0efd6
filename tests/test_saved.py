"""Files written by earlier versions: saved/schema_1.npz to schema_3.npz are of svkc's own history,
written by the last commit that wrote each."""

import pathlib

import jax.numpy as jnp
import numpy as np
import pytest

import svkc

FOLDER = pathlib.Path(__file__).parent / "saved"
ROD = """<mujoco><worldbody>
  <body name="rod"><joint name="pivot" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -1"
    size="0.03"/></body>
</worldbody></mujoco>"""


@pytest.fixture(scope="module")
def today():
    chain = svkc.load(
        ROD, virtual_links=[svkc.VirtualLink("hook", parent="world", real="rod", joint="weld")]
    )
    events = [svkc.at(0.2, connect="hook", here=True)]
    return svkc.simulate(
        chain, chain.state({"pivot": 1.2}), 0.3, ts=jnp.linspace(0, 0.3, 4), dt=0.01, events=events
    )


@pytest.mark.slow
@pytest.mark.parametrize("schema", [1, 2, 3])
def test_older_files_are_read(schema, today, tmp_path):
    """With the numbers that they have; what was not kept then is told as not known; saved again
    they are as any other."""
    old = svkc.load_trajectory(FOLDER / f"schema_{schema}.npz")
    np.testing.assert_allclose(old.states.q, today.states.q, atol=1e-9)
    np.testing.assert_allclose(old.events.time[:1], [0.2])
    assert old.connected[:, 0].tolist() == today.connected[:, 0].tolist()
    assert old.result == svkc.RESULTS.successful
    assert "not looked at" in str(old.report()) or schema == 3
    assert np.isinf(old.phases.gap).all()
    old.save(tmp_path / "new.npz")
    again = svkc.load_trajectory(tmp_path / "new.npz")
    assert str(again.report()) == str(old.report())
    with pytest.raises(ValueError, match="holds no model"):
        svkc.load_chain(FOLDER / f"schema_{schema}.npz")
