"""The loop constraints without the rates of virtual joints, and their row reduction.

Virtual joints have coordinates without inertia, along which a loop transmits no force. The rows of
the loop Jacobian are therefore projected onto the complement of the virtual joints' motion
subspaces. Most rows along a joint's axes are left out beforehand (`DelassusRows`).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from svkc._jax.control_flow import unvmap_any
from svkc._jax.select import where
from svkc._jax.static_gather import static_take
from svkc.loops.constraint import LoopKinematics, jacobian_scales, loop_kinematics, loop_rates
from svkc.loops.delassus_rows import DelassusRows, delassus_rows
from svkc.loops.pivoting import has_redundant_rows, rank_tolerance, release_threshold
from svkc.loops.virtual_joints import VirtualJoints, virtual_joints
from svkc.model.chain import Chain, Structure
from svkc.tree.spatial import matvec


class RowChoice(NamedTuple):
    """Which rows of the loop constraints are used.

    near: whether the rows are reduced at every evaluation, as near a singular configuration.
    kept: the rows that are used otherwise. Of redundant loops these are as many as the phase's
        rank, less the freedoms of connected virtual joints. They are independent at the
        configuration at which they were chosen.
    """

    near: Bool[Array, ""]
    kept: Bool[Array, " delassus"]

    @classmethod
    def of_first_step(
        cls, chain: Chain, structure: Structure, near: Bool[Array, ""]
    ) -> "RowChoice":
        """Return the rows of a phase's first step: reduced ones if a loop is redundant.

        near: whether the phase starts near a singular configuration.
        """
        count = delassus_rows(chain, structure.locked is not None).count
        return cls(near | has_redundant_rows(structure), jnp.ones(count, bool))


class ConstraintRows(NamedTuple):
    """The loop constraints J x + bias = 0 without the rates of the virtual joints.

    They are A x + T R N bias = 0 over the tree's coordinates, with A = T R N J_tree. J_tree are the
    columns of the tree in J, with scaled rows. N rotates and selects rows (`DelassusRows`). R
    projects out the motions of the joints of `in_D.projected_links`. T is the identity without a
    `RowChoice`. Near a singular configuration it is the row reduction of R N J_tree. Elsewhere it
    sets rows that are not kept to zero.

    joints: the virtual joints. in_D: N, without the axes of the frames.
    frame_axes: for each group that N rotates the axes of the joint's frame, as columns.
    scaled: R N J_tree with scaled columns. rank: the largest rank of A.
    T: None without a `RowChoice`.
    pivots: row i is one at the pivot column of row i of A. It is zero if the row has no pivot, and
        where T is no row reduction. None if T is None.
    kept: rows of A that are not dropped. None: all.
    """

    joints: VirtualJoints
    in_D: DelassusRows
    frame_axes: Float[Array, "rotated 3 3"]
    scaled: Float[Array, "delassus nv"]
    rank: Int[Array, ""]
    A: Float[Array, "delassus nv"]
    T: Float[Array, "delassus delassus"] | None = None
    pivots: Float[Array, "delassus nv"] | None = None
    kept: Bool[Array, " delassus"] | None = None

    def reject(self, x: Float[Array, "*n delassus"]) -> Float[Array, "*n delassus"]:
        """Return R x."""
        n = 6 * len(self.in_D.projected_links)
        if not n:
            return x
        of_projected = self.joints.subset(self.in_D.projected_links).reject(x[..., :n])
        return jnp.concatenate([of_projected, x[..., n:]], -1)

    def null_projector(self) -> Float[Array, "delassus delassus"]:
        """Return the projector onto known left null directions of A.

        These are the dropped rows or, if no row is dropped, the motions that R projects out: I - R.
        """
        eye = jnp.eye(self.in_D.count, dtype=self.A.dtype)
        projector = eye - self.reject(eye)
        if self.kept is None:
            return projector
        return where(jnp.all(self.kept), projector, where(self.kept[:, None], 0, eye))

    def reduce(self, bias: Float[Array, " rows"]) -> Float[Array, " delassus"]:
        """Return T R N bias."""
        x = self.reject(self.in_D.select(bias, self.frame_axes))
        return x if self.T is None else matvec(self.T, x)

    def expand(self, force: Float[Array, " delassus"]) -> Float[Array, " rows"]:
        """Return the forces on all rows of J whose generalized force is A^T force."""
        x = force if self.T is None else matvec(self.T.T, force)
        return self.in_D.expand(self.reject(x), self.frame_axes)


def constraint_rows(
    chain: Chain, structure: Structure, loops: LoopKinematics, choice: RowChoice | None = None
) -> ConstraintRows:
    """Return the constraint rows of the scaled J_C, without derivatives.

    choice: which rows are used (None: all of them).
    """
    J, axes, column = jax.lax.stop_gradient((loops.J, loops.frames.axes, jacobian_scales(chain)[1]))
    in_D = delassus_rows(chain, structure.locked is not None)
    joints = virtual_joints(chain, J / column[None])
    joint_columns = jnp.sum(jnp.any(J[:, chain.nv :] != 0, 0), dtype=jnp.int32)
    # the axes of translation are those of the joint's frame; a single axis of rotation is, too
    frame_axes = jnp.swapaxes(static_take(axes[:, 3:], in_D.rotated_groups // 2), -1, -2)
    selected_rows = in_D.select(J[:, : chain.nv], frame_axes)
    rows = ConstraintRows(
        joints=joints, in_D=in_D, frame_axes=frame_axes, scaled=selected_rows,
        rank=structure.rank - joint_columns, A=selected_rows,
    )  # fmt: skip
    scaled, unscale = rows.reject(selected_rows.T).T, 1 / column[None, : chain.nv]
    rows = rows._replace(scaled=scaled, A=scaled * unscale)
    if choice is None:
        return rows
    near, kept = choice
    selects = where(kept[:, None], jnp.eye(len(scaled), dtype=J.dtype), 0)
    selected = where(kept[:, None], scaled, 0), selects, jnp.zeros_like(scaled)
    # under `vmap`, one lane near a singular configuration makes all lanes reduce their rows
    A, T, pivots = jax.lax.cond(
        unvmap_any(near),
        lambda: jax.tree.map(
            lambda a, b: where(near, a, b),
            reduce_rows(scaled, structure, rows.rank),
            selected,
        ),
        lambda: selected,
    )
    kept = where(near, jnp.any(pivots > 0, 1), kept)
    return rows._replace(A=A * unscale, T=T, pivots=pivots, kept=kept)


def independent_rows(structure: Structure, rows: ConstraintRows) -> Bool[Array, " delassus"]:
    """Return which rows of Delassus' matrix are independent, by elimination.

    rows: made with any choice; only `scaled` and `rank` are used.
    """
    return _eliminate(rows.scaled, rows.scaled.shape[1], structure, rows.rank)[1] >= 0


def choose_rows(
    chain: Chain, structure: Structure, q: Float[Array, " q"], near: Bool[Array, ""]
) -> RowChoice:
    """Return the rows that a step from q uses.

    near: as in `RowChoice`.
    """
    q, redundant = jax.lax.stop_gradient(q), has_redundant_rows(structure)
    first = RowChoice.of_first_step(chain, structure, near)

    def independent() -> Bool[Array, " delassus"]:
        loops = loop_kinematics(chain, structure, q)
        kept = independent_rows(structure, constraint_rows(chain, structure, loops))
        return where(redundant, kept, first.kept)

    # under `vmap`, one lane with redundant loops makes all lanes choose rows
    return RowChoice(near, jax.lax.cond(unvmap_any(redundant), independent, lambda: first.kept))


def reduce_rows(
    B: Float[Array, "n nv"], structure: Structure, rank: Int[Array, ""]
) -> tuple[Float[Array, "n nv"], Float[Array, "n n"], Float[Array, "n nv"]]:
    """Return A = T B, T and the pivots, by Gauss-Jordan elimination with complete pivoting.

    Each row of A is one in its own pivot column and zero in those of other rows. A pivot counts
    only within the rank, and if it exceeds the first one times the larger of `rank_tolerance` and
    `release_threshold` times the margin; other rows are zero. Towards a singular configuration the
    condition number of B grows. That of A does not.
    """
    n, nv = B.shape
    with_T = jnp.concatenate([B, jnp.eye(n, dtype=B.dtype)], 1)
    A, pivot_column = _eliminate(with_T, nv, structure, rank)
    A = where((pivot_column >= 0)[:, None], A, 0)
    pivots = pivot_column[:, None] == jnp.arange(nv, dtype=jnp.int32)[None]
    return A[:, :nv], A[:, nv:], pivots.astype(B.dtype)


def _eliminate(
    A: Float[Array, "n m"], nv: int, structure: Structure, rank: Int[Array, ""]
) -> tuple[Float[Array, "n m"], Int[Array, " n"]]:
    """Return A after the elimination of `reduce_rows`, and the pivot column of each row (-1: none).

    nv: number of columns, the first ones, in which pivots are chosen.
    """
    n = len(A)
    weak = jnp.maximum(rank_tolerance(A.dtype), release_threshold(A.dtype) * structure.margin)
    weight = jnp.ones(nv, A.dtype)
    if structure.independent is not None:
        weight = where(structure.independent[:nv], rank_tolerance(A.dtype) ** 2, weight)

    def step(k, carry):
        A, pivot_column, largest = carry
        size = jnp.max(jnp.abs(A[:, :nv]) * weight[None], 1)
        # the argmax prefers rows of zeros to rows that have a pivot
        i = jax.lax.argmax(where(pivot_column >= 0, -1, size), 0, jnp.int32)
        at_row = jnp.arange(n, dtype=jnp.int32) == i
        row = jnp.sum(where(at_row[:, None], A, 0), 0)
        j = jax.lax.argmax(jnp.abs(row[:nv]) * weight, 0, jnp.int32)
        at_column = jnp.arange(A.shape[1], dtype=jnp.int32) == j
        pivot = jnp.sum(where(at_column, row, 0))
        largest = where(k == 0, jnp.abs(pivot), largest)
        accept = (k < rank) & (jnp.abs(pivot) > weak * largest)
        column = jnp.sum(where(at_column[None], A, 0), 1)
        row = row / where(accept, pivot, 1)
        others = where(at_column[None], 0, A - column[:, None] * row[None])
        reduced = where(at_row[:, None], row[None], others)
        pivot_column = where(accept & at_row, j, pivot_column)
        return where(accept, reduced, A), pivot_column, largest

    start = A, jnp.full(n, -1, jnp.int32), A[0, 0]
    A, pivot_column, _ = jax.lax.fori_loop(0, min(n, nv), step, start)
    return A, pivot_column


def with_consistent_velocities(
    chain: Chain, loops: LoopKinematics, v: Float[Array, " dofs"], rows: ConstraintRows
) -> Float[Array, " dofs"]:
    """Return v, changed at the pivots of reduced rows and of virtual joints such that J v = 0.

    v: zero where inactive.
    """
    nv, pivots = chain.nv, rows.pivots
    assert pivots is not None
    column, J_tree = jax.lax.stop_gradient((jacobian_scales(chain)[1], loops.J[:, :nv]))

    def correct(v):
        rate = loop_rates(chain, loops, v)
        at_pivots = rows.reduce(rate) @ pivots
        of_joints = rows.joints.joint_rates(rate - J_tree @ at_pivots)
        return v - jnp.concatenate([column[:nv] * at_pivots, rows.joints.scatter(of_joints)])

    # The second correction changes v by round-off alone. It makes first derivatives exact, and
    # second derivatives where J v = 0, although T and J_tree are constant in them.
    return correct(correct(v))
