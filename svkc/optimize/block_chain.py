"""Factorization of symmetric matrices that are block chains with a border."""

import numpy as np
from scipy.linalg import get_lapack_funcs

_FACTOR, _SOLVE = get_lapack_funcs(("sytrf", "sytrs"), dtype=np.float64)
# largest matrix that is factored as one dense block
LARGEST_DENSE = 3000


class _Factors:
    """Bunch-Kaufman factorization L D L^T of a dense symmetric matrix.

    negative: number of negative eigenvalues; None: singular. By Sylvester's law they are those of
    D. Each 2 x 2 block of D has one.
    """

    def __init__(self, matrix: np.ndarray):
        if not len(matrix):
            self.negative: int | None = 0
            return
        self._lower, self._pivots, info = _FACTOR(matrix.T, lower=1, lwork=64 * len(matrix))
        single = self._pivots > 0
        pairs = (len(matrix) - int(single.sum())) // 2
        negative = int((self._lower.diagonal()[single] < 0).sum()) + pairs
        self.negative = None if info else negative

    def solve(self, right: np.ndarray) -> np.ndarray:
        if not right.size:
            return right
        return _SOLVE(self._lower, self._pivots, right, lower=1)[0]


class BlockChain:
    """Solver of linear systems with a symmetric matrix of groups that are coupled like a chain.

    Entries couple the rows of a group with each other, with the group before, and with the border.
    Groups are eliminated in order; what remains is the dense Schur complement of the border. The
    inertia is the sum of those of the factored blocks (Haynsworth). If an entry couples other
    groups, the whole matrix is one dense block.

    group: [n] group of each row of the matrix, from 0; -1: border.
    row, column: of the entries. Entries are given on one side of the diagonal.

    Raises ValueError if an entry couples other groups and the matrix is large.
    """

    def __init__(self, group: np.ndarray, row: np.ndarray, column: np.ndarray):
        swapped = group[row] < group[column]
        later, earlier = np.where(swapped, column, row), np.where(swapped, row, column)
        near = (group[later] - group[earlier] <= 1) | (group[earlier] < 0)
        if not near.all():
            if len(group) > LARGEST_DENSE:
                raise ValueError(
                    "InteriorPoint: rows couple intervals that are not neighbours, and the matrix"
                    f" has {len(group)} rows, more than {LARGEST_DENSE}; use optimize.Ipopt"
                )
            group = np.full(len(group), -1)
        couples = np.zeros(len(group), bool)
        couples[later[(group[later] > group[earlier]) & (group[earlier] >= 0)]] = True
        # rows that are coupled with the group before come first in their group
        order = np.lexsort((~couples, group))
        self._counts: np.ndarray = np.bincount(group + 1, minlength=1)
        start = np.cumsum(self._counts) - self._counts
        local = np.zeros(len(group), int)
        local[order] = np.arange(len(group)) - start[group[order] + 1]
        count, border = len(self._counts) - 1, int(self._counts[0])
        size = int(self._counts[1:].max(initial=0))
        coupled = int(np.bincount(group[couples], minlength=1).max())
        # shapes of: blocks on the diagonal, couplings with the group before and with the border,
        # the border's own block
        self._shapes = (
            (count, size, size), (count, coupled, size), (count, size, border), (border, border)
        )  # fmt: skip
        self._place: np.ndarray = np.where(group >= 0, group * size + local, count * size + local)
        self._set_targets(group, local, later, earlier)

    def _set_targets(self, group, local, later: np.ndarray, earlier: np.ndarray) -> None:
        """Set the place in the blocks of each entry. later, earlier: its rows by their groups."""
        starts = np.cumsum([0, *(int(np.prod(shape)) for shape in self._shapes)])
        of_later, of_earlier = group[later], group[earlier]
        mirrored = later != earlier
        inner, border = of_earlier >= 0, (of_later >= 0) & (of_earlier < 0)
        same, corner = inner & (of_later == of_earlier), of_later < 0
        before = inner & ~same
        targets, sources = [], []

        def add(part, mask, a, b):
            at = np.flatnonzero(mask)
            index = (of_later[at], local[a[at]], local[b[at]])
            shape = self._shapes[part]
            at_place = np.ravel_multi_index(index[-len(shape) :], shape) if len(at) else at
            targets.append(starts[part] + at_place)
            sources.append(at)

        add(0, same, later, earlier)
        add(0, same & mirrored, earlier, later)
        add(1, before, later, earlier)
        add(2, border, later, earlier)
        add(3, corner, later, earlier)
        add(3, corner & mirrored, earlier, later)
        self._target, self._source = np.concatenate(targets), np.concatenate(sources)
        self._starts = starts

    def factor(self, values: np.ndarray) -> int | None:
        """Factor the matrix of these entries; return its number of negative eigenvalues.

        Returns None if the matrix or a block is singular, or if an entry is not finite.
        """
        flat = np.bincount(self._target, values[self._source], int(self._starts[-1]))
        if not np.isfinite(flat).all():
            return None
        parts = np.split(flat, self._starts[1:-1])
        blocks, before, border, corner = map(np.reshape, parts, self._shapes)
        coupled, negative = before.shape[1], 0
        schur = np.zeros((coupled, coupled + len(corner)))
        self._factors: list[tuple[_Factors, np.ndarray]] = []
        for k, size in enumerate(self._counts[1:]):
            first = min(coupled, size)
            block, of_border = blocks[k, :size, :size], border[k, :size]
            block[:first, :first] -= schur[:first, :first]
            of_border[:first] -= schur[:first, coupled:]
            after = before[k + 1, :, :size] if k + 1 < len(blocks) else np.zeros((coupled, size))
            right = np.concatenate([after.T, of_border], 1)
            factors = _Factors(block)
            if factors.negative is None:
                return None
            negative += factors.negative
            solved = factors.solve(right)
            product = right.T @ solved
            schur = product[:coupled]
            corner -= product[coupled:, coupled:]
            self._factors.append((factors, solved))
        self._corner = _Factors(corner)
        if self._corner.negative is None:
            return None
        return negative + self._corner.negative

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Return the solution for the matrix that was factored last."""
        (count, size, _), (_, coupled, _), *_ = self._shapes
        padded = np.zeros(count * size + int(self._counts[0]))
        padded[self._place] = right
        groups, border = padded[: count * size].reshape(count, size), padded[count * size :]
        for k, (factors, solved) in enumerate(self._factors):
            own = groups[k, : len(solved)]
            product = own @ solved
            if k + 1 < count:
                groups[k + 1, :coupled] -= product[:coupled]
            border -= product[coupled:]
            own[:] = factors.solve(own)
        border[:] = self._corner.solve(border)
        for k in range(count - 1, -1, -1):
            solved = self._factors[k][1]
            own = groups[k, : len(solved)]
            own -= solved[:, coupled:] @ border
            if k + 1 < count:
                own -= solved[:, :coupled] @ groups[k + 1, :coupled]
        return padded[self._place]
