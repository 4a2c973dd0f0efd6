"""Inverse dynamics of closed chains: square, redundant and deficient actuation, weights, bounds.

Torques are checked by the round trip through forward dynamics.
"""

import jax
import jax.numpy as jnp
import models
import numpy as np
import pytest
from scipy.optimize import lsq_linear, minimize
from tolerances import DIFFERENCE, REFERENCE, ROUND_OFF

import svkc
from svkc.loops.least_squares import solve_bounded


def mask(chain, *names):
    return np.isin(chain.dof_names, names)


def random_motion(chain, seed=0, q=None):
    rng = np.random.default_rng(seed)
    return chain.state(q, rng.normal(size=chain.nv)), jnp.asarray(rng.normal(size=chain.dofs))


@pytest.fixture(scope="module")
def five_bar():
    chain = models.five_bar()
    state, vdot = random_motion(chain, q={"left_arm": -0.2, "right_arm": 0.3})
    return chain, state, vdot, svkc.coordinates(chain, state)


def acceleration_error(chain, state, vdot, result):
    """Return the largest error of theta_G's accelerations under the torques of the result."""
    independent = svkc.coordinates(chain, state).independent
    return float(
        jnp.abs(
            jnp.where(independent, svkc.forward_dynamics(chain, state, result.tau) - vdot, 0)
        ).max()
    )


@pytest.mark.slow
def test_as_many_motors_as_freedoms(five_bar):
    """Two motors for two freedoms reach the acceleration, without redundancy (paper (22))."""
    chain, state, vdot, co = five_bar
    motors = mask(chain, "left_arm", "right_arm")
    result = svkc.actuation(chain, state, vdot, actuated=motors)
    assert (int(result.rank), int(result.redundancy), int(result.deficiency)) == (2, 0, 0)
    assert acceleration_error(chain, state, vdot, result) < 1e-10 * float(jnp.abs(vdot).max())
    assert not np.any(np.asarray(result.tau)[~motors])
    assert not np.any(result.null_space)
    # theta_G's accelerations alone, in order, give the same torques
    short = svkc.actuation(chain, state, vdot[np.asarray(co.independent)], actuated=motors)
    np.testing.assert_allclose(short.tau, result.tau, rtol=ROUND_OFF)


@pytest.mark.slow
def test_more_motors_than_freedoms(five_bar):
    """Three motors give torques of least norm, compared with numpy's pseudo-inverse.

    Torques in the null space change the wrenches in the loop, but not the motion.
    """
    chain, state, vdot, _ = five_bar
    motors = mask(chain, "left_arm", "right_arm", "left_fore")
    result = svkc.actuation(chain, state, vdot, actuated=motors)
    assert (int(result.rank), int(result.redundancy), int(result.deficiency)) == (2, 1, 0)
    assert acceleration_error(chain, state, vdot, result) < 1e-10 * float(jnp.abs(vdot).max())
    co = svkc.coordinates(chain, state)
    S = np.asarray(co.W)[motors][:, np.asarray(co.independent)]
    target_force = S.T @ np.asarray(result.tau)[motors]
    np.testing.assert_allclose(
        np.asarray(result.tau)[motors], np.linalg.pinv(S.T) @ target_force, rtol=1e-10
    )
    weight = np.where(mask(chain, "left_fore"), 100.0, 1.0)
    weighted = svkc.actuation(chain, state, vdot, weight, actuated=motors)
    root = np.sqrt(weight[motors])
    np.testing.assert_allclose(
        np.asarray(weighted.tau)[motors],
        np.linalg.pinv(S.T / root) @ target_force / root,
        rtol=REFERENCE,
    )
    assert abs(float(weighted.tau[mask(chain, "left_fore")][0])) < abs(
        float(result.tau[mask(chain, "left_fore")][0])
    )
    null = np.asarray(result.null_space)
    assert int(np.any(null, 0).sum()) == 1
    column = null[:, np.any(null, 0)][:, 0]
    before, after = (
        svkc.forward_dynamics(chain, state, result.tau + k * column) for k in (0.0, 7.0)
    )
    np.testing.assert_allclose(before, after, atol=1e-11 * float(jnp.abs(before).max()))
    load = [svkc.loop_forces(chain, state, result.tau + k * column) for k in (0.0, 1.0)]
    column_index = int(np.flatnonzero(np.any(null, 0))[0])
    np.testing.assert_allclose(
        load[1].force - load[0].force, result.null_force[:, :, column_index], atol=REFERENCE
    )
    np.testing.assert_allclose(
        load[1].torque - load[0].torque, result.null_torque[:, :, column_index], atol=REFERENCE
    )
    assert float(jnp.abs(result.null_force).max()) > 1e-3


