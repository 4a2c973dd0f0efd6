"""Guards: a function of the user, and those that measure the mechanism itself: bodies that touch, a
support that would have to pull, a joint that carries too much."""

import abc
from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc._jax.primitive import ClosureConverted
from svkc.loops.constraint import loop_frames
from svkc.loops.forward_dynamics import loop_forces
from svkc.model.chain import Chain, State
from svkc.model.checked_jit import check_chain, joint_torques
from svkc.model.names import link_index
from svkc.model.validation import finite_array, positive_scalar, scalar
from svkc.tree.kinematics import kinematics
from svkc.tree.spatial import quat_conjugate, quat_rotate


class AbstractGuard(eqx.Module):
    """A number that changes with the motion; its zero is an event."""

    # Whether `value` reads tau. Such a guard measures loads and is not re-evaluated after a change
    # of structure: a link that is overloaded from the start of a phase breaks at once.
    needs_torques: eqx.AbstractClassVar[bool]
    # the value with which a run begins; a guard that needs no torques is evaluated there instead
    initial_value: eqx.AbstractClassVar[float]

    @abc.abstractmethod
    def value(self, chain: Chain, t, state: State, args, tau: Float[Array, " dofs"]):
        """Return the guard's value.

        tau: joint torques of the moment (N m, N); zeros where no guard of the run needs them.
        """

    def closure_convert(self, t, state: State, args) -> "AbstractGuard":
        """Return the guard with every array that it reads as a leaf, so that it can be
        differentiated by them. t, state, args: examples."""
        return self


class UserGuard(AbstractGuard):
    """A function (t, state, args) -> real."""

    # the leaf is the function itself, by which two runs are compared
    function: Callable
    needs_torques: ClassVar[bool] = False
    initial_value: ClassVar[float] = 1.0

    def value(self, chain, t, state, args, tau):
        return self.function(t, state, args)

    def closure_convert(self, t, state, args):
        return UserGuard(ClosureConverted.from_function(self.function, t, state, args))


class LinkGuard(AbstractGuard):
    """A guard that measures a virtual link. `simulate` evaluates it with its own chain; called as a
    function it uses the chain it was made with."""

    chain: Chain
    link: int = eqx.field(static=True)

    def __call__(self, t, state: State, args=None, tau=None) -> Float[Array, ""]:
        """Return the value; tau None: no torques."""
        tau = jnp.zeros_like(state.v) if tau is None else joint_torques(self.chain, tau)
        return self.value(self.chain, t, state, args, tau)


class Touch(LinkGuard):
    """See `touch`."""

    needs_torques: ClassVar[bool] = False
    initial_value: ClassVar[float] = 1.0
    distance: Float[Array, ""]
    axes: tuple[int, ...] = eqx.field(static=True)

    def value(self, chain, t, state, args, tau):
        s, kin, i = state.structure, kinematics(chain, state.q), self.link
        end = loop_frames(chain, s, kin, state.q)
        p, r = s.parent[i], s.real[i]
        origin = (
            kin.r[p]
            + quat_rotate(kin.quat[p], s.pos[i])
            + (kin.root_position[p] - kin.root_position[r])
        )
        away = quat_rotate(quat_conjugate(end.base_quat[i]), end.real_position[i] - origin)[
            np.array(self.axes)
        ]
        if len(self.axes) == 1:
            return away[0] - self.distance
        square = jnp.sum(away * away)
        return (
            jnp.where(square == 0, 0, jnp.sqrt(jnp.where(square == 0, 1, square))) - self.distance
        )


class Leaves(LinkGuard):
    """See `leaves`."""

    needs_torques: ClassVar[bool] = True
    initial_value: ClassVar[float] = 1.0
    axis: Float[Array, "3"]

    def value(self, chain, t, state, args, tau):
        s, i = state.structure, self.link
        kin = kinematics(chain, state.q)
        normal = quat_rotate(loop_frames(chain, s, kin, state.q).base_quat[i], self.axis)
        push = jnp.sum(loop_forces(chain, state, tau).force[i] * normal)
        # a link that is not connected counts as pressed, so that one that would have to pull from
        # the first is seen to leave
        return jnp.where(s.connected[i], push, self.initial_value)


class Overload(LinkGuard):
    """See `overload`."""

    needs_torques: ClassVar[bool] = True
    initial_value: ClassVar[float] = -1.0
    force: Float[Array, ""]
    torque: Float[Array, ""]

    def value(self, chain, t, state, args, tau):
        carried = loop_forces(chain, state, tau)
        size = lambda x: jnp.sqrt(jnp.maximum(jnp.sum(x[self.link] ** 2), jnp.finfo(x.dtype).tiny))
        return jnp.maximum(size(carried.force) / self.force, size(carried.torque) / self.torque) - 1


def touch(chain: Chain, link: str, distance=0.01, axes: str | None = None) -> Touch:
    """A guard: how far the real end of a virtual link is from its place in the parent, less
    `distance` (m). Falls through zero as they come together.

    axes: those of the joint's frame in the parent that count, such as "xy" for a bar along z; by
    default the ones the joint does not slide along. With one axis alone, "z", the height over that
    plane, with its sign. Use with direction=False, and with a distance that is not passed within
    one step.
    """
    check_chain(chain)
    slot = link_index(chain, link)
    if axes is None:
        axes = (
            "".join(
                a
                for a, free in zip("xyz", chain.topology.link_freedoms[slot][3:], strict=True)
                if not free
            )
            or "xyz"
        )
    if (
        not isinstance(axes, str)
        or not axes
        or set(axes) - set("xyz")
        or len(set(axes)) < len(axes)
    ):
        raise ValueError(f"touch: axes: expected some of 'xyz', got {axes!r}")
    distance = jnp.asarray(
        scalar("touch: distance", finite_array("touch: distance", distance)), chain.q_load.dtype
    )
    kept = tuple("xyz".index(a) for a in axes)
    return Touch(chain=chain, link=slot, distance=distance, axes=kept)


def leaves(chain: Chain, link: str, axis=(0.0, 0.0, 1.0)) -> Leaves:
    """A guard: the force (N) with which a virtual link's parent pushes its real link along `axis`
    (in the joint's frame in the parent). It falls through zero where the parent would have to pull:
    with direction=False and cut=link the link holds in one direction only."""
    check_chain(chain)
    axis = np.asarray(finite_array("leaves: axis", axis), float)
    size = float(np.linalg.norm(axis))
    if axis.shape != (3,) or not 0 < size < np.inf:
        raise ValueError(f"leaves: axis: expected three numbers that are not all zero, got {axis}")
    return Leaves(chain, link_index(chain, link), jnp.asarray(axis / size, chain.q_load.dtype))


def overload(chain: Chain, link: str, force=None, torque=None) -> Overload:
    """A guard: what a virtual link carries, over the most it can (force N, torque N m), less one.
    It rises through zero where the joint breaks; use with direction=True and cut=link. Where loops
    are redundant the load is the least one (`loop_forces`)."""
    if force is None and torque is None:
        raise ValueError("overload: give the largest force (N), the largest torque (N m), or both")
    check_chain(chain)
    given = (("overload: force", force), ("overload: torque", torque))
    limits = [
        jnp.asarray(np.inf if x is None else positive_scalar(name, x), chain.q_load.dtype)
        for name, x in given
    ]
    return Overload(chain, link_index(chain, link), *limits)
