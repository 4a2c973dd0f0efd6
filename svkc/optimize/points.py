"""A point of a motion, as costs and constraints see it."""

import functools
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc._jax.eager import eager_jit
from svkc._jax.static_gather import static_take
from svkc.model.chain import Chain, State, Structure
from svkc.model.names import link_index
from svkc.optimize.controls import AbstractControls
from svkc.optimize.loop_rows import LinkRows, link_force, link_torque
from svkc.transitions.placement import joint_coordinates
from svkc.tree.configuration import configuration_derivative
from svkc.tree.kinematics import kinematics
from svkc.tree.spatial import quat_conjugate, quat_multiply


def tree_configuration(chain: Chain, q: Float[Array, " nq"]) -> Float[Array, " q"]:
    """Return q of the tree with the virtual joints' coordinates of the load pose."""
    return jnp.concatenate([q, chain.q_load[chain.nq :]])


def tree_velocity(chain: Chain, v: Float[Array, " nv"]) -> Float[Array, " dofs"]:
    """Return v of the tree with zeros for the virtual joints' coordinates."""
    return jnp.concatenate([v, jnp.zeros(chain.dofs - chain.nv, v.dtype)])


def full_state(
    chain: Chain, structure: Structure, q: Float[Array, " nq"], v: Float[Array, " nv"]
) -> State:
    """Return the state of q and v of the tree, with coordinates of virtual joints that agree."""
    q, v = tree_configuration(chain, q), tree_velocity(chain, v)
    if chain.dofs == chain.nv:
        return State(q, v, structure)
    place = lambda q: joint_coordinates(chain, structure, kinematics(chain, q), q)
    q, rate = jax.jvp(place, (q,), (configuration_derivative(chain, q, v),))
    return State(q, _velocity_of(chain, q, rate), structure)


def states_of(
    chain: Chain,
    structures: Sequence[Structure],
    motion: Sequence[tuple[np.ndarray, np.ndarray]],
    function: Any = None,
) -> list[State]:
    """Return the states of all phases, of each with a leading axis over its nodes.

    motion: of each phase, (q, v) [nodes ...] of the tree. function: in place of `full_state`.
    """
    repeat = lambda s, n: jax.tree.map(lambda x: np.broadcast_to(np.asarray(x), (n, *x.shape)), s)
    lanes = [(repeat(s, len(q)), q, v) for s, (q, v) in zip(structures, motion, strict=True)]
    lanes = jax.tree.map(lambda *x: np.concatenate(x), *lanes)
    ends = np.cumsum([len(q) for q, _ in motion])
    states = _over_lanes(full_state if function is None else function, chain, padded(lanes))
    return [
        jax.tree.map(lambda x, a=a, b=b: np.asarray(x)[a:b], states)
        for a, b in zip((0, *ends), ends)
    ]


@functools.partial(eager_jit, jit=eqx.filter_jit)
def _over_lanes(function: Any, chain: Chain, lanes: tuple) -> State:
    return jax.vmap(lambda lane: function(chain, *lane))(lanes)


