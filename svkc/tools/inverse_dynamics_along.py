"""Inverse dynamics along a path: torques and loop forces for given coordinates over time.

A spline through the path gives velocities and accelerations. Loops determine those of the dependent
coordinates, and the torques by the paper's section III-A.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from svkc._jax.pytrees import is_concrete
from svkc.loops.actuation import solve_unbounded, weight_per_dof
from svkc.loops.coordinates import coordinates
from svkc.loops.forward_dynamics import loop_forces_of_motion
from svkc.model.annotations import Checked, Names, Numbers, Scalar
from svkc.model.chain import Chain, State, Structure
from svkc.model.checked_jit import check_chain
from svkc.model.names import unknown_name
from svkc.model.validation import finite_array
from svkc.tools.quintic_spline import spline_derivatives
from svkc.transitions.initial_state import (
    assemble,
    check_quaternions,
    full_vector,
    starting_point,
)
from svkc.tree.spatial import quat_conjugate, quat_multiply


class InverseDynamics(eqx.Module):
    """Torques that move a chain along a path. `str` gives a table by coordinate.

    ts: the times (s).
    states: the states at these times; `v` are velocities along the path.
    vdot: accelerations of every coordinate (rad/s^2, m/s^2).
    tau: torques of the actuators (N m, N), of least weighted norm.
    residual: generalized force on the independent coordinates that tau does not produce. It is not
    zero where the actuators are fewer than the freedoms, as at the base of a free figure.
    loop_force, loop_torque: wrench of each connected virtual link, on `real` from `parent`, at the
    joint, in world axes (N, N m). They are those under tau and residual together.
    null_space: columns are torques that do not change the motion; see `Actuation`.
    """

    ts: Float[Array, "*lanes times"]
    states: State
    vdot: Float[Array, "*lanes times dofs"]
    tau: Float[Array, "*lanes times dofs"]
    residual: Float[Array, "*lanes times dofs"]
    loop_force: Float[Array, "*lanes times links 3"]
    loop_torque: Float[Array, "*lanes times links 3"]
    null_space: Float[Array, "*lanes times dofs dofs"]
    dof_names: tuple[str, ...] = eqx.field(static=True)
    link_names: tuple[str, ...] = eqx.field(static=True)

    def torque(self, joint: str) -> Array:
        """Return the torque (N m, N) of a joint over time: [times], or [times n] if it has several
        coordinates.

        joint: name of a joint, or of one of its coordinates (`Chain.dof_names`).
        Raises ValueError if the name is unknown.
        """
        suffixes = ("", ".x", ".y", ".z", ".rx", ".ry", ".rz")
        known = [f"{joint}{suffix}" for suffix in suffixes]
        own = [i for i, n in enumerate(self.dof_names) if n in known]
        if not own:
            raise unknown_name("joint", joint, self.dof_names)
        tau = self.tau[..., np.array(own)]
        return tau[..., 0] if len(own) == 1 else tau

    def wrench(self, link: str) -> tuple[Array, Array]:
        """Return the force (N) and the torque (N m) of a virtual link over time, each [times 3].

        link: name of the virtual link.
        Raises ValueError if the name is unknown.
        """
        if link not in self.link_names:
            raise unknown_name("virtual link", link, self.link_names)
        i = self.link_names.index(link)
        return self.loop_force[..., i, :], self.loop_torque[..., i, :]

    def __str__(self) -> str:
        if not is_concrete(self.tau) or self.tau.ndim > 2:
            return repr(self)
        tau, residual = np.abs(self.tau), np.abs(self.residual)
        lines = [
            f"{len(self.ts)} times from {float(self.ts[0]):g} s to {float(self.ts[-1]):g} s",
            f"{'torque (N m, N)':24s} {'peak':>10s} {'rms':>10s}",
        ]
        for i in np.flatnonzero(tau.any(0)):
            rms = np.sqrt(np.mean(tau[:, i] ** 2))
            lines.append(f"  {self.dof_names[i]:22s} {tau[:, i].max():10.4g} {rms:10.4g}")
        time, dof = np.unravel_index(np.argmax(residual), residual.shape)
        lines.append(
            f"largest residual {residual[time, dof]:.3g} N m or N, of {self.dof_names[dof]} at"
            f" {float(self.ts[time]):g} s"
        )
        return "\n".join(lines)


def inverse_dynamics_along(
    chain: Chain, ts: Numbers, q: Checked[dict[str, Any] | Numbers],
    connected: Checked[Names | Numbers | None] = None, weight: Scalar | Numbers | None = None,
) -> InverseDynamics:  # fmt: skip
    """Return the torques that move the chain along a path.

    A quintic spline goes through the path; velocities and accelerations are its exact derivatives.
    Its error in accelerations is of the fourth order in the distance of the times. Successive
    quaternions must be less than 180 degrees apart. The torques are those besides the joints'
    springs and dampers; torques of joint ranges are neglected. Results have
    derivatives with respect to `ts`, `q` and the floats of the chain.

    ts: [times] at least four increasing times (s).
    q: coordinates (m, rad, wxyz): an array [times, n] over the tree or over every coordinate, or a
        dict by joint name of arrays over time, [times] or [times, n]. Joints that are not named
        follow from the loops, each state near the one before it. Those in no connected loop rest in
        the load pose. An array that does not close the loops is moved by the least change that
        closes them.
    connected: names of the connected virtual links, or a mask [links]. None: as in the model.
    weight: positive weights of the torques, as in `actuation`.

    Raises ValueError if a name is unknown, a size is wrong, times do not increase, the loops cannot
    be closed at a time, or the named joints do not determine the motion. The message names the time
    and the loops or joints. Under jit, results are NaN instead of the last two errors.
    """
    check_chain(chain)
    dtype = chain.q_load.dtype
    ts = _increasing_times(ts, dtype)
    count = len(ts)
    if isinstance(q, dict):
        rows = {name: _row_for_each_time(name, x, count, dtype) for name, x in q.items()}
    else:
        rows = finite_array("q", q, dtype)
    start, structure = starting_point(chain, None, connected)
    requested, specified = full_vector(
        chain, "q", rows, jnp.broadcast_to(start, (count, chain.topology.nq_all))
    )
    check_quaternions(chain, requested)
    near = State(start, jnp.zeros(chain.dofs, dtype), structure)
    weight = weight_per_dof(chain, weight)
    result, undetermined = _along(chain, near, ts, rows, jnp.asarray(specified), weight)
    if is_concrete(result, undetermined):
        _check_reached(chain, near, rows, result)
        _check_determined(result, np.asarray(undetermined))
    return result


def _increasing_times(ts, dtype) -> Float[Array, " times"]:
    """Return the times as an array; raise ValueError if they are not four or more that increase."""
    ts = finite_array("ts", ts, dtype)
    if ts.ndim != 1 or len(ts) < 4 or (is_concrete(ts) and not np.all(np.diff(ts) > 0)):
        got = np.asarray(ts) if is_concrete(ts) else f"shape {ts.shape}"
        raise ValueError(f"ts: expected at least four increasing times, got {got}")
    return ts


def _row_for_each_time(name, values, count: int, dtype) -> Float[Array, "times *n"]:
    """Return the values of a named joint as an array; raise ValueError for another length."""
    values = finite_array(f"q[{name!r}]", values, dtype)
    if values.ndim not in (1, 2) or len(values) != count:
        raise ValueError(
            f"q[{name!r}]: got shape {values.shape}, expected {count} rows, one for each time"
        )
    return values


def _check_reached(chain: Chain, near: State, rows, result: InverseDynamics) -> None:
    """Raise ValueError for the first time at which there is no state, with the reason."""
    missing = ~np.isfinite(np.asarray(result.states.q)).all(1)
    if not missing.any():
        return
    i, reason = int(np.argmax(missing)), "the loops cannot be closed"
    before = State(result.states.q[i - 1], near.v, near.structure) if i else near
    try:
        _state_at(chain, before, jax.tree.map(lambda x: x[i], rows), throw=True)
    except ValueError as error:
        reason = str(error)
    raise ValueError(f"inverse_dynamics_along: at t = {float(result.ts[i]):g} s: {reason}")


def _check_determined(result: InverseDynamics, undetermined: np.ndarray) -> None:
    """Raise ValueError for the first time at which named joints leave freedoms of the loops."""
    times = undetermined.any(1)
    if times.any():
        i = int(np.argmax(times))
        names = ", ".join(result.dof_names[k] for k in np.flatnonzero(undetermined[i]))
        raise ValueError(
            f"inverse_dynamics_along: at t = {float(result.ts[i]):g} s the joints of q do not"
            f" determine those of the loops: these are free too: {names}. Name them, with constants"
            " where they rest."
        )


def _state_at(chain: Chain, near: State, row, throw: bool) -> State:
    """Return the state with the coordinates of one time."""
    return assemble(chain, row, None, None, near=near, hold=None, tolerance=None, throw=throw)


def _states_along(chain: Chain, near: State, rows, count: int) -> State:
    """Return the state at each time, each from the one before it; NaN where there is none."""

    def step(q, row):
        state = _state_at(chain, State(q, near.v, near.structure), row, throw=False)
        return jnp.where(jnp.all(jnp.isfinite(state.q)), state.q, q), state

    return jax.lax.scan(step, near.q, rows, length=count)[1]


def _path_rates(
    chain: Chain, ts: Float[Array, " times"], q: Float[Array, "times q"]
) -> tuple[Float[Array, "times dofs"], Float[Array, "times dofs"]]:
    """Return velocities and accelerations at `ts` of the spline through q.

    Quaternions are splined componentwise and normalized, which is independent of the frames and
    free of singularities.
    """
    quat_q, quat_v = chain.topology.quaternion_starts
    scalar_q, scalar_v = chain.topology.scalar_coordinates
    at_q, at_v = quat_q[:, None] + np.arange(4), quat_v[:, None] + np.arange(3)
    quat = q[:, at_q]
    # q and -q are one rotation: take the one nearer to the quaternion before
    turned = jnp.sum(quat[1:] * quat[:-1], -1, keepdims=True) < 0
    sign = jnp.cumprod(jnp.where(turned, -1, 1).astype(q.dtype), 0)
    quat = jnp.concatenate([quat[:1], sign * quat[1:]])
    rate, second = spline_derivatives(ts, q.at[:, at_q].set(quat))
    # y = |y| q has conj(y) y' / |y|^2 = (|y|' / |y|, w / 2), and |y| = 1 at the points
    first, curvature = (quat_multiply(quat_conjugate(quat), x[:, at_q]) for x in (rate, second))
    w = 2 * first[..., 1:]
    wdot = 2 * curvature[..., 1:] - 2 * first[..., :1] * w
    over_dofs = lambda scalars, turns: (
        jnp.zeros((len(ts), chain.dofs), q.dtype)
        .at[:, scalar_v].set(scalars[:, scalar_q])
        .at[:, at_v].set(turns)
    )  # fmt: skip
    return over_dofs(rate, w), over_dofs(second, wdot)


def _prefer(structure: Structure, independent: Bool[Array, " dofs"]) -> Structure:
    """Return the structure with coordinates preferred as independent ones."""
    return eqx.tree_at(lambda s: s.independent, structure, independent, is_leaf=lambda x: x is None)


@jax.jit
def _along(
    chain: Chain, near: State, ts, rows, specified: Bool[Array, " dofs"], weight
) -> tuple[InverseDynamics, Bool[Array, "times dofs"]]:
    """Return the result, and the coordinates of loops that named joints do not determine."""
    by_name = isinstance(rows, dict)
    states = _states_along(chain, near, rows, len(ts))
    rates = _path_rates(chain, ts, states.q)
    preferred = specified
    if not by_name:
        # the independent coordinates stay the same where the loops allow it
        first = jax.tree.map(lambda x: x[0], states)
        first = State(first.q, first.v, _prefer(first.structure, specified))
        preferred = coordinates(chain, first).independent

    def at_time(state: State, v, vdot):
        structure = _prefer(state.structure, preferred)
        co = coordinates(chain, State(state.q, v, structure))
        state = State(state.q, co.W @ jnp.where(co.independent, v, 0), structure)
        co = coordinates(chain, state)
        vdot = co.W @ jnp.where(co.independent, vdot, 0) + co.bias
        torques, _ = solve_unbounded(chain, state, vdot, weight, chain.actuated)
        forces = loop_forces_of_motion(chain, state, vdot, torques.tau)
        undetermined = co.independent & ~specified & jnp.any(co.J != 0, 0) & by_name
        return state.v, vdot, torques, forces, undetermined

    v, vdot, torques, forces, undetermined = jax.vmap(at_time)(states, *rates)
    nan_if_undetermined = lambda x: jnp.where(jnp.any(undetermined), jnp.nan, x)
    result = InverseDynamics(
        ts=ts,
        states=State(states.q, v, states.structure),
        vdot=nan_if_undetermined(vdot),
        tau=nan_if_undetermined(torques.tau),
        residual=nan_if_undetermined(torques.residual),
        loop_force=nan_if_undetermined(forces.force),
        loop_torque=nan_if_undetermined(forces.torque),
        null_space=torques.null_space,
        dof_names=chain.dof_names,
        link_names=chain.link_names,
    )
    return result, undetermined
