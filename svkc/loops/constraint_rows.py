"""The loop constraints without the rates of virtual joints, and their row reduction.

Virtual joints have coordinates without inertia, along which a loop transmits no force. The rows of
the loop Jacobian are therefore projected onto the complement of the virtual joints' motion
subspaces. The three angular rows of a ball vanish there and are left out.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from svkc._jax.control_flow import unvmap_any
from svkc._jax.static_gather import static_take
from svkc.loops.constraint import jacobian_scales
from svkc.loops.pivoting import rank_tolerance, release_threshold
from svkc.model.chain import Chain, Structure
from svkc.tree.spatial import inverse_positive, matvec

BALL_FREEDOMS = (True, True, True, False, False, False)


class VirtualJoints(eqx.Module):
    """Motion subspaces of the virtual joints, padded to the d freedoms of the freest.

    S: motion subspace of each link. gram_inverse: (S^T S)^-1.
    dof: index of each freedom among the virtual joints' coordinates (padding: `count` or more).
    count: number of these coordinates.
    """

    S: Float[Array, "links 6 d"]
    gram_inverse: Float[Array, "links d d"]
    dof: np.ndarray
    count: int

    def joint_rates(self, x: Float[Array, "*n rows"]) -> Float[Array, "*n links d"]:
        """Return S^+ x, the joint rates that fit the loop rows x best."""
        x = x.reshape(*x.shape[:-1], -1, 6)
        return matvec(
            _align_batch_axes(self.gram_inverse, x),
            matvec(_align_batch_axes(jnp.swapaxes(self.S, -1, -2), x), x),
        )

    def reject(self, x: Float[Array, "*n rows"]) -> Float[Array, "*n rows"]:
        """Return x - S S^+ x, the part of the loop rows that the joints cannot follow."""
        rates = self.joint_rates(x)
        return x - matvec(_align_batch_axes(self.S, rates), rates).reshape(x.shape)

    def subset(self, links: np.ndarray) -> "VirtualJoints":
        """Return the virtual joints of some links."""
        S, gram_inverse, dof = self.S[links], self.gram_inverse[links], self.dof[links]
        return VirtualJoints(S=S, gram_inverse=gram_inverse, dof=dof, count=self.count)

    def gather(self, x: Float[Array, " virtual"]) -> Float[Array, "links d"]:
        """Return x, over the virtual joints' coordinates, by link; zero for padding."""
        return static_take(x, np.minimum(self.dof, self.count))

    def scatter(self, rates: Float[Array, "links d"]) -> Float[Array, " virtual"]:
        """Return rates, by link, over the virtual joints' coordinates."""
        flat = self.dof.ravel()
        return static_take(
            rates.ravel(), np.argsort(flat, kind="stable")[: np.sum(flat < self.count)]
        )


class DelassusRows(NamedTuple):
    """The rows of J that are in D: six of each of `full_links`, then the linear three of each ball.

    full_links: links with all six rows in D. The others are unlocked declared balls.
    rows: index in J of each row of D.
    position: index in D of each row of J; the size of D for rows that are not in D.
    """

    full_links: np.ndarray
    rows: np.ndarray
    position: np.ndarray

    def expand(self, x: Float[Array, " delassus"]) -> Float[Array, " rows"]:
        """Return x over all rows of J, zero for rows that are not in D."""
        return static_take(x, self.position)


def delassus_rows(chain: Chain, any_locked: bool) -> DelassusRows:
    """Return the rows of J that are in D.

    The angular rows of a declared ball are left out unless some joint may be locked. Those of a
    spare slot are kept, as its joint is known at run time only.
    """
    top = chain.topology
    is_free_ball = np.array(
        [
            tuple(f) == BALL_FREEDOMS and not spare and not any_locked
            for f, spare in zip(top.link_freedoms, top.link_spare, strict=True)
        ],
        bool,
    )
    of_link = np.arange(6 * len(is_free_ball)).reshape(-1, 6)
    rows = np.concatenate([of_link[~is_free_ball].ravel(), of_link[is_free_ball][:, 3:].ravel()])
    position = np.full(of_link.size, len(rows))
    position[rows] = np.arange(len(rows))
    return DelassusRows(np.flatnonzero(~is_free_ball), rows, position)


