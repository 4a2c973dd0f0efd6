"""F3: which coordinates are independent, and what follows from it: H, W, S, Hdot v (paper, section II).

Rows in metres and columns of slides are divided by the chain's `length`, so that pivots and rank have no units.
"""

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from svkc.loops.constraint import active_dofs, ends, gap, loop_bias, loop_jacobian
from svkc.loops.pivoting import Selection, held_part, select, select_again, solve_frozen, square, too_few, weakest, without_weak
from svkc.model.chain import Chain, State, Structure
from svkc.model.checked_jit import verb
from svkc.model.topology import FREE, SLIDE
from svkc.tree.kinematics import Kinematics, bias_accelerations, kinematics, twists

# part of the phase's own margin below which a configuration is near a singular one; elsewhere the motion depends on no choice of pivots
NEAR = 0.1


class Coordinates(eqx.Module):
    """The paper's matrices, over every joint coordinate (rows of dependent, locked and unconnected coordinates' columns are zero).

    `W` [dofs, dofs]: all velocities from the independent ones (16); `bias` [dofs]: Hdot v_G (21) on the dependent ones;
    `independent`, `dependent`: the choice theta_G, theta_S; `actuated`: theta_A; `selection`: the pivots; `J`: the scaled J_C.
    The paper's smaller matrices are rows and columns of these: W[: chain.nv, independent], H[dependent][:, independent], S[actuated][:, independent].
    """

    W: Float[Array, "dofs dofs"]
    bias: Float[Array, " dofs"]
    independent: Bool[Array, " dofs"]
    dependent: Bool[Array, " dofs"]
    actuated: Bool[Array, " dofs"]
    selection: Selection
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


def scales(chain: Chain) -> tuple[Float[Array, " rows"], Float[Array, " dofs"]]:
    """Factors of the rows and columns of J_C that leave numbers without units: 1/length for linear rows, length for slides."""
    top = chain.topology
    rows = jnp.tile(jnp.where(np.arange(6) < 3, 1, 1 / chain.length), len(top.link_names))
    linear = np.zeros(top.dofs, bool)
    linear[: top.nv] = np.array(top.kind)[top.dof_row] == SLIDE
    for i in top.rows_of(FREE):
        linear[top.v_start[i] : top.v_start[i] + 3] = True
    slides = top.links.dof[:, 3:]
    linear[slides[slides < top.dofs]] = True
    return rows, jnp.where(linear, chain.length, 1)


def scaled_jacobian(chain: Chain, structure: Structure, kin, end) -> Float[Array, "rows dofs"]:
    """J_C without units: rows and columns multiplied by `scales`."""
    row, column = scales(chain)
    return row[:, None] * loop_jacobian(chain, structure, kin, end) * column[None]


def loop_rates(chain: Chain, structure: Structure, v, kin: Kinematics, V, end, J, baumgarte=None) -> Float[Array, " rows"]:
    """Jdot_C v without units. baumgarte: rate (1/s) at which gaps are pulled back."""
    row, column = scales(chain)
    moving = jnp.where(active_dofs(chain, structure), v, 0)
    bias = row * loop_bias(chain, structure, kin, end, V, bias_accelerations(chain, kin, V, v), moving)
    if baumgarte is not None:
        bias = bias + 2 * baumgarte * (J @ (moving / column)) + baumgarte**2 * row * gap(structure, end).ravel()
    return bias


def agreeing(chain: Chain, selection: Selection, J: Float[Array, "rows dofs"], v: Float[Array, " dofs"]) -> Float[Array, " dofs"]:
    """W v_G (16): the dependent velocities as the independent ones ask for."""
    _, column = scales(chain)
    Jm, JS = square(selection, J)
    return v - column * (selection.P.T @ solve_frozen(JS, Jm @ (v / column)))


def choose(structure: Structure, J: Float[Array, "rows dofs"], pivots=None) -> Selection:
    """The pivots of J_C, with the rank of the phase and the coordinates that are asked to be independent; without rows that are too weak just now.

    pivots [steps, dofs]: one-hot, chosen before (None: to be chosen now); near a singular configuration, or where they are too few, new ones are.
    """
    new = lambda: select(J, structure.rank, structure.independent)
    if pivots is None:
        selection = new()
    else:
        held = select_again(J, pivots)
        near = (weakest(held) < NEAR * structure.margin) | too_few(pivots, structure.rank)
        # (one lane near is enough to choose for all)
        selection = jax.lax.cond(eqxi.unvmap_any(near), lambda: jax.tree.map(lambda a, b: jnp.where(near, a, b), new(), held), lambda: held)
    return without_weak(selection, held_part(J.dtype) * structure.margin)


