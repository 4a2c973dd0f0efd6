"""The initial state of a chain (`Chain.state`): the user's values by name or as arrays, the loops
closed by continuation, the velocity projected, and errors that name what could not be reached."""

import functools
import math
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from svkc._jax.eager import eager_jit
from svkc._jax.pytrees import is_concrete
from svkc._jax.select import where
from svkc.loops.constraint import gap_tolerance, jacobian_scales, loop_gaps
from svkc.model.annotations import Checked, Names, Numbers, Scalar
from svkc.model.chain import Chain, State, Structure
from svkc.model.checked_jit import check_state
from svkc.model.names import connection_mask, q_slice, v_slice
from svkc.model.validation import boolean, finite_array, positive_scalar, warn_of_precision
from svkc.transitions.path_following import follow_path
from svkc.transitions.spare_links import check_bound
from svkc.transitions.stationarity import Targets
from svkc.tree.configuration import difference, normalize

# coordinates or velocities as users give them: an array, or numbers by joint name
Values: TypeAlias = Checked[Numbers | dict[str, Any] | None]


def _set_values(array, at, values):
    """Return the array with values set at an index.

    Concrete arrays are set with numpy: JAX compiles a program for every eager operation.
    """
    if not is_concrete(array, values):
        return jnp.asarray(array).at[at].set(values)
    out = np.array(array)
    out[at] = values
    return out


def full_vector(
    chain: Chain, quantity: str, value: Values, default: Array | np.ndarray
) -> tuple[Array | np.ndarray, np.ndarray]:
    """Return the full vector of a user's array or dict, and the mask of degrees of freedom whose
    values the user gives.

    An array has the size of the model itself, of the tree, or of every coordinate.

    quantity: "q" or "v".
    default: values of the coordinates that the user does not give. With leading axes, those of
        times, the user's arrays have these axes too.
    """
    top = chain.topology
    tree_size, slice_of, model_entries = (
        (top.nq, q_slice, top.model_q) if quantity == "q" else (top.nv, v_slice, top.model_v)
    )
    named, batch = np.zeros(top.dofs, bool), default.shape[:-1]
    if value is None:
        return default, named
    if isinstance(value, dict):
        out = default
        for name, number in value.items():
            at = slice_of(top, name)
            number = finite_array(f"{quantity}[{name!r}]", number, default.dtype)
            size, width = number.size // math.prod(batch), at.stop - at.start
            if size != width:
                raise ValueError(f"{quantity}[{name!r}]: got {size} numbers, the joint has {width}")
            out = _set_values(out, (..., at), number.reshape(*batch, width))
            named[v_slice(top, name)] = True
        return out, named
    array = finite_array(quantity, value, default.dtype)
    if top.cuttable_joints and array.shape == (*batch, len(model_entries)):
        # the size in the model itself, in which no joint is cut
        named[np.array(top.model_v, int)] = True
        return _set_values(default, (..., np.array(model_entries, int)), array), named
    if array.shape == (*batch, tree_size):
        named[: top.nv] = True
        return _set_values(default, (..., slice(tree_size)), array), named
    if array.shape != default.shape:
        raise ValueError(
            f"{quantity}: got shape {array.shape}, expected {(*batch, tree_size)} for the tree or"
            f" {default.shape} for every coordinate"
        )
    return array, ~named


def check_quaternions(chain: Chain, q: Array | np.ndarray) -> None:
    """Raise ValueError if a quaternion of a concrete q deviates from unit length by more than 1e-3.

    Smaller deviations are round-off, which normalising removes.
    """
    first, _ = chain.topology.quaternion_starts
    if not is_concrete(q) or not len(first):
        return
    norms = np.linalg.norm(np.asarray(q)[..., first[:, None] + np.arange(4)], axis=-1)
    if np.any(np.abs(norms - 1) > 1e-3):
        worst = int(np.argmax(np.abs(norms - 1)))
        i = first[worst % len(first)]
        raise ValueError(
            f"q: the quaternion at q[{i}:{i + 4}] has norm {norms.flat[worst]:.6g}, expected 1"
        )


class HeldMasks(eqx.Module):
    """Masks of the coordinates and velocities that the result must have as given.

    `Targets.held_q` is empty for an array with hold=True: the path then starts at the array.
    """

    q: Bool[Array, " dofs"]
    v: Bool[Array, " dofs"]