def _align_batch_axes(
    A: Float[Array, "links i j"], x: Float[Array, "*n links k"]
) -> Float[Array, "*m links i j"]:
    """Return A with an axis of size 1 for each batch axis of x."""
    return A.reshape(*(1,) * (x.ndim - 2), *A.shape)


def virtual_joints(chain: Chain, J: Float[Array, "rows dofs"]) -> VirtualJoints:
    """Return the virtual joints, with the motion subspaces in the columns of J."""
    dof, count = np.sort(chain.topology.links.dof - chain.nv, 1), chain.dofs - chain.nv
    dof = dof[:, : max(1, np.max(np.sum(dof < count, 1)))]
    columns = jnp.concatenate([J[:, chain.nv :], jnp.zeros_like(J[:, :1])], 1)
    columns = columns.reshape(-1, 6, count + 1)
    S = jnp.swapaxes(columns[np.arange(len(dof))[:, None], :, np.minimum(dof, count)], -1, -2)
    is_padding = jnp.where(jnp.all(S == 0, 1), 1, 0).astype(J.dtype)
    gram = (
        jnp.sum(S[:, :, :, None] * S[:, :, None], 1)
        + is_padding[:, :, None] * np.eye(dof.shape[1], dtype=J.dtype)[None]
    )
    return VirtualJoints(S=S, gram_inverse=inverse_positive(gram), dof=dof, count=count)


class ConstraintRows(NamedTuple):
    """The loop constraints J x + bias = 0 without the rates of the virtual joints.

    They are A x + T R bias = 0 over the tree's coordinates, with A = T R J_D. J_D are the rows of J
    in D, and R rejects what the virtual joints can follow. T is the identity or, near a singular
    configuration, the row reduction of R J_D.

    joints: the virtual joints. in_D: the rows of J in D.
    T: None for the identity.
    pivots: one-hot rows: the pivot column of each row of A, zero where T is the identity. None if T
        is None.
    """

    joints: VirtualJoints
    in_D: DelassusRows
    A: Float[Array, "delassus nv"]
    T: Float[Array, "delassus delassus"] | None = None
    pivots: Float[Array, "delassus nv"] | None = None

    def reject(self, x: Float[Array, "*n delassus"]) -> Float[Array, "*n delassus"]:
        """Return R x."""
        n = 6 * len(self.in_D.full_links)
        if not n:
            return x  # the joint rates of free balls are in none of these rows
        full_joints = self.joints.subset(self.in_D.full_links)
        return jnp.concatenate([full_joints.reject(x[..., :n]), x[..., n:]], -1)

    def along_joints(self) -> Float[Array, "delassus delassus"]:
        """Return I - R, or zero for reduced rows: the projector onto what the joints can follow."""
        n = len(self.in_D.rows)
        eye = jnp.eye(n, dtype=self.A.dtype)
        if not len(self.in_D.full_links):
            return jnp.zeros_like(eye)
        projector = eye - self.reject(eye)
        if self.pivots is None:
            return projector
        return jnp.where(jnp.any(self.pivots > 0), 0, projector)

    def reduce(self, bias: Float[Array, " rows"]) -> Float[Array, " delassus"]:
        """Return T R bias."""
        x = self.reject(static_take(bias, self.in_D.rows))
        return x if self.T is None else matvec(self.T, x)

    def expand(self, force: Float[Array, " delassus"]) -> Float[Array, " rows"]:
        """Return the forces on all rows of J whose generalized force is A^T force."""
        x = force if self.T is None else matvec(self.T.T, force)
        return static_take(self.reject(x), self.in_D.position)


def constraint_rows(
    chain: Chain,
    structure: Structure,
    J: Float[Array, "rows dofs"],
    near: Bool[Array, ""] | None = None,
) -> ConstraintRows:
    """Return the constraint rows of the scaled J_C, without derivatives.

    near: whether the rows are reduced, as near a singular configuration (None: never).
    """
    J, column = jax.lax.stop_gradient((J, jacobian_scales(chain)[1]))
    in_D = delassus_rows(chain, structure.locked is not None)
    rows = ConstraintRows(virtual_joints(chain, J / column[None]), in_D, J)
    J_D = static_take(J[:, : chain.nv], in_D.rows)
    scaled, unscale = rows.reject(J_D.T).T, 1 / column[None, : chain.nv]
    if near is None:
        return rows._replace(A=scaled * unscale)
    identity = scaled, jnp.eye(len(scaled), dtype=J.dtype), jnp.zeros_like(scaled)
    virtual = jnp.sum(jnp.any(J[:, chain.nv :] != 0, 0), dtype=jnp.int32)
    # under `vmap`, one lane near a singular configuration makes all lanes reduce their rows
    A, T, pivots = jax.lax.cond(
        unvmap_any(near),
        lambda: jax.tree.map(
            lambda a, b: jnp.where(near, a, b),
            reduce_rows(scaled, structure, structure.rank - virtual),
            identity,
        ),
        lambda: identity,
    )
    return rows._replace(A=A * unscale, T=T, pivots=pivots)


