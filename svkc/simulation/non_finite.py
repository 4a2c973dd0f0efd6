"""Diagnosis of a run that ended with `RESULTS.non_finite`: which numbers were not finite first.

The numbers that determine the motion are evaluated again outside of the compiled run, at the last
finite state and shortly after it.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from svkc.integration.ode import FieldArgs, ODEState
from svkc.integration.stabilization import NoStabilization
from svkc.integration.vector_field import VectorField
from svkc.loops.constrained_dynamics import default_dynamics
from svkc.loops.forward_dynamics import forward_dynamics
from svkc.model.chain import Chain, State, Structure
from svkc.model.inertial_parameters import row_name
from svkc.model.names import q_slice
from svkc.simulation.codes import RESULTS
from svkc.transitions.events import as_events
from svkc.transitions.plan import Plan, make_plan
from svkc.tree.configuration import integrate
from svkc.tree.mass_matrix import mass_matrix


@dataclasses.dataclass(frozen=True)
class RunEnd:
    """The end of a run, and the arguments of the run.

    t, state: last time (s) and state.
    change_times: when timed events happen (s).
    happened: indices of the events that have happened.
    probes: times after t at which the numbers are evaluated as well (s).
    """

    chain: Chain
    t: float
    state: State
    control: Any
    plan: Plan
    change_times: np.ndarray
    happened: frozenset[int]
    args: Any
    probes: tuple[float, ...]


def trace_non_finite(
    traj: Any, chain: Chain, lane: Callable | None, data: Any, options: dict[str, Any]
) -> str:
    """Return what was not finite first, one line for each lane that ended with `non_finite`.

    traj: a trajectory or a batch of trajectories.
    lane, data: as in `rollout` (lane None: `options` hold for all lanes).
    options: control, events, args and dt of the run.
    """
    lines = []
    for index in np.ndindex(np.shape(traj.ts)[:-1]):
        one = jax.tree.map(lambda x, i=index: jnp.asarray(x)[i], traj)
        if not bool(one.result == RESULTS.non_finite):
            continue
        own = {"chain": chain, **options}
        if lane is not None:
            own |= lane(chain, jax.tree.map(lambda x, i=index: x[i], data))
        label = f"lane {index[0] if len(index) == 1 else index}: " if index else ""
        lines.append(label + find_non_finite(run_end(one, own)))
    return "\n".join(lines)


def run_end(traj: Any, options: dict[str, Any]) -> RunEnd:
    """Return the end of one run.

    options: chain, and the options control, events, args and dt of the run.
    """
    chain, dt = options["chain"], options.get("dt")
    span = float(traj.ts[-1] - traj.ts[0])
    plan = make_plan(chain, as_events(options.get("events") or ()), traj.final.q.dtype)
    return RunEnd(
        chain=chain,
        t=float(traj.t_final),
        state=jax.tree.map(jnp.asarray, traj.final),
        control=options.get("control"),
        plan=plan,
        change_times=_change_times(traj, plan),
        happened=frozenset(np.asarray(traj.events.which)[: int(traj.events.count)].tolist()),
        args=options.get("args"),
        # Step-size controllers shorten steps with numbers that are not finite, except where only a
        # guard is not. Step sizes are not recorded, so that fractions of the run stand for them.
        probes=tuple(
            span * np.array([1e-6, 1e-3, 1e-2, 1e-1])
            if dt is None
            else float(dt) * np.array([0.5, 1.0])
        ),
    )


def _change_times(traj, plan: Plan) -> np.ndarray:
    """Return the times (s) at which timed events happen, after recorded events too."""
    recorded, which = np.asarray(traj.events.time), np.asarray(traj.events.which)
    times = [
        np.asarray(time) + (0 if plan.after[i] is None else recorded[which == plan.after[i]])
        for i, time in zip(plan.timed, plan.times, strict=True)
    ]
    return np.concatenate([np.ravel(t) for t in times]) if times else np.zeros(0)


def find_non_finite(end: RunEnd) -> str:
    """Return what was not finite first, for a message.

    The order is: chain, initial state, then at each instant control, guards and acceleration. At
    the last time, a change of structure by a timed event comes after these. The functions below,
    such as `_in_chain`, return "" if all of their numbers are finite.
    """
    source = _in_chain(end.chain) or _in_state(end.chain, end.state)
    if source:
        return source
    for h in (0.0, *end.probes):
        t, state = end.t + h, _advance(end, h)
        source = _at_instant(end, t, state)
        if not source and h == 0 and np.any(end.change_times == end.t):
            source = "the change of structure"
        if source:
            return f"{source}, at t = {t:.9g} s"
    return f"the motion itself, after t = {end.t:.9g} s; {_fastest(end.chain, end.state)}"


def _last(bad: np.ndarray) -> int:
    """Return the last row with a true entry. Row 0 may be the world's, which no message names."""
    return int(np.flatnonzero(bad.reshape(len(bad), -1).any(1))[-1])


def _in_chain(chain: Chain) -> str:
    """Return the first field of a chain that is not finite, with its body or joint."""
    for field in dataclasses.fields(chain):
        value = getattr(chain, field.name)
        if field.metadata.get("static") or not hasattr(value, "dtype"):
            continue
        # bounds may be infinite
        bounds = field.name in ("limit", "control_range", "force_range")
        bad = np.isnan(np.asarray(value)) if bounds else ~np.isfinite(np.asarray(value))
        if bad.any():
            return f"chain.{field.name}{_owner(chain, field.name, bad)}"
    return _in_structure(chain, chain.structure, "chain.structure")