@pytest.mark.slow
def test_fewer_motors_than_freedoms(five_bar):
    """One motor for two freedoms leaves a residual and one undriven direction."""
    chain, state, vdot, _ = five_bar
    motors = mask(chain, "left_arm")
    result = svkc.actuation(chain, state, vdot, actuated=motors)
    assert (int(result.rank), int(result.redundancy), int(result.deficiency)) == (1, 0, 1)
    assert float(jnp.abs(result.residual).max()) > 1e-2
    undriven = np.asarray(result.undriven)
    assert int(np.any(undriven, 0).sum()) == 1
    direction = undriven[:, np.any(undriven, 0)][:, 0]
    assert np.abs(direction[motors]).max() < ROUND_OFF
    undriven_state = svkc.State(state.q, jnp.asarray(direction), state.structure)
    assert float(jnp.abs(svkc.loop_gap_rates(chain, undriven_state)).max()) < ROUND_OFF
    # an acceleration that the one motor produces is reached without residual
    possible = svkc.forward_dynamics(chain, state, jnp.where(motors, 3.0, 0.0))
    exact = svkc.actuation(chain, state, possible, actuated=motors)
    assert float(jnp.abs(exact.residual).max()) < 1e-10
    np.testing.assert_allclose(exact.tau[motors], 3.0, rtol=REFERENCE)


@pytest.mark.slow
def test_actuated_virtual_joint():
    """A four-bar is driven at its closing hinge (Fig. 6), with springs and dampers in the tree."""
    xml = models.MJCF.format(models.FOUR_BAR).replace('damping="0"', 'damping="0.2" stiffness="3"')
    chain = svkc.load(xml, virtual_links=[models.pin(actuated=True)])
    state, vdot = random_motion(chain)
    assert bool(chain.actuated[-1])
    result = svkc.actuation(chain, state, vdot, actuated=mask(chain, "pin"))
    assert float(jnp.abs(result.tau[:-1]).max()) == 0
    assert acceleration_error(chain, state, vdot, result) < 1e-10 * float(jnp.abs(vdot).max())


@pytest.mark.slow
def test_over_constrained():
    """Three parallel legs have a redundant loop, and six motors for one freedom."""
    chain = models.parallelogram()
    state, vdot = random_motion(chain)
    result = svkc.actuation(chain, state, vdot)
    assert (int(result.rank), int(result.redundancy), int(result.deficiency)) == (
        1,
        chain.nv - 1,
        0,
    )
    assert acceleration_error(chain, state, vdot, result) < 1e-10 * float(jnp.abs(vdot).max())
    assert not svkc.loop_forces(chain, state, result.tau).unique.any()
    # seven self-stresses, wrenches of both pins that need no joint torques
    linear, angular = (np.asarray(x) for x in svkc.loop_jacobian(chain, state))
    force, torque = np.asarray(result.stress_force), np.asarray(result.stress_torque)
    felt = np.einsum("lkd,lkr->dr", linear, force) + np.einsum("lkd,lkr->dr", angular, torque)
    stresses = np.concatenate([force, torque], 1).reshape(12, -1)
    assert np.linalg.matrix_rank(stresses) == int(np.any(stresses, 0).sum()) == 7
    assert np.abs(felt).max() < ROUND_OFF
    assert svkc.loop_forces(chain, chain.state(connected=["pin2"]), result.tau).unique.tolist() == [
        True,
        False,
    ]


@pytest.mark.slow
def test_both_hands_on_the_bar(high_bar):
    """A figure on the bar has 16 motors and 12 freedoms, of which no motor drives the swing."""
    chain, state = high_bar
    state, vdot = random_motion(chain, q=state.q[: chain.nq])
    result = svkc.actuation(chain, state, vdot)
    assert (int(result.rank), int(result.redundancy), int(result.deficiency)) == (11, 5, 1)
    possible = svkc.forward_dynamics(chain, state, jnp.where(chain.actuated, vdot, 0))
    exact = svkc.actuation(chain, state, possible)
    assert float(jnp.abs(exact.residual).max()) < REFERENCE
    assert acceleration_error(chain, state, possible, exact) < 1e-10 * float(
        jnp.abs(possible).max()
    )
    # in the undriven direction no actuated joint moves
    swing = np.asarray(result.undriven)[:, np.any(result.undriven, 0)][:, 0]
    assert np.abs(swing[np.asarray(chain.actuated)]).max() < ROUND_OFF * np.abs(swing).max()


