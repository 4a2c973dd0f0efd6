"""Motion subspaces of the virtual joints, whose coordinates have no inertia."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc._jax.select import where
from svkc._jax.static_gather import static_take
from svkc.model.chain import Chain
from svkc.tree.spatial import inverse_positive, matvec


class VirtualJoints(eqx.Module):
    """Motion subspaces of the virtual joints, padded to d columns: the freest joint's, at least 2.

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


def _align_batch_axes(
    A: Float[Array, "links i j"], x: Float[Array, "*n links k"]
) -> Float[Array, "*m links i j"]:
    """Return A with an axis of size 1 for each batch axis of x."""
    return A.reshape(*(1,) * (x.ndim - 2), *A.shape)


def virtual_joints(chain: Chain, J: Float[Array, "rows dofs"]) -> VirtualJoints:
    """Return the virtual joints, with the motion subspaces in the columns of J."""
    dof, count = np.sort(chain.topology.links.dof - chain.nv, 1), chain.dofs - chain.nv
    # With one column XLA computes the loop rows within the sum of `joint_rates`, in nested loops
    # that LLVM does not vectorize over the lanes of a batch. With two it stores them first.
    dof = dof[:, : max(2, np.max(np.sum(dof < count, 1)))]
    columns = jnp.concatenate([J[:, chain.nv :], jnp.zeros_like(J[:, :1])], 1)
    columns = columns.reshape(-1, 6, count + 1)
    S = jnp.swapaxes(columns[np.arange(len(dof))[:, None], :, np.minimum(dof, count)], -1, -2)
    is_padding = where(jnp.all(S == 0, 1), 1, 0).astype(J.dtype)
    gram = (
        jnp.sum(S[:, :, :, None] * S[:, :, None], 1)
        + is_padding[:, :, None] * np.eye(dof.shape[1], dtype=J.dtype)[None]
    )
    return VirtualJoints(S=S, gram_inverse=inverse_positive(gram), dof=dof, count=count)
