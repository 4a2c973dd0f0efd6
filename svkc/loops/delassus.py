"""Accelerations of a closed chain by articulated bodies and the forces of its loops: no pivots are
chosen.

What a force in one loop row does in all others is Delassus' matrix D = J M^-1 J^T over the tree's
coordinates. Virtual joints have coordinates without inertia: along them nothing is carried, so the
rows are seen across them alone; the three rows that a ball turns in are not in D at all.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from svkc._jax.batched_lapack import cholesky_solver
from svkc._jax.static_gather import static_take
from svkc.model.chain import Chain
from svkc.tree.articulated_body import articulated_inertias, delassus_matrix, solve_mass_matrix
from svkc.tree.kinematics import Kinematics
from svkc.tree.spatial import inverse_positive, matvec

# of the forces' error, along a row with 1e-6 of the others' inverse inertia, each leaves 1e-4
# (float64)
REFINEMENTS = 2
# the joint that turns as it likes
BALL_FREEDOMS = (True, True, True, False, False, False)
# rows from which LAPACK factors D: the inverse by halves is compiled for each size, and its
# operations grow with the rows
LAPACK_MIN_ROWS = 36


class VirtualJoints(eqx.Module):
    """The virtual joints' own coordinates, link by link, as many as the freest has: their motion S
    [links, row, freedom], and (S^T S)^-1; where each stands among the coordinates of virtual joints
    (`count`: nowhere)."""

    S: Float[Array, "links 6 d"]
    inverse: Float[Array, "links d d"]
    place: np.ndarray
    count: int

    def across(self, x: Float[Array, "*n rows"]) -> Float[Array, "*n rows"]:
        """The part of the rows that virtual joints cannot follow."""
        rates = self.along(x)
        return x - matvec(_align_batch_axes(self.S, rates), rates).reshape(x.shape)

    def part(self, links: np.ndarray) -> "Joints":
        """Those of some links."""
        S, inverse, place = self.S[links], self.inverse[links], self.place[links]
        return VirtualJoints(S=S, inverse=inverse, place=place, count=self.count)

    def along(self, x: Float[Array, "*n rows"]) -> Float[Array, "*n links d"]:
        """The rates of virtual joints that follow the rows best."""
        x = x.reshape(*x.shape[:-1], -1, 6)
        return matvec(
            _align_batch_axes(self.inverse, x),
            matvec(_align_batch_axes(jnp.swapaxes(self.S, -1, -2), x), x),
        )

    def of(self, x: Float[Array, " virtual"]) -> Float[Array, "links d"]:
        """What stands for each freedom of each link; zero for those that are none."""
        return static_take(x, np.minimum(self.place, self.count))

    def order(self, rates: Float[Array, "links d"]) -> Float[Array, " virtual"]:
        """The same in the order of the coordinates."""
        flat = self.place.ravel()
        return static_take(
            rates.ravel(), np.argsort(flat, kind="stable")[: np.sum(flat < self.count)]
        )


class DelassusRows(NamedTuple):
    """The rows of J that are in D: all six of `whole` links, then the last three of those with a
    ball; where each row of J is among them (past their end: nowhere)."""

    whole: np.ndarray
    kept: np.ndarray
    back: np.ndarray

    def fill(self, x: Float[Array, " kept"]) -> Float[Array, " rows"]:
        """All rows of J, zero where they are not in D."""
        return static_take(x, self.back)


def delassus_rows(chain: Chain, locked: bool) -> DelassusRows:
    """A declared ball turns freely where none of its coordinates is locked; what a spare slot holds
    is known at run time alone."""
    top = chain.topology
    free = np.array(
        [
            tuple(f) == BALL_FREEDOMS and not spare
            for f, spare in zip(top.link_freedoms, top.link_spare, strict=True)
        ],
        bool,
    )
    free = free & (not locked)
    six = np.arange(6 * len(free)).reshape(-1, 6)
    kept = np.concatenate([six[~free].ravel(), six[free][:, 3:].ravel()])
    back = np.full(six.size, len(kept))
    back[kept] = np.arange(len(kept))
    return DelassusRows(np.flatnonzero(~free), kept, back)


def _align_batch_axes(
    A: Float[Array, "links i j"], x: Float[Array, "*n links k"]
) -> Float[Array, "*m links i j"]:
    return A.reshape(*(1,) * (x.ndim - 2), *A.shape)


def virtual_joints(chain: Chain, J: Float[Array, "rows dofs"]) -> VirtualJoints:
    """From the columns of the virtual joints in J."""
    place, count = np.sort(chain.topology.links.dof - chain.nv, 1), chain.dofs - chain.nv
    place = place[:, : max(1, np.max(np.sum(place < count, 1)))]
    own = jnp.concatenate([J[:, chain.nv :], jnp.zeros_like(J[:, :1])], 1).reshape(-1, 6, count + 1)
    S = jnp.swapaxes(own[np.arange(len(place))[:, None], :, np.minimum(place, count)], -1, -2)
    still = jnp.where(jnp.all(S == 0, 1), 1, 0).astype(J.dtype)
    G = (
        jnp.sum(S[:, :, :, None] * S[:, :, None], 1)
        + still[:, :, None] * np.eye(place.shape[1], dtype=J.dtype)[None]
    )
    return VirtualJoints(S=S, inverse=inverse_positive(G), place=place, count=count)


def _regularized_inverse(D: Float[Array, "kept kept"]) -> Callable:
    """Return x -> (D + a little)^-1 x."""
    most = jnp.max(jnp.where(np.eye(D.shape[0], dtype=bool), D, 0))
    # (none where no loop is closed)
    little = jnp.finfo(D.dtype).eps ** 0.625 * jnp.where(most > 0, most, 1)
    raised = D + little * jnp.eye(D.shape[0], dtype=D.dtype)
    if D.shape[0] >= LAPACK_MIN_ROWS:
        return cholesky_solver(raised)
    inverse = inverse_positive(raised)
    return lambda x: matvec(inverse, x)


def loop_force_solver(
    chain: Chain, kin: Kinematics, J: Float[Array, "rows dofs"], free: Bool[Array, " nv"] | None
) -> Callable:
    """(force, rate) -> (x, mu) with M x + J^T mu = force and J x = rate, of rows that need not be
    independent. free: joints not locked (None: all).

    D + a little is factored, and the forces refined against D (the proximal form): where rows
    repeat one another, or nearly so, the forces stay finite and the motion is that of the others.
    """
    top, nv, tree = chain.topology, chain.nv, J[:, : chain.nv]
    bodies, own, held = (
        articulated_inertias(chain, kin, free),
        virtual_joints(chain, J),
        delassus_rows(chain, free is not None),
    )
    some, six = own.part(held.whole), 6 * len(held.whole)
    across = lambda x: jnp.concatenate([some.across(x[..., :six]), x[..., six:]], -1) if six else x
    D = across(across(delassus_matrix(top, bodies, static_take(tree, held.kept))).T)
    nearly = _regularized_inverse(D)

    def solve(force, rate):
        # what acts on virtual joints is carried by the loops
        carried = -matvec(own.S, matvec(own.inverse, own.of(force[nv:]))).ravel()
        alone = solve_mass_matrix(top, bodies, force[:nv] + carried @ tree)
        left = across(static_take(rate - tree @ alone, held.kept))
        z = nearly(left)
        for _ in range(REFINEMENTS):
            z = z + nearly(left - D @ z)
        mu = carried + held.fill(across(z))
        x = solve_mass_matrix(top, bodies, force[:nv] + mu @ tree)
        return jnp.concatenate([x, own.order(own.along(rate - tree @ x))]), -mu

    return solve
