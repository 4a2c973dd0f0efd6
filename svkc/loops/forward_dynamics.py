"""The acceleration of any structure (paper, section III-B) and the forces its loops carry."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from svkc._jax.lanes_last import with_lanes_last
from svkc.loops.constrained_dynamics import (
    AbstractDynamics,
    ArticulatedBodies,
    default_dynamics,
)
from svkc.loops.constraint import constraint_bias, jacobian_scales, loop_kinematics
from svkc.loops.coordinates import dependent_velocities
from svkc.loops.pivoting import (
    NEAR_SINGULAR,
    PivotedQR,
    pivot_blocks,
    pivot_ratio,
    rank_tolerance,
    select_pivots,
    solve_pivot_block,
)
from svkc.model.chain import Chain, State, Structure, active_dofs
from svkc.model.checked_jit import checked_jit, joint_torques
from svkc.tree.inverse_dynamics import append_virtual_joints, passive_forces, rnea
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
) -> tuple[Float[Array, " dofs"], Float[Array, " dofs"]]:
    """Velocity and acceleration: steps 1 to 5 of section III-B. On an open chain W is the identity
    and nothing of the closure is computed.

    baumgarte: rate (1/s) at which open loops are pulled back; None: not at all. agree: near a
    singular configuration dependent velocities are those of the independent ones, for there the
    stages of a step would make their errors grow. pivots: as `choose` takes them.
    """
    if chain.topology.link_names:
        loops = loop_kinematics(chain, structure, q)
        kin, J = loops.kin, loops.J
        selection = (
            select_pivots(structure, J, pivots)
            if project_velocity or dynamics.uses_pivots
            else None
        )
        if project_velocity:
            near = pivot_ratio(selection) < NEAR_SINGULAR * structure.margin
            v = jnp.where(
                near,
                dependent_velocities(
                    chain, selection, J, jnp.where(active_dofs(chain, structure), v, 0)
                ),
                v,
            )
    else:
        kin, loops = kinematics(chain, q), None
    V = twists(chain, kin, v)
    bias = rnea(chain, kin, V, v, jnp.zeros(chain.nv, v.dtype))
    force = tau + passive_forces(chain, q, v) - append_virtual_joints(chain, bias)
    if loops is None:
        return v, dynamics.prepare_open(chain, structure, kin)(force)
    rates = constraint_bias(chain, structure, v, loops, V, baumgarte)
    return v, dynamics.prepare(chain, structure, loops, selection)(force, rates)


@with_lanes_last
def velocity_and_acceleration_lanes_last(
    chain: Chain, structure: Structure, q, v, tau, baumgarte
) -> tuple[Float[Array, " dofs"], Float[Array, " dofs"]]:
    """`moving` by articulated bodies, without pivots, under a `vmap` that keeps its lanes last."""
    way = ArticulatedBodies()
    return velocity_and_acceleration(chain, structure, q, v, tau, dynamics=way, baumgarte=baumgarte)


def acceleration(
    chain: Chain, structure: Structure, q, v, tau: Float[Array, " dofs"], dynamics: AbstractDynamics
) -> Float[Array, " dofs"]:
    """The acceleration alone, for the velocity as it is."""
    return velocity_and_acceleration(chain, structure, q, v, tau, dynamics=dynamics)[1]


@checked_jit
def forward_dynamics(
    chain: Chain, state: State, tau: Float[Array, " torques"]
) -> Float[Array, " dofs"]:
    """Accelerations (rad/s^2, m/s^2) of every joint coordinate for the joint torques tau (N m, N),
    loops kept (paper, section III-B).

    Springs and dampers of the joints act too. tau: over every coordinate, or the tree's alone. By
    articulated bodies, or composites where there are loops.
    """
    tau = joint_torques(chain, tau)
    return acceleration(chain, state.structure, state.q, state.v, tau, default_dynamics(chain))


def constraint_forces(
    chain: Chain, selection: PivotedQR, J: Float[Array, "rows dofs"], excess: Float[Array, " dofs"]
) -> Float[Array, "links 6"]:
    """Lambda with J_C^T lambda = excess, of least norm where loops are redundant: wrench (N m, N)
    on the virtual link, at the joint."""
    row, column = jacobian_scales(chain)
    _, JS = pivot_blocks(selection, J)
    mu = solve_pivot_block(JS, selection.P @ (column * excess), trans=True)
    return (row * (selection.Q.T @ mu)).reshape(-1, 6)


class LoopForces(eqx.Module):
    """Wrench of each connected virtual link, on `real` from `parent`, at the joint, in world axes;
    unpacks as force, torque.

    `unique`: nothing but the motion decides it. Where loops are redundant some wrenches are not:
    they are the least in norm (rows over `chain.length`).
    """

    force: Float[Array, "links 3"]
    torque: Float[Array, "links 3"]
    unique: Bool[Array, " links"]

    def __iter__(self):
        return iter((self.force, self.torque))


@checked_jit(eager=True)
def loop_forces(chain: Chain, state: State, tau: Float[Array, " torques"]) -> LoopForces:
    """Force (N) and torque (N m) that each connected virtual link carries for the joint torques
    tau: on `real` from `parent`, at the joint, in world axes, and whether the motion alone decides
    it."""
    tau = joint_torques(chain, tau)
    if not len(chain.link_names):
        return LoopForces(
            jnp.zeros((0, 3), state.v.dtype), jnp.zeros((0, 3), state.v.dtype), jnp.zeros(0, bool)
        )
    q, v, s, nv = state.q, state.v, state.structure, chain.nv
    loops = loop_kinematics(chain, s, q)
    kin, J = loops.kin, loops.J
    V = twists(chain, kin, v)
    vdot = acceleration(chain, s, q, v, tau, default_dynamics(chain))
    needed = append_virtual_joints(chain, rnea(chain, kin, V, v, vdot[:nv]))
    selection = select_pivots(s, J)
    wrench = -constraint_forces(chain, selection, J, needed - passive_forces(chain, q, v) - tau)
    return LoopForces(wrench[:, 3:], wrench[:, :3], ~self_stressed(s, selection))


def self_stressed(structure: Structure, selection: PivotedQR) -> Bool[Array, " links"]:
    """Links that take part in a self-stress: wrenches of all loops together, J_C^T lambda = 0, that
    no motion tells of."""
    # a row's length within the range of J_C: 1 where no vector orthogonal to that range has a part
    # in it
    inside = jnp.sum(selection.Q**2, 0).reshape(-1, 6)
    return structure.connected & jnp.any(inside < 1 - rank_tolerance(inside.dtype), 1)
