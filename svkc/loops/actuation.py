"""Which actuator torques give an acceleration, in any structure (paper, section III-A): S^T tau_A =
W^T tau_O, square, redundant or missing."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from svkc._jax.eager import eager_jit
from svkc._jax.pytrees import concrete
from svkc.loops.constraint import loop_kinematics, scales
from svkc.loops.coordinates import constrained, open_coordinates
from svkc.loops.forward_dynamics import constraint_forces
from svkc.loops.pivoting import Selection, select, select_with_rank
from svkc.model.chain import Chain, State
from svkc.model.checked_jit import check_state
from svkc.model.validation import arrayed, numbers
from svkc.tree.inverse_dynamics import generalized_forces, over_all_dofs, passive_forces
from svkc.tree.kinematics import kinematics, twists


class Actuation(eqx.Module):
    """Torques of the actuators for an acceleration, and what is left open or out of reach. Columns
    of the bases that do not count are zero.

    `tau` [dofs]: the particular solution (N m, N), of least weighted norm; `residual` [dofs]:
    generalized force on theta_G that no torque gives (zero:
    the acceleration is reached); `rank`: of S; `redundancy`: actuators more than that,
    `deficiency`: freedoms that nobody drives.
    `null_space` [dofs, dofs]: torques that change no motion (they only load the loops), one for
    each actuator that the others can stand in for; `null_force`, `null_torque`: what each of them
    does to the links' wrenches, on `real` from `parent`, world axes;
    `stress_force`, `stress_torque`: self-stresses, wrenches of redundant loops together that need
    no torque, one for each redundant row;
    `undriven` [dofs, dofs]: joint velocities on which no actuator does work.
    """

    tau: Float[Array, " dofs"]
    residual: Float[Array, " dofs"]
    null_space: Float[Array, "dofs dofs"]
    null_force: Float[Array, "links 3 dofs"]
    null_torque: Float[Array, "links 3 dofs"]
    stress_force: Float[Array, "links 3 rows"]
    stress_torque: Float[Array, "links 3 rows"]
    undriven: Float[Array, "dofs dofs"]
    rank: Int[Array, ""]
    redundancy: Int[Array, ""]
    deficiency: Int[Array, ""]


def actuation(
    chain: Chain, state: State, vdot_G, weight=None, *, actuated=None, bounds=None
) -> Actuation:
    """Inverse dynamics of any structure (paper, section III-A): the torques at `actuated` for the
    accelerations vdot_G of theta_G.

    vdot_G: over every coordinate [dofs], of which those of theta_G (`coordinates(chain,
    state).independent`) are read, or theta_G's alone, in order.
    weight [dofs]: positive; what is least is sum(weight tau^2), by default the plain sum. actuated:
    mask, by default `chain.actuated`.
    bounds: (lower, upper) torques, scalars or [dofs]: the least within them, by scipy's SLSQP on
    the host (not under jit); where they leave no exact solution, the one of least residual. Springs
    and dampers are counted. ValueError: wrong sizes, weights that are not positive, crossed bounds.
    """
    check_state(chain, state)
    independent, vdot_G = None, numbers("vdot_G", vdot_G, state.v.dtype)
    if vdot_G.shape != (chain.dofs,):
        independent = (
            np.asarray(_coordinates(chain, state)[0].independent)
            if not isinstance(state.q, jax.core.Tracer)
            else None
        )
        if independent is None or vdot_G.shape != (independent.sum(),):
            count = (
                "the number of independent ones" if independent is None else int(independent.sum())
            )
            raise ValueError(
                f"vdot_G: got shape {vdot_G.shape}, expected ({chain.dofs},), every joint"
                f" coordinate, or ({count},), theta_G"
            )
        vdot_G = jnp.zeros(chain.dofs, vdot_G.dtype).at[np.flatnonzero(independent)].set(vdot_G)
    weight = _per_dof(chain, "weight", weight, 1.0, state)
    if concrete(weight) and not np.all((np.asarray(weight) > 0) & np.isfinite(np.asarray(weight))):
        raise ValueError(f"weight: expected positive numbers, got {np.asarray(weight)}")
    actuated = chain.actuated if actuated is None else arrayed(actuated)
    if actuated.shape != (chain.dofs,) or actuated.dtype != bool:
        raise ValueError(
            f"actuated: expected {chain.dofs} Booleans, got {actuated.dtype} of shape"
            f" {actuated.shape}"
        )
    actuated = jnp.asarray(actuated)
    done, problem = _solve(chain, state, vdot_G, weight, actuated)
    return done if bounds is None else _within(chain, state, done, problem, weight, bounds)


def _per_dof(chain: Chain, name: str, value, default, state: State) -> Float[Array, " dofs"]:
    value = numbers(name, default if value is None else value, state.v.dtype)
    if value.shape not in ((), (chain.dofs,)):
        raise ValueError(f"{name}: got shape {value.shape}, expected a number or ({chain.dofs},)")
    return jnp.broadcast_to(value, (chain.dofs,))


@eager_jit
def _coordinates(chain: Chain, state: State):
    if not chain.link_names:
        kin = kinematics(chain, state.q)
        return open_coordinates(chain, state.structure), kin, twists(chain, kin, state.v)
    loops = loop_kinematics(chain, state.structure, state.q)
    V = twists(chain, loops.kin, state.v)
    return constrained(chain, state.structure, state.v, loops, V), loops.kin, V


def _basis(
    B: Float[Array, "rows dofs"], rank=None
) -> tuple[Selection, Int[Array, ""], Float[Array, "dofs dofs"]]:
    """Pivots of B, its rank (None: to be found), and a basis of its null space: for each column
    that is no pivot a one there, balanced by the pivots."""
    chosen, rank = select_with_rank(B) if rank is None else (select(B, rank), rank)
    P = chosen.P
    Bm = chosen.Q @ B
    R = Bm @ P.T + jnp.diag(jnp.where(chosen.used, 0, 1).astype(B.dtype))
    others = jnp.eye(B.shape[1], dtype=B.dtype) - P.T @ jnp.linalg.solve(R, Bm)
    return chosen, rank, jnp.where(jnp.any(P > 0, 0)[None], 0, others)


def _reach(chosen: Selection, B, wanted, cost):
    """The y of least sum(cost y^2) that makes |B y - wanted| least, by an orthonormal basis Z of
    B's range."""
    Z = chosen.Q.T
    ZB = Z.T @ B
    over_cost = ZB.T / cost[:, None]
    G = ZB @ over_cost + jnp.diag(jnp.where(chosen.used, 0, 1).astype(B.dtype))
    y = over_cost @ jnp.linalg.solve(G, Z.T @ wanted)
    # once more for what round-off left
    return y + over_cost @ jnp.linalg.solve(G, Z.T @ (wanted - B @ y))


