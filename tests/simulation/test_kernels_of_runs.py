"""Which functions of a run are one kernel on a CPU (jax 0.10 only)."""

import re

import jax
import jax.numpy as jnp
import models
import pytest

import svkc
from svkc._jax.one_kernel import HAS_ONE_KERNEL

pytestmark = pytest.mark.skipif(not HAS_ONE_KERNEL, reason="only jax 0.10 needs kernels")


def small_control(t, s, args):
    return -0.1 * s.v


def control_by_lapack(t, s, args):
    return -jnp.linalg.cholesky(jnp.eye(2) * (1.0 + s.v[0] ** 2))[0]


GUARD = svkc.when(lambda t, s, args: s.q[0] - 0.5, stop=True)
RUNS = {
    "adaptive": {},
    "symplectic Euler": {"dt": 1e-2, "solver": svkc.integrators.SymplecticEuler()},
    "guard": {"events": [GUARD]},
    "control": {"control": small_control},
    "control by LAPACK": {"control": control_by_lapack},
}


def kernels(function, *args) -> set[str]:
    """Return the names of the functions that are one kernel in a lowered program."""
    text = jax.jit(function).lower(*args).as_text()
    bodies = dict(re.findall(r"func\.func private @(\w+)\((.*?)\n  }", text, re.S))
    calls = lambda name: re.findall(r"call @(\w+)\(", bodies[name])
    unpacking = [
        re.search(r"call @(\w+)\(", line)[1]
        for line in text.splitlines()
        if 'xla_cpu_small_call = "true"' in line
    ]
    return {re.sub(r"_\d+$", "", called) for name in unpacking for called in calls(name)}


def two_rods_run(**options):
    chain = svkc.load(models.MJCF.format(models.TWO_RODS))
    run = lambda s: svkc.simulate(chain, s, 0.1, throw=False, max_steps=64, **options)
    return run, chain.state()


@pytest.mark.parametrize("case", RUNS)
def test_an_attempted_step_is_one_kernel(case):
    names = kernels(*two_rods_run(**RUNS[case]))
    assert ("attempt_and_advance" in names) == (case != "control by LAPACK")
    assert names & {"_rates_for_torques", "_rates_without_control"}


@pytest.mark.parametrize("case", RUNS)
def test_batches_have_no_kernels(case):
    run, state = two_rods_run(**RUNS[case])
    batch = jax.tree.map(lambda x: jnp.stack([x, x]), state)
    assert not kernels(jax.vmap(run), batch)
