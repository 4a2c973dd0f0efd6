"""The mass matrix of the tree: by the composite-rigid-body algorithm, by unit vectors."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc._jax.select import where
from svkc._jax.static_gather import static_take
from svkc.model.chain import Chain, State
from svkc.model.checked_jit import checked_jit
from svkc.tree.inverse_dynamics import mass_matrix_product
from svkc.tree.kinematics import Kinematics, kinematics
from svkc.tree.spatial import angular_linear, cross, matvec, skew
from svkc.tree.traversal import accumulate_to_root


def mass_matrix_unit_vectors(chain: Chain, kin: Kinematics) -> Float[Array, "nv nv"]:
    """Return the mass matrix, whose column i is ID(q, 0, e_i) without gravity.

    This is the paper's method (section III-B, step 3).
    """
    return jax.vmap(lambda unit: mass_matrix_product(chain, kin, unit), out_axes=1)(
        jnp.eye(chain.nv, dtype=kin.r.dtype)
    )


def central_inertias(
    chain: Chain, kin: Kinematics
) -> tuple[Float[Array, "rows 3"], Float[Array, "rows 3 3"]]:
    """Return each row's centre of mass, from the root's origin, and the inertia about it.

    Both are in world axes.
    """
    RI = jnp.sum(kin.R[:, :, :, None] * chain.symmetric_inertia[:, None, :, :], 2)
    return kin.r + matvec(kin.R, chain.com), jnp.sum(RI[:, :, None, :] * kin.R[:, None, :, :], -1)


def mass_matrix_crba(chain: Chain, kin: Kinematics) -> Float[Array, "nv nv"]:
    """Return the mass matrix by composite rigid bodies (Featherstone section 6.2).

    About the root's origin mass, first moment and rotational inertia of bodies add up.
    """
    top, (c, central) = chain.topology, central_inertias(chain, kin)
    m = chain.mass[:, None]
    square = (
        jnp.sum(c * c, -1)[:, None, None] * jnp.eye(3, dtype=c.dtype)[None]
        - c[:, :, None] * c[:, None, :]
    )
    I = central + m[:, :, None] * square
    total = static_take(
        accumulate_to_root(top, jnp.concatenate([m, m * c, I.reshape(-1, 9)], -1)), top.dof_row
    )
    m, h, I = total[:, :1], total[:, 1:4], total[:, 4:].reshape(-1, 3, 3)
    w, u = angular_linear(kin.S)
    # momentum of the composite body beyond a joint, for a unit of the joint's velocity
    F = jnp.concatenate([matvec(I, w) + cross(h, u), m * u + cross(w, h)], -1)
    related = top.ancestor_mask[top.dof_row][:, top.dof_row]
    M = where(related, F @ kin.S.T, 0)
    M = where(related.T & ~related, M.T, M)
    return M if chain.armature is None else M + jnp.diag(chain.armature)


@checked_jit
def mass_matrix(chain: Chain, state: State) -> Float[Array, "nv nv"]:
    """Return the mass matrix of the tree (kg, kg m, kg m^2), armature included.

    Computed by composite rigid bodies (Featherstone section 6.2).
    """
    return mass_matrix_crba(chain, kinematics(chain, state.q))


class SpatialInertias(NamedTuple):
    """Blocks of spatial inertias about roots' origins, in world axes (Featherstone (2.63)).

    The matrices are [[angular, coupling], [-coupling, linear]].

    angular: rotational inertia (kg m^2). coupling: mass times the centre of mass, as the matrix of
    a vector product (kg m). linear: mass times the identity (kg).
    """

    angular: Float[Array, "*n 3 3"]
    coupling: Float[Array, "*n 3 3"]
    linear: Float[Array, "*n 3 3"]

    def matrices(self) -> Float[Array, "*n 6 6"]:
        """Return the inertias as matrices."""
        upper = jnp.concatenate([self.angular, self.coupling], -1)
        return jnp.concatenate([upper, jnp.concatenate([-self.coupling, self.linear], -1)], -2)


def spatial_inertias(chain: Chain, kin: Kinematics) -> SpatialInertias:
    """Return each row's spatial inertia about its root's origin."""
    (c, central), m = central_inertias(chain, kin), chain.mass[:, None, None]
    eye = np.eye(3, dtype=c.dtype)[None]
    square = jnp.sum(c * c, -1)[:, None, None] * eye - c[:, :, None] * c[:, None, :]
    return SpatialInertias(central + m * square, m * skew(c), m * eye)