@eager_jit
def _solve(chain: Chain, state: State, vdot_G, weight, actuated: Bool[Array, " dofs"]):
    nv = chain.nv
    co, kin, V = _coordinates(chain, state)
    _, column = scales(chain)
    vdot = co.W @ jnp.where(co.independent, vdot_G, 0) + co.bias
    forces = over_all_dofs(
        chain, generalized_forces(chain, kin, V, state.v, vdot[:nv])
    ) - passive_forces(chain, state.q, state.v)
    wanted = co.W.T @ forces
    # without units: torques over metres, as the columns of J_C
    S = jnp.where(actuated[:, None], co.W, 0)
    B = column[:, None] * S.T / column[None]
    # the null spaces of S^T and S, which are of one size, by one program
    both, ranks, bases = jax.lax.map(_basis, jnp.stack([B, B.T]))
    chosen, rank, null = jax.tree.map(lambda x: x[0], (both, ranks, bases))
    y = _reach(chosen, B, column * wanted, weight / column**2)
    null = column[:, None] ** -1 * jnp.where(actuated[None], null, 0)
    reachable = actuated & jnp.any(co.W != 0, 1)
    undriven = co.W @ (column[:, None] * jnp.where(co.independent[None], bases[1], 0))
    if len(chain.link_names):
        carried = jax.vmap(
            lambda tau: constraint_forces(chain, co.selection, co.J, tau), in_axes=1, out_axes=-1
        )(null)
        _, _, stress = _basis(co.J.T, state.structure.rank)
        row, _ = scales(chain)
        holds = jnp.repeat(state.structure.connected, 6)
        stress = jnp.where(holds[None], row[:, None] * stress, 0).reshape(-1, 6, row.shape[0])
    else:
        carried, stress = jnp.zeros((0, 6, chain.dofs), y.dtype), jnp.zeros((0, 6, 0), y.dtype)
    count = lambda mask: jnp.sum(mask, dtype=jnp.int32)
    tau = y / column
    residual = wanted - S.T @ tau
    done = Actuation(
        tau, residual, null, carried[:, 3:], carried[:, :3], stress[:, 3:], stress[:, :3],
        undriven, rank, count(reachable) - rank, count(co.independent) - rank,
    )  # fmt: skip
    return done, (B, column * wanted, column)


