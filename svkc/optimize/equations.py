"""The equations of motion as rows: inverse dynamics at stages, links at nodes.

No mass matrix is inverted: accelerations and forces are unknowns.
"""

from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc.model.chain import Chain
from svkc.optimize.charts import motion_from_chart, to_next_chart
from svkc.optimize.controls import AbstractControls
from svkc.optimize.lift import Layout
from svkc.optimize.loop_rows import LinkRows, gaps_at, link_wrenches, rates_at, row_accelerations
from svkc.optimize.points import Point, full_state, tree_configuration, tree_velocity
from svkc.tree.inverse_dynamics import (
    generalized_force,
    limit_forces,
    mass_matrix_product,
    newton_euler,
    passive_forces,
)
from svkc.tree.kinematics import kinematics, twists, velocity_products
from svkc.tree.traversal import accumulate_from_root, sum_dofs_per_row

# of a stage in the quadrature over the motion
Weight: TypeAlias = Float[Array, ""] | float


class Params(NamedTuple):
    """What the problem is solved for: data of the compiled functions."""

    chain: Chain
    args: Any


class Model(NamedTuple):
    """The static part of the equations.

    layout: numbers of entries. rows: of links, those that are constraints in some phase.
    controls: of `optimize`.
    """

    layout: Layout
    rows: LinkRows
    controls: AbstractControls


class IntervalData(eqx.Module):
    """What distinguishes an interval, or a node, for the equations.

    reference, following: quaternions of the charts of the interval's first and last node.
    active: which of the links' rows are constraints.
    structure: of the states.
    """

    reference: Any
    following: Any
    active: Any
    structure: Any


def links_force(
    chain: Chain, q: Float[Array, " nq"], table: LinkRows, multipliers: Float[Array, " rows"]
) -> Float[Array, " nv"]:
    """Return J^T f, the generalized force of the links' multipliers."""
    kin = kinematics(chain, q)
    return generalized_force(chain, kin, link_wrenches(chain, kin, table, multipliers))


def equations_of_motion(
    chain: Chain,
    table: LinkRows,
    q: Float[Array, " nq"],
    v: Float[Array, " nv"],
    vdot: Float[Array, " nv"],
    *,
    tau: Float[Array, " dofs"],
    f: Float[Array, " rows"],
) -> tuple[Float[Array, " nv"], Float[Array, " rows"]]:
    """Return the residual of the equations of motion, and the links' accelerations J vdot + Jdot v.

    The residual is ID(q, v, vdot) less joint torques, links' forces J^T f, and forces of springs,
    dampers and joint limits.
    """
    top, kin = chain.topology, kinematics(chain, q)
    V = twists(chain, kin, v)
    joint = sum_dofs_per_row(top, kin.S * vdot[:, None]) + velocity_products(chain, kin, V, v)
    A = accumulate_from_root(top, joint)
    gravity = jnp.concatenate([jnp.zeros_like(chain.gravity), chain.gravity])
    force = newton_euler(chain, kin, V, A - gravity[None])
    if chain.armature is not None:
        force = force + chain.armature * vdot
    full_q, full_v = tree_configuration(chain, q), tree_velocity(chain, v)
    passive = passive_forces(chain, full_q, full_v) + limit_forces(chain, full_q, full_v)
    force = force - passive[: chain.nv] - tau[: chain.nv]
    if not len(table):
        return force, jnp.zeros(0, q.dtype)
    force = force - generalized_force(chain, kin, link_wrenches(chain, kin, table, f))
    return force, row_accelerations(chain, kin, table, V, A)


def stage_equations(
    model: Model, params: Params, data: IntervalData, weight: Weight, y: Float[Array, " y"]
) -> Float[Array, " equations"]:
    """Return the rows of a stage: the equations of motion, and the links' accelerations."""
    (t, _), motion, blocks, f = model.layout.split_stage(y)
    chain, args = params
    q, v, vdot = motion_from_chart(chain, data.reference, *motion)
    needs_state = model.controls.needs_state
    state = full_state(chain, data.structure, q, v) if needs_state else None
    tau = model.controls.torques(chain, t, state, blocks, args)
    f = jnp.where(data.active, f, 0)
    force, links = equations_of_motion(chain, model.rows, q, v, vdot, tau=tau, f=f)
    return jnp.concatenate([force, links])


def end_of_interval(
    model: Model, params: Params, data: IntervalData, weight: Weight, y: Float[Array, " y"]
) -> Float[Array, " node"]:
    """Return the node at the end of an interval, in the next node's chart: q, v, states."""
    _, (x, rate, _), blocks, _ = model.layout.split_stage(y)
    chain = params.chain
    x, rate = to_next_chart(chain, data.reference, data.following, x, rate)
    states = blocks[0] if model.controls.has_state else blocks[0][:0]
    return jnp.concatenate([x, rate, states])


def connection(
    model: Model, params: Params, data: IntervalData, y: Float[Array, " y"]
) -> Float[Array, " equations"]:
    """Return the rows of a node at which links connect: gaps, rates, and the impact's momentum.

    y: q, v after, v before, in the node's chart, and the impulses of the rows.
    """
    chain, nv = params.chain, model.layout.nv
    x, after, before, impulse = jnp.split(y, [nv, 2 * nv, 3 * nv])
    q, v, _ = motion_from_chart(chain, data.reference, x, after, after)
    _, v_before, _ = motion_from_chart(chain, data.reference, x, before, before)
    impulse = jnp.where(data.active, impulse, 0)
    momentum = mass_matrix_product(chain, kinematics(chain, q), v - v_before)
    momentum = momentum - links_force(chain, q, model.rows, impulse)
    return jnp.concatenate(
        [gaps_at(chain, q, model.rows), rates_at(chain, q, v, model.rows), momentum]
    )


def projection(
    model: Model, params: Params, data: IntervalData, y: Float[Array, " y"]
) -> Float[Array, " equations"]:
    """Return the rows that project a node onto its loops: changes of q and v, gaps, rates.

    y: q, v in the node's chart, and the multipliers of the change of q and of v. The changes are
    J^T of the multipliers.
    """
    chain, nv, n = params.chain, model.layout.nv, len(model.rows)
    x, rate, of_q, of_v = jnp.split(y, [nv, 2 * nv, 2 * nv + n])
    q, v, _ = motion_from_chart(chain, data.reference, x, rate, rate)
    change = lambda f: links_force(chain, q, model.rows, jnp.where(data.active, f, 0))
    gaps, rates = gaps_at(chain, q, model.rows), rates_at(chain, q, v, model.rows)
    return jnp.concatenate([change(of_q), change(of_v), gaps, rates])


def point_of_stage(
    model: Model,
    params: Params,
    data: IntervalData,
    y: Float[Array, " y"],
    active: np.ndarray,
    **options: Any,
) -> Point:
    """Return a stage as users' functions see it. active: mask of the phase's rows, static."""
    times, motion, blocks, f = model.layout.split_stage(y)
    return Point(
        params.chain,
        data.structure,
        model.controls,
        rows=(model.rows, active),
        times=(times[0], times[1]),
        motion=motion_from_chart(params.chain, data.reference, *motion),
        blocks=blocks,
        multipliers=f,
        args=params.args,
        **options,
    )
