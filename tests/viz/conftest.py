"""Runs that pages show."""

import html

import jax.numpy as jnp
import models
import pytest
from pages import CUTS, NAME

import svkc


@pytest.fixture(scope="module")
def release(high_bar):
    """Two hands, one, none, in half a second."""
    chain, state = high_bar
    events = [svkc.at(t, cut=link) for t, link in CUTS.items()]
    return chain, svkc.simulate(
        chain, state, 0.5, ts=jnp.linspace(0, 0.5, 21), events=events, dt=0.0125
    )


@pytest.fixture(scope="module")
def stopped():
    """A four-bar that is let go and caught again, to a stop of the run before its time."""
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
    """Nothing virtual in it, and a body whose name would end the script, were it let."""
    body = (
        f'<body name="{html.escape(NAME)}"><joint name="j" axis="0 1'
        f' 0"/>{models.BAR.format("0 0 -1")}</body>'
    )
    return svkc.load(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
