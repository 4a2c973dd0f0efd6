"""Derivatives of the rows of stages and of nodes in closed form, for trees of hinges and slides.

Automatic differentiation of each stage takes about ten times as long (benchmarks/README.md).
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from svkc._jax.static_gather import static_take
from svkc.model.chain import Chain
from svkc.optimize.charts import quaternion_starts
from svkc.optimize.controls import AbstractControls
from svkc.optimize.equations import IntervalData, Model, Params
from svkc.optimize.link_derivatives import RowsOfLink, rows_of_links
from svkc.optimize.points import full_configuration, full_velocity
from svkc.optimize.tree_derivatives import TreeMotion
from svkc.tree.inverse_dynamics import limit_forces, passive_forces
from svkc.tree.kinematics import Kinematics, kinematics


def has_closed_forms(chain: Chain, controls: AbstractControls) -> bool:
    """Return whether the derivatives of this module apply.

    The tree must have no quaternions, and joint torques must be linear in the controls.
    """
    return not len(quaternion_starts(chain)[0]) and not controls.needs_state


def _joint_derivatives(
    chain: Chain, q: Float[Array, " nv"], v: Float[Array, " nv"]
) -> tuple[tuple[Array, Array], tuple[Array, Array, Array]] | None:
    """Return derivatives of the forces of springs, dampers and joint limits.

    A coordinate's force depends on its own position and velocity alone, so that each derivative is
    an array [nv]. The first pair has the derivatives by q and by v. The second tuple has the second
    derivatives by q and q, q and v, v and v. None if the chain has no such forces.
    """
    if chain.damping is None and chain.stiffness is None and chain.limit_spring is None:
        return None
    one, nv = jnp.ones_like(q), chain.nv

    def force(q, v):
        full = full_configuration(chain, q), full_velocity(chain, v)
        return (passive_forces(chain, *full) + limit_forces(chain, *full))[:nv]

    by_q = lambda q, v: jax.jvp(lambda q: force(q, v), (q,), (one,))[1]
    by_v = lambda q, v: jax.jvp(lambda v: force(q, v), (v,), (one,))[1]
    qq, qv = (jax.jvp(by_q, (q, v), x)[1] for x in ((one, 0 * one), (0 * one, one)))
    vv = jax.jvp(lambda v: by_v(q, v), (v,), (one,))[1]
    return (by_q(q, v), by_v(q, v)), (qq, qv, vv)


def _diagonal(x) -> jax.Array:
    """Return the diagonal matrices [... n n] of the diagonals [... n]."""
    eye = np.eye(x.shape[-1], dtype=bool)
    return jnp.where(eye.reshape((1,) * (x.ndim - 1) + eye.shape), x[..., None], 0)


class LinkDerivatives:
    """Derivatives of the links' rows at one motion (q, v, vdot) of the tree.

    active: mask of the rows that are constraints. f: multipliers; those of other rows are zero.
    """

    def __init__(
        self,
        model: Model,
        chain: Chain,
        active: Bool[Array | np.ndarray, " rows"],
        *,
        q: Float[Array, " nv"],
        v: Float[Array, " nv"],
        vdot: Float[Array, " nv"],
        f: Float[Array, " rows"],
    ):
        self.model, self.chain, self.active = model, chain, active
        self.kin: Kinematics = kinematics(chain, q)
        self.f: Float[Array, " rows"] = jnp.where(active, f, 0)
        has_rows = len(model.rows) > 0
        self.links: list[tuple[np.ndarray, RowsOfLink]] = (
            rows_of_links(chain, self.kin, model.rows, v, vdot) if has_rows else []
        )

    def _over_rows(self, parts: list):
        """Return one array in the order of the table's rows, from one array for each of `links`."""
        order = np.argsort(np.concatenate([places for places, _ in self.links]))
        return static_take(jnp.concatenate(parts), order)

    def _stiffness(self, f):
        """Return the derivatives [nv nv] by q of the links' generalized force J^T f."""
        parts = [rows.force_stiffness(static_take(f, places)) for places, rows in self.links]
        return functools.reduce(jnp.add, parts)

    def _of_links(self, multipliers, f, virtual):
        """Return the second derivatives that `RowsOfLink.hessian` gives, of all links together.

        The blocks [4 nv nv] are summed over links; the derivatives by f and q are [rows nv].
        """
        take = static_take
        parts = [r.hessian(take(multipliers, at), take(f, at), virtual) for at, r in self.links]
        blocks = functools.reduce(jnp.add, [blocks for _, blocks, _ in parts])
        return blocks, self._over_rows([by_f for _, _, by_f in parts])


