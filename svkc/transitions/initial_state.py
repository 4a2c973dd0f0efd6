"""F4: a consistent state from what the user knows of it: names to numbers, loops closed, velocities made to agree."""

import functools
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc._jax.eager import eager_jit
from svkc.loops.constraint import active_dofs
from svkc.loops.coordinates import loop_gaps
from svkc.model.chain import Chain, State, Structure
from svkc.model.checked_jit import check_state
from svkc.model.topology import Q_SIZE, V_SIZE
from svkc.model.validation import arrayed, concrete, finite
from svkc.transitions.newton import CLOSE, CLOSE_HELD, RANK, READ, VELOCITY, VELOCITY_HELD, Held, Schedule, solve_structure
from svkc.tree.kinematics import normalize

_NEWTON = 30
_CLOSING, _PROJECTING = (*(CLOSE_HELD,) * _NEWTON, *(CLOSE,) * _NEWTON), (VELOCITY_HELD, VELOCITY)
_PLACE, _ASSEMBLE = Schedule((*_CLOSING, *_PROJECTING)), Schedule((READ, *_CLOSING, *RANK, *_PROJECTING))


def gap_tolerance(dtype) -> float:
    """Largest loop gap, over `chain.length` where it is in metres, that counts as closed: eps^(4/7), 1.1e-9 in float64, 1.1e-4 in float32."""
    return float(np.finfo(dtype).eps ** (4 / 7))


def connection_mask(chain: Chain, connected) -> np.ndarray | jax.Array:
    """[links] Boolean from names, a mask, or None (as the model says)."""
    if connected is None:
        return chain.structure.connected
    names = (connected,) if isinstance(connected, str) else connected
    if isinstance(names, (tuple, list, set, frozenset)) and all(isinstance(n, str) for n in names):
        return np.isin(chain.link_names, [chain.link_names[link_index(chain, n)] for n in names])
    mask = arrayed(connected)
    if mask.shape != (len(chain.link_names),) or mask.dtype != bool:
        raise ValueError(f"connected: expected names of virtual links or {len(chain.link_names)} Booleans, got {mask.dtype} of shape {mask.shape}")
    return mask


def link_index(chain: Chain, name: str) -> int:
    """The slot of a virtual link; ValueError naming those there are."""
    if not isinstance(name, str) or name not in chain.link_names:
        raise ValueError(f"no virtual link {name!r}; virtual links: {', '.join(chain.link_names) or 'none'}")
    return chain.link_names.index(name)


def joint_slice(chain: Chain, name: str, sizes, start) -> slice:
    """Where a joint of the tree, or one that may be cut, stands in q (sizes=Q_SIZE) or v; ValueError naming those there are."""
    top = chain.topology
    for joint, link, freedom in top.cut_joints:
        if joint == name:
            ball = sum(top.link_freedoms[link][:3]) == 3
            if sizes is V_SIZE:
                first = top.links.dof[link, freedom]
                return slice(int(first), int(first) + (3 if ball else 1))
            first = top.links.quat[link, 0] if ball else np.concatenate([top.links.angle, top.links.slide], 1)[link, freedom]
            return slice(int(first), int(first) + (4 if ball else 1))
    if not isinstance(name, str) or name not in top.joint_names:
        raise ValueError(f"no joint {name!r}; joints: {', '.join(top.joint_names)}")
    row = top.joint_row[top.joint_names.index(name)]
    return slice(start[row], start[row] + sizes[top.kind[row]])


def prefer(chain: Chain, state: State, *names: str) -> State:
    """The state with these joint coordinates asked to be independent (theta_G), as far as the loops let them be; no names: the choice is svkc's again.

    names: of joints, virtual links, or single coordinates (`chain.dof_names`). The motion does not depend on it. ValueError: unknown names.
    """
    check_state(chain, state)
    asked = np.zeros(chain.dofs, bool)
    for name in names:
        here = np.array([isinstance(name, str) and name in (n, n.rpartition(".")[0] or n) for n in chain.dof_names])
        if not here.any():
            raise ValueError(f"no joint coordinate {name!r}; coordinates: {', '.join(chain.dof_names)}")
        asked |= here
    wanted = jnp.asarray(asked) if names else None
    return eqx.tree_at(lambda s: s.structure.independent, state, wanted, is_leaf=lambda x: x is None)


def _put(array, at, values):
    """Return the array with values at an index; on the host where nothing is traced, as each operation that jax is given eagerly is a program of its own."""
    if not concrete(array, values):
        return jnp.asarray(array).at[at].set(values)
    out = np.array(array)
    out[at] = values
    return out


def _filled(chain: Chain, what: str, value, default, tree: int, sizes, start):
    """The full vector of a user's array or dict, and which coordinates the dict named."""
    named = np.zeros(len(default), bool)
    if value is None:
        return default, named
    if isinstance(value, dict):
        out = default
        for name, number in value.items():
            at = joint_slice(chain, name, sizes, start)
            number = finite(f"{what}[{name!r}]", number, default.dtype)
            if number.size != at.stop - at.start:
                raise ValueError(f"{what}[{name!r}]: got {number.size} numbers, the joint has {at.stop - at.start}")
            out = _put(out, at, number.reshape(-1))
            if what == "v" or at.stop - at.start == 1:
                named[at] = True
        return out, named
    value = finite(what, value, default.dtype)
    of_model = np.array(chain.topology.model_q if what == "q" else chain.topology.model_v, int)
    if chain.topology.cut_joints and value.shape == of_model.shape:
        # as for the plain tree
        return _put(default, of_model, value), named
    if value.shape == (tree,):
        return _put(default, slice(tree), value), named
    if value.shape != default.shape:
        raise ValueError(f"{what}: got shape {value.shape}, expected ({tree},) for the tree or {default.shape} for every coordinate")
    return value, named


