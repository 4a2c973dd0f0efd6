"""Forward dynamics of any structure (paper, section III-B) and the wrenches in its loops."""

import functools
from collections.abc import Callable, Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from svkc._jax.control_flow import unvmap_any
from svkc._jax.lanes_last import with_lanes_last
from svkc._jax.one_kernel import one_kernel
from svkc._jax.select import where
from svkc.loops.constrained_dynamics import (
    AbstractDynamics,
    ArticulatedBodies,
    default_dynamics,
)
from svkc.loops.constraint import (
    LoopKinematics,
    constraint_bias,
    jacobian_scales,
    loop_kinematics,
)
from svkc.loops.constraint_rows import (
    ConstraintRows,
    RowChoice,
    constraint_rows,
    with_consistent_velocities,
)
from svkc.loops.coordinates import with_dependent_velocities
from svkc.loops.diagonal_inertia import with_armature, with_inertia
from svkc.loops.pivoting import (
    NEAR_SINGULAR,
    PivotedQR,
    pivot_blocks,
    pivot_ratio,
    rank_tolerance,
    select_pivots,
    solve_pivot_block,
)
from svkc.model.annotations import Torques
from svkc.model.chain import Chain, State, Structure, active_dofs
from svkc.model.checked_jit import checked_jit, torques_over_dofs
from svkc.model.names import unknown_name
from svkc.tree.inverse_dynamics import pad_to_dofs, passive_forces, rnea
from svkc.tree.kinematics import kinematics, twists


@functools.partial(jax.jit, static_argnames="project_velocity")
def velocity_and_acceleration(
    chain: Chain,
    structure: Structure,
    q,
    v,
    tau: Float[Array, " dofs"],
    *,
    dynamics: AbstractDynamics,
    baumgarte=None,
    project_velocity: bool = False,
    pivots=None,
    choice: RowChoice | None = None,
    added_inertia: Float[Array, " dofs"] | None = None,
) -> tuple[Float[Array, " dofs"], Float[Array, " dofs"]]:
    """Return the velocity and the acceleration (paper, section III-B, steps 1 to 5).

    The velocity is v unless `project_velocity` changes it. On an open chain nothing of the loop
    constraints is computed.

    baumgarte: rate (1/s) of the gaps' decay (None: no such terms).
    project_velocity: near a singular configuration compute the dependent velocities from the
    independent ones, as the errors of v would grow there from stage to stage of a step.
    pivots: as in `select_pivots`.
    choice: rows of the loops that articulated bodies use (None: all). Where they are reduced, the
    dependent velocities are computed from the independent ones, too.
    added_inertia: added to the diagonal of the mass matrix (None: nothing), on the coordinates of
    the tree and of cuttable joints.
    """
    if chain.topology.link_names:
        loops = loop_kinematics(chain, structure, q)
        kin = loops.kin
        selection, v = _select_rows(
            chain, structure, loops, v, dynamics=dynamics, project_velocity=project_velocity,
            pivots=pivots, choice=choice,
        )  # fmt: skip
    else:
        kin, loops = kinematics(chain, q), None
    V = twists(chain, kin, v)
    bias = rnea(chain, kin, V, v, jnp.zeros(chain.nv, v.dtype))
    force = tau + passive_forces(chain, q, v) - pad_to_dofs(chain, bias)
    if added_inertia is not None:
        chain = with_armature(chain, added_inertia[: chain.nv])
    if loops is None:
        return v, dynamics.prepare_open(chain, structure, kin)(force)
    loop_bias = constraint_bias(chain, structure, v, loops, V, baumgarte)
    solve = dynamics.prepare(chain, structure, loops, selection)
    if added_inertia is not None:
        solve = _with_cuttable_inertia(chain, solve, added_inertia)
    return v, solve(force, loop_bias)


