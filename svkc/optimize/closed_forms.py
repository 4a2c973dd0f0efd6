"""Derivatives of a stage's rows in closed form, for trees of hinges and slides.

They have a thirtieth of the operations of automatic differentiation of the rows.
"""

import jax
import jax.numpy as jnp
import numpy as np

from svkc._jax.static_gather import static_take
from svkc.model.chain import Chain
from svkc.optimize.charts import quaternion_starts
from svkc.optimize.equations import IntervalData, Model, Params
from svkc.optimize.link_derivatives import rows_of_links
from svkc.optimize.points import tree_configuration, tree_velocity
from svkc.optimize.tree_derivatives import TreeMotion
from svkc.tree.inverse_dynamics import limit_forces, passive_forces
from svkc.tree.kinematics import kinematics


def has_closed_forms(chain: Chain, controls) -> bool:
    """Return whether the derivatives of this module hold.

    The tree has no quaternions, and joint torques are linear in the controls.
    """
    return not len(quaternion_starts(chain)[0]) and not controls.needs_state


def _joint_derivatives(chain: Chain, q, v):
    """Return derivatives of springs, dampers and limits, each joint's by its own coordinate.

    First by q and v; then by q and q, q and v, v and v. None if the chain has no such forces.
    """
    if chain.damping is None and chain.stiffness is None and chain.limit_spring is None:
        return None
    one, nv = jnp.ones_like(q), chain.nv

    def force(q, v):
        full = tree_configuration(chain, q), tree_velocity(chain, v)
        return (passive_forces(chain, *full) + limit_forces(chain, *full))[:nv]

    by_q = lambda q, v: jax.jvp(lambda q: force(q, v), (q,), (one,))[1]
    by_v = lambda q, v: jax.jvp(lambda v: force(q, v), (v,), (one,))[1]
    qq, qv = (jax.jvp(by_q, (q, v), x)[1] for x in ((one, 0 * one), (0 * one, one)))
    vv = jax.jvp(lambda v: by_v(q, v), (v,), (one,))[1]
    return (by_q(q, v), by_v(q, v)), (qq, qv, vv)


def _diagonal(x) -> jax.Array:
    """Return diagonal matrices from their diagonals in the last axis."""
    return jnp.where(np.eye(x.shape[-1], dtype=bool), x[..., None], 0)


class StageDerivatives:
    """Derivatives of `stage_equations`.

    y: the stage's variables.
    """

    def __init__(self, model: Model, params: Params, data: IntervalData, y):
        self.model, self.chain, self.params = model, params.chain, params
        (self.t, _), (q, v, vdot), self.blocks, f = model.layout.split_stage(y)
        self.active, self.f = data.active, jnp.where(data.active, f, 0)
        kin = kinematics(self.chain, q)
        self.tree = TreeMotion(self.chain, kin, v, vdot)
        has_rows = len(model.rows) > 0
        self.links = rows_of_links(self.chain, kin, model.rows, v, vdot) if has_rows else []
        self.joints = _joint_derivatives(self.chain, q, v)

    def _torques_by_blocks(self):
        """Return the derivatives [nv blocks control] of the joint torques, which are linear."""
        controls, chain = self.model.controls, self.chain
        torques = lambda w: controls.torques(chain, self.t, None, w, self.params.args)[: chain.nv]
        return jax.jacrev(torques)(jnp.zeros_like(self.blocks))

    def _over_rows(self, parts: list):
        """Return arrays of the links' rows, each a list over links, in the order of the table."""
        order = np.argsort(np.concatenate([places for places, _ in self.links]))
        return static_take(jnp.concatenate(parts), order)

    def _forces_by_motion(self):
        """Return the derivatives [nv 3 nv] of the forces by q, v and vdot."""
        J, at = self.tree.jacobian(), np.arange(3)[None, :, None]
        diagonals = []
        if self.chain.armature is not None:
            diagonals.append((2, self.chain.armature))
        if self.joints is not None:
            diagonals += [(0, -self.joints[0][0]), (1, -self.joints[0][1])]
        for k, x in diagonals:
            J = J + jnp.where(at == k, _diagonal(x)[:, None], 0)
        for places, rows in self.links:
            stiffness = rows.force_stiffness(static_take(self.f, places))
            J = J - jnp.where(at == 0, stiffness[:, None], 0)
        return J

    def jacobian(self):
        """Return the derivatives [rows y]."""
        nv, J = self.chain.nv, self._forces_by_motion()
        controls = -self._torques_by_blocks().reshape(nv, -1)
        upper = [jnp.zeros((nv, 2)), J.reshape(nv, -1), controls]
        if not self.links:
            return jnp.concatenate(upper, 1)
        of_rows = self._over_rows([rows.jacobian() for _, rows in self.links])
        rates = self._over_rows([rows.rates() for _, rows in self.links])
        upper.append(jnp.where(self.active, -rates.T, 0))
        count = len(of_rows)
        zeros = jnp.zeros((count, controls.shape[1] + count))
        lower = [jnp.zeros((count, 2)), of_rows.reshape(count, -1), zeros]
        return jnp.concatenate([jnp.concatenate(upper, 1), jnp.concatenate(lower, 1)])

    def hessian(self, multipliers):
        """Return derivatives of the rows' sum with multipliers.

        Gradients by the motion [3 nv] and by the control blocks; second derivatives by q and q, q
        and v, v and v, q and vdot [4 nv nv], and by the links' multipliers and q [rows nv].
        """
        nv = self.chain.nv
        of_dynamics, of_rows = multipliers[:nv], multipliers[nv:]
        gradient, blocks = self.tree.hessian(of_dynamics)
        if self.chain.armature is not None:
            gradient = gradient + (np.arange(3) == 2)[:, None] * self.chain.armature * of_dynamics
        if self.joints is not None:
            first, second = self.joints
            zero = jnp.zeros_like(first[0])
            gradient = gradient - of_dynamics * jnp.stack([*first, zero])
            blocks = blocks - _diagonal(of_dynamics * jnp.stack([*second, zero]))
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