def padded(lanes: Any, multiple: int = 64) -> Any:
    """Return lanes with the last one repeated up to a multiple of a number.

    Other numbers of intervals are then seldom compiled again.
    """
    count = len(jax.tree.leaves(lanes)[0])
    at = np.minimum(np.arange(-(-count // multiple) * multiple), count - 1)
    return jax.tree.map(lambda x: np.asarray(x)[at], lanes)


def _velocity_of(chain: Chain, q, rate) -> Float[Array, " dofs"]:
    """Return v from the derivative of q by time."""
    quat_q, quat_v = chain.topology.quaternion_starts
    scalar_q, scalar_v = chain.topology.scalar_coordinates
    at = quat_q[:, None] + np.arange(4)
    w = 2 * quat_multiply(quat_conjugate(static_take(q, at)), static_take(rate, at))[..., 1:]
    order = np.argsort(np.concatenate([scalar_v, (quat_v[:, None] + np.arange(3)).ravel()]))
    return static_take(jnp.concatenate([static_take(rate, scalar_q), w.ravel()]), order)


class Point:
    """A point of a motion: what costs and constraints are functions of.

    chain: the chain, with the parameters for which the problem is solved.
    t: time from the start of the motion (s).
    duration: duration of the phase (s).
    u: what is chosen: torque rates, torques, or the user's own numbers.
    vdot: accelerations of the tree's coordinates (rad/s^2, m/s^2).
    args: the problem's arguments.
    """

    def __init__(
        self,
        chain: Chain,
        structure: Structure,
        controls: AbstractControls,
        *,
        rows: tuple[LinkRows, np.ndarray],
        times: tuple[Float[Array, ""], Float[Array, ""]],
        motion: tuple[Float[Array, " nq"], Float[Array, " nv"], Float[Array, " nv"]],
        blocks: Float[Array, "k n"],
        multipliers: Float[Array, " rows"],
        args: Any,
        at_start: bool = False,
        fill: float | None = None,
    ):
        self.chain = chain
        self.args = args
        self._structure, self._controls = structure, controls
        self.t: Float[Array, ""] = times[0]
        self.duration: Float[Array, ""] = times[1]
        self._q, self._v, self._vdot = motion
        self._blocks, self._multipliers, self._at_start = blocks, multipliers, at_start
        self._rows, self._active = rows
        # in place of coordinates of virtual joints, for functions that do not read them
        self._fill = fill

    @functools.cached_property
    def state(self) -> State:
        """The state, with the structure of the phase."""
        fill = self._fill
        if fill is None:
            return full_state(self.chain, self._structure, self._q, self._v)
        pad = lambda x, size: jnp.concatenate([x, jnp.full(size - len(x), fill, x.dtype)])
        q, v = pad(self._q, self.chain.topology.nq_all), pad(self._v, self.chain.dofs)
        return State(q, v, self._structure)

    @property
    def u(self) -> Float[Array, " n"]:
        """What is chosen: torque rates (N m/s, N/s), torques (N m, N), or the user's own."""
        return self._blocks[-1]

    @functools.cached_property
    def tau(self) -> Float[Array, " dofs"]:
        """Joint torques over every coordinate (N m, N)."""
        return self._controls.torques(self.chain, self.t, self.state, self._blocks, self.args)

    @property
    def vdot(self) -> Float[Array, " nv"]:
        """Accelerations of the tree's coordinates (rad/s^2, m/s^2).

        Raises ValueError at the start of a phase, where there are none.
        """
        self._refuse_at_start("vdot")
        return self._vdot

    def forces(self, link: str) -> Float[Array, "3"]:
        """Return the force (N) that a virtual link transmits on its real link from the parent, at
        the joint, in axes of the parent body.

        link: name of the virtual link.
        Raises ValueError for a link that is not connected, and at the start of a phase.
        """
        self._refuse_at_start("forces")
        return link_force(self.chain, self._rows, *self._multipliers_of(link, "forces"))

    def torques(self, link: str) -> Float[Array, "3"]:
        """Return the torque (N m) that a virtual link transmits, in the convention of `forces`.

        link: name of the virtual link.
        Raises ValueError for a link that is not connected, and at the start of a phase.
        """
        self._refuse_at_start("torques")
        return link_torque(self.chain, self._q, self._rows, *self._multipliers_of(link, "torques"))

    def impulse(self, link: str) -> Float[Array, "3"]:
        """Return the impulse (N s) of a virtual link at the start of a phase with an impact, in the
        convention of `forces`.

        link: name of the virtual link.
        Raises ValueError for a link that is not connected, and elsewhere than at a phase's start.
        """
        if not self._at_start:
            raise ValueError("impulse: a point has one at the start of a phase only")
        return link_force(self.chain, self._rows, *self._multipliers_of(link, "impulse"))

    def torque(self, joint: str) -> Array:
        """Return the torque (N m, N) of a joint: a scalar for a hinge or slide.

        joint: name of the joint.
        Raises ValueError, with the nearest names, if there is no such joint.
        """
        tau = self.tau[self.chain.v_index(joint)]
        return tau[0] if tau.shape == (1,) else tau

    def _refuse_at_start(self, name: str) -> None:
        if self._at_start:
            raise ValueError(
                f"{name}: a point at the start of a phase has none; use `path`, or `end`"
            )

    def _multipliers_of(self, link: str, method: str) -> tuple[int, Float[Array, " rows"]]:
        """Return the index of a link in the chain, and the multipliers of all rows.

        method: name of the method that the message of the ValueError begins with.
        """
        i = link_index(self.chain.topology, link)
        if not np.any((self._rows.rows // 6 == i) & self._active):
            raise ValueError(f"{method}: the virtual link {link!r} is not connected in this phase")
        return i, jnp.where(self._active, self._multipliers, 0)


class PhaseStructure(eqx.Module):
    """What a phase's structure is to the transcription.

    structure: of the states. active: mask of the selected rows that are constraints in the phase.
    new: those of links that connect at its start.
    """

    structure: Structure
    active: np.ndarray
    new: np.ndarray
