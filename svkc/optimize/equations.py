"""The equations of the transcription: inverse dynamics at stages, links and impacts at nodes.

Accelerations and multipliers of links are unknowns of the solver, so that no mass matrix is
inverted.
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
from svkc.optimize.points import (
    Point,
    full_configuration,
    full_state,
    full_velocity,
    placed_as_in,
)
from svkc.optimize.schemes import Radau
from svkc.tree.inverse_dynamics import (
    generalized_force,
    limit_forces,
    mass_matrix_product,
    newton_euler,
    passive_forces,
)
from svkc.tree.kinematics import kinematics, twists, velocity_products
from svkc.tree.traversal import accumulate_from_root, sum_dofs_per_row

# weight of a stage in the quadrature of a running cost, see `StageBlock`
Weight: TypeAlias = Float[Array, ""] | float


class Params(NamedTuple):
    """The parameters of the compiled functions, by which the optimal cost has derivatives."""

    chain: Chain
    args: Any


class Model(NamedTuple):
    """The static part of the equations.

    layout: order of an interval's unknowns. rows: those of links that are constraints in some
    phase. controls: of the problem.
    """

    layout: Layout
    rows: LinkRows
    controls: AbstractControls

    @classmethod
    def of(
        cls, chain: Chain, controls: AbstractControls, scheme: Radau, rows: np.ndarray
    ) -> "Model":
        """Return the static part for a chain. rows: the links' rows, as in `LinkRows`."""
        layout = Layout(
            nv=chain.nv,
            stages=scheme.stages,
            rows=len(rows),
            control=controls.count(chain),
            blocks=controls.blocks(scheme),
            stage_blocks=controls.stage_blocks,
        )
        return cls(layout, LinkRows.of(chain, rows), controls)


class IntervalData(eqx.Module):
    """The constants of an interval, or of a node, in the equations.

    reference, next_reference: configurations [nq] at the origins of the charts of the interval's
        first and last node.
    active: mask [rows] of the links' rows that are constraints.
    structure: structure of the phase.
    """

    reference: Any
    next_reference: Any
    active: Any
    structure: Any


def links_force(
    chain: Chain, q: Float[Array, " nq"], table: LinkRows, multipliers: Float[Array, " rows"]
) -> Float[Array, " nv"]:
    """Return J^T f (N m, N), the generalized force of the links' multipliers f."""
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
    """Return the residual of the equations of motion, and J vdot + Jdot v of the links' rows.

    The residual (N m, N) is ID(q, v, vdot) minus joint torques, minus the links' forces J^T f, and
    minus the forces of springs, dampers and joint limits.

    table: the links' rows. tau: joint torques over every coordinate. f: multipliers of the rows.
    """
    top, kin = chain.topology, kinematics(chain, q)
    V = twists(chain, kin, v)
    joint = sum_dofs_per_row(top, kin.S * vdot[:, None]) + velocity_products(chain, kin, V, v)
    A = accumulate_from_root(top, joint)
    gravity = jnp.concatenate([jnp.zeros_like(chain.gravity), chain.gravity])
    force = newton_euler(chain, kin, V, A - gravity[None])
    if chain.armature is not None:
        force = force + chain.armature * vdot
    full_q, full_v = full_configuration(chain, q), full_velocity(chain, v)
    passive = passive_forces(chain, full_q, full_v) + limit_forces(chain, full_q, full_v)
    force = force - passive[: chain.nv] - tau[: chain.nv]
    if not len(table):
        return force, jnp.zeros(0, q.dtype)
    force = force - generalized_force(chain, kin, link_wrenches(chain, kin, table, f))
    return force, row_accelerations(chain, kin, table, V, A)


def stage_equations(
    model: Model, params: Params, data: IntervalData, weight: Weight, y: Float[Array, " y"]
) -> Float[Array, " equations"]:
    """Return the rows of a stage: the equations of motion, then the links' accelerations.

    weight: not used; `StageBlock` passes it to every function. y: variables of the stage.
    """
    (t, _), motion, blocks, f = model.layout.split_stage(y)
    chain, args = params
    q, v, vdot = motion_from_chart(chain, data.reference, *motion)
    needs_state = model.controls.needs_state
    state = full_state(chain, placed_as_in(chain, data.structure), q, v) if needs_state else None
    tau = model.controls.torques(chain, t, state, blocks, args)
    f = jnp.where(data.active, f, 0)
    force, links = equations_of_motion(chain, model.rows, q, v, vdot, tau=tau, f=f)
    return jnp.concatenate([force, links])


def end_of_interval(
    model: Model, params: Params, data: IntervalData, weight: Weight, y: Float[Array, " y"]
) -> Float[Array, " node"]:
    """Return the collocation polynomial at the end of an interval: q, v, states of controls.

    q and v are in the chart of the next node. weight: not used. y: variables of the last stage.
    """
    _, (x, rate, _), blocks, _ = model.layout.split_stage(y)
    chain = params.chain
    x, rate = to_next_chart(chain, data.reference, data.next_reference, x, rate)
    states = blocks[0] if model.controls.has_state else blocks[0][:0]
    return jnp.concatenate([x, rate, states])


def connection(
    model: Model, params: Params, data: IntervalData, y: Float[Array, " y"]
) -> Float[Array, " equations"]:
    """Return the rows of a node at which links connect: gaps, gap rates, momentum balance.

    y: q, v after the impact, v before the impact, all in the node's chart, and impulses [rows].
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
    """Return the rows that project a node onto its loops: changes of q, of v, gaps, gap rates.

    The node is the end of the interval's polynomial plus a change of q and of v. Each change is J^T
    times multipliers of its own.

    y: q, v in the node's chart, and the two sets of multipliers [rows].
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
    """Return the `Point` of a stage, for users' functions.

    y: variables of the stage. active: static mask of the rows that are constraints in the phase.
    options: further keyword arguments of `Point`.
    """
    times, motion, blocks, f = model.layout.split_stage(y)
    return Point(
        params.chain,
        placed_as_in(params.chain, data.structure),
        model.controls,
        rows=(model.rows, active),
        times=(times[0], times[1]),
        motion=motion_from_chart(params.chain, data.reference, *motion),
        blocks=blocks,
        multipliers=f,
        args=params.args,
        **options,
    )
