"""The rows of the loop Jacobian J that are in Delassus' matrix D."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc._jax.static_gather import static_take
from svkc.model.chain import Chain
from svkc.tree.spatial import matvec


class DelassusRows(NamedTuple):
    """The rows of D: the rows of J, without those along which a virtual joint can move.

    A link has two groups of rows in J, three angular and three linear ones. If its joint moves
    along one or two of a group's directions, the group is expressed in the joint's frame, which is
    fixed in the parent, and the rows along the joint's axes are left out. If the joint moves along
    all three, the group is left out; if it moves along none, the group stays as in J.

    Some links keep all six rows as in J. Their joints are universal joints, whose second axis
    depends on the first angle, spare slots, which are known at run time only, and all joints that
    move if coordinates may be locked. Free joints are among them, too, although they constrain
    nothing: D would be empty for a chain with no other links.

    full_links: links with all six rows, which are the first rows of D.
    rotated_groups: groups that are expressed in a joint's frame. 2 i is the angular group of link
        i, and 2 i + 1 is the linear one.
    kept_of_rotated: of all rows of the rotated groups, those that are the next rows of D.
    rows_as_in_J: rows of J that are the last rows of D.
    links: number of virtual links.
    """

    full_links: np.ndarray
    rotated_groups: np.ndarray
    kept_of_rotated: np.ndarray
    rows_as_in_J: np.ndarray
    links: int

    @property
    def count(self) -> int:
        """Number of rows of D."""
        return 6 * len(self.full_links) + len(self.kept_of_rotated) + len(self.rows_as_in_J)

    def select(
        self, x: Float[Array, "rows *n"], joint_axes: Float[Array, "rotated 3 3"]
    ) -> Float[Array, "delassus *n"]:
        """Return the rows of D from those of J: rotate the groups, and take the rows that are kept.

        joint_axes: for each rotated group the axes of the joint's frame, as columns.
        """
        parts = []
        if len(self.full_links):
            parts.append(static_take(x, _rows_of(self.full_links, 6)))
        if len(self.rotated_groups):
            groups = static_take(x, _rows_of(self.rotated_groups, 3)).reshape(-1, 3, *x.shape[1:])
            axes = joint_axes.reshape(-1, 3, 3, *(1,) * (x.ndim - 1))
            rotated = jnp.sum(axes * groups[:, :, None], 1).reshape(-1, *x.shape[1:])
            parts.append(static_take(rotated, self.kept_of_rotated))
        if len(self.rows_as_in_J):
            parts.append(static_take(x, self.rows_as_in_J))
        return jnp.concatenate(parts)

    def expand(
        self, x: Float[Array, " delassus"], joint_axes: Float[Array, "rotated 3 3"]
    ) -> Float[Array, " rows"]:
        """Return the transpose of `select` times x, over all rows of J."""
        ends = np.cumsum([6 * len(self.full_links), len(self.kept_of_rotated)]).tolist()
        of_full_links, of_rotated, as_in_J = jnp.split(x, ends)
        source = _positions(self.kept_of_rotated, 3 * len(self.rotated_groups))
        groups = matvec(joint_axes, static_take(of_rotated, source).reshape(-1, 3))
        rows = _rows_of(self.full_links, 6), _rows_of(self.rotated_groups, 3), self.rows_as_in_J
        source = _positions(np.concatenate(rows), 6 * self.links)
        return static_take(jnp.concatenate([of_full_links, groups.ravel(), as_in_J]), source)


def delassus_rows(chain: Chain, any_locked: bool) -> DelassusRows:
    """Return which rows of J are in D.

    any_locked: whether the structure has a mask of locked coordinates.
    """
    top = chain.topology
    freedoms = np.array(top.link_freedoms, bool).reshape(-1, 2, 3)
    of_group = freedoms.sum(-1)
    is_full = np.array(top.link_spare, bool) | (of_group[:, 0] == 2) | freedoms.all((1, 2))
    if any_locked:
        is_full = is_full | freedoms.any((1, 2))
    is_rotated = ~is_full[:, None] & (of_group > 0) & (of_group < 3)
    stays = ~is_full[:, None] & (of_group == 0)
    return DelassusRows(
        full_links=np.flatnonzero(is_full),
        rotated_groups=np.flatnonzero(is_rotated.ravel()),
        kept_of_rotated=np.flatnonzero(~freedoms[is_rotated].ravel()),
        rows_as_in_J=_rows_of(np.flatnonzero(stays.ravel()), 3),
        links=len(freedoms),
    )


def _rows_of(blocks: np.ndarray, size: int) -> np.ndarray:
    """Return the indices of the rows of blocks of `size` rows each."""
    return (size * blocks[:, None] + np.arange(size)).ravel()


def _positions(index: np.ndarray, size: int) -> np.ndarray:
    """Return where each of 0, ..., size - 1 stands in index, or len(index) if it is absent."""
    position = np.full(size, len(index))
    position[index] = np.arange(len(index))
    return position
