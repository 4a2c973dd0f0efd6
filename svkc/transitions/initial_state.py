"""The initial state of a chain (`Chain.state`): the user's values by name or as arrays, the loops
closed by Newton's method, the velocity projected onto the closed loops."""

import dataclasses
import functools
import warnings

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc._jax.eager import eager_jit
from svkc._jax.pytrees import is_concrete
from svkc.loops.constraint import gap_tolerance, loop_gaps
from svkc.model.chain import Chain, State, Structure, active_dofs
from svkc.model.names import connection_mask, joint_slice
from svkc.model.topology import Q_SIZE, V_SIZE
from svkc.model.validation import finite_array
from svkc.transitions.newton import solve_structure
from svkc.transitions.newton_state import (
    CLOSE,
    CLOSE_HELD,
    PROJECT_VELOCITY,
    PROJECT_VELOCITY_HELD,
    RANK_SEARCH,
    READ_COORDINATES,
    HeldCoordinates,
    Schedule,
)
from svkc.tree.configuration import normalize

_NEWTON_ITERATIONS = 30
_CLOSE_KINDS, _PROJECT_KINDS = (
    (*(CLOSE_HELD,) * _NEWTON_ITERATIONS, *(CLOSE,) * _NEWTON_ITERATIONS),
    (PROJECT_VELOCITY_HELD, PROJECT_VELOCITY),
)
_PLACE_SCHEDULE, _ASSEMBLE_SCHEDULE = (
    Schedule((*_CLOSE_KINDS, *_PROJECT_KINDS)),
    Schedule((READ_COORDINATES, *_CLOSE_KINDS, *RANK_SEARCH, *_PROJECT_KINDS)),
)


def _set_values(array, at, values):
    """Return the array with values set at an index.

    Concrete arrays are set with numpy: JAX compiles a program for every eager operation.
    """
    if not is_concrete(array, values):
        return jnp.asarray(array).at[at].set(values)
    out = np.array(array)
    out[at] = values
    return out


def _full_vector(chain: Chain, quantity: str, value, default):
    """Return the full vector of a user's array or dict, and the mask of scalar coordinates and
    velocities that the dict names.

    quantity: "q" or "v".
    default: values of the coordinates that the user does not give.
    """
    top = chain.topology
    tree_size, widths, start, model_entries = (
        (top.nq, Q_SIZE, top.q_start, top.model_q)
        if quantity == "q"
        else (top.nv, V_SIZE, top.v_start, top.model_v)
    )
    named = np.zeros(len(default), bool)
    if value is None:
        return default, named
    if isinstance(value, dict):
        out = default
        for name, number in value.items():
            at = joint_slice(chain, name, widths, start)
            number = finite_array(f"{quantity}[{name!r}]", number, default.dtype)
            if number.size != at.stop - at.start:
                raise ValueError(
                    f"{quantity}[{name!r}]: got {number.size} numbers, the joint has"
                    f" {at.stop - at.start}"
                )
            out = _set_values(out, at, number.reshape(-1))
            if quantity == "v" or at.stop - at.start == 1:
                named[at] = True
        return out, named
    value = finite_array(quantity, value, default.dtype)
    if top.cuttable_joints and value.shape == (len(model_entries),):
        # the size in the model itself, in which no joint is cut
        return _set_values(default, np.array(model_entries, int), value), named
    if value.shape == (tree_size,):
        return _set_values(default, slice(tree_size), value), named
    if value.shape != default.shape:
        raise ValueError(
            f"{quantity}: got shape {value.shape}, expected ({tree_size},) for the tree or"
            f" {default.shape} for every coordinate"
        )
    return value, named


def _check_quaternions(chain: Chain, q):
    """Raise ValueError if a quaternion of a concrete q deviates from unit length by more than 1e-3.

    Smaller deviations are round-off, which normalising removes.
    """
    first, _ = chain.topology.quaternion_starts
    if not is_concrete(q) or not len(first):
        return
    norms = np.linalg.norm(np.asarray(q)[first[:, None] + np.arange(4)], axis=1)
    if np.any(np.abs(norms - 1) > 1e-3):
        i = int(np.argmax(np.abs(norms - 1)))
        raise ValueError(
            f"q: the quaternion at q[{first[i]}:{first[i] + 4}] has norm {norms[i]:.6g}, expected 1"
        )