def _select_rows(
    chain: Chain, structure: Structure, loops: LoopKinematics, v, *, dynamics: AbstractDynamics,
    project_velocity: bool, pivots, choice: RowChoice | None,
) -> tuple[Any, Float[Array, " dofs"]]:  # fmt: skip
    """Return the `selection` of `AbstractDynamics.prepare`, and v or, near a singular
    configuration, consistent velocities. The options are those of `velocity_and_acceleration`."""
    selection, J = None, loops.J
    if project_velocity or dynamics.uses_pivots:
        selection = select_pivots(structure, J, pivots)
    if project_velocity:
        assert selection is not None
        v = _projected_if_near_singular(chain, structure, selection, J, v)
    if not dynamics.uses_pivots:
        selection = constraint_rows(chain, structure, loops, choice)
        if choice is not None:
            v = _with_consistent_velocities_if(choice.near, chain, structure, loops, v, selection)
    return selection, v


def _projected_if_near_singular(
    chain: Chain, structure: Structure, qr: PivotedQR, J, v
) -> Float[Array, " dofs"]:
    """Return v, near a singular configuration with its dependent part from the independent one."""
    near = pivot_ratio(qr) < NEAR_SINGULAR * structure.margin
    active_v = where(active_dofs(chain, structure), v, 0)
    return where(near, with_dependent_velocities(chain, qr, J, active_v), v)


def _with_consistent_velocities_if(
    near: Bool[Array, ""],
    chain: Chain,
    structure: Structure,
    loops: LoopKinematics,
    v,
    rows: ConstraintRows,
) -> Float[Array, " dofs"]:
    """Return v, where `near` holds with its dependent part from the independent one."""
    active_v = where(active_dofs(chain, structure), v, 0)
    return jax.lax.cond(
        unvmap_any(near),
        lambda: where(near, with_consistent_velocities(chain, loops, active_v, rows), v),
        lambda: v,
    )


def _with_cuttable_inertia(
    chain: Chain, solve: Callable, inertia: Float[Array, " dofs"]
) -> Callable:
    """Return `solve` of a chain whose cuttable joints have inertia, from one without."""
    top = chain.topology
    dofs = top.links.dof[np.array(top.link_child, int) >= 0].ravel()
    dofs = dofs[dofs < chain.dofs]
    return with_inertia(chain, solve, dofs, inertia[dofs]) if len(dofs) else solve


@with_lanes_last
def velocity_and_acceleration_lanes_last(
    chain: Chain, structure: Structure, state, tau, baumgarte, choice
) -> tuple[Float[Array, " dofs"], Float[Array, " dofs"]]:
    """Return `velocity_and_acceleration` by articulated bodies; a `vmap` keeps lanes last.

    state: q and v.
    """
    q, v = state
    return velocity_and_acceleration(
        chain, structure, q, v, tau, dynamics=ArticulatedBodies(), baumgarte=baumgarte,
        choice=choice,
    )  # fmt: skip


@one_kernel
def acceleration(
    chain: Chain,
    structure: Structure,
    q: Float[Array, " q"],
    v: Float[Array, " dofs"],
    tau: Float[Array, " dofs"],
    dynamics: AbstractDynamics,
) -> Float[Array, " dofs"]:
    """Return the acceleration at v."""
    return velocity_and_acceleration(chain, structure, q, v, tau, dynamics=dynamics)[1]


@checked_jit
def forward_dynamics(chain: Chain, state: State, tau: Torques) -> Float[Array, " dofs"]:
    """Return the acceleration of every joint coordinate (rad/s^2, m/s^2), with loops kept closed.

    The forces of the joints' springs and dampers are added to tau. Computed by articulated bodies
    on chains without virtual links, and by composite rigid bodies otherwise (paper, section III-B).

    tau: joint torques (N m, N) over every coordinate, over the tree's, or by joint name.
    Raises ValueError if tau has neither length, or a name is unknown.
    """
    tau = torques_over_dofs(chain, tau)
    return acceleration(chain, state.structure, state.q, state.v, tau, default_dynamics(chain))