class Deviations(eqx.Module):
    """Deviations of held coordinates (rad, m) and velocities (rad/s, m/s) from the given values, 0
    within the tolerance.

    is_open: mask of the loops that are open.
    failed: whether a value deviates, a loop is open, or the path failed.
    """

    q: Float[Array, " dofs"]
    v: Float[Array, " dofs"]
    is_open: Bool[Array, " links"]
    failed: Bool[Array, ""]


@functools.partial(eager_jit, jit=eqx.filter_jit)
def _follow_and_compare(
    chain: Chain, structure: Structure, targets: Targets, held: HeldMasks
) -> tuple[State, Deviations]:
    """Return the state at the end of the path from the start, and its deviations, which have no
    derivatives."""
    start, requested = normalize(chain, targets.start), normalize(chain, targets.requested)
    targets = eqx.tree_at(lambda t: (t.start, t.requested), targets, (start, requested))
    end, column = follow_path(chain, structure, targets), jacobian_scales(chain)[1]
    structure = eqx.tree_at(lambda s: (s.rank, s.margin), structure, (end.rank, end.margin))
    last, requested, v = jax.lax.stop_gradient((end, targets.requested, targets.v))
    deviation_q = where(held.q, jnp.abs(difference(chain, last.q, requested)), 0)
    deviation_v = where(held.v, jnp.abs(v - last.v), 0)
    limit = targets.tolerance * column
    missed_q = ~(deviation_q <= limit)
    missed_v = ~(deviation_v <= limit * (1 + jnp.max(jnp.abs(v / column))))
    is_open = structure.connected & ~(last.residual_gaps < gap_tolerance(last.q.dtype))
    deviations = Deviations(
        q=where(missed_q, deviation_q, 0),
        v=where(missed_v, deviation_v, 0),
        is_open=is_open,
        failed=~last.reached | jnp.any(missed_q) | jnp.any(missed_v) | jnp.any(is_open),
    )
    # the given velocity itself, without the round-off of the projection
    correction = where(targets.held_v & ~missed_v, v - last.v, 0)
    return State(end.q, end.v + correction, structure), deviations


def assemble(
    chain: Chain, q: Values, v: Values, connected: Names | Numbers | None, *, near: State | None,
    hold: bool | None, tolerance: Scalar | None, throw: bool,
) -> State:  # fmt: skip
    """Return a consistent state; see `Chain.state`."""
    start, structure = starting_point(chain, near, connected)
    warn_of_precision(chain.q_load.dtype, q=q, v=v)
    requested, specified_q = full_vector(chain, "q", q, start)
    v_full, specified_v = full_vector(chain, "v", v, np.zeros(chain.dofs, chain.q_load.dtype))
    requested, v_full = jnp.asarray(requested), jnp.asarray(v_full)
    check_quaternions(chain, requested)
    holds = [isinstance(x, dict) if hold is None else boolean("hold", hold) for x in (q, v)]
    throw, tolerance = boolean("throw", throw), _tolerance(chain, tolerance)
    held = HeldMasks(jnp.asarray(specified_q & holds[0]), jnp.asarray(specified_v & holds[1]))
    if not len(chain.link_names):
        return _state_without_links(chain, structure, requested, v_full, held.v, throw)
    follows_names = isinstance(q, dict) and holds[0]
    # a full array gives the poses of the bodies of cuttable joints; names, and an array in the
    # model's own order, give the coordinates of these joints
    by_joint = q is None or isinstance(q, dict) or np.shape(q) == (len(chain.topology.model_q),)
    cuttable = np.array(chain.topology.link_child, int) >= 0
    targets = Targets(
        start=jnp.asarray(start) if follows_names else requested,
        requested=requested,
        v=v_full,
        held_q=jnp.asarray(specified_q & follows_names),
        held_v=held.v,
        read_links=jnp.asarray(~(cuttable & by_joint)),
        tolerance=tolerance,
    )
    state, deviations = _follow_and_compare(chain, structure, targets, held)
    return _check_reached(chain, state, deviations, throw)


def _state_without_links(
    chain: Chain, structure: Structure, q: Array, v: Array, held_v: Array, throw: bool
) -> State:
    """Return the state of a chain without virtual links, whose locked joints are at rest."""
    if structure.locked is None:
        return State(normalize(chain, q), v, structure)
    lost = where(held_v & structure.locked, jnp.abs(v), 0)
    if throw and is_concrete(lost) and np.any(lost):
        name = chain.dof_names[int(np.argmax(lost))]
        raise ValueError(f"v: {name} is locked, so that its velocity is zero")
    state = State(normalize(chain, q), where(structure.locked, 0, v), structure)
    deviations = Deviations(
        q=jnp.zeros_like(lost), v=lost, is_open=jnp.zeros(0, bool), failed=jnp.any(lost > 0)
    )
    return _check_reached(chain, state, deviations, throw)


