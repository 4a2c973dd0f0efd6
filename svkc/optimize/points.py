"""`Point`, the argument of costs and constraints, and states from coordinates of the tree."""

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


def full_configuration(chain: Chain, q: Float[Array, " nq"]) -> Float[Array, " q"]:
    """Return q of the chain: q of the tree, then virtual joints' coordinates of the load pose."""
    return jnp.concatenate([q, chain.q_load[chain.nq :]])


def full_velocity(chain: Chain, v: Float[Array, " nv"]) -> Float[Array, " dofs"]:
    """Return v of the chain: v of the tree, then zeros for the virtual joints' coordinates."""
    return jnp.concatenate([v, jnp.zeros(chain.dofs - chain.nv, v.dtype)])


def placed_as_in(chain: Chain, structure: Structure) -> Structure:
    """Return a structure with the links at their places in the chain, which may depend on args."""
    places = lambda s: (s.pos, s.quat, s.real_pos, s.real_quat)
    return eqx.tree_at(places, structure, places(chain.structure))


def full_state(
    chain: Chain, structure: Structure, q: Float[Array, " nq"], v: Float[Array, " nv"]
) -> State:
    """Return the state at q and v of the tree.

    Coordinates and velocities of virtual joints follow from the motion of the bodies.
    """
    q, v = full_configuration(chain, q), full_velocity(chain, v)
    if chain.dofs == chain.nv:
        return State(q, v, structure)
    place = lambda q: joint_coordinates(chain, structure, kinematics(chain, q), q)
    q, rate = jax.jvp(place, (q,), (configuration_derivative(chain, q, v),))
    return State(q, _velocity_from_rate(chain, q, rate), structure)


def states_of(
    chain: Chain,
    structures: Sequence[Structure],
    motion: Sequence[tuple[np.ndarray, np.ndarray]],
    function: Any = None,
) -> list[State]:
    """Return the states of each phase, with a leading axis over its nodes.

    motion: of each phase, (q [nodes nq], v [nodes nv]) of the tree.
    function: (chain, structure, q, v) -> state; None: `full_state`.
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
    """Return function(chain, structure, q, v) over lanes of (structure, q, v)."""
    return jax.vmap(lambda lane: function(chain, *lane))(lanes)


def padded(lanes: Any, multiple: int = 64) -> Any:
    """Return arrays with their last entry repeated until the length is a multiple of a number.

    Meshes of nearly as many intervals then share one compiled program.
    """
    count = len(jax.tree.leaves(lanes)[0])
    at = np.minimum(np.arange(-(-count // multiple) * multiple), count - 1)
    return jax.tree.map(lambda x: np.asarray(x)[at], lanes)


def _velocity_from_rate(chain: Chain, q, rate) -> Float[Array, " dofs"]:
    """Return v from q and its derivative by time."""
    quat_q, quat_v = chain.topology.quaternion_starts
    scalar_q, scalar_v = chain.topology.scalar_coordinates
    at = quat_q[:, None] + np.arange(4)
    w = 2 * quat_multiply(quat_conjugate(static_take(q, at)), static_take(rate, at))[..., 1:]
    order = np.argsort(np.concatenate([scalar_v, (quat_v[:, None] + np.arange(3)).ravel()]))
    return static_take(jnp.concatenate([static_take(rate, scalar_q), w.ravel()]), order)


class AbsentAtStartError(ValueError):
    """Raised where a function reads a quantity that a point at the start of a phase lacks."""


class Point:
    """One time of a motion: the argument of costs and constraints.

    Points are at the stages of intervals, and at the start of a phase.

    chain: the chain of the problem. Read masses and lengths from this attribute: the optimal cost
        then has derivatives by them.
    t: time from the start of the motion (s).
    duration: duration of the phase (s).
    u: controls: torque rates, torques, or the numbers of `Parametrized`.
    vdot: accelerations of the tree's coordinates (rad/s^2, m/s^2).
    args: `args` of the problem.
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
        fill: Any = None,
    ):
        self.chain = chain
        self.args = args
        self._structure, self._controls = structure, controls
        self.t: Float[Array, ""] = times[0]
        self.duration: Float[Array, ""] = times[1]
        self._q, self._v, self._vdot = motion
        self._blocks, self._multipliers, self._at_start = blocks, multipliers, at_start
        self._rows, self._active = rows
        # value of the virtual joints' coordinates for functions that do not read them; None:
        # computed from the bodies
        self._fill = fill

    @functools.cached_property
    def state(self) -> State:
        """State at this time, with the structure of the phase."""
        fill = self._fill
        if fill is None:
            return full_state(self.chain, self._structure, self._q, self._v)
        pad = lambda x, size: jnp.concatenate([x, jnp.full(size - len(x), fill, x.dtype)])
        q, v = pad(self._q, self.chain.topology.nq_all), pad(self._v, self.chain.dofs)
        return State(q, v, self._structure)

    @property
    def u(self) -> Float[Array, " n"]:
        """Controls: torque rates (N m/s, N/s), torques (N m, N), or numbers of `Parametrized`."""
        return self._blocks[-1]

    @functools.cached_property
    def tau(self) -> Float[Array, " dofs"]:
        """Joint torques over every coordinate (N m, N)."""
        return self._controls.torques(self.chain, self.t, self.state, self._blocks, self.args)

    @property
    def vdot(self) -> Float[Array, " nv"]:
        """Accelerations of the tree's coordinates (rad/s^2, m/s^2).

        Raises ValueError at the start of a phase, where a point has no accelerations.
        """
        self._refuse_at_start("vdot")
        return self._vdot

    def forces(self, link: str) -> Float[Array, "3"]:
        """Return the force (N) of a virtual link: on its real link, from its parent.

        The force acts at the joint. Components are along the axes of the parent body.

        link: name of the virtual link.
        Raises ValueError for a link that is not connected, and at the start of a phase.
        """
        self._refuse_at_start("forces")
        return link_force(self.chain, self._rows, *self._multipliers_of(link, "forces"))

    def torques(self, link: str) -> Float[Array, "3"]:
        """Return the torque (N m) of a virtual link about its joint, in the axes of `forces`.

        link: name of the virtual link.
        Raises ValueError for a link that is not connected, and at the start of a phase.
        """
        self._refuse_at_start("torques")
        return link_torque(self.chain, self._q, self._rows, *self._multipliers_of(link, "torques"))

    def impulse(self, link: str) -> Float[Array, "3"]:
        """Return the impulse (N s) of a virtual link in the impact at the start of a phase.

        It acts at the joint, on the real link from the parent. Components are along the axes of the
        parent body. Phases without an impact have zero impulse.

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
        """Raise ValueError at the start of a phase. name: what the point does not have there."""
        if self._at_start:
            raise AbsentAtStartError(
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
    """The structure of a phase, with masks of the links' rows in it.

    structure: structure of the phase's states.
    active: mask [rows] of the links' rows that are constraints in the phase.
    new: mask [rows] of those that belong to links that connect at the start of the phase.
    here: mask [rows] of those that belong to links placed by `Phase.here`.
    """

    structure: Structure
    active: np.ndarray
    new: np.ndarray
    here: np.ndarray
