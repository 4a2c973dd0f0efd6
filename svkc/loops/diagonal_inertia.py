"""Inertia added to, or subtracted from, the diagonal of the mass matrix.

Implicit joint damping adds such an inertia. Massless bodies need one too: where loops alone
determine their motion, the tree's mass matrix is singular.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc._jax.batched_lapack import solve_general
from svkc._jax.select import where
from svkc.loops.constraint import jacobian_scales
from svkc.model.chain import Chain


def with_armature(chain: Chain, added: Float[Array, " nv"]) -> Chain:
    """Return the chain with more inertia on the diagonal of its mass matrix."""
    armature = added if chain.armature is None else chain.armature + added
    return eqx.tree_at(lambda c: c.armature, chain, armature, is_leaf=lambda x: x is None)


def with_inertia(
    chain: Chain, solve: Callable, dofs: np.ndarray, inertia: Float[Array, " n"]
) -> Callable:
    """Return the solver of the mass matrix M + C from `solve`, that of M (Woodbury's formula).

    Let x_0 be the accelerations of `dofs` from `solve`, and G f those that forces f on `dofs` cause
    there. The added inertia acts as the forces -C x, so that (1 + G C) x = x_0.

    solve: (force [dofs], bias [rows]) -> accelerations, or a tuple whose first entry they are.
    dofs: the coordinates to which C adds inertia.
    inertia: diagonal of C on the coordinates `dofs`; may be negative.
    """
    no_bias = jnp.zeros(6 * len(chain.link_names), inertia.dtype)
    unit_forces = jnp.asarray(np.eye(chain.dofs)[dofs], inertia.dtype)
    responses = jax.vmap(lambda force: solve(force, no_bias))(unit_forces)
    G = jax.tree.leaves(responses)[0][:, dofs].T
    system = np.eye(len(dofs), dtype=inertia.dtype) + G * inertia[None]

    def solve_with_inertia(force, bias):
        start = solve(force, bias)
        x = solve_general(system, jax.tree.leaves(start)[0][dofs])
        return jax.tree.map(lambda a, b: a - (inertia * x) @ b, start, responses)

    return solve_with_inertia


def auxiliary_inertia(chain: Chain) -> Float[Array, " nv"]:
    """Return an inertia of each massless body's joint coordinates, zero for other coordinates.

    With this inertia on the diagonal the tree's mass matrix is regular; `with_inertia` subtracts it
    again. Its size is eps^(1/4) (float64: 1.2e-4) of the largest mass, or of that mass times
    `chain.length`^2 for angles. With a smaller one, the regularization of Delassus' matrix would
    make loop forces inexact. A larger one costs digits where loops couple a massless body to little
    inertia of its neighbours.
    """
    mask = np.isin(np.arange(chain.nv), chain.topology.massless_dofs)
    column = jacobian_scales(chain)[1][: chain.nv]
    size = jnp.finfo(column.dtype).eps ** 0.25 * jnp.max(chain.mass) * (chain.length / column) ** 2
    return where(mask, size, 0)
