"""Which actuator torques give an acceleration, in any structure (paper, section III-A): S^T tau_A =
W^T tau_O, square, redundant or missing."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from svkc._jax.eager import eager_jit
from svkc._jax.pytrees import is_concrete, stop_gradient_tree
from svkc.loops.constraint import jacobian_scales, loop_kinematics
from svkc.loops.coordinates import closed_coordinates, open_coordinates
from svkc.loops.forward_dynamics import constraint_forces
from svkc.loops.pivoting import PivotedQR, pivoted_qr, pivoted_qr_with_rank, solve_positive
from svkc.model.chain import Chain, State
from svkc.model.checked_jit import check_state
from svkc.model.validation import as_array, real_array
from svkc.tree.inverse_dynamics import append_virtual_joints, passive_forces, rnea
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
    bounds: (lower, upper) torques, scalars or [dofs]: the least within them; where they leave no
    exact solution, the one of least residual. Crossed bounds that are traced give NaN. Springs and
    dampers are counted. ValueError: wrong sizes, weights that are not positive, crossed bounds.
    """
    check_state(chain, state)
    independent, vdot_G = None, real_array("vdot_G", vdot_G, state.v.dtype)
    if vdot_G.shape != (chain.dofs,):
        independent = (
            np.asarray(_coordinates_and_twists(chain, state)[0].independent)
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
    if is_concrete(weight) and not np.all(
        (np.asarray(weight) > 0) & np.isfinite(np.asarray(weight))
    ):
        raise ValueError(f"weight: expected positive numbers, got {np.asarray(weight)}")
    actuated = chain.actuated if actuated is None else as_array(actuated)
    if actuated.shape != (chain.dofs,) or actuated.dtype != bool:
        raise ValueError(
            f"actuated: expected {chain.dofs} Booleans, got {actuated.dtype} of shape"
            f" {actuated.shape}"
        )
    actuated = jnp.asarray(actuated)
    done, problem = _solve_unbounded(chain, state, vdot_G, weight, actuated)
    if bounds is None:
        return done
    tau, residual = _solve_bounded(problem, weight, *_limits(chain, bounds, state))
    return eqx.tree_at(lambda d: (d.tau, d.residual), done, (tau, residual))


def _per_dof(chain: Chain, name: str, value, default, state: State) -> Float[Array, " dofs"]:
    value = real_array(name, default if value is None else value, state.v.dtype)
    if value.shape not in ((), (chain.dofs,)):
        raise ValueError(f"{name}: got shape {value.shape}, expected a number or ({chain.dofs},)")
    return jnp.broadcast_to(value, (chain.dofs,))


def _limits(chain: Chain, bounds, state: State) -> list[Float[Array, " dofs"]]:
    """Return the lower and the upper bounds; ValueError where they are not two, or cross."""
    if not isinstance(bounds, tuple | list | np.ndarray | jax.Array) or len(bounds) != 2:
        raise ValueError(f"bounds: expected (lower, upper), got {bounds!r}")
    limits = [_per_dof(chain, "bounds", b, 0.0, state) for b in bounds]
    if is_concrete(limits) and not np.all(np.asarray(limits[0]) <= np.asarray(limits[1])):
        lower, upper = np.asarray(limits)
        raise ValueError(f"bounds: expected lower at or below upper, got {lower} and {upper}")
    return limits


@eager_jit
def _coordinates_and_twists(chain: Chain, state: State):
    if not chain.link_names:
        kin = kinematics(chain, state.q)
        return open_coordinates(chain, state.structure), kin, twists(chain, kin, state.v)
    loops = loop_kinematics(chain, state.structure, state.q)
    V = twists(chain, loops.kin, state.v)
    return closed_coordinates(chain, state.structure, state.v, loops, V), loops.kin, V


def _null_space_basis(
    B: Float[Array, "rows dofs"], rank=None
) -> tuple[PivotedQR, Int[Array, ""], Float[Array, "dofs dofs"]]:
    """Pivots of B, its rank (None: to be found), and a basis of its null space: for each column
    that is no pivot a one there, balanced by the pivots."""
    chosen, rank = pivoted_qr_with_rank(B) if rank is None else (pivoted_qr(B, rank), rank)
    P = chosen.P
    Bm = chosen.Q @ B
    R = Bm @ P.T + jnp.diag(jnp.where(chosen.active, 0, 1).astype(B.dtype))
    others = jnp.eye(B.shape[1], dtype=B.dtype) - P.T @ jnp.linalg.solve(R, Bm)
    return chosen, rank, jnp.where(jnp.any(P > 0, 0)[None], 0, others)


def _least_cost_solution(chosen: PivotedQR, B, wanted, cost):
    """The y of least sum(cost y^2) that makes |B y - wanted| least, by an orthonormal basis Z of
    B's range."""
    Z = chosen.Q.T
    ZB = Z.T @ B
    over_cost = ZB.T / cost[:, None]
    G = ZB @ over_cost + jnp.diag(jnp.where(chosen.active, 0, 1).astype(B.dtype))
    y = over_cost @ jnp.linalg.solve(G, Z.T @ wanted)
    # once more for what round-off left
    return y + over_cost @ jnp.linalg.solve(G, Z.T @ (wanted - B @ y))


@eager_jit
def _solve_unbounded(chain: Chain, state: State, vdot_G, weight, actuated: Bool[Array, " dofs"]):
    nv = chain.nv
    co, kin, V = _coordinates_and_twists(chain, state)
    _, column = jacobian_scales(chain)
    vdot = co.W @ jnp.where(co.independent, vdot_G, 0) + co.bias
    forces = append_virtual_joints(chain, rnea(chain, kin, V, state.v, vdot[:nv])) - passive_forces(
        chain, state.q, state.v
    )
    wanted = co.W.T @ forces
    # without units: torques over metres, as the columns of J_C
    S = jnp.where(actuated[:, None], co.W, 0)
    B = column[:, None] * S.T / column[None]
    # the null spaces of S^T and S, which are of one size, by one program
    both, ranks, bases = jax.lax.map(_null_space_basis, jnp.stack([B, B.T]))
    chosen, rank, null = jax.tree.map(lambda x: x[0], (both, ranks, bases))
    y = _least_cost_solution(chosen, B, column * wanted, weight / column**2)
    null = column[:, None] ** -1 * jnp.where(actuated[None], null, 0)
    reachable = actuated & jnp.any(co.W != 0, 1)
    undriven = co.W @ (column[:, None] * jnp.where(co.independent[None], bases[1], 0))
    if len(chain.link_names):
        carried = jax.vmap(
            lambda tau: constraint_forces(chain, co.selection, co.J, tau), in_axes=1, out_axes=-1
        )(null)
        _, _, stress = _null_space_basis(co.J.T, state.structure.rank)
        row, _ = jacobian_scales(chain)
        holds = jnp.repeat(state.structure.connected, 6)
        stress = jnp.where(holds[None], row[:, None] * stress, 0).reshape(-1, 6, row.shape[0])
    else:
        carried, stress = jnp.zeros((0, 6, chain.dofs), y.dtype), jnp.zeros((0, 6, 0), y.dtype)
    count = lambda mask: jnp.sum(mask, dtype=jnp.int32)
    tau = y / column
    residual = wanted - S.T @ tau
    done = Actuation(
        tau=tau,
        residual=residual,
        null_space=null,
        null_force=carried[:, 3:],
        null_torque=carried[:, :3],
        stress_force=stress[:, 3:],
        stress_torque=stress[:, :3],
        undriven=undriven,
        rank=rank,
        redundancy=count(reachable) - rank,
        deficiency=count(co.independent) - rank,
    )
    return done, (B, column * wanted, column)


@eager_jit
def _solve_bounded(
    problem, weight, lower, upper
) -> tuple[Float[Array, " dofs"], Float[Array, " dofs"]]:
    """Return the least weighted torques of least residual within the bounds, and that residual.

    The active bounds are found on frozen numbers. The free torques then follow from one linear
    solve, so derivatives are exact wherever the active set is locally constant.
    """
    B, wanted, column = problem
    root, small = jnp.sqrt(weight), jnp.finfo(B.dtype).eps ** 0.25
    scaled = stop_gradient_tree((B * (column / root)[None], wanted, root * lower, root * upper))
    target = _bounded_target(*scaled) / jax.lax.stop_gradient(root)
    nearest, drives = jnp.clip(target, lower, upper), jnp.any(B != 0, 0)
    free = drives & (lower < target) & (target < upper)
    held = jnp.where(drives & ~free, jnp.where(target <= lower, lower, upper), 0)
    part = jnp.where(free[None], B, 0)
    y = _least_cost_solution(
        pivoted_qr_with_rank(part)[0], part, wanted - B @ (column * held), weight / column**2
    )
    solved = jnp.where(free, y / column, nearest)
    tau = jnp.clip(solved, lower, upper)
    # the iterate, should a free torque leave its bounds by more than round-off
    inside = jnp.max(jnp.abs(solved - tau)) <= small * jnp.max(jnp.abs(nearest))
    tau = jnp.where(free, jnp.where(inside, tau, nearest), held)
    valid = jnp.all(lower <= upper) & jnp.isfinite(jnp.sum(B) + jnp.sum(wanted))
    tau = jnp.where(valid, tau, jnp.nan)
    return tau, (wanted - B @ (column * tau)) / column


def _bounded_target(A, b, lower, upper):
    """Return the z for which clip(z, lower, upper) is the x of least norm in the box among those
    that make |A x - b| least.

    In two stages: in the second the coordinates that the residual presses against a bound stay
    there. Without them the residual no longer drives the multiplier, which keeps its precision.
    """
    small = jnp.finfo(A.dtype).eps ** 0.25

    def stage(_, carry):
        held, target = carry
        rest = b - A @ jnp.where(held, jnp.clip(target, lower, upper), 0)
        part = jnp.where(held[None], 0, A)
        Z = pivoted_qr_with_rank(part)[0].Q
        part, rest = Z @ part, Z @ rest
        target = jnp.where(held, target, _multiplier(part, rest, lower, upper) @ part)
        press = (rest - part @ jnp.clip(target, lower, upper)) @ part
        far = jnp.abs(press) > small * jnp.sqrt(jnp.sum(part**2, 0) * jnp.sum(rest**2))
        return held | (far & ((target <= lower) | (target >= upper))), target

    start = jnp.zeros(b.shape, bool), jnp.zeros_like(b)
    return jax.lax.fori_loop(0, 2, stage, start)[1]


def _multiplier(A, b, lower, upper):
    """Return the mu for which x = clip(A^T mu, lower, upper) is of least norm in the box among
    those that make |A x - b| least.

    Augmented Lagrangian, ten updates of `center`; where no x of the box solves A x = b it converges
    to the closest problem that has a solution (Chiche and Gilbert, 2016). Each inner problem is
    solved in its dual, by semismooth Newton with exact line search.
    """
    eps, size = jnp.finfo(A.dtype).eps, jnp.sum(A * A)
    damping = eps**0.8 * jnp.where(size > 0, size, 1)

    def step(carry):
        mu, center, updates, k = carry
        target = mu @ A
        x, free = jnp.clip(target, lower, upper), (lower < target) & (target < upper)
        gradient = A @ x - b + damping * (mu - center)
        hessian = jnp.where(free[None], A, 0) @ A.T + damping * jnp.eye(b.size, dtype=A.dtype)
        d = -solve_positive(hessian, gradient)
        along = d @ A
        # the slope along d is linear in t between the t at which a coordinate meets a bound
        speed = jnp.where(along == 0, 1, along)
        meets = jnp.append((lower - target) / speed, (upper - target) / speed)
        t = jnp.sort(jnp.append(jnp.clip(meets, 0, 1), jnp.array([0, 1], A.dtype)))
        clipped = jax.vmap(lambda t: jnp.clip(target + t * along, lower, upper))(t)
        slope = clipped @ along - b @ d + damping * ((mu - center) @ d + t * (d @ d))
        mu = mu + jnp.interp(jnp.zeros((), A.dtype), slope, t) * d
        after = jnp.clip(mu @ A, lower, upper)
        error = jnp.max(jnp.abs(after - x - jnp.where(free, along, 0)))
        # true for NaN
        solved = ~(error > eps**0.5 * jnp.max(jnp.abs(after)))
        return mu, jnp.where(solved, mu, center), jnp.where(solved, updates + 1, updates), k + 1

    more = lambda carry: (carry[2] < 10) & (carry[3] < 10 * b.size + 10)
    return jax.lax.while_loop(more, step, (jnp.zeros_like(b), jnp.zeros_like(b), 0, 0))[0]
