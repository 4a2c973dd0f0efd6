"""F3: which coordinates are independent, and what follows from it: H, W, S, Hdot v (paper, section II), and the way back onto closed loops.

Rows in metres and columns of slides are divided by the chain's `length`, so that pivots and rank have no units. Pivots are integers chosen on
stop_gradient(J); H and W come from one masked square solve with that choice frozen, exact to differentiate wherever the rank does not change.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float, Int

from svkc.chain import Chain, State, Structure
from svkc.kinematics import bias_accelerations, integrate, kinematics, normalize, twists
from svkc.loops import active_dofs, ends, gap, loop_bias, loop_jacobian
from svkc.topology import FREE, SLIDE


class Selection(eqx.Module):
    """Pivoted Gram-Schmidt of the scaled J_C, frozen: Q [steps, rows], one-hot pivots P [steps, dofs], |R_kk|, and which steps count."""

    Q: Float[Array, "steps rows"]
    P: Float[Array, "steps dofs"]
    size: Float[Array, " steps"]
    used: Bool[Array, " steps"]


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


def rank_tolerance(dtype) -> float:
    """|R_kk| / |R_11| below which a row of the scaled J_C counts as redundant: sqrt(eps), 1.5e-8 in float64, 3.5e-4 in float32."""
    return float(np.sqrt(np.finfo(dtype).eps))


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


def select(J: Float[Array, "rows dofs"], rank: Int[Array, ""] | None = None, wanted: Bool[Array, " dofs"] | None = None) -> Selection:
    """min(rows, dofs) steps of column-pivoted Gram-Schmidt, orthogonalised twice; steps from `rank` on are inert (None: all are taken).

    `wanted`: columns to leave independent, taken as pivots only where nothing else is left.
    """
    J = jax.lax.stop_gradient(J)
    rows, dofs = J.shape
    steps = min(rows, dofs)
    weight = None if wanted is None else jnp.where(wanted, rank_tolerance(J.dtype) ** 2, 1).astype(J.dtype)

    def step(k, carry):
        A, Q, P, size = carry
        norms = jnp.sum(A * A, 0)
        pivot = jnp.arange(dofs) == jnp.argmax(norms if weight is None else norms * weight)
        column = jnp.sum(jnp.where(pivot[None], A, 0), 1)
        column = column - (Q @ column) @ Q
        r = jnp.sqrt(jnp.sum(column * column))
        taken = r > 0 if rank is None else (r > 0) & (k < rank)
        q = jnp.where(taken, column / jnp.where(taken, r, 1), 0)
        A = jnp.where(pivot[None], 0, A - q[:, None] * (q @ A)[None])
        here = jnp.arange(steps) == k
        Q = jnp.where(here[:, None], q[None], Q)
        P = jnp.where(here[:, None] & pivot[None] & taken, 1, P)
        return A, Q, P, jnp.where(here, r, size)

    start = (J, jnp.zeros((steps, rows), J.dtype), jnp.zeros((steps, dofs), J.dtype), jnp.zeros(steps, J.dtype))
    _, Q, P, size = jax.lax.fori_loop(0, steps, step, start)
    return Selection(Q, P, size, jnp.any(P > 0, 1))


def count_rank(size: Float[Array, " steps"]) -> Int[Array, ""]:
    """Steps whose |R_kk| is above the tolerance."""
    return jnp.sum(size > rank_tolerance(size.dtype) * jnp.maximum(size[0], jnp.finfo(size.dtype).tiny)).astype(jnp.int32)


def solve_frozen(B: Float[Array, "steps steps"], x: Float[Array, "steps *n"]) -> Float[Array, "steps *n"]:
    """B^-1 x for a B that the frozen choice leaves upper triangular in value but not in derivative."""
    triangle = jax.lax.stop_gradient(B)
    return jax.lax.custom_linear_solve(
        lambda y: B @ y,
        x,
        solve=lambda _, y: solve_triangular(triangle, y),
        transpose_solve=lambda _, y: solve_triangular(triangle, y, trans=1),
    )


def square(selection: Selection, J: Float[Array, "rows dofs"]) -> tuple[Float[Array, "steps dofs"], Float[Array, "steps steps"]]:
    """J_Cm = Q J_C, m independent rows (12), and J_S, its pivot columns in order (14), with ones on the unused diagonal."""
    Jm = selection.Q @ J
    return Jm, Jm @ selection.P.T + jnp.diag(jnp.where(selection.used, 0, 1).astype(J.dtype))


def scaled_jacobian(chain: Chain, structure: Structure, kin, end) -> Float[Array, "rows dofs"]:
    """J_C without units: rows and columns multiplied by `scales`."""
    row, column = scales(chain)
    return row[:, None] * loop_jacobian(chain, structure, kin, end) * column[None]


def constrain(chain: Chain, structure: Structure, q, v, kin, V, baumgarte=None) -> Coordinates:
    """W and Hdot v at one state, from its kinematics: (14)-(21). baumgarte: rate (1/s) at which gaps are pulled back."""
    row, column = scales(chain)
    end = ends(chain, structure, kin, q)
    J = scaled_jacobian(chain, structure, kin, end)
    active = active_dofs(chain, structure)
    selection = select(J, structure.rank, structure.independent)
    bias = loop_bias(chain, structure, kin, end, V, bias_accelerations(chain, kin, V, v), jnp.where(active, v, 0))
    drift = row * bias
    if baumgarte is not None:
        drift = drift + 2 * baumgarte * (J @ (v / column)) + baumgarte**2 * row * gap(structure, end).ravel()
    Jm, JS = square(selection, J)
    dependent = jnp.any(selection.P > 0, 0)
    independent = active & ~dependent
    solved = solve_frozen(JS, jnp.concatenate([Jm, (selection.Q @ drift)[:, None]], 1))
    from_pivots = selection.P.T @ solved
    W = jnp.where(independent[None], jnp.eye(len(column), dtype=J.dtype) - from_pivots[:, :-1], 0)
    W = column[:, None] * W / column[None]
    return Coordinates(W, -column * from_pivots[:, -1], independent, dependent, chain.actuated, selection, J)


@jax.jit
def coordinates(chain: Chain, state: State) -> Coordinates:
    """H, W, S, Hdot v and the selection, as the paper names them (section II)."""
    kin = kinematics(chain, state.q)
    return constrain(chain, state.structure, state.q, state.v, kin, twists(chain, kin, state.v))


@jax.jit
def loop_gaps(chain: Chain, state: State) -> Float[Array, "links 6"]:
    """How far each connected loop is open: rotation vector (rad), then distance (m), in the world; zero where not connected."""
    kin = kinematics(chain, state.q)
    return gap(state.structure, ends(chain, state.structure, kin, state.q))


@jax.jit
def jacobian(chain: Chain, state: State) -> tuple[Float[Array, "links 3 dofs"], Float[Array, "links 3 dofs"]]:
    """J_C (paper (11)): linear (m/s) and angular (rad/s) velocity of each connected virtual link relative to its real link, for a unit rate of each
    joint coordinate, at the joint, in world axes."""
    kin = kinematics(chain, state.q)
    J = loop_jacobian(chain, state.structure, kin, ends(chain, state.structure, kin, state.q)).reshape(-1, 6, chain.dofs)
    return J[:, 3:], J[:, :3]


@jax.jit
def velocity_gaps(chain: Chain, state: State) -> Float[Array, "links 6"]:
    """J_C v: relative twist (rad/s, m/s) across each connected virtual link."""
    kin = kinematics(chain, state.q)
    end = ends(chain, state.structure, kin, state.q)
    return (loop_jacobian(chain, state.structure, kin, end) @ state.v).reshape(-1, 6)


@jax.jit
def decide_rank(chain: Chain, structure: Structure, q: Float[Array, " q"]) -> Structure:
    """The structure with its rank m: the larger of those at q and at a closed configuration nearby, for q itself may be singular."""
    if not len(chain.topology.link_names):
        return structure
    row, column = scales(chain)

    def sizes(q):
        kin = kinematics(chain, q)
        end = ends(chain, structure, kin, q)
        return select(scaled_jacobian(chain, structure, kin, end)).size, jnp.max(jnp.abs(row * gap(structure, end).ravel()))

    # a fixed direction without pattern, a few degrees away; left out where Newton's method does not come back onto the loops
    direction = np.sin(1.0 + 2.3 * np.arange(chain.dofs))
    near = jnp.where(active_dofs(chain, structure), 0.05 * direction * column, 0).astype(q.dtype)
    full = eqx.tree_at(lambda s: s.rank, structure, jnp.asarray(min(row.shape[0], chain.dofs), jnp.int32))
    moved = close(chain, full, integrate(chain, q, near), iterations=12)
    size, open_ = jax.lax.map(sizes, jnp.stack([q, moved]))
    closed = open_[1] < jnp.finfo(q.dtype).eps ** 0.75
    rank = jnp.where(closed, jnp.maximum(count_rank(size[0]), count_rank(size[1])), count_rank(size[0]))
    return eqx.tree_at(lambda s: s.rank, structure, jax.lax.stop_gradient(rank))


def _least_change(selection: Selection, J, x: Float[Array, "rows *n"]) -> Float[Array, "dofs *n"]:
    """The smallest y with J_Cm y = Q x."""
    Jm, _ = square(selection, J)
    gram = Jm @ Jm.T + jnp.diag(jnp.where(selection.used, 0, 1).astype(J.dtype))
    return Jm.T @ jnp.linalg.solve(gram, selection.Q @ x)


def _solvable(selection: Selection) -> Selection:
    """Steps below the rank's tolerance dropped: a gap along them is of second order, and dividing by them would only amplify round-off."""
    floor = rank_tolerance(selection.size.dtype) * selection.size[0]
    keep = selection.used & (selection.size > floor)
    return Selection(jnp.where(keep[:, None], selection.Q, 0), jnp.where(keep[:, None], selection.P, 0), selection.size, keep)


