"""F4: the acceleration of any structure (paper, section III-B) and the forces its loops carry."""

import functools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from svkc._jax.batched_lapack import factor_positive, solve_triangle
from svkc._jax.lanes_last import with_lanes_last
from svkc.loops.constraint import active_dofs, ends
from svkc.loops.coordinates import NEAR, Coordinates, agreeing, choose, constrain, loop_rates, scaled_jacobian, scales
from svkc.loops.delassus import by_loop_forces
from svkc.loops.pivoting import Selection, rank_tolerance, solve_frozen, square, weakest
from svkc.model.chain import Chain, State, Structure
from svkc.model.checked_jit import verb
from svkc.model.validation import function, one
from svkc.tree.articulated_body import accelerations, articulate, by_bodies
from svkc.tree.inverse_dynamics import generalized_forces, inertia_by_composites, inertia_by_unit_vectors, inertia_times, passive_forces
from svkc.tree.kinematics import Kinematics, kinematics, twists


class Dynamics(eqx.Module):
    """How `svkc.simulate` computes accelerations. All of these agree; they differ in what they cost.

    inertia: None (default), articulated bodies where the scene has no loops, else composite ones; `svkc.inertia_by_composites` always;
    `svkc.inertia_by_unit_vectors`, the paper's columns by inverse dynamics; or `svkc.by_bodies`, articulated bodies and the forces of the loops, which
    square the loops' conditioning near singular configurations. With it `Projection()` too does without pivots: the fastest, and the one for batches;
    the certificate then has the margin of the phases' ends alone, and counts no swaps.
    hold: dependent coordinates are chosen at every evaluation (None), or held until, at the end of a step, the least |R_kk| / |R_11| of their columns is
    below this part of what a new choice has (default 0.3); 0 holds them until the structure changes. Held only where steps are projected; near a
    singular configuration, and in what is differentiated, they are chosen at every evaluation, as the motion does not depend on the choice.
    """

    inertia: Callable | None = eqx.field(static=True, default=None)
    hold: float | None = eqx.field(static=True, default=0.3)

    def __check_init__(self):
        function("dynamics.inertia", self.inertia)
        if self.hold is not None and not 0 <= one("dynamics.hold", self.hold) <= 1:
            raise ValueError(f"dynamics.hold: got {self.hold}, expected None or a part between 0 and 1")


def joint_torques(chain: Chain, tau) -> Float[Array, " dofs"]:
    """Torques over every coordinate; those of virtual joints are zero where only the tree's are given. ValueError: another size."""
    if tau.shape == (chain.dofs,):
        return tau
    if tau.shape == (chain.nv,):
        return jnp.concatenate([tau, jnp.zeros(chain.dofs - chain.nv, tau.dtype)])
    raise ValueError(f"tau: got shape {tau.shape}, expected {chain.dofs} joint torques (or {chain.nv}, the tree's)")


def reduced_inertia(chain: Chain, co: Coordinates, M: Float[Array, "nv nv"]) -> Float[Array, "dofs dofs"]:
    """A = W^T M W (23), ones on the diagonal of coordinates that are not independent."""
    W = co.W[: chain.nv]
    A = W.T @ (M @ W) + jnp.diag(jnp.where(co.independent, 0, 1).astype(M.dtype))
    if chain.link_armature is None:
        return A
    own = co.W[chain.nv :]
    return A + own.T @ (chain.link_armature[:, None] * own)


def with_links(chain: Chain, tree: Float[Array, " nv"], own: Float[Array, " dofs"]) -> Float[Array, " dofs"]:
    """Generalized forces of the tree, and those that the armatures of virtual joints need for `own` (accelerations, or jumps of velocity)."""
    if chain.link_armature is None:
        return jnp.concatenate([tree, jnp.zeros(chain.dofs - chain.nv, tree.dtype)])
    return jnp.concatenate([tree, chain.link_armature * own[chain.nv :]])


