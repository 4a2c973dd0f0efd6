"""The rows of the loop Jacobian J that are in Delassus' matrix D."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc._jax.static_gather import static_take
from svkc.model.chain import Chain
from svkc.tree.spatial import matvec


class DelassusRows(NamedTuple):
    """The rows of D: those of J along which no virtual joint moves, as far as they are known.

    A link has two groups of rows in J, three angular and three linear ones. If the axes of its
    joint span a part of a group, the group is turned into the axes of the joint's frame in the
    parent, and its rows along the joint's axes are left out. A group that the joint spans is left
    out, and other groups are unchanged.

    All six rows of coupled links are in D, unchanged. These are universal joints, whose axes depend
    on their angles, joints of which a coordinate may be locked, and spare slots, whose joint is
    known at run time only. They are also free joints, so that D has rows if a chain has loops.

    coupled: links of the first rows of D.
    turned: groups of the next rows: 2 i is the angular and 2 i + 1 the linear group of link i.
    turned_rows: which rows of the turned groups are in D.
    unchanged: index in J of the last rows of D.
    links: number of virtual links.
    """

    coupled: np.ndarray
    turned: np.ndarray
    turned_rows: np.ndarray
    unchanged: np.ndarray
    links: int

    @property
    def count(self) -> int:
        """Number of rows of D."""
        return 6 * len(self.coupled) + len(self.turned_rows) + len(self.unchanged)

    def select(
        self, x: Float[Array, "rows *n"], bases: Float[Array, "turned 3 3"]
    ) -> Float[Array, "delassus *n"]:
        """Return the rows of D from those of J.

        bases: for each turned group the axes of the joint's frame, as columns.
        """
        parts = []
        if len(self.coupled):
            parts.append(static_take(x, _rows_of(self.coupled, 6)))
        if len(self.turned):
            groups = static_take(x, _rows_of(self.turned, 3)).reshape(-1, 3, *x.shape[1:])
            along = bases.reshape(-1, 3, 3, *(1,) * (x.ndim - 1))
            turned = jnp.sum(along * groups[:, :, None], 1).reshape(-1, *x.shape[1:])
            parts.append(static_take(turned, self.turned_rows))
        if len(self.unchanged):
            parts.append(static_take(x, self.unchanged))
        return jnp.concatenate(parts)

    def expand(
        self, x: Float[Array, " delassus"], bases: Float[Array, "turned 3 3"]
    ) -> Float[Array, " rows"]:
        """Return x over all rows of J, the transpose of `select`."""
        ends = np.cumsum([6 * len(self.coupled), len(self.turned_rows)]).tolist()
        of_coupled, along, unchanged = jnp.split(x, ends)
        source = _inverse(self.turned_rows, 3 * len(self.turned))
        turned = matvec(bases, static_take(along, source).reshape(-1, 3)).ravel()
        rows = _rows_of(self.coupled, 6), _rows_of(self.turned, 3), self.unchanged
        position = _inverse(np.concatenate(rows), 6 * self.links)
        return static_take(jnp.concatenate([of_coupled, turned, unchanged]), position)


def delassus_rows(chain: Chain, any_locked: bool) -> DelassusRows:
    """Return the rows of J that are in D.

    any_locked: whether coordinates of the chain may be locked.
    """
    top = chain.topology
    freedoms = np.array(top.link_freedoms, bool).reshape(-1, 2, 3)
    of_group = freedoms.sum(-1)
    coupled = np.array(top.link_spare, bool) | (of_group[:, 0] == 2) | freedoms.all((1, 2))
    if any_locked:
        coupled = coupled | freedoms.any((1, 2))
    partial = ~coupled[:, None] & (of_group > 0) & (of_group < 3)
    unchanged = ~coupled[:, None] & (of_group == 0)
    return DelassusRows(
        coupled=np.flatnonzero(coupled),
        turned=np.flatnonzero(partial.ravel()),
        turned_rows=np.flatnonzero(~freedoms[partial].ravel()),
        unchanged=_rows_of(np.flatnonzero(unchanged.ravel()), 3),
        links=len(freedoms),
    )


def _rows_of(blocks: np.ndarray, size: int) -> np.ndarray:
    """Return the indices of the rows of blocks of `size` rows each."""
    return (size * blocks[:, None] + np.arange(size)).ravel()


def _inverse(index: np.ndarray, size: int) -> np.ndarray:
    """Return the position of 0, 1, ..., size - 1 in index; len(index) for absent ones."""
    position = np.full(size, len(index))
    position[index] = np.arange(len(index))
    return position
