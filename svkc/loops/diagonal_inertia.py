"""Inertia added to, or taken off, the diagonal of the mass matrix.

For implicit joint damping, and for bodies without mass, which leave the tree's mass matrix singular
where loops alone determine their motion.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc.loops.constraint import jacobian_scales
from svkc.model.chain import Chain


def with_armature(chain: Chain, added: Float[Array, " nv"]) -> Chain:
    """Return the chain with more inertia on the diagonal of its mass matrix."""
    armature = added if chain.armature is None else chain.armature + added
    return eqx.tree_at(lambda c: c.armature, chain, armature, is_leaf=lambda x: x is None)


def with_inertia(
    chain: Chain, solve: Callable, dofs: np.ndarray, inertia: Float[Array, " n"]
) -> Callable:
    """Return `solve` for a mass matrix M + C, from that for M (Woodbury's formula).

    With accelerations G f under forces f on `dofs`, the forces -C x of the added inertia change
    x_0, the accelerations without them, to x = x_0 - G C x.

    solve: (force [dofs], bias [rows]) -> x, or a tuple whose first entry is x.
    inertia: diagonal of C on the coordinates `dofs`; may be negative.
    """
    no_bias = jnp.zeros(6 * len(chain.link_names), inertia.dtype)
    unit_forces = jnp.asarray(np.eye(chain.dofs)[dofs], inertia.dtype)
    responses = jax.vmap(lambda force: solve(force, no_bias))(unit_forces)
    G = jax.tree.leaves(responses)[0][:, dofs].T
    system = np.eye(len(dofs), dtype=inertia.dtype) + G * inertia[None]

    def solve_with_inertia(force, bias):
        start = solve(force, bias)
        x = jnp.linalg.solve(system, jax.tree.leaves(start)[0][dofs])
        return jax.tree.map(lambda a, b: a - (inertia * x) @ b, start, responses)

    return solve_with_inertia


def auxiliary_inertia(chain: Chain) -> Float[Array, " nv"]:
    """Return an inertia of each massless body's joint coordinates, zero for other coordinates.

    With it on the diagonal the tree's mass matrix is regular; `with_inertia` takes it off again. It
    is eps^(1/4) (float64: 1.2e-4) of that of the largest mass at `chain.length`: a smaller one
    leaves loop forces inexact by the regularization of Delassus' matrix, a larger one costs digits
    where loops leave a massless body little inertia of its neighbours.
    """
    mask = np.isin(np.arange(chain.nv), chain.topology.massless_dofs)
    column = jacobian_scales(chain)[1][: chain.nv]
    size = jnp.finfo(column.dtype).eps ** 0.25 * jnp.max(chain.mass) * (chain.length / column) ** 2
    return jnp.where(mask, size, 0)
