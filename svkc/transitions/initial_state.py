"""A consistent state from what the user knows of it: names to numbers, loops closed, velocities
made to agree."""

import dataclasses
import functools
import warnings

import equinox as eqx
import jax
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
from svkc.transitions.newton import (
    CLOSE,
    CLOSE_HELD,
    PROJECT_VELOCITY,
    PROJECT_VELOCITY_HELD,
    RANK_SEARCH,
    READ_COORDINATES,
    HeldCoordinates,
    Schedule,
    solve_structure,
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
    """Return the array with values at an index; on the host where nothing is traced, as each
    operation that jax is given eagerly is a program of its own."""
    if not is_concrete(array, values):
        return jnp.asarray(array).at[at].set(values)
    out = np.array(array)
    out[at] = values
    return out


def _full_vector(chain: Chain, quantity: str, value, default):
    """Return the full vector of a user's array or dict for `what`, q or v, and which coordinates
    the dict named."""
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
    if top.cut_joints and value.shape == (len(model_entries),):
        # as for the plain tree
        return _set_values(default, np.array(model_entries, int), value), named
    if value.shape == (tree_size,):
        return _set_values(default, slice(tree_size), value), named
    if value.shape != default.shape:
        raise ValueError(
            f"{quantity}: got shape {value.shape}, expected ({tree_size},) for the tree or {default.shape}"
            " for every coordinate"
        )
    return value, named


def _check_quaternions(chain: Chain, q):
    """Unit quaternions where that can be seen: to a thousandth, beyond which a normalised one would
    be a guess."""
    first, _ = chain.topology.quaternion_starts
    if isinstance(q, jax.core.Tracer) or not len(first):
        return
    norms = np.linalg.norm(np.asarray(q)[first[:, None] + np.arange(4)], axis=1)
    if np.any(np.abs(norms - 1) > 1e-3):
        i = int(np.argmax(np.abs(norms - 1)))
        raise ValueError(
            f"q: the quaternion at q[{first[i]}:{first[i] + 4}] has norm {norms[i]:.6g}, expected 1"
        )


def _place_cuttable_bodies(chain: Chain, structure: Structure, q, v, links_to_place):
    """Bodies that may be cut, put where the joints that hold them say, in position and velocity,
    all else as it is."""
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
    """Return the state with its loops closed, and how far each loop is still open (rad, or
    `chain.length`s).

    Named coordinates are held at first; what that leaves open is closed with all of them free. The
    same goes for velocities.
    whole: q says where every body is; else those that may be cut are put where their joint's
    coordinates say.
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
    """See `Chain.state`."""
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
            f"state: {' and '.join(float64_inputs)} in float64, kept in float32: jax_enable_x64 was off when"
            " the chain was loaded",
            stacklevel=3,
        )
    q, held_q = _full_vector(chain, "q", q, chain.q_load)
    v, held_v = _full_vector(chain, "v", v, np.zeros(top.dofs, chain.q_load.dtype))
    q, v = jnp.asarray(q), jnp.asarray(v)
    _check_quaternions(chain, q)
    if not len(top.link_names):
        return State(normalize(chain, q), v, structure)
    # (where no joint can be cut it is all the same, and one program)
    q_is_complete = max(top.link_child, default=-1) < 0 or (
        user_q is not None
        and not isinstance(user_q, dict)
        and np.shape(user_q) != (len(top.model_q),)
    )
    held = HeldCoordinates(jnp.asarray(_q_mask_to_dofs(chain, held_q)), jnp.asarray(held_v))
    return check_closed(chain, *_close_and_project(chain, structure, q, v, held, q_is_complete))


def _q_mask_to_dofs(chain: Chain, held_q: np.ndarray) -> np.ndarray:
    """Held entries of q (one number a joint) as entries of v."""
    held = np.zeros(chain.dofs, bool)
    scalar_q, scalar_v = chain.topology.scalar_coordinates
    held[scalar_v] = held_q[scalar_q]
    return held


def check_closed(chain: Chain, state: State, residual_gaps: Float[Array, " links"]) -> State:
    """The state; ValueError (or an error raised at run time, under jit) where a loop is open,
    saying which and by how much. worst: of each loop's gaps."""
    limit = gap_tolerance(state.q.dtype)
    if not is_concrete(residual_gaps, state):
        return eqx.error_if(
            state,
            ~(jnp.max(residual_gaps) < limit),
            "the loops of the initial state cannot be closed",
        )
    residual_gaps = np.asarray(residual_gaps)
    if not np.all(residual_gaps < limit):
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
