"""Inverse dynamics of any structure (paper, section III-A): S^T tau_A = W^T tau_O.

The system may be square, redundant or deficient, and the torques may be bounded.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from svkc._jax.batched_lapack import solve_general
from svkc._jax.eager import eager_jit
from svkc._jax.pytrees import is_concrete
from svkc._jax.select import where
from svkc.loops.constraint import jacobian_scales, loop_kinematics
from svkc.loops.coordinates import closed_coordinates, open_coordinates
from svkc.loops.forward_dynamics import constraint_forces
from svkc.loops.least_squares import least_cost_solution, solve_bounded
from svkc.loops.pivoting import PivotedQR, pivoted_qr, pivoted_qr_with_rank
from svkc.model.annotations import Checked, Numbers, Scalar
from svkc.model.chain import Chain, State
from svkc.model.chain_names import ChainNames
from svkc.model.checked_jit import check_state
from svkc.model.tables import Block, Printed, Table, count, number, ranges
from svkc.model.validation import as_array, real_array
from svkc.tree.inverse_dynamics import pad_to_dofs, passive_forces, rnea
from svkc.tree.kinematics import kinematics, twists


class Actuation(Printed):
    """Torques of the actuators for an acceleration, and bases of what they leave undetermined.

    Bases are padded with zero columns.

    tau: torques (N m, N) of least weighted norm.
    residual: generalized force on theta_G that tau does not produce; zero if the acceleration is
    reached.
    null_space: columns are torques that do not change the motion, one for each redundant actuator.
    null_force, null_torque: change of the links' wrenches by each column of `null_space`, on `real`
    from `parent`, in world axes.
    stress_force, stress_torque: self-stresses, wrenches of redundant loops that need no torques,
    one for each redundant row.
    undriven: columns are joint velocities on which no actuator does work.
    rank: rank of S. redundancy: number of actuators that the loops let move, less the rank.
    deficiency: number of freedoms beyond the rank.
    names: names of the chain's bodies, joints, links and coordinates.
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
    names: ChainNames = eqx.field(static=True)

    def _blocks(self) -> list[Block]:
        names, shape = self.names, np.shape(self.rank)
        tau, residual = np.asarray(self.tau), np.asarray(self.residual)
        units = ["N m" if angular else "N" for angular in names.angular]
        round_off = np.finfo(tau.dtype).eps ** 0.5 * max(np.abs(tau).max(initial=0), 1)
        driven = np.any(tau != 0, tuple(range(len(shape))))
        missed = np.any(np.abs(residual) > round_off, tuple(range(len(shape))))
        shown = np.flatnonzero(np.logical_or(driven, missed)).tolist()
        others = f"no torque on {count(len(names.v) - len(shown), 'other joint coordinate')}"
        numbers = {
            "rank of S": self.rank,
            "redundant actuators": self.redundancy,
            "freedoms that no actuator drives": self.deficiency,
        }
        if not shape:
            counts = ", ".join(f"{name} {int(x)}" for name, x in numbers.items())
            rest = np.where(missed, residual, 0)
            rows = [(names.v[i], units[i], number(tau[i]), number(rest[i])) for i in shown]
            titles = "joint", "unit", "torque or force", "residual"
            return [f"Actuation: {counts}", *[Table(titles, rows)] * bool(rows), others]
        numbers |= {"largest residual (N m, N)": np.abs(residual).max(-1)}
        torques = {f"{names.v[i]} ({units[i]})": tau[..., i] for i in shown}
        heading = f"Actuation of {'x'.join(map(str, shape))} lanes"
        return [heading, ranges(numbers), ranges(torques, most=12), others]