@functools.partial(jax.jit, static_argnames="iterations")
def close(chain: Chain, structure: Structure, q: Float[Array, " q"], iterations: int = 2, hold=None) -> Float[Array, " q"]:
    """Q moved by the least change (scaled coordinates) that closes the loops: Newton's method on the gaps, `iterations` times.

    `hold`: coordinates that must not move in the first half of the iterations.
    """
    row, column = scales(chain)

    def newton(i, q):
        kin = kinematics(chain, q)
        end = ends(chain, structure, kin, q)
        J = scaled_jacobian(chain, structure, kin, end)
        if hold is not None:
            J = jnp.where(hold[None] & (i < iterations // 2), 0, J)
        selection = _solvable(select(J, structure.rank))
        return integrate(chain, q, -column * _least_change(selection, J, row * gap(structure, end).ravel()))

    return jax.lax.fori_loop(0, iterations, newton, normalize(chain, q))


@functools.partial(jax.jit, static_argnames="iterations")
def settle_loops(chain: Chain, structure: Structure, q, v, iterations: int) -> tuple[Float[Array, " q"], Float[Array, " dofs"]]:
    """`close`, then `agree`: one body for both, the last turn of the loop being the velocities', so that it is compiled once."""
    row, column = scales(chain)
    active = active_dofs(chain, structure)

    def turn(i, both):
        q, v = both
        kin = kinematics(chain, q)
        end = ends(chain, structure, kin, q)
        J = scaled_jacobian(chain, structure, kin, end)
        selection = _solvable(select(J, structure.rank))
        open_ = jnp.stack([row * gap(structure, end).ravel(), J @ jnp.where(active, v / column, 0)], 1)
        step = -column[:, None] * _least_change(selection, J, open_)
        last = i == iterations
        return integrate(chain, q, jnp.where(last, 0, step[:, 0])), jnp.where(last, v + step[:, 1], v)

    return jax.lax.fori_loop(0, iterations + 1, turn, (normalize(chain, q), v))


@jax.jit
def agree(chain: Chain, structure: Structure, q, v, hold=None) -> Float[Array, " dofs"]:
    """V with the least change (scaled coordinates) that makes J_C v = 0; first without changing those in `hold`, then as far as needed."""
    _, column = scales(chain)
    kin = kinematics(chain, q)
    J = scaled_jacobian(chain, structure, kin, ends(chain, structure, kin, q))
    active = active_dofs(chain, structure)

    def project(i, v):
        free = J if hold is None else jnp.where(hold[None] & (i == 0), 0, J)
        selection = _solvable(select(free, structure.rank))
        return v - column * _least_change(selection, free, J @ jnp.where(active, v / column, 0))

    return project(0, v) if hold is None else jax.lax.fori_loop(0, 2, project, v)
