"""F4: accelerations of a closed chain by articulated bodies and the forces of its loops: no pivots are chosen.

What a force in one loop row does in all others is Delassus' matrix D = J M^-1 J^T over the tree's coordinates. Virtual joints have coordinates without
inertia: along them nothing is carried, so the rows are seen across them alone.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from svkc.articulated import accelerations, articulate
from svkc.chain import Chain
from svkc.kinematics import Kinematics
from svkc.spatial import inverse_positive, rotate

# of the forces' error, along a row with 1e-6 of the others' inverse inertia, each leaves 1e-4 (float64)
REFINEMENTS = 2


class Joints(eqx.Module):
    """The virtual joints' own coordinates, link by link: motion [links, row, freedom] of those without inertia and of those with armature, (S^T S)^-1 of
    the former, the armature, and where each stands among the coordinates of virtual joints (out of range: nowhere)."""

    light: Float[Array, "links 6 6"]
    heavy: Float[Array, "links 6 6"]
    inverse: Float[Array, "links 6 6"]
    armature: Float[Array, "links 6"]
    place: np.ndarray

    def across(self, x: Float[Array, "*n rows"]) -> Float[Array, "*n rows"]:
        """The part of the rows that virtual joints without inertia cannot follow."""
        return x - self.motion(self.along(x))

    def along(self, x: Float[Array, "*n rows"]) -> Float[Array, "*n links 6"]:
        """The rates of virtual joints without inertia that follow the rows best."""
        x = x.reshape(*x.shape[:-1], -1, 6)
        return rotate(_lead(self.inverse, x), rotate(_lead(jnp.swapaxes(self.light, -1, -2), x), x))

    def motion(self, rates: Float[Array, "*n links 6"]) -> Float[Array, "*n rows"]:
        """What the rows see of these rates."""
        x = rotate(_lead(self.light, rates), rates)
        return x.reshape(*x.shape[:-2], -1)


def _lead(A: Float[Array, "links 6 6"], x: Float[Array, "*n links 6"]) -> Float[Array, "*n links 6 6"]:
    return A.reshape(*(1,) * (x.ndim - 2), *A.shape)


def joints(chain: Chain, J: Float[Array, "rows dofs"], active: Bool[Array, " dofs"]) -> Joints:
    """From the columns of the virtual joints in J."""
    own, place = J[:, chain.nv :], chain.topology.links.dof - chain.nv
    count = own.shape[1]
    padded = jnp.concatenate([own, jnp.zeros_like(J[:, :1])], 1)
    mine = padded.reshape(-1, 6, count + 1)[np.arange(len(place))[:, None], :, np.minimum(place, count)]
    mine = jnp.swapaxes(mine, -1, -2)
    armature = jnp.zeros((*mine.shape[:1], 6), J.dtype)
    if chain.link_armature is not None:
        armature = jnp.concatenate([chain.link_armature, jnp.zeros_like(armature[0, :1])])[np.minimum(place, count)]
    light = jnp.where(armature[:, None] == 0, mine, 0)
    still = jnp.all(light == 0, 1)
    G = jnp.sum(light[:, :, :, None] * light[:, :, None], 1) + jnp.where(still, 1, 0).astype(J.dtype)[:, :, None] * np.eye(6, dtype=J.dtype)[None]
    return Joints(light, mine - light, inverse_positive(G), armature, place)


def by_loop_forces(chain: Chain, kin: Kinematics, J: Float[Array, "rows dofs"], active: Bool[Array, " dofs"], locked: bool) -> Callable:
    """(force, rate) -> (x, mu) with M x = force + J^T mu and J x = rate, of rows that need not be independent.

    Cholesky's factor of D + a little, and refinement against D (the proximal form): where rows repeat one another, or nearly so, the forces stay finite
    and the motion is that of the others.
    """
    top, nv = chain.topology, chain.nv
    bodies, own = articulate(chain, kin, active[:nv] if locked else None), joints(chain, J, active)
    tree = J[:, :nv]
    moved = jax.vmap(lambda row: accelerations(top, bodies, row))(tree)
    D = tree @ moved.T
    if chain.link_armature is not None:
        weight = jnp.where(own.armature > 0, 1 / jnp.where(own.armature > 0, own.armature, 1), 0)
        blocks = jnp.sum(own.heavy[:, :, None] * own.heavy[:, None] * weight[:, None, None], -1)
        D = D + jax.scipy.linalg.block_diag(*blocks)
    D = own.across(own.across(D).T)
    little = jnp.finfo(J.dtype).eps ** 0.625 * jnp.maximum(jnp.max(jnp.diagonal(D)), jnp.finfo(J.dtype).tiny)
    factor = jax.scipy.linalg.cho_factor(D + little * jnp.eye(D.shape[0], dtype=J.dtype))

    def solve(force, rate):
        # on virtual joints without inertia nothing acts but what the loops carry
        padded = jnp.concatenate([force[nv:], jnp.zeros_like(force[:1])])[np.minimum(own.place, force.shape[0] - nv)]
        applied = jnp.where(own.armature > 0, padded, 0)
        carried = -own.motion(rotate(own.inverse, jnp.where(own.armature > 0, 0, padded)))
        alone = accelerations(top, bodies, force[:nv] + carried @ tree)
        heavy = lambda mu: jnp.where(
            own.armature > 0, (applied + rotate(jnp.swapaxes(own.heavy, -1, -2), mu.reshape(-1, 6))) / jnp.where(own.armature > 0, own.armature, 1), 0
        )
        seen = lambda rates: rotate(own.heavy, rates).ravel()
        wanted = own.across(rate - tree @ alone - seen(heavy(carried)))
        z = jax.scipy.linalg.cho_solve(factor, wanted)
        for _ in range(REFINEMENTS):
            z = z + jax.scipy.linalg.cho_solve(factor, wanted - D @ z)
        mu = carried + own.across(z)
        x = alone + own.across(z) @ moved
        turned = heavy(mu)
        turned = turned + own.along(rate - tree @ x - seen(turned))
        return jnp.concatenate([x, _placed(turned, own.place, force.shape[0] - nv)]), mu

    return solve


def _placed(rates: Float[Array, "links 6"], place: np.ndarray, count: int) -> Float[Array, " virtual"]:
    """Rates of virtual joints in the order of their coordinates."""
    flat = place.ravel()
    here = np.flatnonzero(flat < count)
    return rates.ravel()[here[np.argsort(flat[here], kind="stable")]]