class StageDerivatives(LinkDerivatives):
    """Derivatives of `stage_equations` at the stage variables y."""

    def __init__(self, model: Model, params: Params, data: IntervalData, y: Float[Array, " y"]):
        self.params = params
        (t, _), (q, v, vdot), blocks, f = model.layout.split_stage(y)
        self.t: Float[Array, ""] = t
        self.blocks: Float[Array, "blocks control"] = blocks
        super().__init__(model, params.chain, data.active, q=q, v=v, vdot=vdot, f=f)
        self.tree: TreeMotion = TreeMotion(self.chain, self.kin, v, vdot)
        self.joints: tuple[tuple[Array, Array], tuple[Array, Array, Array]] | None = (
            _joint_derivatives(self.chain, q, v)
        )

    def _torques_by_blocks(self):
        """Return the derivatives [nv blocks control] of the joint torques by the controls."""
        controls, chain = self.model.controls, self.chain
        torques = lambda w: controls.torques(chain, self.t, None, w, self.params.args)[: chain.nv]
        return jax.jacrev(torques)(jnp.zeros_like(self.blocks))

    def _forces_by_motion(self):
        """Return the derivatives [nv 3 nv] of the dynamics' rows by q, v and vdot."""
        J, at = self.tree.jacobian(), np.arange(3)[None, :, None]
        diagonals = []
        if self.chain.armature is not None:
            diagonals.append((2, self.chain.armature))
        if self.joints is not None:
            diagonals += [(0, -self.joints[0][0]), (1, -self.joints[0][1])]
        for k, x in diagonals:
            J = J + jnp.where(at == k, _diagonal(x)[:, None], 0)
        if self.links:
            J = J - jnp.where(at == 0, self._stiffness(self.f)[:, None], 0)
        return J

    def jacobian(self) -> Float[Array, "equations y"]:
        """Return the derivatives of the rows by the stage variables."""
        nv, J = self.chain.nv, self._forces_by_motion()
        controls = -self._torques_by_blocks().reshape(nv, -1)
        upper = [jnp.zeros((nv, 2)), J.reshape(nv, -1), controls]
        if not self.links:
            return jnp.concatenate(upper, 1)
        of_rows = self._over_rows([rows.jacobian() for _, rows in self.links])
        rates = self._over_rows([rows.rates() for _, rows in self.links])
        upper.append(jnp.where(self.active[None], -rates.T, 0))
        count = len(of_rows)
        zeros = jnp.zeros((count, controls.shape[1] + count))
        lower = [jnp.zeros((count, 2)), of_rows.reshape(count, -1), zeros]
        return jnp.concatenate([jnp.concatenate(upper, 1), jnp.concatenate(lower, 1)])

    def hessian(
        self, multipliers: Float[Array, " equations"]
    ) -> tuple[
        Float[Array, "3 nv"],
        Float[Array, "blocks control"],
        Float[Array, "4 nv nv"],
        Float[Array, "rows nv"],
    ]:
        """Return derivatives of the function multipliers . rows.

        Its gradient by q, v and vdot [3 nv] and by the control blocks. Its second derivatives by q
        and q, q and v, v and v, q and vdot [4 nv nv], and by f and q [rows nv]. All others are
        zero.
        """
        nv = self.chain.nv
        of_dynamics, of_rows = multipliers[:nv], multipliers[nv:]
        gradient, blocks = self.tree.hessian(of_dynamics)
        if self.chain.armature is not None:
            of_vdot = self.chain.armature * of_dynamics
            gradient = gradient + jnp.where(np.arange(3)[:, None] == 2, of_vdot[None], 0)
        if self.joints is not None:
            first, second = self.joints
            zero = jnp.zeros_like(first[0])
            gradient = gradient - of_dynamics[None] * jnp.stack([*first, zero])
            blocks = blocks - _diagonal(of_dynamics[None] * jnp.stack([*second, zero]))
        controls = -jnp.sum(of_dynamics[:, None, None] * self._torques_by_blocks(), 0)
        parts = []
        for places, rows in self.links:
            m, f = static_take(of_rows, places), static_take(self.f, places)
            of_link, pairs, by_f = rows.hessian(m, f, of_dynamics)
            gradient, blocks = gradient + of_link, blocks + pairs
            parts.append(by_f)
        by_f = jnp.zeros((0, nv))
        if parts:
            by_f = jnp.where(self.active[:, None], self._over_rows(parts), 0)
        return gradient, controls, blocks, by_f


class NodeDerivatives(LinkDerivatives):
    """Derivatives of a function of nodes at its unknowns y, of which q is the first."""

    def _rates_by_q(self) -> Array:
        """Return the derivatives of gap rates by q, half of those of gap accelerations by v."""
        return self._over_rows([rows.jacobian()[:, 1] / 2 for _, rows in self.links])

    def _gaps_and_rates(self, gaps, rates) -> tuple[Array, Array]:
        """Return the second derivatives by q and q, and by q and v, of rows times multipliers.

        gaps, rates: multipliers of the gaps and of the gap rates.
        """
        none, nothing = jnp.zeros_like(gaps), jnp.zeros(self.chain.nv)
        of_gaps, _ = self._of_links(gaps, none, nothing)
        of_rates, _ = self._of_links(rates, none, nothing)
        # from those of gap accelerations: d2 g'' / (dq dv') = d2 g / dq2, d g'' / dv = 2 d g' / dq
        return of_gaps[3] + of_rates[1] / 2, of_rates[3]

    def _force(self, f, virtual) -> tuple[Array, Array]:
        """Return the second derivatives of virtual . J^T f by q and q, and by q and f."""
        of_force, by_f = self._of_links(jnp.zeros_like(f), f, -virtual)
        return of_force[0], jnp.where(self.active[:, None], by_f, 0).T


