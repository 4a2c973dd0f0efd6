"""Public functions that are compiled for short compile time when called eagerly: equal results
under every transformation."""

import jax
import jax.numpy as jnp
import models
import numpy as np
import pytest
from tolerances import REFERENCE

import svkc
from svkc._jax import eager

XS = jnp.array([0.1, 0.2])


@pytest.fixture(scope="module")
def linkage():
    """Return a four-bar and a run of one step."""
    chain = models.four_bar()
    traj = svkc.simulate(chain, chain.state(v={"crank": 2.0}), 1e-3, dt=1e-3, throw=False)
    return chain, traj


def all_results(chain, traj, x):
    """Return results of all eagerly compiled functions at a crank angle."""
    state = chain.state({"crank": x}, {"crank": 2.0 + x})
    tau = jnp.zeros(chain.dofs).at[0].set(x)
    co = svkc.coordinates(chain, state)
    again = svkc.connect(chain, svkc.cut(chain, state, "pin"), "pin")
    free = svkc.mobility(chain, again)
    wrench = svkc.loop_forces(
        chain, again, svkc.actuation(chain, again, jnp.where(free.independent, tau, 0)).tau
    )
    report = traj.report()
    return {
        "state": state.v,
        "connect": again.v,
        "coordinates": jnp.sum(co.W, 1),
        "mobility": free.margin,
        "forces": wrench.force,
        "energy": svkc.energy(chain, again),
        "report": report.energy_drift + report.margin,
    }


def assert_close(got, expected):
    for name in expected:
        np.testing.assert_allclose(
            got[name],
            expected[name],
            rtol=REFERENCE,
            atol=REFERENCE * (1 + float(np.abs(expected[name]).max())),
            err_msg=name,
        )


@pytest.fixture(scope="module")
def eagerly(linkage):
    return jax.tree.map(lambda *x: np.stack(x), *[all_results(*linkage, x) for x in XS])


@pytest.mark.slow
def test_results_under_jit_and_scan_equal_eager_ones(linkage, eagerly):
    assert_close(
        jax.jit(lambda xs: jax.lax.map(lambda x: all_results(*linkage, x), xs))(XS), eagerly
    )


@pytest.mark.slow
def test_results_under_vmap_equal_eager_ones(linkage, eagerly):
    assert_close(jax.vmap(lambda x: all_results(*linkage, x))(XS), eagerly)


@pytest.mark.slow
def test_derivatives_of_all_functions(linkage):
    chain, traj = linkage
    one = lambda x: all_results(chain, traj, x)
    x, h = jnp.asarray(0.1), 1e-5
    slopes = jax.tree.map(lambda a, b: np.asarray(a - b) / (2 * h), one(x + h), one(x - h))
    forwards = jax.jacfwd(one)(x)
    for name, slope in slopes.items():
        np.testing.assert_allclose(
            forwards[name], slope, rtol=1e-6, atol=1e-6 * (1 + np.abs(slope).max()), err_msg=name
        )
    weights = {
        name: np.cos(np.arange(np.size(s))).reshape(np.shape(s)) for name, s in slopes.items()
    }
    backwards = jax.grad(lambda x: sum(jnp.sum(v * weights[name]) for name, v in one(x).items()))(x)
    np.testing.assert_allclose(
        backwards,
        sum(np.sum(np.asarray(forwards[name]) * w) for name, w in weights.items()),
        rtol=REFERENCE,
    )


def test_options_unknown_to_jaxlib_are_dropped(monkeypatch):
    monkeypatch.setattr(
        eager,
        "_FAST_COMPILE_OPTIONS",
        {"xla_no_such_option": 1, "xla_backend_optimization_level": 0},
    )
    assert float(eager.eager_jit(lambda x: 2 * x)(jnp.asarray(3.0))) == 6
    assert eager._FAST_COMPILE_OPTIONS == {"xla_backend_optimization_level": 0}


def test_other_errors_are_raised():
    def fails(x):
        raise ValueError("no such compile option as this is meant")

    with pytest.raises(ValueError, match="is meant"):
        eager.eager_jit(fails)(jnp.asarray(3.0))


def test_options_are_passed_at_the_outermost_jit_only():
    # the first eager call of a process drops the options that jaxlib does not know
    eager.eager_jit(lambda x: x)(jnp.asarray(3.0))
    jit_options = []

    def jit(function, **options):
        jit_options.append(options)
        return jax.jit(function, **options)

    double = eager.eager_jit(lambda x: 2 * x, jit)
    assert float(jax.jit(double)(3.0)) == float(jax.jit(lambda: double(3.0))()) == 6
    assert jit_options == [{}]
    assert float(double(3.0)) == 6
    assert jit_options[1:] == [{"compiler_options": eager._FAST_COMPILE_OPTIONS}]


@pytest.mark.slow
@pytest.mark.parametrize("make", [models.sarrus, models.bennett])
def test_the_derivative_of_a_state_closed_from_afar(make):
    """The open loops of an over-constrained linkage have a higher rank than the closed ones;
    derivatives follow the iterates of Newton's method."""
    chain = make()
    rng = np.random.default_rng(0)
    start, along = (
        jnp.asarray(0.04 * rng.normal(size=chain.nv)),
        jnp.asarray(rng.normal(size=chain.nv)),
    )
    tree = lambda dv: svkc.integrate(chain, chain.q_load, jnp.pad(dv, (0, chain.dofs - chain.nv)))[
        : chain.nq
    ]
    closed = lambda x: chain.state(tree(start + x * along)).q
    x, h = jnp.asarray(0.0), 1e-5
    difference = (closed(h) - closed(-h)) / (2 * h)
    assert float(jnp.abs(difference).max()) > 0.01
    for derivative in (jax.jacfwd(closed)(x), jax.jacrev(closed)(x)):
        np.testing.assert_allclose(
            derivative, difference, atol=1e-6 * float(jnp.abs(difference).max())
        )


@pytest.mark.slow
def test_a_state_that_cannot_be_closed_is_an_error_under_a_derivative():
    chain = models.four_bar()
    with pytest.raises(Exception, match="cannot be closed"):
        jax.grad(lambda x: jnp.sum(chain.state({"crank": x, "coupler": 3.0 + x, "rocker": 3.0}).q))(
            0.1
        )
