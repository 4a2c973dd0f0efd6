"""The loop constraints: loop Jacobian J_C, its bias Jdot_C v, gaps and their rates.

Each loop has six rows (paper (9)-(11)), three angular, then three linear: the motion of the virtual
link relative to its real link, in world axes, each link at its own end of the joint.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc._jax.dynamic_gather import take_rows
from svkc._jax.pytrees import only_leaves
from svkc._jax.select import where
from svkc._jax.static_gather import static_take
from svkc.loops.frames import LoopFrames, frame_gaps, loop_frames
from svkc.model.annotations import DType, Scalar
from svkc.model.chain import Chain, State, Structure, active_dofs
from svkc.model.checked_jit import checked_jit
from svkc.model.topology import FREE, SLIDE
from svkc.tree.bodies import Jacobian
from svkc.tree.kinematics import Kinematics, bias_accelerations, kinematics
from svkc.tree.spatial import angular_linear, cross, motion_cross, shift_motion


def _virtual_motion_subspaces(
    chain: Chain, structure: Structure, frames: LoopFrames
) -> Float[Array, "links 6 6"]:
    """Return each virtual joint's motion subspace about the virtual link's origin.

    Freedoms that the joint does not have, and those of links not connected, are zero.
    """
    zero = jnp.zeros_like(frames.axes[:, :3])
    rotations = jnp.concatenate([frames.axes[:, :3], zero], -1)
    slides = jnp.concatenate([zero, frames.axes[:, 3:]], -1)
    S = jnp.concatenate([rotations, slides], 1)
    return where((structure.connected[:, None] & structure.freedoms)[:, :, None], S, 0)


def assemble_loop_jacobian(
    chain: Chain, structure: Structure, kin: Kinematics, frames: LoopFrames
) -> Float[Array, "rows dofs"]:
    """Return J_C (paper (11)), six rows for each virtual link.

    Rows of links that are not connected, and columns of locked coordinates, are zero.
    """
    top = chain.topology
    above = jnp.asarray(top.ancestor_mask[:, top.dof_row].astype(kin.r.dtype))
    of_parent, of_real = above[structure.parent], above[structure.real]
    # One where a coordinate is above this link alone. A coordinate above both links moves them
    # together, and its column is zero.
    moves_parent, moves_real = of_parent * (1 - of_real), of_real * (1 - of_parent)
    sign = (moves_parent - moves_real)[:, :, None]
    # the parent's end, or minus the real link's end, each as its position from its root
    signed_position = (
        moves_parent[:, :, None] * frames.from_parent_root[:, None]
        - moves_real[:, :, None] * frames.real_position[:, None]
    )
    angular, linear = angular_linear(kin.S[None])
    tree = jnp.concatenate([sign * angular, sign * linear + cross(angular, signed_position)], -1)
    S = _virtual_motion_subspaces(chain, structure, frames)
    count = len(top.link_names)
    # for each link and coordinate its row in the virtual joints' motion subspaces; rows past the
    # end read as zero
    source = np.full((count, top.dofs + 1), 6 * count)
    np.put_along_axis(source, top.links.dof, np.arange(6 * count).reshape(-1, 6), 1)
    virtual = static_take(S.reshape(-1, 6), source[:, top.nv : top.dofs])
    J = jnp.concatenate([tree, virtual], 1)
    active = structure.connected[:, None, None] & active_dofs(chain, structure)[None, :, None]
    J = where(active, J, 0)
    return jnp.swapaxes(J, 1, 2).reshape(-1, top.dofs)


def loop_jacobian_dot_v(
    chain: Chain,
    structure: Structure,
    frames: LoopFrames,
    v: Float[Array, " dofs"],
    *,
    V: Float[Array, "rows 6"],
    A: Float[Array, "rows 6"],
) -> Float[Array, " loop_rows"]:
    """Return Jdot_C v (paper (21)), the relative velocity-product acceleration of the two frames.

    V: twists of the tree. A: spatial accelerations of the tree with vdot = 0.
    """
    top = chain.topology
    rate = where(
        structure.connected[:, None] & structure.freedoms, static_take(v, top.links.dof), 0
    )
    parts = _virtual_motion_subspaces(chain, structure, frames) * rate[:, :, None]
    slide = jnp.sum(parts[:, 3:], 1)
    ends = jnp.concatenate([structure.parent, structure.real])
    at_parent, at_real = jnp.split(take_rows(jnp.concatenate([V, A], 1), ends), 2)
    V_parent = shift_motion(at_parent[:, :6], frames.from_parent_root)
    V_base = V_parent + slide
    bias = motion_cross(V_parent, slide) + motion_cross(V_base, jnp.sum(parts[:, :3], 1))
    # rotations in sequence move the axes after them; a ball's axes move together and add nothing
    is_ball = np.array([sum(f[:3]) == 3 for f in top.link_freedoms], bool)[:, None]
    x, y, z = parts[:, 0], parts[:, 1], parts[:, 2]
    moved_axes = motion_cross(x, y + z) + motion_cross(y, z)
    bias = bias + where(is_ball, 0, moved_axes)
    A_virtual = shift_motion(at_parent[:, 6:], frames.from_parent_root) + bias
    A_real = shift_motion(at_real[:, 6:], frames.real_position)
    return where(structure.connected[:, None], A_virtual - A_real, 0).reshape(-1)


def jacobian_scales(chain: Chain) -> tuple[Float[Array, " rows"], Float[Array, " dofs"]]:
    """Return the factors of J_C's rows and of its columns that make J_C dimensionless.

    They are 1 / chain.length for linear rows, chain.length for columns of slides, and 1 otherwise.
    """
    top = chain.topology
    rows = jnp.tile(where(np.arange(6) < 3, 1, 1 / chain.length), len(top.link_names))
    linear = np.zeros(top.dofs, bool)
    linear[: top.nv] = np.array(top.kind)[top.dof_row] == SLIDE
    for i in top.rows_of_kind(FREE):
        linear[top.v_start[i] : top.v_start[i] + 3] = True
    slides = top.links.dof[:, 3:]
    linear[slides[slides < top.dofs]] = True
    return rows, where(linear, chain.length, 1)


class LoopKinematics(eqx.Module):
    """Kinematics of the tree and of its loops at one configuration.

    kin: kinematics of the tree. frames: both ends of each virtual link.
    J: the scaled J_C, its rows and columns multiplied by `jacobian_scales`.
    row_scale: the factors of the rows.
    """

    kin: Kinematics
    frames: LoopFrames
    J: Float[Array, "rows dofs"]
    structure: Structure
    row_scale: Float[Array, " rows"]

    # a property, as most programs do not use it: XLA would remove a field only after tracing
    @property
    def gap(self) -> Float[Array, " rows"]:
        """Return the scaled gap of each link, row by row."""
        return self.row_scale * frame_gaps(self.structure, self.frames).ravel()


def loop_kinematics(chain: Chain, structure: Structure, q: Float[Array, " q"]) -> LoopKinematics:
    """Return the kinematics of the tree and of its loops at q."""
    kin = kinematics(chain, q)
    frames = loop_frames(chain, structure, kin, q)
    row, column = jacobian_scales(chain)
    J = row[:, None] * assemble_loop_jacobian(chain, structure, kin, frames) * column[None]
    return LoopKinematics(kin=kin, frames=frames, J=J, structure=structure, row_scale=row)


def loop_rates(
    chain: Chain, loops: LoopKinematics, v: Float[Array, " dofs"]
) -> Float[Array, " rows"]:
    """Return J_C v with scaled rows. In its derivative, J_C is not differentiated.

    v: zero where inactive, as its tangent.
    """
    return _loop_rates_with_jvp(only_leaves(chain, lambda c: c.length), loops, v)


@eqx.filter_custom_jvp
def _loop_rates_with_jvp(chain: Chain, loops: LoopKinematics, v) -> Float[Array, " rows"]:
    return loops.J @ (v / jacobian_scales(chain)[1])


@_loop_rates_with_jvp.def_jvp
def _loop_rates_jvp(primals, tangents):
    rates = _loop_rates_with_jvp(*primals)
    return rates, eqx.filter_jvp(loop_rates_by_twists, primals, tangents)[1]


def loop_rates_by_twists(
    chain: Chain, loops: LoopKinematics, v: Float[Array, " dofs"]
) -> Float[Array, " rows"]:
    """Return `loop_rates` from the twists of the links, which is cheaper to differentiate.

    v: zero where inactive, as its tangent.
    """
    top, structure, frames = chain.topology, loops.structure, loops.frames
    above = jnp.asarray(top.ancestor_mask[:, top.dof_row])
    of_parent, of_real = above[structure.parent], above[structure.real]
    moved = loops.kin.S * v[: chain.nv, None]
    # coordinates above both links cancel, as in J_C
    twist = lambda mask: jnp.sum(where(mask[:, :, None], moved[None], 0), 1)
    at_parent = shift_motion(twist(of_parent & ~of_real), frames.from_parent_root)
    at_real = shift_motion(twist(of_real & ~of_parent), frames.real_position)
    S = _virtual_motion_subspaces(chain, structure, frames)
    virtual = jnp.sum(S * static_take(v, top.links.dof)[:, :, None], 1)
    rates = where(structure.connected[:, None], at_parent + virtual - at_real, 0)
    return loops.row_scale * rates.ravel()


def constraint_bias(
    chain: Chain,
    structure: Structure,
    v: Float[Array, " dofs"],
    loops: LoopKinematics,
    V: Float[Array, "tree_rows 6"],
    baumgarte: Scalar | None = None,
) -> Float[Array, " rows"]:
    """Return Jdot_C v with scaled rows, plus Baumgarte's terms.

    V: twists of the tree. baumgarte: rate (1/s) of the gaps' decay (None: no such terms).
    """
    row = jacobian_scales(chain)[0]
    active_v = where(active_dofs(chain, structure), v, 0)
    A = bias_accelerations(chain, loops.kin, V, v)
    bias = row * loop_jacobian_dot_v(chain, structure, loops.frames, active_v, V=V, A=A)
    if baumgarte is not None:
        gaps = frame_gaps(structure, loops.frames).ravel()
        bias = bias + 2 * baumgarte * loop_rates(chain, loops, active_v) + baumgarte**2 * row * gaps
    return bias


def gaps_and_rates(
    chain: Chain, state: State
) -> tuple[Float[Array, "links 6"], Float[Array, "links 6"]]:
    """Return `loop_gaps` and `loop_gap_rates` from one pass over the tree."""
    kin = kinematics(chain, state.q)
    frames = loop_frames(chain, state.structure, kin, state.q)
    rates = assemble_loop_jacobian(chain, state.structure, kin, frames) @ state.v
    return frame_gaps(state.structure, frames), rates.reshape(-1, 6)


def gap_norms(rows: Float[Array, " rows"]) -> Float[Array, "links 2"]:
    """Return the norms of each loop's angular and linear rows."""
    return jnp.sqrt(jnp.sum(rows.reshape(-1, 2, 3) ** 2, -1))