def _symmetric(first: Float[Array, "nv y"]) -> Float[Array, "y y"]:
    """Return a symmetric matrix that is zero outside its first rows and columns."""
    nv, size = first.shape
    below = jnp.concatenate([first[:, nv:].T, jnp.zeros((size - nv, size - nv))], 1)
    return jnp.concatenate([first, below])


class ConnectionDerivatives(NodeDerivatives):
    """Derivatives of `connection` at its unknowns y."""

    def __init__(self, model: Model, params: Params, data: IntervalData, y: Float[Array, " y"]):
        chain, nv = params.chain, model.layout.nv
        q, after, before, f = jnp.split(y, [nv, 2 * nv, 3 * nv])
        super().__init__(model, chain, data.active, q=q, v=after, vdot=jnp.zeros_like(q), f=f)
        # at rest without gravity, torques are mass times acceleration: the change of momentum
        rest, jump = jnp.zeros_like(q), after - before
        self.tree: TreeMotion = TreeMotion(chain, self.kin, rest, jump, gravity=False)

    def jacobian(self) -> Float[Array, "equations y"]:
        """Return the derivatives of the rows by y."""
        by_motion = self.tree.jacobian()
        mass = by_motion[:, 2]
        if self.chain.armature is not None:
            mass = mass + _diagonal(self.chain.armature)
        rates = self._over_rows([rows.rates() for _, rows in self.links])
        of_rates = self._rates_by_q()
        zero, square = jnp.zeros_like(rates), jnp.zeros((len(rates),) * 2)
        by_q = by_motion[:, 0] - self._stiffness(self.f)
        by_f = jnp.where(self.active[None], -rates.T, 0)
        parts = [
            [rates, zero, zero, square],
            [of_rates, rates, zero, square],
            [by_q, mass, -mass, by_f],
        ]
        return jnp.concatenate([jnp.concatenate(x, 1) for x in parts])

    def hessian(self, multipliers: Float[Array, " equations"]) -> Float[Array, "y y"]:
        """Return the second derivatives of the function multipliers . rows."""
        count = len(self.f)
        gaps, rates, momentum = jnp.split(multipliers, [count, 2 * count])
        _, (of_momentum, _, _, of_mass) = self.tree.hessian(momentum)
        of_rows, of_rates = self._gaps_and_rates(gaps, rates)
        of_force, by_f = self._force(self.f, -momentum)
        qq = of_momentum + of_rows + of_force
        return _symmetric(jnp.concatenate([qq, of_mass + of_rates, -of_mass, by_f], 1))


class ProjectionDerivatives(NodeDerivatives):
    """Derivatives of `projection` at its unknowns y."""

    def __init__(self, model: Model, params: Params, data: IntervalData, y: Float[Array, " y"]):
        nv, n = model.layout.nv, len(model.rows)
        q, v, of_q, of_v = jnp.split(y, [nv, 2 * nv, 2 * nv + n])
        self.of_v: Float[Array, " rows"] = jnp.where(data.active, of_v, 0)
        none = jnp.zeros_like(q)
        super().__init__(model, params.chain, data.active, q=q, v=v, vdot=none, f=of_q)

    def jacobian(self) -> Float[Array, "equations y"]:
        """Return the derivatives of the rows by y."""
        rates = self._over_rows([rows.rates() for _, rows in self.links])
        of_rates = self._rates_by_q()
        by_f = jnp.where(self.active[None], rates.T, 0)
        none, square = jnp.zeros_like(by_f), jnp.zeros((len(rates),) * 2)
        zero = jnp.zeros((self.chain.nv,) * 2)
        parts = [
            [self._stiffness(self.f), zero, by_f, none],
            [self._stiffness(self.of_v), zero, none, by_f],
            [rates, none.T, square, square],
            [of_rates, rates, square, square],
        ]
        return jnp.concatenate([jnp.concatenate(x, 1) for x in parts])

    def hessian(self, multipliers: Float[Array, " equations"]) -> Float[Array, "y y"]:
        """Return the second derivatives of the function multipliers . rows."""
        nv, count = self.chain.nv, len(self.f)
        of_q, of_v, gaps, rates = jnp.split(multipliers, [nv, 2 * nv, 2 * nv + count])
        of_rows, of_rates = self._gaps_and_rates(gaps, rates)
        first, by_q = self._force(self.f, of_q)
        second, by_v = self._force(self.of_v, of_v)
        qq = of_rows + first + second
        return _symmetric(jnp.concatenate([qq, of_rates, by_q, by_v], 1))
