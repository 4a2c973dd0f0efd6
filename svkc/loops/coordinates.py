"""Coordinate partitioning: independent coordinates and H, W, S, Hdot v (paper, section II).

Pivots and rank are those of the scaled J_C (`jacobian_scales`), so that they do not depend on
units.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from svkc._jax.select import where
from svkc.loops.constraint import LoopKinematics, constraint_bias, jacobian_scales, loop_kinematics
from svkc.loops.pivoting import PivotedQR, pivot_blocks, select_pivots, solve_pivot_block
from svkc.model.chain import Chain, State, Structure, active_dofs
from svkc.model.checked_jit import check_state, checked_jit
from svkc.model.names import unknown_name
from svkc.tree.kinematics import twists


class Coordinates(eqx.Module):
    """The paper's matrices, over every joint coordinate.

    `W`: all velocities from the independent ones (16). Columns of dependent and of locked
    coordinates, and of those of links not connected, are zero.
    `bias`: Hdot v_G (21), zero for coordinates that are not dependent.
    `independent`, `dependent`, `actuated`: the masks of theta_G, theta_S and theta_A.
    `selection`: the pivoted QR of `J`. `J`: the scaled J_C.
    The paper's smaller matrices are rows and columns of these: W[: chain.nv, independent],
    H[dependent][:, independent], S[actuated][:, independent].
    """

    W: Float[Array, "dofs dofs"]
    bias: Float[Array, " dofs"]
    independent: Bool[Array, " dofs"]
    dependent: Bool[Array, " dofs"]
    actuated: Bool[Array, " dofs"]
    selection: PivotedQR
    J: Float[Array, "rows dofs"]

    @property
    def H(self) -> Float[Array, "dofs dofs"]:
        """Return the derivative of theta_S with respect to theta_G (17): W's dependent rows."""
        return where(self.dependent[:, None], self.W, 0)

    @property
    def S(self) -> Float[Array, "dofs dofs"]:
        """Return the derivative of theta_A with respect to theta_G (6): W's actuated rows."""
        return where(self.actuated[:, None], self.W, 0)

    @property
    def Hdot_v(self) -> Float[Array, " dofs"]:
        """Return the velocity-product part of the dependent accelerations (21)."""
        return self.bias


def with_dependent_velocities(
    chain: Chain, qr: PivotedQR, J: Float[Array, "rows dofs"], v: Float[Array, " dofs"]
) -> Float[Array, " dofs"]:
    """Return W v_G (16): v with new dependent velocities. v must be zero where inactive."""
    _, column = jacobian_scales(chain)
    Jm, JS = pivot_blocks(qr, J)
    return v - column * (qr.P.T @ solve_pivot_block(JS, Jm @ (v / column)))


def partition_coordinates(
    chain: Chain,
    structure: Structure,
    qr: PivotedQR,
    J: Float[Array, "rows dofs"],
    bias: Float[Array, " rows"],
) -> Coordinates:
    """Return W and Hdot v from scaled J_C, its pivoted QR and row-scaled Jdot_C v ((14)-(21))."""
    _, column = jacobian_scales(chain)
    Jm, JS = pivot_blocks(qr, J)
    dependent = jnp.any(qr.P > 0, 0)
    independent = active_dofs(chain, structure) & ~dependent
    JS_inverse_rows = solve_pivot_block(JS, jnp.concatenate([Jm, (qr.Q @ bias)[:, None]], 1))
    from_pivots = qr.P.T @ JS_inverse_rows
    W = where(independent[None], jnp.eye(len(column), dtype=J.dtype) - from_pivots[:, :-1], 0)
    W = column[:, None] * W / column[None]
    return Coordinates(
        W=W,
        bias=-column * from_pivots[:, -1],
        independent=independent,
        dependent=dependent,
        actuated=chain.actuated,
        selection=qr,
        J=J,
    )


def closed_coordinates(
    chain: Chain,
    structure: Structure,
    v: Float[Array, " dofs"],
    loops: LoopKinematics,
    V: Float[Array, "tree_rows 6"],
) -> Coordinates:
    """Return the coordinates of a chain with virtual links. V: twists of the tree."""
    bias = constraint_bias(chain, structure, v, loops, V)
    return partition_coordinates(chain, structure, select_pivots(structure, loops.J), loops.J, bias)


def open_coordinates(chain: Chain, structure: Structure) -> Coordinates:
    """Return the coordinates of a chain without virtual links.

    Every coordinate that is not locked is independent.
    """
    n, dtype = chain.dofs, chain.q_load.dtype
    free = jnp.ones(n, bool) if structure.locked is None else ~structure.locked
    none = jnp.zeros((0, n), dtype)
    return Coordinates(
        W=jnp.diag(where(free, 1, 0).astype(dtype)),
        bias=jnp.zeros(n, dtype),
        independent=free,
        dependent=jnp.zeros(n, bool),
        actuated=chain.actuated,
        selection=PivotedQR(
            Q=jnp.zeros((0, 0), dtype), P=none, diag_R=none[:, 0], active=jnp.zeros(0, bool)
        ),
        J=none,
    )


@checked_jit(eager=True)
def coordinates(chain: Chain, state: State) -> Coordinates:
    """Return the coordinate partitioning of a state, as the paper names it (section II).

    H, W and S are in rad or m per rad or m, Hdot v in rad/s^2 and m/s^2.
    """
    if not len(chain.link_names):
        return open_coordinates(chain, state.structure)
    loops = loop_kinematics(chain, state.structure, state.q)
    V = twists(chain, loops.kin, state.v)
    return closed_coordinates(chain, state.structure, state.v, loops, V)


def with_independent(chain: Chain, state: State, *names: str) -> State:
    """Return the state with these joint coordinates preferred as independent (theta_G).

    They are independent as far as the loops allow. The motion does not depend on the choice.

    names: joints, virtual links, or single coordinates (`chain.dof_names`). Without names no
    coordinate is preferred.
    Raises ValueError if a name is unknown.
    """
    check_state(chain, state)
    mask = np.zeros(chain.dofs, bool)
    for name in names:
        named = np.array(
            [
                isinstance(name, str) and name in (n, n.rpartition(".")[0] or n)
                for n in chain.dof_names
            ]
        )
        if not named.any():
            raise unknown_name("joint coordinate", name, chain.dof_names)
        mask |= named
    independent = jnp.asarray(mask) if names else None
    return eqx.tree_at(
        lambda s: s.structure.independent, state, independent, is_leaf=lambda x: x is None
    )