def solve_motion(
    chain: Chain, structure: Structure, kin: Kinematics, selection: Selection | None, J: Float[Array, "rows dofs"], force: Float[Array, " dofs"],
    bias: Float[Array, " rows"], inertia=None,
) -> Float[Array, " dofs"]:  # fmt: skip
    """The x with M x = force + J_C^T lambda and J_C x + bias = 0 (paper, section III-B).

    Its derivatives are those of these equations, M x by Newton-Euler: one more solve with the same factors, nothing through recursions for M or pivots.
    """
    nv, (_, column) = chain.nv, scales(chain)
    chosen, rows, frozen, static = jax.lax.stop_gradient((selection, J, (chain, kin), structure))
    active = active_dofs(chain, structure)
    if inertia is by_bodies:
        # every row as it is, whether or not it repeats others
        pick, used = (lambda x: x), jnp.ones(J.shape[0], bool)
        solve = by_loop_forces(*frozen, jnp.where(active[None], rows / column[None], 0), None if static.locked is None else active[:nv])
    else:
        pick, used = (lambda x: chosen.Q @ x), chosen.used
        solve = _by_independent(*frozen, static, chosen, rows, inertia or inertia_by_composites)

    def equations(unknown):
        x, mu = unknown
        held = pick(J) / column[None]
        moving = jnp.where(active, x, 0)
        force = with_links(chain, inertia_times(chain, kin, moving[:nv]), moving) + held.T @ mu
        return jnp.where(active, force, x), held @ x + jnp.where(used, 0, mu)

    # jax transposes the solve only where both sides take part in the derivative
    right = (jnp.where(active, force, 0) + 0 * jnp.sum(bias), -pick(bias) + 0 * jnp.sum(force))
    return jax.lax.custom_linear_solve(equations, right, solve=lambda _, right: solve(*right), symmetric=True)[0]


def _by_independent(chain: Chain, kin: Kinematics, structure: Structure, chosen: Selection, J, inertia: Callable) -> Callable:
    """The solution through W, A and b, as the paper has it."""
    nv, (_, column) = chain.nv, scales(chain)
    co = constrain(chain, structure, chosen, J, jnp.zeros(J.shape[0], J.dtype))
    tree, W = inertia(chain, kin), co.W
    A_inverse = factor_positive(reduced_inertia(chain, co, tree))
    _, JS = square(chosen, J)

    def solve(force, rate):
        x = column * (chosen.P.T @ solve_triangle(JS, rate))
        x = x + W @ A_inverse(W.T @ (force - with_links(chain, tree @ x[:nv], x)))
        rest = column * (force - with_links(chain, tree @ x[:nv], x))
        return x, jnp.where(chosen.used, solve_triangle(JS, chosen.P @ rest, trans=True), rate)

    return solve


def solve_free_motion(chain: Chain, structure: Structure, kin: Kinematics, force: Float[Array, " dofs"], inertia=None) -> Float[Array, " dofs"]:
    """The same on an open chain: M x = force, zero for locked joints."""
    locked, frozen = structure.locked, jax.lax.stop_gradient((chain, kin))
    free = jnp.ones(chain.nv, bool) if locked is None else ~locked
    if inertia in (None, by_bodies):
        bodies = articulate(*frozen, None if locked is None else free)
        solve = lambda _, x: accelerations(chain.topology, bodies, x)
    else:
        M = (inertia or inertia_by_composites)(*frozen)
        if locked is not None:
            M = jnp.where(free[:, None] & free[None], M, jnp.eye(chain.nv, dtype=M.dtype))
        inverse = factor_positive(M)
        solve = lambda _, x: inverse(x)

    def equations(x):
        return jnp.where(free, inertia_times(chain, kin, jnp.where(free, x, 0)), x)

    return jax.lax.custom_linear_solve(equations, jnp.where(free, force, 0), solve=solve, symmetric=True)


@functools.partial(jax.jit, static_argnames=("inertia", "agree"))
def moving(
    chain: Chain, structure: Structure, q, v, tau: Float[Array, " dofs"], inertia=None, baumgarte=None, agree: bool = False, pivots=None
) -> tuple[Float[Array, " dofs"], Float[Array, " dofs"]]:
    """Velocity and acceleration: steps 1 to 5 of section III-B. On an open chain W is the identity and nothing of the closure is computed.

    baumgarte: rate (1/s) at which open loops are pulled back; None: not at all. agree: near a singular configuration dependent velocities are
    those of the independent ones, for there the stages of a step would make their errors grow. pivots: as `choose` takes them.
    """
    kin = kinematics(chain, q)
    loops = len(chain.topology.link_names)
    if loops:
        end = ends(chain, structure, kin, q)
        J = scaled_jacobian(chain, structure, kin, end)
        selection = choose(structure, J, pivots) if agree or inertia is not by_bodies else None
        if agree:
            near = weakest(selection) < NEAR * structure.margin
            v = jnp.where(near, agreeing(chain, selection, J, jnp.where(active_dofs(chain, structure), v, 0)), v)
    V = twists(chain, kin, v)
    bias = generalized_forces(chain, kin, V, v, jnp.zeros(chain.nv, v.dtype))
    force = tau + passive_forces(chain, q, v) - jnp.concatenate([bias, jnp.zeros(chain.dofs - chain.nv, v.dtype)])
    if not loops:
        return v, solve_free_motion(chain, structure, kin, force, inertia)
    rates = loop_rates(chain, structure, v, kin, V, end, J, baumgarte)
    return v, solve_motion(chain, structure, kin, selection, J, force, rates, inertia)