def constrain(chain: Chain, structure: Structure, selection: Selection, J: Float[Array, "rows dofs"], bias: Float[Array, " rows"]) -> Coordinates:
    """W and Hdot v from the loops' rows and the choice of pivots: (14)-(21)."""
    _, column = scales(chain)
    Jm, JS = square(selection, J)
    dependent = jnp.any(selection.P > 0, 0)
    independent = active_dofs(chain, structure) & ~dependent
    solved = solve_frozen(JS, jnp.concatenate([Jm, (selection.Q @ bias)[:, None]], 1))
    from_pivots = selection.P.T @ solved
    W = jnp.where(independent[None], jnp.eye(len(column), dtype=J.dtype) - from_pivots[:, :-1], 0)
    W = column[:, None] * W / column[None]
    return Coordinates(W, -column * from_pivots[:, -1], independent, dependent, chain.actuated, selection, J)


def constrained(chain: Chain, structure: Structure, q, v, kin: Kinematics, V) -> Coordinates:
    """`constrain` at one state, from its kinematics."""
    end = ends(chain, structure, kin, q)
    J = scaled_jacobian(chain, structure, kin, end)
    bias = loop_rates(chain, structure, v, kin, V, end, J)
    return constrain(chain, structure, choose(structure, J), J, bias)


def open_coordinates(chain: Chain, structure: Structure) -> Coordinates:
    """The coordinates of a chain without virtual links: every joint that is not locked is independent."""
    n, none, dtype = chain.dofs, jnp.zeros(0, bool), chain.q_load.dtype
    free = jnp.ones(n, bool) if structure.locked is None else ~structure.locked
    selection = Selection(jnp.zeros((0, 0), dtype), jnp.zeros((0, n), dtype), jnp.zeros(0, dtype), none)
    W = jnp.diag(jnp.where(free, 1, 0).astype(dtype))
    return Coordinates(W, jnp.zeros(n, dtype), free, jnp.zeros(n, bool), chain.actuated, selection, jnp.zeros((0, n), dtype))


@verb(eager=True)
def coordinates(chain: Chain, state: State) -> Coordinates:
    """H, W, S (without units, rad or m per rad or m), Hdot v (rad/s^2, m/s^2) and the selection, as the paper names them (section II)."""
    if not len(chain.link_names):
        return open_coordinates(chain, state.structure)
    kin = kinematics(chain, state.q)
    return constrained(chain, state.structure, state.q, state.v, kin, twists(chain, kin, state.v))


def gaps_and_rates(chain: Chain, state: State) -> tuple[Float[Array, "links 6"], Float[Array, "links 6"]]:
    """`loop_gaps` and `velocity_gaps` from one pass over the tree."""
    kin = kinematics(chain, state.q)
    end = ends(chain, state.structure, kin, state.q)
    return gap(state.structure, end), (loop_jacobian(chain, state.structure, kin, end) @ state.v).reshape(-1, 6)


def sizes(rows: Float[Array, " rows"]) -> Float[Array, "links 2"]:
    """Of each loop's rows: how long its rotation vector is, and how long the distance."""
    return jnp.sqrt(jnp.sum(rows.reshape(-1, 2, 3) ** 2, -1))


def largest(x: Float[Array, "links 6"]) -> Float[Array, "2"]:
    """Return the largest angular and the largest linear part over the loops."""
    if not len(x):
        return jnp.zeros(2, x.dtype)
    square = jnp.sum(x.reshape(-1, 2, 3) ** 2, -1)
    closed = square == 0
    # a root that can be differentiated where the loop is closed to the last bit
    return jnp.max(jnp.where(closed, 0, jnp.sqrt(jnp.where(closed, 1, square))), 0)


def largest_gaps(chain: Chain, state: State) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
    """The largest over the loops: of the gaps (rad, m) and of their rates (rad/s, m/s)."""
    gaps, rates = gaps_and_rates(chain, state)
    return largest(gaps), largest(rates)


@verb(eager=True)
def loop_gaps(chain: Chain, state: State) -> Float[Array, "links 6"]:
    """How far each connected loop is open: rotation vector (rad), then distance (m), in the world; zero where not connected."""
    return gaps_and_rates(chain, state)[0]


@verb(eager=True)
def jacobian(chain: Chain, state: State) -> tuple[Float[Array, "links 3 dofs"], Float[Array, "links 3 dofs"]]:
    """J_C (paper (11)): linear (m/s) and angular (rad/s) velocity of each connected virtual link relative to its real link, for a unit rate of each
    joint coordinate, at the joint, in world axes."""
    kin = kinematics(chain, state.q)
    J = loop_jacobian(chain, state.structure, kin, ends(chain, state.structure, kin, state.q)).reshape(-1, 6, chain.dofs)
    return J[:, 3:], J[:, :3]


@verb(eager=True)
def velocity_gaps(chain: Chain, state: State) -> Float[Array, "links 6"]:
    """J_C v: relative twist (rad/s, m/s) across each connected virtual link."""
    return gaps_and_rates(chain, state)[1]