def constraint_forces(
    chain: Chain, qr: PivotedQR, J: Float[Array, "rows dofs"], force: Float[Array, " dofs"]
) -> Float[Array, "links 6"]:
    """Return the lambda with J_C^T lambda = force, of least norm if loops are redundant.

    It is the wrench (N m, N) on each virtual link, at the joint.

    force: generalized force over every coordinate.
    """
    row, column = jacobian_scales(chain)
    _, JS = pivot_blocks(qr, J)
    mu = solve_pivot_block(JS, qr.P @ (column * force), trans=True)
    return (row * (qr.Q.T @ mu)).reshape(-1, 6)


class LoopForces(eqx.Module):
    """Wrench of each connected virtual link, on `real` from `parent`, at the joint, in world axes.

    Unpacks as force, torque.

    force: in N. torque: in N m, about the joint.
    unique: whether the motion determines the wrench. Redundant loops have wrenches that it does
    not determine; theirs are of least norm, with torques divided by `chain.length`.
    link_names: names of the virtual links.
    """

    force: Float[Array, "*lanes links 3"]
    torque: Float[Array, "*lanes links 3"]
    unique: Bool[Array, "*lanes links"]
    link_names: tuple[str, ...] = eqx.field(static=True, default=())

    def wrench(self, link: str) -> tuple[Float[Array, "*lanes 3"], Float[Array, "*lanes 3"]]:
        """Return the force (N) and the torque (N m) of a virtual link.

        link: name of the virtual link.
        Raises ValueError, with the nearest names, if there is no such link.
        """
        if link not in self.link_names:
            raise unknown_name("virtual link", link, self.link_names)
        i = self.link_names.index(link)
        return self.force[..., i, :], self.torque[..., i, :]

    def __iter__(self) -> Iterator[Array]:
        return iter((self.force, self.torque))


@checked_jit(eager=True)
def loop_forces(chain: Chain, state: State, tau: Torques) -> LoopForces:
    """Return the wrench that each connected virtual link transmits for the joint torques tau.

    tau: joint torques (N m, N) over every coordinate, over the tree's, or by joint name.
    Raises ValueError if tau has neither length, or a name is unknown.
    """
    tau = torques_over_dofs(chain, tau)
    dynamics = default_dynamics(chain)
    vdot = acceleration(chain, state.structure, state.q, state.v, tau, dynamics)
    return loop_forces_of_motion(chain, state, vdot, tau)


def loop_forces_of_motion(
    chain: Chain, state: State, vdot: Float[Array, " dofs"], tau: Float[Array, " dofs"]
) -> LoopForces:
    """Return the wrenches of the virtual links in a motion, for torques that produce the motion.

    What the torques lack is taken to act on the independent coordinates.
    """
    q, v, s = state.q, state.v, state.structure
    if not len(chain.link_names):
        return LoopForces(
            jnp.zeros((0, 3), v.dtype), jnp.zeros((0, 3), v.dtype), jnp.zeros(0, bool)
        )
    loops = loop_kinematics(chain, s, q)
    V = twists(chain, loops.kin, v)
    force = pad_to_dofs(chain, rnea(chain, loops.kin, V, v, vdot[: chain.nv]))
    qr = select_pivots(s, loops.J)
    wrench = -constraint_forces(chain, qr, loops.J, force - passive_forces(chain, q, v) - tau)
    return LoopForces(
        force=wrench[:, 3:],
        torque=wrench[:, :3],
        unique=~self_stressed(s, qr),
        link_names=chain.link_names,
    )


def self_stressed(structure: Structure, qr: PivotedQR) -> Bool[Array, " links"]:
    """Return the links that take part in a self-stress, a lambda with J_C^T lambda = 0."""
    # squared length of each row's unit vector within the range of J_C: below 1 if a self-stress
    # has a component along the row
    in_range = jnp.sum(qr.Q**2, 0).reshape(-1, 6)
    return structure.connected & jnp.any(in_range < 1 - rank_tolerance(in_range.dtype), 1)