@with_lanes_last
def moving_in_lanes(chain: Chain, structure: Structure, q, v, tau, baumgarte) -> tuple[Float[Array, " dofs"], Float[Array, " dofs"]]:
    """`moving` by articulated bodies, without pivots, under a `vmap` that keeps its lanes last."""
    return moving(chain, structure, q, v, tau, by_bodies, baumgarte)


def acceleration(chain: Chain, structure: Structure, q, v, tau: Float[Array, " dofs"], inertia=None) -> Float[Array, " dofs"]:
    """The acceleration alone, for the velocity as it is."""
    return moving(chain, structure, q, v, tau, inertia)[1]


@verb
def forward_dynamics(chain: Chain, state: State, tau: Float[Array, " torques"]) -> Float[Array, " dofs"]:
    """Accelerations (rad/s^2, m/s^2) of every joint coordinate for the joint torques tau (N m, N), loops kept (paper, section III-B).

    Springs and dampers of the joints act too. tau: over every coordinate, or the tree's alone. By articulated bodies, or composites where there are loops.
    """
    return acceleration(chain, state.structure, state.q, state.v, joint_torques(chain, tau))


@verb
def forward_dynamics_by_unit_vectors(chain: Chain, state: State, tau: Float[Array, " torques"]) -> Float[Array, " dofs"]:
    """The same with the inertia matrix column by column from inverse dynamics: the paper's own way."""
    return acceleration(chain, state.structure, state.q, state.v, joint_torques(chain, tau), inertia_by_unit_vectors)


def constraint_forces(chain: Chain, selection: Selection, J: Float[Array, "rows dofs"], excess: Float[Array, " dofs"]) -> Float[Array, "links 6"]:
    """Lambda with J_C^T lambda = excess, of least norm where loops are redundant: wrench (N m, N) on the virtual link, at the joint."""
    row, column = scales(chain)
    _, JS = square(selection, J)
    mu = solve_frozen(JS, selection.P @ (column * excess), trans=True)
    return (row * (selection.Q.T @ mu)).reshape(-1, 6)


class LoopForces(eqx.Module):
    """Wrench of each connected virtual link, on `real` from `parent`, at the joint, in world axes; unpacks as force, torque.

    `unique`: nothing but the motion decides it. Where loops are redundant some wrenches are not: they are the least in norm (rows over `chain.length`).
    """

    force: Float[Array, "links 3"]
    torque: Float[Array, "links 3"]
    unique: Bool[Array, " links"]

    def __iter__(self):
        return iter((self.force, self.torque))


@verb(eager=True)
def loop_forces(chain: Chain, state: State, tau: Float[Array, " torques"]) -> LoopForces:
    """Force (N) and torque (N m) that each connected virtual link carries for the joint torques tau: on `real` from `parent`, at the joint, in
    world axes, and whether the motion alone decides it."""
    tau = joint_torques(chain, tau)
    if not len(chain.link_names):
        return LoopForces(jnp.zeros((0, 3), state.v.dtype), jnp.zeros((0, 3), state.v.dtype), jnp.zeros(0, bool))
    q, v, s, nv = state.q, state.v, state.structure, chain.nv
    kin = kinematics(chain, q)
    V = twists(chain, kin, v)
    vdot = acceleration(chain, s, q, v, tau)
    needed = with_links(chain, generalized_forces(chain, kin, V, v, vdot[:nv]), vdot)
    J = scaled_jacobian(chain, s, kin, ends(chain, s, kin, q))
    selection = choose(s, J)
    wrench = -constraint_forces(chain, selection, J, needed - passive_forces(chain, q, v) - tau)
    return LoopForces(wrench[:, 3:], wrench[:, :3], ~self_stressed(s, selection))


def self_stressed(structure: Structure, selection: Selection) -> Bool[Array, " links"]:
    """Links that take part in a self-stress: wrenches of all loops together, J_C^T lambda = 0, that no motion tells of."""
    # a row's length within the range of J_C: 1 where no vector orthogonal to that range has a part in it
    inside = jnp.sum(selection.Q**2, 0).reshape(-1, 6)
    return structure.connected & jnp.any(inside < 1 - rank_tolerance(inside.dtype), 1)
