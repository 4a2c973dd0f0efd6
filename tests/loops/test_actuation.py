"""Inverse dynamics of closed chains: square, redundant and missing actuation; weights, bounds; the
round trip through forward dynamics."""

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


def moving(chain, seed=0, q=None):
    rng = np.random.default_rng(seed)
    return chain.state(q, rng.normal(size=chain.nv)), jnp.asarray(rng.normal(size=chain.dofs))


@pytest.fixture(scope="module")
def five_bar():
    chain = models.five_bar()
    state, vdot = moving(chain, q={"left_arm": -0.2, "right_arm": 0.3})
    return chain, state, vdot, svkc.coordinates(chain, state)


def reached(chain, state, vdot, found):
    """Largest difference of theta_G's accelerations from those asked for, under the torques
    found."""
    independent = svkc.coordinates(chain, state).independent
    return float(
        jnp.abs(
            jnp.where(independent, svkc.forward_dynamics(chain, state, found.tau) - vdot, 0)
        ).max()
    )


def test_square(five_bar):
    """Two motors for two freedoms: (22), nothing left over."""
    chain, state, vdot, co = five_bar
    motors = mask(chain, "left_arm", "right_arm")
    found = svkc.actuation(chain, state, vdot, actuated=motors)
    assert (int(found.rank), int(found.redundancy), int(found.deficiency)) == (2, 0, 0)
    assert reached(chain, state, vdot, found) < 1e-10 * float(jnp.abs(vdot).max())
    assert not np.any(np.asarray(found.tau)[~motors])
    assert not np.any(found.null_space)
    # theta_G's accelerations alone, in order, say the same
    short = svkc.actuation(chain, state, vdot[np.asarray(co.independent)], actuated=motors)
    np.testing.assert_allclose(short.tau, found.tau, rtol=ROUND_OFF)


def test_redundant(five_bar):
    """Three motors: least norm and least weighted norm by numpy's pseudo-inverse; the null space
    changes the loop's load and no motion."""
    chain, state, vdot, _ = five_bar
    motors = mask(chain, "left_arm", "right_arm", "left_fore")
    found = svkc.actuation(chain, state, vdot, actuated=motors)
    assert (int(found.rank), int(found.redundancy), int(found.deficiency)) == (2, 1, 0)
    assert reached(chain, state, vdot, found) < 1e-10 * float(jnp.abs(vdot).max())
    co = svkc.coordinates(chain, state)
    S = np.asarray(co.W)[motors][:, np.asarray(co.independent)]
    wanted = S.T @ np.asarray(found.tau)[motors]
    np.testing.assert_allclose(
        np.asarray(found.tau)[motors], np.linalg.pinv(S.T) @ wanted, rtol=1e-10
    )
    weight = np.where(mask(chain, "left_fore"), 100.0, 1.0)
    weighted = svkc.actuation(chain, state, vdot, weight, actuated=motors)
    root = np.sqrt(weight[motors])
    np.testing.assert_allclose(
        np.asarray(weighted.tau)[motors], np.linalg.pinv(S.T / root) @ wanted / root, rtol=REFERENCE
    )
    assert abs(float(weighted.tau[mask(chain, "left_fore")][0])) < abs(
        float(found.tau[mask(chain, "left_fore")][0])
    )
    null = np.asarray(found.null_space)
    assert int(np.any(null, 0).sum()) == 1
    column = null[:, np.any(null, 0)][:, 0]
    before, after = (
        svkc.forward_dynamics(chain, state, found.tau + k * column) for k in (0.0, 7.0)
    )
    np.testing.assert_allclose(before, after, atol=1e-11 * float(jnp.abs(before).max()))
    load = [svkc.loop_forces(chain, state, found.tau + k * column) for k in (0.0, 1.0)]
    which = int(np.flatnonzero(np.any(null, 0))[0])
    np.testing.assert_allclose(
        load[1].force - load[0].force, found.null_force[:, :, which], atol=REFERENCE
    )
    np.testing.assert_allclose(
        load[1].torque - load[0].torque, found.null_torque[:, :, which], atol=REFERENCE
    )
    assert float(jnp.abs(found.null_force).max()) > 1e-3


