"""Runs whose pages are tested."""

import html

import jax.numpy as jnp
import models
import pytest
from pages import CUTS, NAME

import svkc


@pytest.fixture(scope="module")
def release(high_bar):
    """Return chain and run of the high bar for half a second: two hands, one, none."""
    chain, state = high_bar
    events = [svkc.at(t, cut=link) for t, link in CUTS.items()]
    return chain, svkc.simulate(
        chain, state, 0.5, ts=jnp.linspace(0, 0.5, 21), events=events, dt=0.0125
    )


@pytest.fixture(scope="module")
def stopped():
    """Return chain and run of a four-bar that is cut and connected; the second event stops it."""
    chain = models.four_bar()
    events = [svkc.at(0.023, cut="pin"), svkc.at(0.035, connect="pin", here=True, stop=True)]
    return chain, svkc.simulate(
        chain,
        chain.state({"crank": 0.4}),
        0.1,
        ts=jnp.linspace(0, 0.1, 11),
        events=events,
        dt=0.005,
    )


@pytest.fixture(scope="module")
def pendulum():
    """Return a pendulum whose body name would end a script element if it were not escaped."""
    body = (
        f'<body name="{html.escape(NAME)}"><joint name="j" axis="0 1'
        f' 0"/>{models.BAR.format("0 0 -1")}</body>'
    )
    return svkc.load(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
