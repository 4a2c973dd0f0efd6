"""Articulated bodies (Featherstone chapter 7): M^-1 f on the tree without M, level by level.

In world axes about the root's origin articulated inertias add up along the tree as they are. All
rows of a level are one array; a joint of fewer freedoms than its level's widest has freedoms that
are nothing: no motion, an inertia of one.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from svkc._jax.lanes_last import sum_in_chunks
from svkc._jax.static_gather import static_take
from svkc.model.chain import Chain
from svkc.model.topology import Topology
from svkc.tree.kinematics import Kinematics
from svkc.tree.mass_matrix import spatial_inertias
from svkc.tree.spatial import inverse_positive
from svkc.tree.traversal import (
    initial_carry,
    level_tables,
    scan_levels,
    sum_children,
    with_level_data,
    zip_levels,
)


class ArticulatedLevel(NamedTuple):
    """What `accelerations` needs of the bodies of one level: joint axes S, U = S I^A, (S I^A
    S^T)^-1."""

    S: Float[Array, "*levels n d 6"]
    U: Float[Array, "*levels n d 6"]
    inverse: Float[Array, "*levels n d d"]


def articulated_inertias(
    chain: Chain, kin: Kinematics, free: Bool[Array, " nv"] | None = None
) -> list[ArticulatedLevel] | ArticulatedLevel:
    """Articulated inertias from the leaves to the roots. free: coordinates that are not locked
    (None: all)."""
    top, own = chain.topology, spatial_inertias(chain, kin)
    S = kin.S if free is None else jnp.where(free[:, None], kin.S, 0)
    more = jnp.zeros(chain.nv, S.dtype) if chain.armature is None else chain.armature
    more = more if free is None else jnp.where(free, more, 1)
    more = jnp.concatenate([more, jnp.ones(1, S.dtype)])

    def step(below, given):
        level, A, s, m = given
        A = A if below is None else A + sum_children(level.children, below)
        U = jnp.sum(s[:, :, :, None] * A[:, None], 2)
        D = jnp.sum(U[:, :, None] * s[:, None], -1) + m[:, :, None] * np.eye(s.shape[1])[None]
        inverse = inverse_positive(D)
        along = jnp.sum(inverse[..., None] * U[:, None], 2)
        return A - jnp.sum(U[:, :, :, None] * along[:, :, None, :], 1), ArticulatedLevel(
            s, U, inverse
        )

    given = with_level_data(
        top,
        lambda x: static_take(own, x.rows),
        lambda x: static_take(S, x.dofs),
        lambda x: static_take(more, x.dofs),
    )
    return scan_levels(step, initial_carry(top, 6, 6, dtype=S.dtype), given, reverse=True)


def _batched_matvec(A: Float[Array, "n i j"], x: Float[Array, "n j *k"]) -> Float[Array, "n i *k"]:
    return jnp.sum(A.reshape(*A.shape, *(1,) * (x.ndim - 2)) * x[:, None], 2)


def _inward_pass(top: Topology, bodies, f: Float[Array, "nv *k"]):
    """For each level the forces that its joints are left with, those from below taken off, and the
    accelerations that these give each joint alone."""

    def step(below, given):
        (level, force), body = given
        p = None if below is None else sum_children(level.children, below)
        u = force if p is None else force - _batched_matvec(body.S, p)
        x = _batched_matvec(body.inverse, u)
        passed = _batched_matvec(jnp.swapaxes(body.U, 1, 2), x)
        return passed if p is None else passed + p, (u, x)

    return scan_levels(
        step,
        initial_carry(top, 6, *f.shape[1:], dtype=f.dtype),
        zip_levels(with_level_data(top, lambda x: static_take(f, x.dofs)), bodies),
        reverse=True,
    )


def delassus_matrix(top: Topology, bodies, J: Float[Array, "rows nv"]) -> Float[Array, "rows rows"]:
    """J M^-1 J^T. M = L D L^T with a joint's block of D for each (Featherstone section 6.5), so
    that half the way to M^-1 J^T is enough."""
    parts = _inward_pass(top, bodies, J.T)
    parts = parts if isinstance(parts, list) else [parts]
    u, x = (jnp.concatenate([part[i].reshape(-1, J.shape[0]) for part in parts]) for i in (0, 1))
    # sums, not a `dot`, which XLA's CPU backend would not put into one kernel with what is around
    # it
    return sum_in_chunks(u[:, :, None] * x[:, None], (0,))


def solve_mass_matrix(top: Topology, bodies, f: Float[Array, " nv"]) -> Float[Array, " nv"]:
    """M^-1 f: the joints' accelerations at rest, without gravity (Featherstone table 7.1)."""

    def step(above, given):
        (level, body), (_, x) = given
        if above is not None:
            a = static_take(above, level.parent)
            x = x - jnp.sum(body.inverse * jnp.sum(body.U * a[:, None], -1)[:, None], -1)
        moved = jnp.sum(body.S * x[..., None], 1)
        return moved if above is None else a + moved, x

    found = level_tables(top)
    x = scan_levels(
        step,
        initial_carry(top, 6, dtype=f.dtype),
        zip_levels(zip_levels(found, bodies), _inward_pass(top, bodies, f)),
    )
    x, order = (
        (jnp.concatenate([y.ravel() for y in x]), [y.dofs for y in found])
        if isinstance(found, list)
        else (x.ravel(), [found.dofs])
    )
    return static_take(
        x, np.argsort(np.concatenate([y.ravel() for y in order]), kind="stable")[: top.nv]
    )