def _place_cuttable_bodies(chain: Chain, structure: Structure, q, v, links_to_place):
    """Return q and v with the bodies of cuttable joints placed by the coordinates of these joints.

    Coordinates and velocities of all other bodies stay unchanged.
    links_to_place: mask of the virtual links that replace the cuttable joints.
    """
    top = chain.topology
    movable = np.zeros(top.dofs, bool)
    for row in top.link_child:
        if row >= 0:
            movable[top.v_start[row] : top.v_start[row] + 6] = True
    max_rank = jnp.asarray(min(6 * len(links_to_place), top.dofs), jnp.int32)
    placing_structure = eqx.tree_at(
        lambda s: (s.connected, s.rank), structure, (structure.connected & links_to_place, max_rank)
    )
    solution = solve_structure(
        chain,
        placing_structure,
        q,
        v,
        HeldCoordinates(jnp.asarray(~movable), jnp.asarray(~movable)),
        _PLACE_SCHEDULE,
    )
    return solution.q, jnp.where(active_dofs(chain, placing_structure), solution.v, v)


@functools.partial(eager_jit, jit=eqx.filter_jit)
def _close_and_project(
    chain: Chain, structure: Structure, q, v, held: HeldCoordinates, q_is_complete: bool
) -> tuple[State, Float[Array, " links"]]:
    """Return the state with its loops closed, and the residual gap of each loop (rad, or in
    `chain.length`s).

    The first Newton steps hold the coordinates that the user named; further steps change all
    coordinates, for loops that the first steps could not close. Velocities are projected likewise.

    q_is_complete: whether q gives the poses of all bodies. Otherwise the bodies of cuttable joints
        are placed by the coordinates of these joints first.
    """
    links_to_place = (np.array(chain.topology.link_child, int) >= 0) & (not q_is_complete)
    if links_to_place.any():
        q, v = _place_cuttable_bodies(chain, structure, q, v, links_to_place)
    held = dataclasses.replace(held, read_links=jnp.asarray(~links_to_place) | ~structure.connected)
    solution = solve_structure(chain, structure, q, v, held, _ASSEMBLE_SCHEDULE)
    return (
        State(
            solution.q,
            solution.v,
            eqx.tree_at(lambda s: (s.rank, s.margin), structure, (solution.rank, solution.margin)),
        ),
        solution.residual_gaps,
    )


def assemble(chain: Chain, q, v, connected) -> State:
    """Return a consistent state; see `Chain.state`."""
    top = chain.topology
    structure = eqx.tree_at(
        lambda s: s.connected, chain.structure, jnp.asarray(connection_mask(chain, connected))
    )
    user_q = q
    float64_inputs = [
        name
        for name, x in (("q", q), ("v", v))
        if isinstance(x, np.ndarray) and x.dtype == np.float64
    ]
    if float64_inputs and chain.q_load.dtype == np.float32:
        warnings.warn(
            f"state: {' and '.join(float64_inputs)} in float64, kept in float32: jax_enable_x64 was"
            " off when the chain was loaded",
            stacklevel=3,
        )
    q, held_q = _full_vector(chain, "q", q, chain.q_load)
    v, held_v = _full_vector(chain, "v", v, np.zeros(top.dofs, chain.q_load.dtype))
    q, v = jnp.asarray(q), jnp.asarray(v)
    _check_quaternions(chain, q)
    if not len(top.link_names):
        return State(normalize(chain, q), v, structure)
    # True for every chain without cuttable joints, so that one program serves all inputs
    q_is_complete = max(top.link_child, default=-1) < 0 or (
        user_q is not None
        and not isinstance(user_q, dict)
        and np.shape(user_q) != (len(top.model_q),)
    )
    held = HeldCoordinates(jnp.asarray(_q_mask_to_dofs(chain, held_q)), jnp.asarray(held_v))
    return check_closed(chain, *_close_and_project(chain, structure, q, v, held, q_is_complete))


def _q_mask_to_dofs(chain: Chain, held_q: np.ndarray) -> np.ndarray:
    """Return the mask over v of the joints that a mask over q selects; joints of one freedom
    only."""
    held = np.zeros(chain.dofs, bool)
    scalar_q, scalar_v = chain.topology.scalar_coordinates
    held[scalar_v] = held_q[scalar_q]
    return held


def check_closed(chain: Chain, state: State, residual_gaps: Float[Array, " links"]) -> State:
    """Return the state.

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