def _check_quaternions(chain: Chain, q):
    """Unit quaternions where that can be seen: to a thousandth, beyond which a normalised one would be a guess."""
    first, _ = chain.topology.quaternions
    if isinstance(q, jax.core.Tracer) or not len(first):
        return
    norms = np.linalg.norm(np.asarray(q)[first[:, None] + np.arange(4)], axis=1)
    if np.any(np.abs(norms - 1) > 1e-3):
        i = int(np.argmax(np.abs(norms - 1)))
        raise ValueError(f"q: the quaternion at q[{first[i]}:{first[i] + 4}] has norm {norms[i]:.6g}, expected 1")


def _carried(chain: Chain, structure: Structure, q, v, placed):
    """Bodies that may be cut, put where the joints that hold them say, in position and velocity, all else as it is."""
    top = chain.topology
    carried = np.zeros(top.dofs, bool)
    for row in top.link_child:
        if row >= 0:
            carried[top.v_start[row] : top.v_start[row] + 6] = True
    every = jnp.asarray(min(6 * len(placed), top.dofs), jnp.int32)
    only = eqx.tree_at(lambda s: (s.connected, s.rank), structure, (structure.connected & placed, every))
    found = solve_structure(chain, only, q, v, Held(jnp.asarray(~carried), jnp.asarray(~carried)), _PLACE)
    return found.q, jnp.where(active_dofs(chain, only), found.v, v)


@functools.partial(eager_jit, jit=eqx.filter_jit)
def _close_and_agree(chain: Chain, structure: Structure, q, v, held_q, held_v, whole: bool) -> tuple[State, Float[Array, " links"]]:
    """Return the state with its loops closed, and how far each loop is still open (rad, or `chain.length`s).

    Named coordinates are held at first; what that leaves open is closed with all of them free. The same goes for velocities.
    whole: q says where every body is; else those that may be cut are put where their joint's coordinates say.
    """
    placed = (np.array(chain.topology.link_child, int) >= 0) & (not whole)
    if placed.any():
        q, v = _carried(chain, structure, q, v, placed)
    held = Held(held_q, held_v, jnp.asarray(~placed) | ~structure.connected)
    found = solve_structure(chain, structure, q, v, held, _ASSEMBLE)
    return State(found.q, found.v, eqx.tree_at(lambda s: (s.rank, s.margin), structure, (found.rank, found.margin))), found.left


def assemble(chain: Chain, q, v, connected) -> State:
    """See `Chain.state`."""
    top = chain.topology
    structure = eqx.tree_at(lambda s: s.connected, chain.structure, jnp.asarray(connection_mask(chain, connected)))
    given = q
    wide = [name for name, x in (("q", q), ("v", v)) if isinstance(x, np.ndarray) and x.dtype == np.float64]
    if wide and chain.q_load.dtype == np.float32:
        warnings.warn(f"state: {' and '.join(wide)} in float64, kept in float32: jax_enable_x64 was off when the chain was loaded", stacklevel=3)
    q, held_q = _filled(chain, "q", q, chain.q_load, top.nq, Q_SIZE, top.q_start)
    v, held_v = _filled(chain, "v", v, np.zeros(top.dofs, chain.q_load.dtype), top.nv, V_SIZE, top.v_start)
    q, v = jnp.asarray(q), jnp.asarray(v)
    _check_quaternions(chain, q)
    if not len(top.link_names):
        return State(normalize(chain, q), v, structure)
    # (where no joint can be cut it is all the same, and one program)
    whole = max(top.link_child, default=-1) < 0 or (given is not None and not isinstance(given, dict) and np.shape(given) != (len(top.model_q),))
    return check_closed(chain, *_close_and_agree(chain, structure, q, v, jnp.asarray(_as_dofs(chain, held_q)), jnp.asarray(held_v), whole))


def _as_dofs(chain: Chain, held_q: np.ndarray) -> np.ndarray:
    """Held entries of q (one number a joint) as entries of v."""
    held = np.zeros(chain.dofs, bool)
    scalar_q, scalar_v = chain.topology.scalars
    held[scalar_v] = held_q[scalar_q]
    return held


def check_closed(chain: Chain, state: State, worst: Float[Array, " links"]) -> State:
    """The state; ValueError (or an error raised at run time, under jit) where a loop is open, saying which and by how much. worst: of each loop's gaps."""
    limit = gap_tolerance(state.q.dtype)
    if not concrete(worst, state):
        return eqx.error_if(state, ~(jnp.max(worst) < limit), "the loops of the initial state cannot be closed")
    worst = np.asarray(worst)
    if not np.all(worst < limit):
        gaps = np.asarray(loop_gaps(chain, state))
        open_ = [
            f"{chain.link_names[i]} by {np.linalg.norm(gaps[i, 3:]):.3g} m and {np.linalg.norm(gaps[i, :3]):.3g} rad" for i in np.flatnonzero(~(worst < limit))
        ]
        raise ValueError(f"the loops cannot be closed from this configuration: {'; '.join(open_)}. Give a q nearer to a closed one.")
    return state
