"""Plots of a run."""

import jax.numpy as jnp
import matplotlib.image
import models
import numpy as np
import pytest

import svkc


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
