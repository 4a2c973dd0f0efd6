"""The articulated-body algorithm (Featherstone chapter 7): M^-1 f without M, level by level.

Articulated inertias are given in world axes about the root's origin, so that those of children
add up without a change of coordinates. All rows of a level are one array. Joints with fewer
freedoms than the widest of their level are padded with freedoms without motion and with inertia 1.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from svkc._jax.chunked_sum import sum_in_chunks
from svkc._jax.select import where
from svkc._jax.static_gather import static_take
from svkc.model.chain import Chain
from svkc.model.topology import Topology
from svkc.tree.kinematics import Kinematics
from svkc.tree.mass_matrix import spatial_inertias
from svkc.tree.spatial import inverse_positive
from svkc.tree.traversal import (
    initial_carry,
    level_tables,
    rows_per_level,
    scan_levels,
    sum_children,
    with_level_data,
    zip_levels,
)


class ArticulatedLevel(NamedTuple):
    """Factors of the mass matrix at one level (Featherstone (7.43), (7.44)).

    S: motion subspaces, one row per freedom. U: S I^A. D_inverse: (S I^A S^T + armature)^-1.
    """

    S: Float[Array, "*levels n d 6"]
    U: Float[Array, "*levels n d 6"]
    D_inverse: Float[Array, "*levels n d d"]


def articulated_factors(
    chain: Chain, kin: Kinematics, free: Bool[Array, " nv"] | None = None
) -> list[ArticulatedLevel] | ArticulatedLevel:
    """Return S, U and D^-1 of each level, from articulated inertias summed towards the roots.

    free: coordinates that are not locked (None: all).
    """
    top = chain.topology
    S = kin.S if free is None else where(free[:, None], kin.S, 0)
    armature = jnp.zeros(chain.nv, S.dtype) if chain.armature is None else chain.armature
    armature = armature if free is None else where(free, armature, 1)
    # The last entry is the padding's.
    armature = jnp.concatenate([armature, jnp.ones(1, S.dtype)])

    def step(from_children, level_data):
        (level, s, rotor), own = level_data
        I_A = own.matrices()
        if from_children is not None:
            I_A = I_A + sum_children(level.children, from_children)
        U = jnp.sum(s[:, :, :, None] * I_A[:, None], 2)
        D = (
            jnp.sum(U[:, :, None] * s[:, None], -1)
            + rotor[:, :, None] * np.eye(s.shape[1], dtype=s.dtype)[None]
        )
        D_inverse = inverse_positive(D)
        D_inverse_U = jnp.sum(D_inverse[..., None] * U[:, None], 2)
        to_parent = I_A - jnp.sum(U[:, :, :, None] * D_inverse_U[:, :, None, :], 1)
        return to_parent, ArticulatedLevel(s, U, D_inverse)

    level_data = with_level_data(
        top, lambda x: static_take(S, x.dofs), lambda x: static_take(armature, x.dofs)
    )
    # The matrices are made level by level: matrices of all levels would be copied once more.
    own = rows_per_level(top, spatial_inertias(chain, kin))
    return scan_levels(
        step, initial_carry(top, 6, 6, dtype=S.dtype), zip_levels(level_data, own), reverse=True
    )


def _batched_matvec(A: Float[Array, "n i j"], x: Float[Array, "n j *k"]) -> Float[Array, "n i *k"]:
    """Return A x for each of n matrices, over any trailing axes of x."""
    return jnp.sum(A.reshape(*A.shape, *(1,) * (x.ndim - 2)) * x[:, None], 2)


class JointForces(NamedTuple):
    """Joint forces passed towards the roots: u = f - S p^A, and D^-1 u, over all levels.

    p^A is the articulated bias force that a body's children pass to it (Featherstone table 7.1,
    second pass). The rows are those of the levels in order, padding included.
    """

    u: Float[Array, "padded *k"]
    x: Float[Array, "padded *k"]


def pass_inward(top: Topology, bodies: Any, f: Float[Array, "nv *k"]) -> JointForces:
    """Return u = L^-T f and D^-1 u, for M = L^T D L with a block of D for each joint.

    (Featherstone section 6.5.) f may have trailing axes.
    """

    def step(from_children, level_data):
        (level, force), body = level_data
        p = None if from_children is None else sum_children(level.children, from_children)
        u = force if p is None else force - _batched_matvec(body.S, p)
        x = _batched_matvec(body.D_inverse, u)
        to_parent = _batched_matvec(jnp.swapaxes(body.U, 1, 2), x)
        return to_parent if p is None else to_parent + p, (u, x)

    parts = scan_levels(
        step,
        initial_carry(top, 6, *f.shape[1:], dtype=f.dtype),
        zip_levels(with_level_data(top, lambda x: static_take(f, x.dofs)), bodies),
        reverse=True,
    )
    parts = parts if isinstance(parts, list) else [parts]
    flat = lambda i: jnp.concatenate([part[i].reshape(-1, *f.shape[1:]) for part in parts])
    return JointForces(flat(0), flat(1))


def inner_product(a: JointForces, b: JointForces) -> Float[Array, "columns *k"]:
    """Return f_a^T M^-1 f_b, of the columns f_a and f_b that were passed inward."""
    u = a.u.reshape(*a.u.shape, *(1,) * (b.x.ndim - 1))
    # sums instead of a `dot`, which XLA's CPU backend does not fuse with its neighbours
    return sum_in_chunks(u * b.x[:, None], (0,))


def pass_outward(top: Topology, bodies: Any, x: Float[Array, " padded"]) -> Float[Array, " nv"]:
    """Return L^-1 x, which is M^-1 f if x is D^-1 L^-T f (Featherstone table 7.1, third pass)."""

    def step(previous, level_data):
        (level, body), x = level_data
        if previous is not None:
            a = static_take(previous, level.parent)
            x = x - jnp.sum(body.D_inverse * jnp.sum(body.U * a[:, None], -1)[:, None], -1)
        relative = jnp.sum(body.S * x[..., None], 1)
        return relative if previous is None else a + relative, x

    levels = level_tables(top)
    shape = lambda level: level.dofs.shape
    if isinstance(levels, list):
        ends = np.cumsum([level.dofs.size for level in levels])
        parts = [
            x[end - level.dofs.size : end].reshape(shape(level))
            for level, end in zip(levels, ends, strict=True)
        ]
    else:
        parts = x.reshape(shape(levels))
    x = scan_levels(
        step, initial_carry(top, 6, dtype=x.dtype), zip_levels(zip_levels(levels, bodies), parts)
    )
    if isinstance(levels, list):
        x = jnp.concatenate([y.ravel() for y in x])
        dofs = np.concatenate([level.dofs.ravel() for level in levels])
    else:
        x, dofs = x.ravel(), levels.dofs.ravel()
    # the padding, whose entries of `dofs` are nv, comes last
    return static_take(x, np.argsort(dofs, kind="stable")[: top.nv])


def solve_mass_matrix(top: Topology, bodies: Any, f: Float[Array, " nv"]) -> Float[Array, " nv"]:
    """Return M^-1 f, the joint accelerations at rest without gravity (Featherstone table 7.1)."""
    return pass_outward(top, bodies, pass_inward(top, bodies, f).x)
