"""Compilation ahead of time."""

import jax
import jax.numpy as jnp
import models
import numpy as np
import pytest

import svkc


def test_the_program_is_the_run():
    """From shapes alone; one compilation, none when it is called."""
    chain = svkc.load(models.MJCF.format(models.bar("arm", models.Y, "0 0 -1")))
    state = chain.state({"arm": 0.5})
    run = lambda state, tau: svkc.step(chain, state, tau, 1e-3)
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), (state, jnp.zeros(1)))
    program = svkc.compile(run, *shapes)
    assert set(program.seconds) == {"lower", "compile"}
    assert min(program.seconds.values()) > 0
    assert program.temporary_bytes >= 0
    assert "compile" in repr(program)
    moved = program(state, jnp.ones(1))
    np.testing.assert_allclose(moved.v, run(state, jnp.ones(1)).v, rtol=1e-14)
    with pytest.raises(TypeError, match="float64"):
        program(state, jnp.zeros(2))
