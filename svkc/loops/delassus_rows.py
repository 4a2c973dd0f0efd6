"""From which rows of the loop Jacobian J the rows in Delassus' matrix are made."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc._jax.static_gather import static_take
from svkc.model.chain import Chain
from svkc.tree.spatial import matvec


class DelassusRows(NamedTuple):
    """How the rows N J in Delassus' matrix D are made from those of J. N is orthonormal.

    A link has two groups of rows in J, three angular and three linear ones. If its joint moves
    along one or two of a group's directions, the group is expressed in the joint's frame, which is
    fixed in the parent, and the rows along the joint's axes are left out. If the joint moves along
    all three, the group is left out. If it moves along none, the group is used as it is.

    Of some links all six rows are used as they are, although their joints can move along some of
    them. `ConstraintRows.reject` projects these motions out. They are

    - joints with exactly two rotations, whose second axis depends on the first angle;
    - spare slots, whose joint is known at run time only;
    - every joint that can move, if the structure has a mask of locked coordinates;
    - free joints, which constrain nothing. Without their rows D could be empty.

    projected_links: indices of these links. Their rows come first.
    rotated_groups: groups that are expressed in a joint's frame. 2 i is the angular group of link
        i, and 2 i + 1 is the linear one.
    kept_of_rotated: which of the rows of the rotated groups, three each, come next.
    unrotated_rows: rows of J that come last.
    link_count: number of virtual links.
    """

    projected_links: np.ndarray
    rotated_groups: np.ndarray
    kept_of_rotated: np.ndarray
    unrotated_rows: np.ndarray
    link_count: int

    @property
    def count(self) -> int:
        """Number of rows in D."""
        return 6 * len(self.projected_links) + len(self.kept_of_rotated) + len(self.unrotated_rows)

    def select(
        self, x: Float[Array, "rows *n"], frame_axes: Float[Array, "rotated 3 3"]
    ) -> Float[Array, "delassus *n"]:
        """Return N x: rotate the groups, and take the rows that are kept.

        frame_axes: for each rotated group the axes of the joint's frame, as columns.
        """
        parts = []
        if len(self.projected_links):
            parts.append(static_take(x, _rows_of(self.projected_links, 6)))
        if len(self.rotated_groups):
            groups = static_take(x, _rows_of(self.rotated_groups, 3)).reshape(-1, 3, *x.shape[1:])
            axes = frame_axes.reshape(-1, 3, 3, *(1,) * (x.ndim - 1))
            rotated = jnp.sum(axes * groups[:, :, None], 1).reshape(-1, *x.shape[1:])
            parts.append(static_take(rotated, self.kept_of_rotated))
        if len(self.unrotated_rows):
            parts.append(static_take(x, self.unrotated_rows))
        return jnp.concatenate(parts)

    def expand(
        self, x: Float[Array, " delassus"], frame_axes: Float[Array, "rotated 3 3"]
    ) -> Float[Array, " rows"]:
        """Return N^T x, over all rows of J."""
        ends = np.cumsum([6 * len(self.projected_links), len(self.kept_of_rotated)]).tolist()
        of_projected, of_rotated, unrotated = jnp.split(x, ends)
        source = _positions(self.kept_of_rotated, 3 * len(self.rotated_groups))
        groups = matvec(frame_axes, static_take(of_rotated, source).reshape(-1, 3))
        rows = _rows_of(self.projected_links, 6), _rows_of(self.rotated_groups, 3)
        source = _positions(np.concatenate([*rows, self.unrotated_rows]), 6 * self.link_count)
        return static_take(jnp.concatenate([of_projected, groups.ravel(), unrotated]), source)


def delassus_rows(chain: Chain, has_lock_mask: bool) -> DelassusRows:
    """Return how the rows in Delassus' matrix of a chain are made."""
    top = chain.topology
    freedoms = np.array(top.link_freedoms, bool).reshape(-1, 2, 3)
    of_group = freedoms.sum(-1)
    is_projected = np.array(top.link_spare, bool) | (of_group[:, 0] == 2) | freedoms.all((1, 2))
    if has_lock_mask:
        is_projected = is_projected | freedoms.any((1, 2))
    is_rotated = ~is_projected[:, None] & (of_group > 0) & (of_group < 3)
    is_unrotated = ~is_projected[:, None] & (of_group == 0)
    return DelassusRows(
        projected_links=np.flatnonzero(is_projected),
        rotated_groups=np.flatnonzero(is_rotated.ravel()),
        kept_of_rotated=np.flatnonzero(~freedoms[is_rotated].ravel()),
        unrotated_rows=_rows_of(np.flatnonzero(is_unrotated.ravel()), 3),
        link_count=len(freedoms),
    )


def _rows_of(blocks: np.ndarray, size: int) -> np.ndarray:
    """Return the indices of the rows of blocks of `size` rows each."""
    return (size * blocks[:, None] + np.arange(size)).ravel()


def _positions(index: np.ndarray, size: int) -> np.ndarray:
    """Return where each of 0, ..., size - 1 stands in index, or len(index) if it is absent."""
    position = np.full(size, len(index))
    position[index] = np.arange(len(index))
    return position
