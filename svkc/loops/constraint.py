"""Where the two ends of every virtual link are, how far apart, and how they move: the loop Jacobian
J_C (paper (9)-(11)).

Rows of a loop: three angular, then three linear, the motion of the virtual link less that of its
real link, in world axes at the real link's end of the joint.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc._jax.static_gather import static_take
from svkc.model.chain import Chain, State, Structure, active_dofs
from svkc.model.checked_jit import checked_jit
from svkc.model.topology import FREE, SLIDE, Topology
from svkc.tree.kinematics import Kinematics, bias_accelerations, kinematics
from svkc.tree.spatial import (
    matvec,
    motion_cross,
    quat_conjugate,
    quat_from_axis_angle,
    quat_log,
    quat_matrix,
    quat_multiply,
    quat_normalize,
    quat_rotate,
    shift_motion,
)


class LoopFrames(eqx.Module):
    """Both ends of each virtual link. `base`: the joint's frame in the parent, `virtual`: the
    virtual link, `real`: its real link's end.

    Places are relative to `real`'s root (`parent_root`, `real_root`: that and the parent's root,
    from which twists are given).
    """

    base_quat: Float[Array, "links 4"]
    virtual_quat: Float[Array, "links 4"]
    virtual_position: Float[Array, "links 3"]
    real_quat: Float[Array, "links 4"]
    real_position: Float[Array, "links 3"]
    from_parent_root: Float[Array, "links 3"]
    axes: Float[Array, "links 6 3"]


def _virtual_joint_coordinates(chain: Chain, q: Float[Array, " q"]):
    """Turns [L 3], slides [L 3] and quaternions [L 4] of the virtual joints."""
    table, end = chain.topology.links, chain.topology.nq_all
    quat = static_take(q, np.minimum(table.quat, end)) + (table.quat > end).astype(q.dtype)
    return static_take(q, table.angle), static_take(q, table.slide), quat_normalize(quat)


def _virtual_joint_rotations(
    top: Topology, angle: Float[Array, "links 3"], ball: Float[Array, "links 4"]
):
    """Rotation of each virtual joint and the axes of its three turns, all in the joint's frame;
    only what some joint of the scene has is computed.

    Turns in sequence about x, then y, then z, each axis carried by the turns before it; a ball's
    axes are those of the virtual link.
    """
    eye = jnp.eye(3, dtype=angle.dtype)
    freedoms = np.array(top.link_freedoms, bool).reshape(-1, 6)[:, :3]
    is_ball = np.all(freedoms, axis=1)
    turn, axes = None, []
    for k in range(3):
        axis = jnp.broadcast_to(eye[k], (len(is_ball), 3))
        axes.append(axis if turn is None else quat_rotate(turn, axis))
        if np.any(freedoms[~is_ball, k]):
            this = quat_from_axis_angle(eye[k : k + 1], angle[:, k])
            turn = this if turn is None else quat_multiply(turn, this)
    axes = jnp.stack(axes, 1)
    if is_ball.any():
        of_ball = jnp.swapaxes(quat_matrix(ball), -1, -2)
        axes = jnp.where(is_ball[:, None, None], of_ball, axes)
        # one that is not a ball holds the identity here
        turn = ball if turn is None else quat_multiply(ball, turn)
    return turn, axes


@jax.jit
def loop_frames(
    chain: Chain, structure: Structure, kin: Kinematics, q: Float[Array, " q"]
) -> LoopFrames:
    """Frames of both ends of every virtual link, the joint's own turn and slide included.

    A joint slides along its parent's axes, then turns: about x, then y, then z (universal: x, y),
    or by a quaternion (ball).
    """
    top = chain.topology
    angle, slide, ball = _virtual_joint_coordinates(chain, q)
    p, r = structure.parent, structure.real
    of_parent, of_real = kin.quat[p], kin.quat[r]
    base_quat = quat_normalize(quat_multiply(of_parent, structure.quat))
    base = quat_matrix(base_quat)
    turn, turning = _virtual_joint_rotations(top, angle, ball)
    axes = jnp.sum(base[:, None] * turning[:, :, None], -1)
    from_parent_root = kin.r[p] + quat_rotate(of_parent, structure.pos)
    if np.any(np.array(top.link_freedoms, bool).reshape(-1, 6)[:, 3:]):
        from_parent_root = from_parent_root + matvec(base, slide)
    return LoopFrames(
        base_quat=base_quat,
        virtual_quat=base_quat if turn is None else quat_multiply(base_quat, turn),
        virtual_position=from_parent_root + (kin.root_position[p] - kin.root_position[r]),
        real_quat=quat_normalize(quat_multiply(of_real, structure.real_quat)),
        real_position=kin.r[r] + quat_rotate(of_real, structure.real_pos),
        from_parent_root=from_parent_root,
        axes=jnp.concatenate([axes, jnp.swapaxes(base, -1, -2)], 1),
    )


def frame_gaps(structure: Structure, end: LoopFrames) -> Float[Array, "links 6"]:
    """Rotation vector (rad) and distance (m) from the real link's end to the virtual link, world
    axes; zero where not connected."""
    turn = quat_log(quat_multiply(end.virtual_quat, quat_conjugate(end.real_quat)))
    gaps = jnp.concatenate([turn, end.virtual_position - end.real_position], -1)
    return jnp.where(structure.connected[:, None], gaps, 0)


def _virtual_motion_subspaces(
    chain: Chain, structure: Structure, end: LoopFrames
) -> Float[Array, "links 6 6"]:
    """Motion of the virtual link for a unit of each of its six freedoms, at its own origin; zero
    for those it has not."""
    zero = jnp.zeros_like(end.axes[:, :3])
    turns = jnp.concatenate([end.axes[:, :3], zero], -1)
    slides = jnp.concatenate([zero, end.axes[:, 3:]], -1)
    S = jnp.concatenate([turns, slides], 1)
    return jnp.where((structure.connected[:, None] & structure.freedoms)[:, :, None], S, 0)


def assemble_loop_jacobian(
    chain: Chain, structure: Structure, kin: Kinematics, end: LoopFrames
) -> Float[Array, "rows dofs"]:
    """J_C (paper (11)): six rows a virtual link, zero where not connected; columns of coordinates
    that cannot move are zero."""
    top = chain.topology
    above = jnp.asarray(top.ancestor_mask[:, top.dof_row])
    sign = above[structure.parent].astype(kin.r.dtype) - above[structure.real].astype(kin.r.dtype)
    # the joint's place as seen from the root of each coordinate's tree
    of_parent = above[structure.parent][:, :, None]
    place = jnp.where(of_parent, end.from_parent_root[:, None, :], end.real_position[:, None, :])
    tree = sign[:, :, None] * shift_motion(kin.S[None], place)
    own = _virtual_motion_subspaces(chain, structure, end)
    count = len(top.link_names)
    # of each link and coordinate the row in `own`, which is followed by zeros
    source = np.full((count, top.dofs + 1), 6 * count)
    np.put_along_axis(source, top.links.dof, np.arange(6 * count).reshape(-1, 6), 1)
    virtual = static_take(own.reshape(-1, 6), source[:, top.nv : top.dofs])
    J = jnp.concatenate([tree, virtual], 1)
    moving = structure.connected[:, None, None] & active_dofs(chain, structure)[None, :, None]
    J = jnp.where(moving, J, 0)
    return jnp.swapaxes(J, 1, 2).reshape(-1, top.dofs)


def loop_jacobian_dot_v(
    chain: Chain,
    structure: Structure,
    end: LoopFrames,
    v: Float[Array, " dofs"],
    *,
    V: Float[Array, "rows 6"],
    A: Float[Array, "rows 6"],
) -> Float[Array, " loop_rows"]:
    """Jdot_C v (paper (21)): the difference of the two ends' velocity-product accelerations. V,
    A: twists and, with vdot = 0, accelerations of the tree."""
    top = chain.topology
    rate = jnp.where(
        structure.connected[:, None] & structure.freedoms, static_take(v, top.links.dof), 0
    )
    parts = _virtual_motion_subspaces(chain, structure, end) * rate[:, :, None]
    slide = jnp.sum(parts[:, 3:], 1)
    V_parent = shift_motion(V[structure.parent], end.from_parent_root)
    V_base = V_parent + slide
    bias = motion_cross(V_parent, slide) + motion_cross(V_base, jnp.sum(parts[:, :3], 1))
    # turns in sequence carry one another; a ball's axes turn together and add nothing
    is_ball = np.array([sum(f[:3]) == 3 for f in top.link_freedoms], bool)[:, None]
    x, y, z = parts[:, 0], parts[:, 1], parts[:, 2]
    carried = motion_cross(x, y + z) + motion_cross(y, z)
    bias = bias + jnp.where(is_ball, 0, carried)
    A_virtual = shift_motion(A[structure.parent], end.from_parent_root) + bias
    A_real = shift_motion(A[structure.real], end.real_position)
    return jnp.where(structure.connected[:, None], A_virtual - A_real, 0).reshape(-1)


def jacobian_scales(chain: Chain) -> tuple[Float[Array, " rows"], Float[Array, " dofs"]]:
    """Factors of the rows and columns of J_C that leave numbers without units: 1/length for linear
    rows, length for slides."""
    top = chain.topology
    rows = jnp.tile(jnp.where(np.arange(6) < 3, 1, 1 / chain.length), len(top.link_names))
    linear = np.zeros(top.dofs, bool)
    linear[: top.nv] = np.array(top.kind)[top.dof_row] == SLIDE
    for i in top.rows_of_kind(FREE):
        linear[top.v_start[i] : top.v_start[i] + 3] = True
    slides = top.links.dof[:, 3:]
    linear[slides[slides < top.dofs]] = True
    return rows, jnp.where(linear, chain.length, 1)


class LoopKinematics(eqx.Module):
    """Kinematics of the tree and of its loops at one configuration.

    kin: the tree's. frames: both ends of each virtual link. J: J_C without units, its rows and
    columns multiplied by `scales`. row_scale: the factors of the rows.
    """

    kin: Kinematics
    frames: LoopFrames
    J: Float[Array, "rows dofs"]
    structure: Structure
    row_scale: Float[Array, " rows"]

    # a property, as most programs have no use for it: XLA would remove it, but only after it was
    # traced and lowered
    @property
    def gap(self) -> Float[Array, " rows"]:
        """Return `gap` of each link without units, row by row."""
        return self.row_scale * frame_gaps(self.structure, self.frames).ravel()


def loop_kinematics(chain: Chain, structure: Structure, q: Float[Array, " q"]) -> LoopKinematics:
    """Return the kinematics of the tree and of its loops at q."""
    kin = kinematics(chain, q)
    end = loop_frames(chain, structure, kin, q)
    row, column = jacobian_scales(chain)
    J = row[:, None] * assemble_loop_jacobian(chain, structure, kin, end) * column[None]
    return LoopKinematics(kin=kin, frames=end, J=J, structure=structure, row_scale=row)


def constraint_bias(
    chain: Chain, structure: Structure, v, loops: LoopKinematics, V, baumgarte=None
) -> Float[Array, " rows"]:
    """Return Jdot_C v without units. baumgarte: rate (1/s) at which gaps are pulled back."""
    row, column = jacobian_scales(chain)
    moving = jnp.where(active_dofs(chain, structure), v, 0)
    A = bias_accelerations(chain, loops.kin, V, v)
    bias = row * loop_jacobian_dot_v(chain, structure, loops.frames, moving, V=V, A=A)
    if baumgarte is not None:
        gaps = frame_gaps(structure, loops.frames).ravel()
        bias = bias + 2 * baumgarte * (loops.J @ (moving / column)) + baumgarte**2 * row * gaps
    return bias


def gaps_and_rates(
    chain: Chain, state: State
) -> tuple[Float[Array, "links 6"], Float[Array, "links 6"]]:
    """`loop_gaps` and `velocity_gaps` from one pass over the tree."""
    kin = kinematics(chain, state.q)
    end = loop_frames(chain, state.structure, kin, state.q)
    rates = assemble_loop_jacobian(chain, state.structure, kin, end) @ state.v
    return frame_gaps(state.structure, end), rates.reshape(-1, 6)


def gap_norms(rows: Float[Array, " rows"]) -> Float[Array, "links 2"]:
    """Of each loop's rows: how long its rotation vector is, and how long the distance."""
    return jnp.sqrt(jnp.sum(rows.reshape(-1, 2, 3) ** 2, -1))


