"""Contents of compiled programs: no callbacks to Python, float32 throughout in float32, no LAPACK
in steps by articulated bodies."""

import re

import jax
import jax.numpy as jnp
import models
import pytest

import svkc

pytestmark = pytest.mark.slow

BODIES = {"dynamics": svkc.dynamics.ArticulatedBodies()}


def lowered(function, *args) -> str:
    return jax.jit(function).lower(*args).as_text()


def calls(text: str) -> set[str]:
    """Return names of custom calls, without those that only annotate sharding."""
    return set(re.findall(r"custom_call @(\w+)", text)) - {"Sharding", "annotate_device_placement"}


@pytest.fixture(scope="module", params=["float64", "float32"])
def precision(request):
    with jax.enable_x64(request.param == "float64"):
        yield request.param


def run(chain, state, **options):
    events = [
        svkc.at(0.02, cut="pin"),
        svkc.when(lambda t, s, args: s.q[0] - 0.3, connect="pin", here=True),
    ]
    return svkc.simulate(chain, state, 0.1, events=events, throw=False, **options)


def test_programs(precision):
    chain = models.four_bar()
    state, tau = chain.state(v={"crank": 4.0}), jnp.zeros(chain.nv)
    batch = jax.tree.map(lambda x: jnp.stack([x, x]), state)
    gradient = lambda options: (
        lambda v: jax.grad(
            lambda v: jnp.sum(
                run(chain, svkc.State(state.q, v, state.structure), **options).final.q
            )
        )(v)
    )
    programs = {
        "step": lowered(lambda s: svkc.step(chain, s, tau, 1e-3), state),
        "steps of lanes": lowered(jax.vmap(lambda s: svkc.step(chain, s, tau, 1e-3)), batch),
        "phase by bodies": lowered(
            lambda s: svkc.simulate(chain, s, 0.1, throw=False, **BODIES), state
        ),
        "run": lowered(lambda s: run(chain, s), state),
        "gradient": lowered(gradient({}), state.v),
    }
    for name, text in programs.items():
        custom_calls = calls(text)
        assert not any("callback" in call for call in custom_calls), (name, custom_calls)
        assert not custom_calls or name in ("run", "gradient"), (name, custom_calls)
        assert ("f64" in text) == (precision == "float64"), name
        # on a GPU these are its own library's
        assert all(call.startswith("lapack") for call in custom_calls), (name, custom_calls)