def _tolerance(chain: Chain, tolerance) -> Float[Array, ""]:
    """Return the largest deviation of a held coordinate (rad, or in `chain.length`s)."""
    if tolerance is None:
        tolerance = gap_tolerance(chain.q_load.dtype)
    return jnp.asarray(positive_scalar("tolerance", tolerance), chain.q_load.dtype)


def starting_point(
    chain: Chain, near: State | None, connected: Names | Numbers | None
) -> tuple[Array, Structure]:
    """Return the load pose or the configuration of `near`, and the structure of the state."""
    if near is None:
        start, structure = chain.q_load, chain.structure
    else:
        check_state(chain, near)
        start, structure = near.q, near.structure
    if near is None or connected is not None:
        mask = connection_mask(chain.topology, connected, chain.structure.connected)
        at_rest = jnp.zeros(chain.dofs, chain.q_load.dtype)
        state = check_bound(chain, State(start, at_rest, structure), mask)
        start = state.q
        structure = eqx.tree_at(lambda s: s.connected, state.structure, jnp.asarray(mask))
    return start, structure


def _check_reached(chain: Chain, state: State, deviations: Deviations, throw: bool) -> State:
    """Return the state if it is the requested one; otherwise raise, or fill it with NaN."""
    if not throw:
        nan_if_failed = lambda x: where(deviations.failed, jnp.nan, x)
        return State(nan_if_failed(state.q), nan_if_failed(state.v), state.structure)
    if not is_concrete(deviations, state):
        return eqx.error_if(
            state, deviations.failed, "the loops of the initial state cannot be closed"
        )
    if not deviations.failed:
        return state
    for quantity, per, deviation in (("q", "", deviations.q), ("v", "/s", deviations.v)):
        missed = _describe_deviations(chain, np.asarray(deviation), per)
        if missed:
            raise ValueError(
                f"{quantity}: the loops do not allow the given values: {'; '.join(missed)}. Name"
                " fewer joints, start from a State near them (near=), or give them as a guess"
                " (hold=False)."
            )
    # no held value deviates, so the path failed to close the loops: list every connected loop
    # a path that failed with closed loops failed in all of them
    is_open = np.asarray(deviations.is_open)
    is_open = is_open if is_open.any() else np.asarray(state.structure.connected)
    return check_closed(chain, state, where(is_open, jnp.inf, 0))


def _describe_deviations(chain: Chain, deviation: np.ndarray, per: str) -> list[str]:
    """Return the name and the deviation of each coordinate that was not reached.

    per: "/s" for velocities, "" for coordinates.
    """
    # coordinates in m are those whose scale is `chain.length`
    doubled = eqx.tree_at(lambda c: c.length, chain, jnp.full_like(chain.length, 2))
    linear = np.asarray(jacobian_scales(doubled)[1]) == 2
    return [
        f"{chain.dof_names[i]} by {deviation[i]:.3g} {'m' if linear[i] else 'rad'}{per}"
        for i in np.flatnonzero(~(deviation == 0))
    ]


def check_closed(chain: Chain, state: State, residual_gaps: Float[Array, " links"]) -> State:
    """Return the state if its loops are closed.

    residual_gaps: largest gap of each loop (rad, or in `chain.length`s).

    Raises ValueError that lists the open loops and their gaps (a runtime error under jit).
    """
    limit = gap_tolerance(state.q.dtype)
    if not is_concrete(residual_gaps, state):
        return eqx.error_if(
            state,
            ~(jnp.max(residual_gaps) < limit),
            "the loops of the initial state cannot be closed",
        )
    if not np.all(np.asarray(residual_gaps) < limit):
        gaps = np.asarray(loop_gaps(chain, state))
        open_loops = [
            f"{chain.link_names[i]} by {np.linalg.norm(gaps[i, 3:]):.3g} m and"
            f" {np.linalg.norm(gaps[i, :3]):.3g} rad"
            for i in np.flatnonzero(~(residual_gaps < limit))
        ]
        raise ValueError(
            f"the loops cannot be closed from this configuration: {'; '.join(open_loops)}. Give a q"
            " nearer to a closed one."
        )
    return state
