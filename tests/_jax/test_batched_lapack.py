"""Batched factorisations and solves: equality with single solves, derivatives, no large matrix for
LAPACK, and no deadlock of several calls of one program or of several CPU devices."""

import re
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from tolerances import REFERENCE, ROUND_OFF

from svkc._jax.batched_lapack import (
    batched_solve_triangular,
    cholesky,
    cholesky_solver,
    solve_general,
)


@pytest.mark.parametrize("size", [1, 6])
@pytest.mark.parametrize("lanes", [(), (5,), (3, 4)])
def test_batches_are_their_single_solves(lanes, size):
    rng = np.random.default_rng(0)
    A, x = rng.normal(size=(*lanes, size, size)), rng.normal(size=(*lanes, size))
    A, x = jnp.asarray(A @ np.swapaxes(A, -1, -2) + np.eye(size)), jnp.asarray(x)
    positive = lambda A, x: cholesky_solver(A)(x)
    triangle = lambda trans: lambda A, x: batched_solve_triangular(A, x, trans)
    for _ in lanes:
        positive = jax.vmap(positive)
    np.testing.assert_allclose(
        positive(A, x),
        np.linalg.solve(np.asarray(A), np.asarray(x)[..., None])[..., 0],
        rtol=REFERENCE,
        atol=ROUND_OFF,
    )
    for trans in False, True:
        solve, upper = triangle(trans), np.triu(np.asarray(A))
        for _ in lanes:
            solve = jax.vmap(solve)
        expected = np.linalg.solve(
            np.swapaxes(upper, -1, -2) if trans else upper, np.asarray(x)[..., None]
        )[..., 0]
        np.testing.assert_allclose(solve(A, x), expected, rtol=REFERENCE, atol=ROUND_OFF)


@pytest.mark.slow
def test_derivatives():
    rng = np.random.default_rng(0)
    A, x = jnp.asarray(rng.normal(size=(4, 4))), jnp.asarray(rng.normal(size=(4, 2)))
    factor = lambda B: cholesky(jnp.asarray(B) @ B.T + jnp.eye(4))
    check_grads(factor, (A,), 2, rtol=1e-6)
    solve = lambda A, x: solve_general(jnp.asarray(A), jnp.asarray(x))
    check_grads(solve, (A + 4 * jnp.eye(4), x), 2, rtol=1e-6)
    many = jnp.asarray(np.asarray(A) + np.arange(1, 4)[:, None, None] * np.eye(4))
    np.testing.assert_allclose(
        jax.vmap(solve_general, (0, None))(many, x),
        np.linalg.solve(many, np.broadcast_to(x, (3, 4, 2))),
        rtol=REFERENCE,
        atol=ROUND_OFF,
    )


@pytest.mark.parametrize("columns", [1, 9])
def test_lapack_runs_in_one_thread(columns):
    rng = np.random.default_rng(0)
    A, x = rng.normal(size=(150, 150)), rng.normal(size=(150, columns))
    A = A @ A.T + 150 * np.eye(150)
    run = jax.jit(lambda A, x: cholesky_solver(A)(x)).lower(A, x).compile()
    np.testing.assert_allclose(run(A, x), np.linalg.solve(A, x), rtol=REFERENCE, atol=ROUND_OFF)
    shapes = lambda name: re.findall(rf"f64\[(\d+),(\d+)\][^=]* custom-call.*{name}", run.as_text())
    assert {int(n) for n, _ in shapes("dpotrf")} == {75}
    assert all(int(n) * int(m) <= 1000 for n, m in shapes("dtrsm"))
    assert shapes("dtrsm")


INDEPENDENT_CALLS = """
import jax, jax.numpy as jnp, numpy as np
from svkc._jax.batched_lapack import cholesky_solver, solve_general

rng = np.random.default_rng(0)
A = rng.normal(size=(8, 192, 24, 24)) + 24 * np.eye(24)
x = rng.normal(size=(192, 24))

@jax.jit
def run(A, x):
    parts = [jax.vmap(solve_general)(a, x) for a in A[:4]]
    return parts + [jax.vmap(lambda A, x: cholesky_solver(A)(x))(a @ a.mT, x) for a in A[4:]]

for _ in range(100):
    jax.block_until_ready(run(A, x))
"""


@pytest.mark.slow
def test_independent_calls_do_not_wait_for_each_other():
    subprocess.run([sys.executable, "-c", INDEPENDENT_CALLS], check=True, timeout=120)


TWO_DEVICES = """
import jax, jax.numpy as jnp, numpy as np
jax.config.update("jax_num_cpu_devices", 2)
from jax.sharding import Mesh, PartitionSpec
from svkc._jax.batched_lapack import cholesky_solver

rng = np.random.default_rng(0)
A = rng.normal(size=(2 * 127, 24, 24)).astype(np.float32)
A = A @ A.transpose(0, 2, 1) + 24 * np.eye(24, dtype=np.float32)
x = rng.normal(size=A.shape).astype(np.float32)
one = lambda A, x: jax.lax.fori_loop(0, 300, lambda _, y: x + 0.1 * cholesky_solver(A)(y), x)
spec = PartitionSpec("lanes")
lanes = jax.vmap(one)
on = lambda devices: Mesh(np.array(devices), ("lanes",))
solve = lambda mesh: jax.jit(jax.shard_map(lanes, mesh=mesh, in_specs=spec, out_specs=spec))
both, single = (solve(on(devices))(A, x) for devices in (jax.devices(), jax.devices()[:1]))
np.testing.assert_allclose(both, single, rtol=1e-4, atol=1e-5)
"""


@pytest.mark.slow
def test_devices_of_one_process_do_not_wait_for_each_other():
    subprocess.run([sys.executable, "-c", TWO_DEVICES], check=True, timeout=120)