def test_missing(five_bar):
    """One motor for two freedoms: the residual is said, and the direction that nobody drives is a
    motion without work."""
    chain, state, vdot, _ = five_bar
    motors = mask(chain, "left_arm")
    found = svkc.actuation(chain, state, vdot, actuated=motors)
    assert (int(found.rank), int(found.redundancy), int(found.deficiency)) == (1, 0, 1)
    assert float(jnp.abs(found.residual).max()) > 1e-2
    undriven = np.asarray(found.undriven)
    assert int(np.any(undriven, 0).sum()) == 1
    direction = undriven[:, np.any(undriven, 0)][:, 0]
    assert np.abs(direction[motors]).max() < ROUND_OFF
    there = svkc.State(state.q, jnp.asarray(direction), state.structure)
    assert float(jnp.abs(svkc.loop_gap_rates(chain, there)).max()) < ROUND_OFF
    # what can be reached is: with an acceleration that the one motor makes, nothing is left
    possible = svkc.forward_dynamics(chain, state, jnp.where(motors, 3.0, 0.0))
    exact = svkc.actuation(chain, state, possible, actuated=motors)
    assert float(jnp.abs(exact.residual).max()) < 1e-10
    np.testing.assert_allclose(exact.tau[motors], 3.0, rtol=REFERENCE)


@pytest.mark.slow
def test_actuated_virtual_joint():
    """A four-bar driven at its closing hinge (Fig. 6), with a spring and damper in the tree."""
    xml = models.MJCF.format(models.FOUR_BAR).replace('damping="0"', 'damping="0.2" stiffness="3"')
    chain = svkc.load(xml, virtual_links=[models.pin(actuated=True)])
    state, vdot = moving(chain)
    assert bool(chain.actuated[-1])
    found = svkc.actuation(chain, state, vdot, actuated=mask(chain, "pin"))
    assert float(jnp.abs(found.tau[:-1]).max()) == 0
    assert reached(chain, state, vdot, found) < 1e-10 * float(jnp.abs(vdot).max())


@pytest.mark.slow
def test_over_constrained():
    """Three parallel legs: a redundant loop, six motors for one freedom."""
    chain = models.parallelogram()
    state, vdot = moving(chain)
    found = svkc.actuation(chain, state, vdot)
    assert (int(found.rank), int(found.redundancy), int(found.deficiency)) == (1, chain.nv - 1, 0)
    assert reached(chain, state, vdot, found) < 1e-10 * float(jnp.abs(vdot).max())
    assert not svkc.loop_forces(chain, state, found.tau).unique.any()
    # seven self-stresses: wrenches of both pins that no joint feels
    linear, angular = (np.asarray(x) for x in svkc.loop_jacobian(chain, state))
    force, torque = np.asarray(found.stress_force), np.asarray(found.stress_torque)
    felt = np.einsum("lkd,lkr->dr", linear, force) + np.einsum("lkd,lkr->dr", angular, torque)
    stresses = np.concatenate([force, torque], 1).reshape(12, -1)
    assert np.linalg.matrix_rank(stresses) == int(np.any(stresses, 0).sum()) == 7
    assert np.abs(felt).max() < ROUND_OFF
    assert svkc.loop_forces(chain, chain.state(connected=["pin2"]), found.tau).unique.tolist() == [
        True,
        False,
    ]


@pytest.mark.slow
def test_both_hands_on_the_bar(high_bar):
    """16 motors, 12 freedoms, of which the swing about the bar is nobody's: reached by the others,
    over-actuated by five."""
    chain, state = high_bar
    state, vdot = moving(chain, q=state.q[: chain.nq])
    found = svkc.actuation(chain, state, vdot)
    assert (int(found.rank), int(found.redundancy), int(found.deficiency)) == (11, 5, 1)
    possible = svkc.forward_dynamics(chain, state, jnp.where(chain.actuated, vdot, 0))
    exact = svkc.actuation(chain, state, possible)
    assert float(jnp.abs(exact.residual).max()) < REFERENCE
    assert reached(chain, state, possible, exact) < 1e-10 * float(jnp.abs(possible).max())
    # the swing, every joint held: no actuator works on it
    swing = np.asarray(found.undriven)[:, np.any(found.undriven, 0)][:, 0]
    assert np.abs(swing[np.asarray(chain.actuated)]).max() < ROUND_OFF * np.abs(swing).max()


def test_bounds(five_bar):
    """Loose bounds change nothing; tighter ones are kept, and the acceleration with them; too tight
    ones say what is missing."""
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
    assert reached(chain, state, vdot, tight) < 1e-10 * float(jnp.abs(vdot).max())
    assert float(jnp.abs(tight.residual).max()) < 1e-10
    # the least norm on the face of the box: another point of the same line is longer
    null = np.asarray(free.null_space)
    step = null[:, np.any(null, 0)][:, 0]
    for k in (-1e-3, 1e-3):
        other = np.asarray(tight.tau) + k * step
        assert np.any(np.abs(other) > limit) or np.sum(other**2) > np.sum(
            np.asarray(tight.tau) ** 2
        )
    never = svkc.actuation(chain, state, 1e3 * vdot, actuated=motors, bounds=(-1.0, 1.0))
    assert float(jnp.abs(never.residual).max()) > 1
    assert float(jnp.abs(never.tau).max()) <= 1


