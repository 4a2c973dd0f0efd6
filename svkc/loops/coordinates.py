"""Which coordinates are independent, and what follows from it: H, W, S, Hdot v (paper, section II).

Rows in metres and columns of slides are divided by the chain's `length`, so that pivots and rank
have no units.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from svkc.loops.constraint import LoopKinematics, constraint_bias, jacobian_scales, loop_kinematics
from svkc.loops.pivoting import PivotedQR, pivot_blocks, select_pivots, solve_pivot_block
from svkc.model.chain import Chain, State, Structure, active_dofs
from svkc.model.checked_jit import check_state, checked_jit
from svkc.tree.kinematics import twists


class Coordinates(eqx.Module):
    """The paper's matrices, over every joint coordinate (rows of dependent, locked and unconnected
    coordinates' columns are zero).

    `W` [dofs, dofs]: all velocities from the independent ones (16); `bias` [dofs]: Hdot v_G (21) on
    the dependent ones;
    `independent`, `dependent`: the choice theta_G, theta_S; `actuated`: theta_A; `selection`: the
    pivots; `J`: the scaled J_C.
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
        """The derivative of theta_S by theta_G (17): the dependent rows of W."""
        return jnp.where(self.dependent[:, None], self.W, 0)

    @property
    def S(self) -> Float[Array, "dofs dofs"]:
        """The derivative of theta_A by theta_G (paper (6)): the actuated rows of W."""
        return jnp.where(self.actuated[:, None], self.W, 0)

    @property
    def Hdot_v(self) -> Float[Array, " dofs"]:
        """The part of the dependent accelerations that velocities make (21)."""
        return self.bias


def dependent_velocities(
    chain: Chain, selection: PivotedQR, J: Float[Array, "rows dofs"], v: Float[Array, " dofs"]
) -> Float[Array, " dofs"]:
    """W v_G (16): the dependent velocities as the independent ones ask for."""
    _, column = jacobian_scales(chain)
    Jm, JS = pivot_blocks(selection, J)
    return v - column * (selection.P.T @ solve_pivot_block(JS, Jm @ (v / column)))


def partition_coordinates(
    chain: Chain,
    structure: Structure,
    selection: PivotedQR,
    J: Float[Array, "rows dofs"],
    bias: Float[Array, " rows"],
) -> Coordinates:
    """W and Hdot v from the loops' rows and the choice of pivots: (14)-(21)."""
    _, column = jacobian_scales(chain)
    Jm, JS = pivot_blocks(selection, J)
    dependent = jnp.any(selection.P > 0, 0)
    independent = active_dofs(chain, structure) & ~dependent
    solved = solve_pivot_block(JS, jnp.concatenate([Jm, (selection.Q @ bias)[:, None]], 1))
    from_pivots = selection.P.T @ solved
    W = jnp.where(independent[None], jnp.eye(len(column), dtype=J.dtype) - from_pivots[:, :-1], 0)
    W = column[:, None] * W / column[None]
    return Coordinates(
        W=W,
        bias=-column * from_pivots[:, -1],
        independent=independent,
        dependent=dependent,
        actuated=chain.actuated,
        selection=selection,
        J=J,
    )


def closed_coordinates(
    chain: Chain, structure: Structure, v: Float[Array, " dofs"], loops: LoopKinematics, V
) -> Coordinates:
    """Return `constrain` at one state. V: twists of the tree (`twists`)."""
    bias = constraint_bias(chain, structure, v, loops, V)
    return partition_coordinates(chain, structure, select_pivots(structure, loops.J), loops.J, bias)


def open_coordinates(chain: Chain, structure: Structure) -> Coordinates:
    """The coordinates of a chain without virtual links: every joint that is not locked is
    independent."""
    n, dtype = chain.dofs, chain.q_load.dtype
    free = jnp.ones(n, bool) if structure.locked is None else ~structure.locked
    none = jnp.zeros((0, n), dtype)
    return Coordinates(
        W=jnp.diag(jnp.where(free, 1, 0).astype(dtype)),
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
    """H, W, S (without units, rad or m per rad or m), Hdot v (rad/s^2, m/s^2) and the selection, as
    the paper names them (section II)."""
    if not len(chain.link_names):
        return open_coordinates(chain, state.structure)
    loops = loop_kinematics(chain, state.structure, state.q)
    V = twists(chain, loops.kin, state.v)
    return closed_coordinates(chain, state.structure, state.v, loops, V)


def with_independent(chain: Chain, state: State, *names: str) -> State:
    """The state with these joint coordinates asked to be independent (theta_G), as far as the loops
    let them be; no names: the choice is svkc's again.

    names: of joints, virtual links, or single coordinates (`chain.dof_names`). The motion does not
    depend on it. ValueError: unknown names.
    """
    check_state(chain, state)
    mask = np.zeros(chain.dofs, bool)
    for name in names:
        here = np.array(
            [
                isinstance(name, str) and name in (n, n.rpartition(".")[0] or n)
                for n in chain.dof_names
            ]
        )
        if not here.any():
            raise ValueError(
                f"no joint coordinate {name!r}; coordinates: {', '.join(chain.dof_names)}"
            )
        mask |= here
    wanted = jnp.asarray(mask) if names else None
    return eqx.tree_at(
        lambda s: s.structure.independent, state, wanted, is_leaf=lambda x: x is None
    )
