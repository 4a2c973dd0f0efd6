"""Contents of compiled programs: no callbacks to Python, float32 throughout in float32, no LAPACK
in steps by articulated bodies, nothing slow on a GPU in steps of batches."""

import re

import jax
import jax.numpy as jnp
import models
import pytest
import speed_cases

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


def steps_for_cuda(name: str) -> str:
    """Return the steps of 96 lanes of a case of the speed benchmarks, lowered for CUDA.

    On a CPU these are several tiles in both precisions.
    """
    chain, state = speed_cases.load_case(name)
    batch = jax.tree.map(lambda x: jax.ShapeDtypeStruct((96, *x.shape), x.dtype), state)
    tau = jnp.zeros(chain.nv)
    step = jax.jit(jax.vmap(lambda s: svkc.step(chain, s, tau, speed_cases.DT)))
    return step.trace(batch).lower(lowering_platforms=("cuda",)).as_text()


@pytest.mark.parametrize("name", ["open", "two ball grips", "two hinge grips"])
def test_steps_of_lanes_for_cuda(name, monkeypatch):
    """With a GPU as the default backend: no library calls, no scatter, no loop, no `dot`.

    A `dot` in float32 would be in TF32. On a CPU the same lanes are a loop over tiles.
    """
    if name == "open":
        assert "stablehlo.while" in steps_for_cuda(name)
        # the batched program of the same number of lanes is kept
        jax.clear_caches()
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    text = steps_for_cuda(name)
    assert text.count("stablehlo.") > 1000
    for operation in ("custom_call", "scatter", "while", "dot_general", "cholesky"):
        assert f"stablehlo.{operation}" not in text
    jax.clear_caches()