def _owner(chain: Chain, field: str, bad: np.ndarray) -> str:
    """Return " of ..." with the name of the body or joint of a bad entry of a field."""
    if field in ("pos", "quat", "axis", "mass", "com", "inertia", "anchor"):
        return f" of {row_name(chain, _last(bad))}"
    if field in ("q_load", "q_spring"):
        return f" of {_joint_of_coordinate(chain, bad)}"
    if field in ("armature", "damping", "stiffness"):
        return f" of joint {chain.dof_names[_last(bad)]!r}"
    if field in ("limit", "limit_spring", "gear"):
        return f" of joint {chain.dof_names[_last(bad.T)]!r}"
    return ""


def _joint_of_coordinate(chain: Chain, bad: np.ndarray) -> str:
    """Return text that names the joint of the first bad entry of q."""
    index = int(np.argmax(bad))
    for joint in chain.joint_names:
        coordinates = q_slice(chain.topology, joint)
        if coordinates.start <= index < coordinates.stop:
            return f"joint {joint!r}"
    return f"the virtual joint at q[{index}]"


def _in_structure(chain: Chain, structure: Structure, name: str) -> str:
    """Return the first placement of a virtual link that is not finite."""
    for field in ("pos", "quat", "real_pos", "real_quat"):
        bad = ~np.isfinite(np.asarray(getattr(structure, field)))
        if bad.any():
            return f"{name}.{field} of virtual link {chain.link_names[_last(bad)]!r}"
    return ""


def _in_state(chain: Chain, state: State) -> str:
    """Return what is not finite in the last state: only an initial state is not finite."""
    q, v = ~np.isfinite(np.asarray(state.q)), ~np.isfinite(np.asarray(state.v))
    if q.any():
        return f"q of {_joint_of_coordinate(chain, q)} in the initial state"
    if v.any():
        return f"v of joint {chain.dof_names[int(np.argmax(v))]!r} in the initial state"
    return _in_structure(chain, state.structure, "state.structure")


def _torques(end: RunEnd, t: Array, state: State) -> Array:
    """Return the torques of the control and of joint limits [dofs]."""
    field = VectorField(end.control, NoStabilization(), default_dynamics(end.chain))
    field_args = FieldArgs(end.chain, state.structure, end.args)
    tau, _ = field.torques(t, ODEState(state.q, state.v), field_args)
    # Inside of jvp and grad the control may read traced values, whose primal values are concrete.
    return jax.lax.stop_gradient(tau)


def _advance(end: RunEnd, h: float) -> State:
    """Return the last state, advanced by h (s) with a step of the symplectic Euler method."""
    if h == 0:
        return end.state
    q, v, dt = end.state.q, end.state.v, jnp.asarray(h, end.state.q.dtype)
    v = v + dt * forward_dynamics(
        end.chain, end.state, _torques(end, jnp.asarray(end.t, q.dtype), end.state)
    )
    return State(integrate(end.chain, q, dt * v), v, end.state.structure)


def _at_instant(end: RunEnd, t: float, state: State) -> str:
    """Return what is not finite at a time and a state; "" if the state itself is not finite."""
    dtype = state.q.dtype
    if not np.isfinite(np.concatenate([state.q, state.v])).all():
        return ""
    time = jnp.asarray(t, dtype)
    tau = np.asarray(_torques(end, time, state))
    if not np.isfinite(tau).all():
        joint = int(np.argmax(~np.isfinite(tau)))
        return (
            f"the control: {tau[joint]} for {end.chain.dof_names[joint]!r}{_note_on_args(end.args)}"
        )
    armed = np.asarray(end.plan.armed(end.chain, state.structure)) if end.plan.guards else []
    for guard, index, may_fire in zip(end.plan.guards, end.plan.guarded, armed, strict=True):
        first = end.plan.after[index]
        if not may_fire or (first is not None and first not in end.happened):
            continue
        value = guard.value(end.chain, time, state, end.args, jnp.asarray(tau, dtype))
        if np.isnan(np.asarray(jax.lax.stop_gradient(value))):
            return f"the guard of events[{index}]{_note_on_args(end.args)}"
    vdot = np.asarray(forward_dynamics(end.chain, state, jnp.asarray(tau, dtype)))
    if np.isfinite(vdot).all():
        return ""
    name = end.chain.dof_names[int(np.argmax(~np.isfinite(vdot)))]
    moments = np.linalg.eigvalsh(np.asarray(mass_matrix(end.chain, state)))
    singular = moments[0] <= 8 * np.finfo(dtype).eps * moments[-1]
    if t > end.t and not singular:
        # The acceleration overflows only because of large velocities: the motion itself is named.
        return ""
    reason = "the mass matrix is singular, so a joint moves no mass"
    return f"the acceleration of {name!r}; {reason if singular else _fastest(end.chain, state)}"


def _note_on_args(args) -> str:
    """Return a note that names the first array of `args` that is not finite."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(args):
        if hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, jnp.floating):
            if not np.isfinite(np.asarray(leaf)).all():
                return f" (args{jax.tree_util.keystr(path)} is not finite)"
        elif isinstance(leaf, float) and not np.isfinite(leaf):
            return f" (args{jax.tree_util.keystr(path)} is not finite)"
    return ""


def _fastest(chain: Chain, state: State) -> str:
    """Return a clause that names the fastest joint coordinate and its speed."""
    v = np.abs(np.asarray(state.v))
    return f"{chain.dof_names[int(np.argmax(v))]!r} moves at {np.max(v):.3g} rad/s or m/s"