def _within(chain: Chain, state: State, done: Actuation, problem, weight, bounds) -> Actuation:
    """The least weighted torques within the bounds that give what is wanted, or come nearest to
    it."""
    if isinstance(done.tau, jax.core.Tracer):
        raise ValueError(
            "bounds: the bounded problem is solved on the host; call actuation with bounds outside"
            " of jit, vmap and grad"
        )
    if not isinstance(bounds, tuple | list | np.ndarray | jax.Array) or len(bounds) != 2:
        raise ValueError(f"bounds: expected (lower, upper), got {bounds!r}")
    lower, upper = (np.asarray(_per_dof(chain, "bounds", b, 0.0, state), float) for b in bounds)
    if not np.all(lower <= upper):
        raise ValueError(f"bounds: expected lower at or below upper, got {lower} and {upper}")
    B, wanted, column = (np.asarray(x, float) for x in problem)
    drives, lower, upper = np.any(B != 0, 0), lower * column, upper * column
    y = np.where(drives, np.clip(0, lower, upper), 0.0)
    used = drives & (upper > lower)
    if not (np.isfinite(B).all() and np.isfinite(wanted).all()):
        y[:] = np.nan
    elif used.any():
        cost = (np.asarray(weight, float) / column**2)[used]
        y[used] = _least_within(
            B[:, used], wanted - B[:, ~used] @ y[~used], cost, (lower[used], upper[used])
        )
    tau = jnp.asarray(y / column, done.tau.dtype)
    residual = jnp.asarray((wanted - B @ y) / column, done.tau.dtype)
    return eqx.tree_at(lambda d: (d.tau, d.residual), done, (tau, residual))


def _least_within(A, b, cost, box):
    """The x in the box of least sum(cost x^2) among those that make |A x - b| least."""
    from scipy.optimize import lsq_linear, minimize

    nearest = lsq_linear(A, b, box, method="bvls", tol=1e-15).x
    # independent rows of what is to be kept
    U, size, _ = np.linalg.svd(A, full_matrices=False)
    A = U[:, size > 1e-9 * size[0]].T @ A
    kept, scale = A @ nearest, max(1.0, np.abs(nearest).max())
    kept_by = {"type": "eq", "fun": lambda x: (A @ x - kept) / scale, "jac": lambda x: A / scale}
    best = minimize(
        lambda x: np.sum(cost * (x / scale) ** 2),
        nearest,
        jac=lambda x: 2 * cost * x / scale**2,
        bounds=list(zip(*box, strict=True)),
        method="SLSQP",
        constraints=[kept_by],
        options={"ftol": 1e-14, "maxiter": 500},
    )
    return _polished(A, kept, cost, box, best.x if best.success else nearest)


def _polished(A, b, cost, box, x):
    """The same point to round-off: what is at a bound stays there, the others are the least that
    give b."""
    lower, upper = box
    x = np.clip(x, lower, upper)
    width = 1e-7 * np.maximum(1, np.abs(x))
    free = (x > lower + width) & (x < upper - width)
    if not free.any():
        return x
    rest = b - A[:, ~free] @ x[~free]
    half = A[:, free] / np.sqrt(cost[free])
    y = np.linalg.lstsq(half, rest, rcond=1e-10)[0] / np.sqrt(cost[free])
    inside = np.all((y >= lower[free]) & (y <= upper[free])) and np.abs(
        A[:, free] @ y - rest
    ).max() <= 1e-9 * max(1.0, np.abs(b).max())
    if inside:
        x[free] = y
    return x