def largest_norms(x: Float[Array, "links 6"]) -> Float[Array, "2"]:
    """Return the largest angular and the largest linear part over the loops."""
    if not len(x):
        return jnp.zeros(2, x.dtype)
    square = jnp.sum(x.reshape(-1, 2, 3) ** 2, -1)
    closed = square == 0
    # a root that can be differentiated where the loop is closed to the last bit
    return jnp.max(jnp.where(closed, 0, jnp.sqrt(jnp.where(closed, 1, square))), 0)


def largest_gaps(chain: Chain, state: State) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
    """The largest over the loops: of the gaps (rad, m) and of their rates (rad/s, m/s)."""
    gaps, rates = gaps_and_rates(chain, state)
    return largest_norms(gaps), largest_norms(rates)


@checked_jit(eager=True)
def loop_gaps(chain: Chain, state: State) -> Float[Array, "links 6"]:
    """How far each connected loop is open: rotation vector (rad), then distance (m), in the world;
    zero where not connected."""
    return gaps_and_rates(chain, state)[0]


@checked_jit(eager=True)
def loop_jacobian(
    chain: Chain, state: State
) -> tuple[Float[Array, "links 3 dofs"], Float[Array, "links 3 dofs"]]:
    """J_C (paper (11)): linear (m/s) and angular (rad/s) velocity of each connected virtual link
    relative to its real link, for a unit rate of each joint coordinate, at the joint, in world
    axes."""
    kin = kinematics(chain, state.q)
    end = loop_frames(chain, state.structure, kin, state.q)
    J = assemble_loop_jacobian(chain, state.structure, kin, end).reshape(-1, 6, chain.dofs)
    return J[:, 3:], J[:, :3]


@checked_jit(eager=True)
def loop_gap_rates(chain: Chain, state: State) -> Float[Array, "links 6"]:
    """J_C v: relative twist (rad/s, m/s) across each connected virtual link."""
    return gaps_and_rates(chain, state)[1]


def gap_tolerance(dtype) -> float:
    """Largest loop gap, over `chain.length` where it is in metres, that counts as closed:
    eps^(4/7), 1.1e-9 in float64, 1.1e-4 in float32."""
    return float(np.finfo(dtype).eps ** (4 / 7))