def reduce_rows(
    B: Float[Array, "n nv"], structure: Structure, rank: Int[Array, ""]
) -> tuple[Float[Array, "n nv"], Float[Array, "n n"], Float[Array, "n nv"]]:
    """Return A = T B, T and the pivots, by Gauss-Jordan elimination with complete pivoting.

    Each row of A is one in its own pivot column and zero in those of other rows. Beyond the rank,
    and below `rank_tolerance` or `release_threshold` of the first pivot, rows are zero. The
    condition number of A does not grow towards a singular configuration, as that of B does.
    """
    n, nv = B.shape
    weak = jnp.maximum(rank_tolerance(B.dtype), release_threshold(B.dtype) * structure.margin)
    weight = jnp.ones(nv, B.dtype)
    if structure.independent is not None:
        weight = jnp.where(structure.independent[:nv], rank_tolerance(B.dtype) ** 2, weight)

    def step(k, carry):
        A, pivots, largest = carry
        free = ~jnp.any(pivots > 0, 1)
        size = jnp.where(free[:, None], jnp.abs(A[:, :nv]) * weight[None], 0)
        at_row = jnp.arange(n) == jnp.argmax(jnp.max(size, 1))
        row = jnp.sum(jnp.where(at_row[:, None], A, 0), 0)
        size = jnp.max(jnp.where(at_row[:, None], size, 0), 0)
        at_column = jnp.arange(nv) == jnp.argmax(size)
        pivot = jnp.sum(jnp.where(at_column, row[:nv], 0))
        largest = jnp.where(k == 0, jnp.abs(pivot), largest)
        accept = (k < rank) & (jnp.abs(pivot) > weak * largest)
        row = row / jnp.where(accept, pivot, 1)
        column = jnp.sum(jnp.where(at_column[None], A[:, :nv], 0), 1)
        reduced = jnp.where(at_row[:, None], row[None], A - column[:, None] * row[None])
        exact = jnp.where(at_column[None] & ~at_row[:, None], 0, reduced[:, :nv])
        reduced = jnp.concatenate([exact, reduced[:, nv:]], 1)
        pivots = jnp.where(accept & at_row[:, None] & at_column[None], 1, pivots)
        return jnp.where(accept, reduced, A), pivots, largest

    start = jnp.concatenate([B, jnp.eye(n, dtype=B.dtype)], 1), jnp.zeros_like(B), B[0, 0]
    A, pivots, _ = jax.lax.fori_loop(0, min(n, nv), step, start)
    A = jnp.where(jnp.any(pivots > 0, 1)[:, None], A, 0)
    return A[:, :nv], A[:, nv:], pivots


def with_consistent_velocities(
    chain: Chain,
    J: Float[Array, "rows dofs"],
    v: Float[Array, " dofs"],
    rows: ConstraintRows,
) -> Float[Array, " dofs"]:
    """Return v, changed at the pivots of reduced rows and of virtual joints such that J v = 0.

    J: the scaled J_C. v: zero where inactive.
    """
    assert rows.pivots is not None
    nv, column = chain.nv, jacobian_scales(chain)[1]
    frozen = jax.lax.stop_gradient(column)
    # The second correction is round-off. With it, derivatives are exact although T is constant.
    for _ in range(2):
        rate = J @ (v / column)
        at_pivots = frozen[:nv] * (rows.reduce(rate) @ rows.pivots)
        v = jnp.concatenate([v[:nv] - at_pivots, v[nv:]])
        rate = J @ (v / column)
        v = jnp.concatenate([v[:nv], v[nv:] - rows.joints.scatter(rows.joints.joint_rates(rate))])
    return v