def actuation(
    chain: Chain, state: State, vdot_G: Numbers, weight: Scalar | Numbers | None = None, *,
    actuated: Numbers | None = None, bounds: Checked[tuple[Any, Any] | None] = None,
) -> Actuation:  # fmt: skip
    """Return the torques for the accelerations vdot_G of the independent coordinates theta_G.

    The forces of the joints' springs and dampers are subtracted. (Paper, section III-A.)

    vdot_G: accelerations (rad/s^2, m/s^2) over every coordinate, of which those of theta_G
    (`coordinates(chain, state).independent`) are used; outside jit also those of theta_G alone.
    weight: positive weights, a scalar or [dofs]; sum(weight tau^2) is minimised (None: ones).
    actuated: mask of the actuated coordinates (None: `chain.actuated`).
    bounds: (lower, upper) torques, each a scalar or [dofs] (None: unbounded). If no torques within
    them reach the acceleration, the residual is minimised first. Traced bounds that cross give NaN.
    Raises ValueError if a size is wrong, if a weight is not positive, or if bounds cross.
    """
    check_state(chain, state)
    independent, vdot = None, real_array("vdot_G", vdot_G, state.v.dtype)
    if vdot.shape != (chain.dofs,):
        independent = (
            np.asarray(_coordinates_and_twists(chain, state)[0].independent)
            if is_concrete(state.q)
            else None
        )
        if independent is None or vdot.shape != (independent.sum(),):
            count = (
                "the number of independent ones" if independent is None else int(independent.sum())
            )
            raise ValueError(
                f"vdot_G: got shape {vdot.shape}, expected ({chain.dofs},), every joint"
                f" coordinate, or ({count},), theta_G"
            )
        vdot = jnp.zeros(chain.dofs, vdot.dtype).at[np.flatnonzero(independent)].set(vdot)
    weight = weight_per_dof(chain, weight)
    mask = chain.actuated if actuated is None else as_array(actuated)
    if mask.shape != (chain.dofs,) or mask.dtype != bool:
        raise ValueError(
            f"actuated: expected {chain.dofs} Booleans, got {mask.dtype} of shape {mask.shape}"
        )
    mask = jnp.asarray(mask)
    result, problem = solve_unbounded(chain, state, vdot, weight, mask)
    if bounds is None:
        return result
    tau, residual = solve_bounded(problem, weight, *_limits(chain, bounds))
    return eqx.tree_at(lambda r: (r.tau, r.residual), result, (tau, residual))


def weight_per_dof(chain: Chain, weight: Scalar | Numbers | None) -> Float[Array, " dofs"]:
    """Return the weight over every coordinate; raise ValueError if it is not positive."""
    weight = _per_dof(chain, "weight", weight, 1.0)
    if is_concrete(weight) and not np.all(
        (np.asarray(weight) > 0) & np.isfinite(np.asarray(weight))
    ):
        raise ValueError(f"weight: expected positive numbers, got {np.asarray(weight)}")
    return weight


def _per_dof(chain: Chain, name: str, value, default) -> Float[Array, " dofs"]:
    """Return the argument `name` over every coordinate.

    Raises ValueError for another shape than () or [dofs].
    """
    value = real_array(name, default if value is None else value, chain.q_load.dtype)
    if value.shape not in ((), (chain.dofs,)):
        raise ValueError(f"{name}: got shape {value.shape}, expected a number or ({chain.dofs},)")
    return jnp.broadcast_to(value, (chain.dofs,))


def _limits(chain: Chain, bounds) -> list[Float[Array, " dofs"]]:
    """Return the lower and the upper bounds.

    Raises ValueError if they are not a pair, or if they cross.
    """
    if not isinstance(bounds, tuple | list | np.ndarray | jax.Array) or len(bounds) != 2:
        raise ValueError(f"bounds: expected (lower, upper), got {bounds!r}")
    limits = [_per_dof(chain, "bounds", b, 0.0) for b in bounds]
    if is_concrete(limits) and not np.all(np.asarray(limits[0]) <= np.asarray(limits[1])):
        lower, upper = np.asarray(limits)
        raise ValueError(f"bounds: expected lower at or below upper, got {lower} and {upper}")
    return limits


