"""Plots of a run."""

import pathlib

import jax.numpy as jnp
import matplotlib.image
import models
import numpy as np
import pytest
from processes import looks_drawn

import svkc
from svkc.model.chain_names import chain_names
from svkc.viz.plots import (
    Curve,
    coordinates,
    energy_parts,
    panels_of_coordinates,
    rotation_vectors,
)
from svkc.viz.run_data import saved_states

SCENES = pathlib.Path(svkc.__file__).parent / "scenes"


@pytest.mark.slow
def test_a_long_floor_does_not_shrink_the_figure(tmp_path):
    """Ground shapes end at most a metre beyond the bodies: a floor's length has no effect."""

    def drawn(half: float):
        floor = (
            f'<geom type="capsule" size=".02" contype="0" conaffinity="0" fromto="{-half} 0 0'
            f' {half} 0 0"/>'
        )
        chain = svkc.load(
            f'<mujoco><worldbody>{floor}<body pos="0 0'
            f' 1"><freejoint/>{models.BAR.format("0 0 0.3")}</body></worldbody></mujoco>'
        )
        traj = svkc.simulate(chain, chain.state(), 0.1, ts=jnp.linspace(0, 0.1, 3), dt=0.05)
        return matplotlib.image.imread(svkc.render(chain, traj, tmp_path / f"{half}.png"))

    np.testing.assert_array_equal(drawn(4.0), drawn(40.0))


@pytest.mark.slow
def test_runs_without_phases_or_save_times_are_drawn(tmp_path):
    """A run of no length, and one that ends before its first save time."""
    chain = svkc.load(models.ARM)
    state = chain.state({"arm": 0.5})
    at_rest = svkc.simulate(chain, state, 0.0, dt=0.05)
    assert str(at_rest).startswith("Trajectory: t = 0 to 0 s, 2 save times, 0 phases")
    stop = svkc.at(0.05, stop=True)
    early = svkc.simulate(chain, state, 0.2, ts=jnp.array([0.1, 0.2]), dt=0.05, events=stop)
    for traj in (at_rest, early):
        traj.plot(chain).savefig(tmp_path / "run.png")
        looks_drawn(tmp_path / "run.png")


@pytest.mark.slow
def test_names_are_shown_as_they_are(tmp_path):
    """Legends leave out labels that start with an underscore, and dollar signs enclose TeX."""
    for name in ("_arm", "arm$\\frac{$"):
        chain = svkc.load(models.ARM.replace('name="arm"', f'name="{name}"'))
        traj = svkc.simulate(chain, chain.state({name: 0.5}), 0.1, dt=0.05)
        figure = traj.plot(chain)
        figure.savefig(tmp_path / "run.png")
        texts = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
        assert [text.strip().replace("\\$", "$") for text in texts] == [name]


def test_plot_draws_coordinates_and_events():
    """Axes have labels, coordinates are curves over the save times, an event is a vertical line."""
    chain = svkc.load(models.ARM)
    traj = svkc.simulate(
        chain,
        chain.state({"arm": 0.5}),
        0.1,
        ts=jnp.linspace(0, 0.1, 3),
        dt=0.05,
        events=[svkc.at(0.05)],
    )
    figure = svkc.plot(traj, chain)
    for axes in figure.axes:
        assert axes.get_ylabel()
    lines = [line for axes in figure.axes for line in axes.lines]
    assert any(
        np.array_equal(line.get_xdata(), traj.ts)
        and np.allclose(line.get_ydata(), traj.states.q[:, 0])
        for line in lines
    )
    assert any(np.allclose(line.get_xdata(), 0.05) for line in lines)