def test_bounds(five_bar):
    """Loose bounds have no effect, tighter ones hold, and too tight ones leave a residual."""
    chain, state, vdot, _ = five_bar
    motors = mask(chain, "left_arm", "right_arm", "left_fore")
    free = svkc.actuation(chain, state, vdot, actuated=motors)
    loose = svkc.actuation(chain, state, vdot, actuated=motors, bounds=(-1e3, 1e3))
    np.testing.assert_allclose(loose.tau, free.tau, atol=REFERENCE)
    worst = int(jnp.argmax(jnp.abs(free.tau)))
    limit = np.full(chain.dofs, 1e3)
    limit[worst] = 0.5 * abs(float(free.tau[worst]))
    tight = svkc.actuation(chain, state, vdot, actuated=motors, bounds=(-limit, limit))
    assert np.all(np.abs(tight.tau) <= limit)
    assert acceleration_error(chain, state, vdot, tight) < 1e-10 * float(jnp.abs(vdot).max())
    assert float(jnp.abs(tight.residual).max()) < 1e-10
    # the norm is the least on the face of the box: other points of the null space are longer
    null = np.asarray(free.null_space)
    step = null[:, np.any(null, 0)][:, 0]
    for k in (-1e-3, 1e-3):
        other = np.asarray(tight.tau) + k * step
        assert np.any(np.abs(other) > limit) or np.sum(other**2) > np.sum(
            np.asarray(tight.tau) ** 2
        )
    unreachable = svkc.actuation(chain, state, 1e3 * vdot, actuated=motors, bounds=(-1.0, 1.0))
    assert float(jnp.abs(unreachable.residual).max()) > 1
    assert float(jnp.abs(unreachable.tau).max()) <= 1


@pytest.mark.slow
def test_open_chain_and_derivative(five_bar):
    """Without loops actuation is inverse dynamics; derivatives agree with finite differences."""
    tree = svkc.load(models.random_tree(4, 3, kinds=("hinge", "ball")))
    state, vdot = random_motion(tree)
    result = svkc.actuation(tree, state, vdot)
    np.testing.assert_allclose(
        result.tau, svkc.inverse_dynamics(tree, state, vdot), rtol=1e-10, atol=ROUND_OFF
    )
    chain, state, vdot, _ = five_bar
    state = svkc.with_independent(chain, state, "left_arm", "right_arm")
    along = svkc.coordinates(chain, state).W @ jnp.where(
        svkc.coordinates(chain, state).independent, 1.0, 0.0
    )

    at = state.structure
    for motors in (
        mask(chain, "left_arm"),
        mask(chain, "left_arm", "right_arm"),
        mask(chain, "left_arm", "right_arm", "left_fore"),
    ):
        f = lambda step, m=motors: (
            svkc.actuation(
                chain,
                svkc.State(svkc.integrate(chain, state.q, step * along), state.v, at),
                vdot,
                actuated=m,
            ).tau
        )
        forward = jax.jacfwd(f)(0.0)
        np.testing.assert_allclose(jax.jacrev(f)(0.0), forward, rtol=REFERENCE, atol=REFERENCE)
        h = 1e-5
        np.testing.assert_allclose(
            forward, (f(h) - f(-h)) / (2 * h), rtol=DIFFERENCE, atol=DIFFERENCE
        )


def bounded_problem(seed, n=12, dtype=np.float64):
    """Return random B, force, cost, lower and upper: of any rank, solvable or not."""
    rng = np.random.default_rng(seed)
    rank = rng.integers(1, n + 1)
    B = rng.normal(size=(n, rank)) @ rng.normal(size=(rank, n))
    B[:, rng.random(n) < 0.1] = 0
    target_force = B @ rng.normal(size=n) if seed % 2 else 5 * rng.normal(size=n)
    lower, upper = -np.abs(rng.normal(size=n)), np.abs(rng.normal(size=n))
    if seed % 3 == 1:
        lower[:] = 0
    if seed % 3 == 2:
        lower, upper = np.sort(rng.normal(size=(2, n)), 0)
    upper = np.where(rng.random(n) < 0.1, lower, upper)
    lower = np.where(rng.random(n) < 0.15, -np.inf, lower)
    upper = np.where(rng.random(n) < 0.15, np.inf, upper)
    cost = 10 ** rng.uniform(-1, 1, size=n)
    return tuple(x.astype(dtype) for x in (B, target_force, cost, lower, upper))


@jax.jit
def bounded_solution(B, target_force, cost, lower, upper):
    return solve_bounded((B, target_force, jnp.ones_like(target_force)), cost, lower, upper)[0]