def largest_norms(x: Float[Array, "links 6"]) -> Float[Array, "2"]:
    """Return the largest angular and the largest linear norm over the loops."""
    if not len(x):
        return jnp.zeros(2, x.dtype)
    square = jnp.sum(x.reshape(-1, 2, 3) ** 2, -1)
    closed = square == 0
    # the derivative of the square root is not finite where a gap is exactly zero
    return jnp.max(where(closed, 0, jnp.sqrt(where(closed, 1, square))), 0)


def largest_gaps(chain: Chain, state: State) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
    """Return the largest gaps over the loops (rad, m) and the largest rates (rad/s, m/s)."""
    gaps, rates = gaps_and_rates(chain, state)
    return largest_norms(gaps), largest_norms(rates)


@checked_jit(eager=True)
def loop_gaps(chain: Chain, state: State) -> Float[Array, "links 6"]:
    """Return each loop's gap: rotation vector (rad), then displacement (m), in world axes.

    The gap is that of the virtual link from its real link, and zero where not connected.
    """
    return gaps_and_rates(chain, state)[0]


@checked_jit(eager=True)
def loop_jacobian(chain: Chain, state: State) -> Jacobian:
    """Return J_C (paper (11)) as its linear and its angular rows.

    They are the linear (m/s) and the angular (rad/s) velocity of each connected virtual link
    relative to its real link, for a unit rate of each joint coordinate, at the joint, in world
    axes. Rows of links that are not connected are zero.
    """
    kin = kinematics(chain, state.q)
    frames = loop_frames(chain, state.structure, kin, state.q)
    J = assemble_loop_jacobian(chain, state.structure, kin, frames).reshape(-1, 6, chain.dofs)
    return Jacobian(linear=J[:, 3:], angular=J[:, :3])


@checked_jit(eager=True)
def loop_gap_rates(chain: Chain, state: State) -> Float[Array, "links 6"]:
    """Return J_C v, the twist of each connected virtual link relative to its real link.

    Each row is angular (rad/s), then linear (m/s), at the joint, in world axes.
    """
    return gaps_and_rates(chain, state)[1]


def gap_tolerance(dtype: DType) -> float:
    """Return the largest gap of a loop that counts as closed (rad, and m / `chain.length`).

    It is eps^(4/7): 1.1e-9 in float64, 1.1e-4 in float32.
    """
    return float(np.finfo(dtype).eps ** (4 / 7))