@pytest.mark.slow
def test_open_chain_and_derivative(five_bar):
    """Without loops actuation is inverse dynamics; the torques' derivative by q against
    differences, in both modes."""
    tree = svkc.load(models.random_tree(4, 3, kinds=("hinge", "ball")))
    state, vdot = moving(tree)
    found = svkc.actuation(tree, state, vdot)
    np.testing.assert_allclose(
        found.tau, svkc.inverse_dynamics(tree, state, vdot), rtol=1e-10, atol=ROUND_OFF
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
    """B, wanted, cost and box at random: redundant or deficient, exact or out of reach."""
    rng = np.random.default_rng(seed)
    rank = rng.integers(1, n + 1)
    B = rng.normal(size=(n, rank)) @ rng.normal(size=(rank, n))
    B[:, rng.random(n) < 0.1] = 0
    wanted = B @ rng.normal(size=n) if seed % 2 else 5 * rng.normal(size=n)
    lower, upper = -np.abs(rng.normal(size=n)), np.abs(rng.normal(size=n))
    if seed % 3 == 1:
        lower[:] = 0
    if seed % 3 == 2:
        lower, upper = np.sort(rng.normal(size=(2, n)), 0)
    upper = np.where(rng.random(n) < 0.1, lower, upper)
    lower = np.where(rng.random(n) < 0.15, -np.inf, lower)
    upper = np.where(rng.random(n) < 0.15, np.inf, upper)
    cost = 10 ** rng.uniform(-1, 1, size=n)
    return tuple(x.astype(dtype) for x in (B, wanted, cost, lower, upper))


@jax.jit
def within(B, wanted, cost, lower, upper):
    return solve_bounded((B, wanted, jnp.ones_like(wanted)), cost, lower, upper)[0]


def by_scipy(B, wanted, cost, lower, upper):
    """The least residual by BVLS, then the least cost by SLSQP with what is reached held."""
    y = np.where(np.any(B != 0, 0), np.clip(0, lower, upper), 0)
    used = np.any(B != 0, 0) & (lower < upper)
    A, box = B[:, used], (lower[used], upper[used])
    y[used] = lsq_linear(A, wanted - B @ np.where(used, 0, y), box, method="bvls", tol=1e-15).x
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
    """No residual and, at the same residual, no cost above scipy's, whatever the active set."""
    problems = [bounded_problem(seed, dtype=dtype) for seed in range(60)]
    found = np.asarray(jax.vmap(within)(*map(jnp.asarray, zip(*problems, strict=True))), float)
    for seed, y in enumerate(found):
        # as it is in float64, for in float32 the rank of B is not to be seen
        B, wanted, cost, lower, upper = bounded_problem(seed)
        drives = np.any(B != 0, 0)
        assert np.all(((lower - tolerance <= y) & (y <= upper + tolerance))[drives]), seed
        assert not np.any(y[~drives])
        other = by_scipy(B, wanted, cost, lower, upper)
        residual, least = (np.linalg.norm(B @ x - wanted) for x in (y, other))
        scale = np.linalg.norm(wanted) + np.linalg.norm(B) * np.abs(other).max()
        assert residual <= least + tolerance * scale, seed
        if residual > least - tolerance * scale:
            assert np.sum(cost * y**2) <= np.sum(cost * other**2) * (1 + 10 * tolerance), seed
        if dtype == np.float64:
            np.testing.assert_allclose(within(B, wanted, cost, lower, upper), y, atol=1e-9)


@pytest.mark.slow
def test_derivative_of_bounded():
    """By the matrix, what is wanted, the cost and the bounds, both modes against differences."""
    for seed in range(6):
        B, *given = bounded_problem(seed, n=6)
        ways = [np.random.default_rng(k).normal(size=B.shape) for k in range(4)]
        at = [np.where(np.isfinite(x), x, np.sign(x) * 50) for x in given]
        # the rank of B, its empty columns and equal bounds stay as they are
        along = [ways[0] @ B, *(w[0] for w in ways[:2]), w3 := ways[3][0], w3]
        f = lambda h, B=B, at=at, along=along: within(
            *(x + h * d for x, d in zip((B, *at), along, strict=True))
        )
        forward = jax.jacfwd(f)(0.0)
        np.testing.assert_allclose(jax.jacrev(f)(0.0), forward, rtol=1e-8, atol=1e-8)
        h = 1e-6
        np.testing.assert_allclose(forward, (f(h) - f(-h)) / (2 * h), rtol=1e-5, atol=1e-5)
    B, wanted, cost, _, _ = bounded_problem(1)
    loose = jax.grad(lambda u: jnp.sum(within(B, wanted, cost, -u, u)))(np.full(12, np.inf))
    assert not np.any(loose)


def test_bounds_under_transformations(five_bar):
    """Under jit, vmap and grad: another active set in each lane, NaN where a lane's bounds cross or
    its numbers are not finite."""
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