def scipy_solution(B, target_force, cost, lower, upper):
    """Return the solution by BVLS for the residual, then SLSQP for the cost at this residual."""
    y = np.where(np.any(B != 0, 0), np.clip(0, lower, upper), 0)
    used = np.any(B != 0, 0) & (lower < upper)
    A, box = B[:, used], (lower[used], upper[used])
    y[used] = lsq_linear(
        A, target_force - B @ np.where(used, 0, y), box, method="bvls", tol=1e-15
    ).x
    U, size, _ = np.linalg.svd(A, full_matrices=False)
    A = U[:, size > 1e-9 * size[0]].T @ A
    kept = {"type": "eq", "fun": lambda x: A @ (x - y[used]), "jac": lambda x: A}
    best = minimize(
        lambda x: np.sum(cost[used] * x**2),
        y[used],
        jac=lambda x: 2 * cost[used] * x,
        bounds=list(zip(*box, strict=True)),
        method="SLSQP",
        constraints=[kept],
        options={"ftol": 1e-14, "maxiter": 500},
    )
    if best.success:
        y[used] = best.x
    return y


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 1e-7), (np.float32, 1e-3)])
def test_bounded_against_scipy(dtype, tolerance):
    """Neither residual nor cost are above scipy's, for random active sets."""
    problems = [bounded_problem(seed, dtype=dtype) for seed in range(60)]
    result = np.asarray(
        jax.vmap(bounded_solution)(*map(jnp.asarray, zip(*problems, strict=True))), float
    )
    for seed, y in enumerate(result):
        # compared in float64, as B's rank is not well defined in float32
        B, target_force, cost, lower, upper = bounded_problem(seed)
        has_effect = np.any(B != 0, 0)
        assert np.all(((lower - tolerance <= y) & (y <= upper + tolerance))[has_effect]), seed
        assert not np.any(y[~has_effect])
        other = scipy_solution(B, target_force, cost, lower, upper)
        residual, least = (np.linalg.norm(B @ x - target_force) for x in (y, other))
        scale = np.linalg.norm(target_force) + np.linalg.norm(B) * np.abs(other).max()
        assert residual <= least + tolerance * scale, seed
        if residual > least - tolerance * scale:
            assert np.sum(cost * y**2) <= np.sum(cost * other**2) * (1 + 10 * tolerance), seed
        if dtype == np.float64:
            np.testing.assert_allclose(
                bounded_solution(B, target_force, cost, lower, upper), y, atol=1e-9
            )


@pytest.mark.slow
def test_derivative_of_bounded():
    """Derivatives with respect to every input agree with finite differences, in both modes."""
    for seed in range(6):
        B, *numbers = bounded_problem(seed, n=6)
        directions = [np.random.default_rng(k).normal(size=B.shape) for k in range(4)]
        at = [np.where(np.isfinite(x), x, np.sign(x) * 50) for x in numbers]
        # a direction that keeps the rank of B, its empty columns and equal bounds
        along = [directions[0] @ B, *(w[0] for w in directions[:2]), w3 := directions[3][0], w3]
        f = lambda h, B=B, at=at, along=along: bounded_solution(
            *(x + h * d for x, d in zip((B, *at), along, strict=True))
        )
        forward = jax.jacfwd(f)(0.0)
        np.testing.assert_allclose(jax.jacrev(f)(0.0), forward, rtol=1e-8, atol=1e-8)
        h = 1e-6
        np.testing.assert_allclose(forward, (f(h) - f(-h)) / (2 * h), rtol=1e-5, atol=1e-5)
    B, target_force, cost, _, _ = bounded_problem(1)
    loose = jax.grad(lambda u: jnp.sum(bounded_solution(B, target_force, cost, -u, u)))(
        np.full(12, np.inf)
    )
    assert not np.any(loose)


@pytest.mark.slow
def test_bounds_under_transformations(five_bar):
    """Under jit, vmap and grad each lane has its own active set.

    A lane whose bounds cross, or whose numbers are not finite, gives NaN.
    """
    chain, state, vdot, _ = five_bar
    motors = mask(chain, "left_arm", "right_arm", "left_fore")
    limited = jax.jit(
        jax.vmap(lambda a, u: svkc.actuation(chain, state, a, actuated=motors, bounds=(-u, u)).tau)
    )
    free = svkc.actuation(chain, state, vdot, actuated=motors).tau
    largest = float(jnp.abs(free).max())
    limits = largest * jnp.array([2.0, 0.9, 0.5, 0.1, -1.0, 1.0])
    tau = limited(jnp.stack([vdot] * 5 + [jnp.nan * vdot]), limits)
    np.testing.assert_allclose(tau[0], free, atol=1e-9)
    assert np.isnan(tau[4:]).all()
    for k in (1, 2, 3):
        alone = svkc.actuation(
            chain, state, vdot, actuated=motors, bounds=(-limits[k], np.full(5, limits[k]))
        )
        np.testing.assert_allclose(tau[k], alone.tau, atol=1e-9)
    at_bound = np.sum(np.isclose(np.abs(tau[:4]), limits[:4, None], rtol=1e-12), 1)
    assert at_bound[0] == 0 < at_bound[1] < at_bound[3] == 3
    tight = lambda s: jnp.sum(
        jnp.sin(
            svkc.actuation(
                chain, state, s * vdot, actuated=motors, bounds=(-limits[1], limits[1])
            ).tau
        )
    )
    svkc.check_grad(tight, jnp.asarray(0.99))