@pytest.mark.parametrize("figure", ["figure16", "figure40"])
def test_panels_of_joints_are_legible(figure):
    """A panel has at most eight curves of one unit; all joints of both figures are shown."""
    chain = svkc.load(str(SCENES / f"{figure}.xml"))
    names = chain_names(chain.topology)
    every = coordinates(names, np.tile(chain.state().q, (3, 1)))
    groups, note = panels_of_coordinates(every, names, None)
    assert not note
    assert all(0 < len(group) <= 8 for group in groups)
    assert all(len({curve.unit for curve in group}) == 1 for group in groups)
    # a free joint has three lengths and three angles
    labels = [curve.label for group in groups for curve in group]
    assert labels[:3] == ["base.x", "base.y", "base.z"]
    assert len(labels) == len(set(labels)) == chain.nv
    assert {label.split(".")[0] for label in labels} == set(chain.joint_names)
    assert len(groups) <= -(-chain.nv // 8) + 2


def test_more_coordinates_than_fit():
    """Of very many coordinates, those that change most are shown; named joints are all shown."""
    every = [
        Curve(f"j{i}", label=f"j{i}", unit="angle (rad)", values=np.array([0.0, i % 60]))
        for i in range(100)
    ]
    groups, note = panels_of_coordinates(every, None, None)
    labels = [curve.label for group in groups for curve in group]
    assert note.startswith("48 of 100 coordinates")
    assert 48 <= len(labels) < 56
    assert "j59" in labels
    assert "j60" not in labels
    groups, note = panels_of_coordinates(every, None, tuple(f"j{i}" for i in range(60)))
    assert ([len(group) for group in groups], note) == ([8] * 7 + [4], "")


def test_rotation_vectors_of_quaternions():
    """Rotation vectors are continuous beyond half a turn, whatever the quaternions' signs."""
    angle = np.linspace(0, 1.9 * np.pi, 40)
    axis = np.array([0.0, 0.6, -0.8])
    quats = np.concatenate([np.cos(angle / 2)[:, None], np.sin(angle / 2)[:, None] * axis], -1)
    quats[10:20] *= -1
    np.testing.assert_allclose(rotation_vectors(quats), angle[:, None] * axis, atol=1e-12)
    # q and -q are one rotation
    np.testing.assert_allclose(rotation_vectors(-quats), angle[:, None] * axis, atol=1e-12)


def test_joints_by_name():
    """Named joints alone are shown, labelled from the run's own names; others raise ValueError."""
    chain = svkc.load(models.ARM)
    traj = svkc.simulate(chain, chain.state({"arm": 0.5}), 0.1, ts=jnp.linspace(0, 0.1, 3), dt=0.05)
    figure = traj.plot(joints=["arm"])
    labels = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert labels == ["arm"]
    with pytest.raises(ValueError, match=r"no joint 'arn'; did you mean 'arm'\?"):
        traj.plot(joints=["arn"])


SPRINGS = """<mujoco><worldbody><body name="rod">
  <joint name="pivot" axis="0 1 0" damping="0.3" stiffness="4" range="-20 20" limited="true"/>
  <geom type="capsule" fromto="0 0 0 0 0 -1" size="0.03"/>
  <body name="tip" pos="0 0 -1"><joint name="tip" axis="0 1 0" stiffness="3"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.5" size="0.03"/></body></body></worldbody></mujoco>"""


@pytest.mark.slow
@pytest.mark.parametrize("end", [1.0, 0.9])
def test_the_parts_of_the_energy_add_up(end):
    """The sum is flat to the run's drift, also where a joint with a stretched spring is cut.

    A run that an event ends counts what this event takes.
    """
    chain = svkc.load(SPRINGS, cuttable="tip")
    events = [svkc.at(0.4, cut="tip"), svkc.at(0.6, lock="pivot"), svkc.at(0.7, unlock="pivot")]
    events += [svkc.at(0.9, lock="pivot", stop=True)] if end < 1 else []
    traj = svkc.simulate(
        chain,
        chain.state({"pivot": 1.2, "tip": 0.5}),
        1.0,
        ts=jnp.arange(21) / 20,
        rtol=1e-10,
        control=lambda t, state, args: 2 * jnp.sin(5 * t) * chain.torques({"pivot": 1.0}),
        events=events,
    )
    ts, numbers, _ = saved_states(traj)
    assert ts[-1] == end
    parts = energy_parts(traj, ts[: len(numbers)], numbers, chain)
    assert all(np.ptp(values) > 1e-3 for values in parts.values()), parts
    total = np.sum(list(parts.values()), 0)
    assert np.ptp(total) < 1e-8
    lost = parts["lost in events"]
    # a cut takes the spring's energy, an impact of the lock kinetic energy
    assert np.all(np.diff(lost) >= 0)
    assert np.flatnonzero(np.diff(lost) > 1e-4).tolist() == [7, 11] + [17] * (end < 1)
    panel = traj.plot(chain).axes[-3]
    assert panel.get_ylabel() == "energy (J)"
    legend = [text.get_text() for text in panel.get_legend().get_texts()]
    assert legend[:-1] == list(parts)
    assert legend[-1].startswith("sum, drifts by ")
    assert float(legend[-1].split()[3]) < 1e-8