@eager_jit
def _coordinates_and_twists(chain: Chain, state: State):
    """Return the coordinate partitioning, the kinematics and the twists of a state."""
    if not chain.link_names:
        kin = kinematics(chain, state.q)
        return open_coordinates(chain, state.structure), kin, twists(chain, kin, state.v)
    loops = loop_kinematics(chain, state.structure, state.q)
    V = twists(chain, loops.kin, state.v)
    return closed_coordinates(chain, state.structure, state.v, loops, V), loops.kin, V


def _null_space_basis(
    B: Float[Array, "rows dofs"], rank=None
) -> tuple[PivotedQR, Int[Array, ""], Float[Array, "dofs dofs"]]:
    """Return the pivoted QR of B, its rank, and a basis of its null space.

    Each basis vector has a one at a column that is no pivot; the pivots balance it.

    rank: rank of B (None: determine it).
    """
    qr, rank = pivoted_qr_with_rank(B) if rank is None else (pivoted_qr(B, rank), rank)
    P = qr.P
    Bm = qr.Q @ B
    R = Bm @ P.T + jnp.diag(where(qr.active, 0, 1).astype(B.dtype))
    null_space = jnp.eye(B.shape[1], dtype=B.dtype) - P.T @ solve_general(R, Bm)
    return qr, rank, where(jnp.any(P > 0, 0)[None], 0, null_space)


@eager_jit
def solve_unbounded(chain: Chain, state: State, vdot_G, weight, actuated: Bool[Array, " dofs"]):
    """Return the `Actuation` without bounds, and (B, force, column) for `solve_bounded`."""
    nv = chain.nv
    co, kin, V = _coordinates_and_twists(chain, state)
    _, column = jacobian_scales(chain)
    vdot = co.W @ where(co.independent, vdot_G, 0) + co.bias
    forces = pad_to_dofs(chain, rnea(chain, kin, V, state.v, vdot[:nv])) - passive_forces(
        chain, state.q, state.v
    )
    target_force = co.W.T @ forces
    # dimensionless, scaled as the columns of J_C
    S = where(actuated[:, None], co.W, 0)
    B = column[:, None] * S.T / column[None]
    # the null spaces of S^T and of S, which have the same size, by one compiled function
    both, ranks, bases = jax.lax.map(_null_space_basis, jnp.stack([B, B.T]))
    qr, rank, null = jax.tree.map(lambda x: x[0], (both, ranks, bases))
    y = least_cost_solution(qr, B, column * target_force, weight / column**2)
    null = column[:, None] ** -1 * where(actuated[None], null, 0)
    reachable = actuated & jnp.any(co.W != 0, 1)
    undriven = co.W @ (column[:, None] * where(co.independent[None], bases[1], 0))
    if len(chain.link_names):
        wrenches = jax.vmap(
            lambda tau: constraint_forces(chain, co.selection, co.J, tau), in_axes=1, out_axes=-1
        )(null)
        _, _, stress = _null_space_basis(co.J.T, state.structure.rank)
        row, _ = jacobian_scales(chain)
        connected_rows = jnp.repeat(state.structure.connected, 6)
        stress = where(connected_rows[None], row[:, None] * stress, 0).reshape(-1, 6, row.shape[0])
    else:
        wrenches, stress = jnp.zeros((0, 6, chain.dofs), y.dtype), jnp.zeros((0, 6, 0), y.dtype)
    count = lambda mask: jnp.sum(mask, dtype=jnp.int32)
    tau = y / column
    residual = target_force - S.T @ tau
    result = Actuation(
        tau=tau,
        residual=residual,
        null_space=null,
        null_force=wrenches[:, 3:],
        null_torque=wrenches[:, :3],
        stress_force=stress[:, 3:],
        stress_torque=stress[:, :3],
        undriven=undriven,
        rank=rank,
        redundancy=count(reachable) - rank,
        deficiency=count(co.independent) - rank,
        names=chain.names,
    )
    return result, (B, column * target_force, column)
