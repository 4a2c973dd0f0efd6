"""Accelerations and multipliers of a chain with loops, and the choice among the ways to compute
them."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from svkc._jax.batched_lapack import factor_positive, solve_triangle
from svkc.loops.constraint import scales
from svkc.loops.coordinates import Coordinates, constrain
from svkc.loops.delassus import by_loop_forces
from svkc.loops.pivoting import Selection, square
from svkc.model.chain import Chain, Structure, active_dofs
from svkc.model.validation import function, one
from svkc.tree.articulated_body import Body, accelerations, articulate
from svkc.tree.inverse_dynamics import inertia_times
from svkc.tree.kinematics import Kinematics
from svkc.tree.mass_matrix import inertia_by_composites


def by_bodies(chain: Chain, kin: Kinematics) -> list[Body] | Body:
    """Names articulated bodies as the way to accelerations, for `svkc.Dynamics(inertia=...)`."""
    return articulate(chain, kin)


class Dynamics(eqx.Module):
    """How `svkc.simulate` computes accelerations. All of these agree; they differ in what they
    cost.

    inertia: None (default), articulated bodies where the scene has no loops, else composite ones;
    `svkc.inertia_by_composites` always; `svkc.inertia_by_unit_vectors`, the paper's columns by
    inverse dynamics; or `svkc.by_bodies`, articulated bodies and the forces of the loops, which
    square the loops' conditioning near singular configurations. With it `Projection()` too does
    without pivots: the fastest, and the one for batches;
    the certificate then has the margin of the phases' ends alone, and counts no swaps.
    hold: dependent coordinates are chosen at every evaluation (None), or held until, at the end of
    a step, the least |R_kk| / |R_11| of their columns is below this part of what a new choice has
    (default 0.3); 0 holds them until the structure changes. Held only where steps are projected;
    near a
    singular configuration, and in what is differentiated, they are chosen at every evaluation, as
    the motion does not depend on the choice.
    """

    inertia: Callable | None = eqx.field(static=True, default=None)
    hold: float | None = eqx.field(static=True, default=0.3)

    def __check_init__(self):
        function("dynamics.inertia", self.inertia)
        if self.hold is not None and not 0 <= one("dynamics.hold", self.hold) <= 1:
            raise ValueError(
                f"dynamics.hold: got {self.hold}, expected None or a part between 0 and 1"
            )


def reduced_inertia(
    chain: Chain, co: Coordinates, M: Float[Array, "nv nv"]
) -> Float[Array, "dofs dofs"]:
    """A = W^T M W (23), ones on the diagonal of coordinates that are not independent."""
    W = co.W[: chain.nv]
    A = W.T @ (M @ W) + jnp.diag(jnp.where(co.independent, 0, 1).astype(M.dtype))
    if chain.link_armature is None:
        return A
    own = co.W[chain.nv :]
    return A + own.T @ (chain.link_armature[:, None] * own)


def with_links(
    chain: Chain, tree: Float[Array, " nv"], own: Float[Array, " dofs"]
) -> Float[Array, " dofs"]:
    """Generalized forces of the tree, and those that the armatures of virtual joints need for `own`
    (accelerations, or jumps of velocity)."""
    if chain.link_armature is None:
        return jnp.concatenate([tree, jnp.zeros(chain.dofs - chain.nv, tree.dtype)])
    return jnp.concatenate([tree, chain.link_armature * own[chain.nv :]])


def solve_motion(
    chain: Chain, structure: Structure, kin: Kinematics, selection: Selection | None,
    J: Float[Array, "rows dofs"], force: Float[Array, " dofs"], bias: Float[Array, " rows"],
    inertia=None,
) -> Float[Array, " dofs"]:  # fmt: skip
    """The x with M x = force + J_C^T lambda and J_C x + bias = 0 (paper, section III-B).

    Its derivatives are those of these equations, M x by Newton-Euler: one more solve with the same
    factors, nothing through recursions for M or pivots.
    """
    nv, (_, column) = chain.nv, scales(chain)
    chosen, rows, frozen, static = jax.lax.stop_gradient((selection, J, (chain, kin), structure))
    active = active_dofs(chain, structure)
    if inertia is by_bodies:
        # every row as it is, whether or not it repeats others
        pick, used = (lambda x: x), jnp.ones(J.shape[0], bool)
        solve = by_loop_forces(
            *frozen,
            jnp.where(active[None], rows / column[None], 0),
            None if static.locked is None else active[:nv],
        )
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
    return jax.lax.custom_linear_solve(
        equations, right, solve=lambda _, right: solve(*right), symmetric=True
    )[0]


def _by_independent(
    chain: Chain, kin: Kinematics, structure: Structure, chosen: Selection, J, inertia: Callable
) -> Callable:
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


def solve_free_motion(
    chain: Chain, structure: Structure, kin: Kinematics, force: Float[Array, " dofs"], inertia=None
) -> Float[Array, " dofs"]:
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

    return jax.lax.custom_linear_solve(
        equations, jnp.where(free, force, 0), solve=solve, symmetric=True
    )
