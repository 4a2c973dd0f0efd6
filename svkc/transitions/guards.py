"""Guards: functions of the motion whose zeros are events.

A guard is a function of the user, or measures the mechanism: bodies that touch, a support that
would have to pull, an overloaded joint.
"""

import abc
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc._jax.primitive import ClosureConverted
from svkc._jax.select import where
from svkc.loops.forward_dynamics import loop_forces
from svkc.loops.frames import loop_frames
from svkc.model.annotations import Numbers, Scalar
from svkc.model.chain import Chain, State
from svkc.model.checked_jit import check_chain, torques_over_dofs
from svkc.model.names import link_index
from svkc.model.validation import finite_array, positive_scalar, scalar
from svkc.tree.kinematics import kinematics
from svkc.tree.spatial import quat_conjugate, quat_rotate


class AbstractGuard(eqx.Module):
    """A real function of the motion; an event happens when the function crosses zero."""

    # Whether `value` reads tau. Such a guard measures loads. Its value from before a change of
    # structure is kept as the first value of the next phase, so that a link that is overloaded from
    # the start of that phase breaks at once. Other guards are re-evaluated after a change.
    needs_torques: eqx.AbstractClassVar[bool]
    # the first value in a run of a guard that needs torques; not used for other guards
    initial_value: eqx.AbstractClassVar[float]

    @abc.abstractmethod
    def value(
        self, chain: Chain, t: Scalar, state: State, args: Any, tau: Float[Array, " dofs"]
    ) -> Float[Array, ""]:
        """Return the guard's value.

        tau: joint torques at this time (N m, N); zeros if no guard of the run needs torques.
        """

    def closure_convert(self, t: Scalar, state: State, args: Any) -> "AbstractGuard":
        """Return the guard with every array that it closes over as a leaf, so that derivatives with
        respect to these arrays exist.

        t, state, args: example arguments for tracing.
        """
        return self


class UserGuard(AbstractGuard):
    """A guard from the user's function (t, state, args) -> real number."""

    # a leaf, so that `simulate` can compare functions by their code and values
    function: Callable
    needs_torques: ClassVar[bool] = False
    initial_value: ClassVar[float] = 1.0

    def value(self, chain: Chain, t: Scalar, state: State, args: Any, tau: Any) -> Any:
        return self.function(t, state, args)

    def closure_convert(self, t: Scalar, state: State, args: Any) -> "UserGuard":
        return UserGuard(ClosureConverted.from_function(self.function, t, state, args))


class LinkGuard(AbstractGuard):
    """A guard that measures a virtual link.

    `simulate` passes its own chain to `value`. A direct call uses the guard's own `chain`.
    """

    chain: Chain
    link: int = eqx.field(static=True)

    def __call__(
        self, t: Scalar, state: State, args: Any = None, tau: Any = None
    ) -> Float[Array, ""]:
        """Return the guard's value with the guard's own chain.

        tau: joint torques (N m, N) over every coordinate, or the tree's; None: zeros.
        """
        tau = jnp.zeros_like(state.v) if tau is None else torques_over_dofs(self.chain, tau)
        return self.value(self.chain, t, state, args, tau)


class Touch(LinkGuard):
    """The guard that `touch` returns."""

    needs_torques: ClassVar[bool] = False
    initial_value: ClassVar[float] = 1.0
    distance: Float[Array, ""]
    axes: tuple[int, ...] = eqx.field(static=True)

    def value(self, chain: Chain, t: Scalar, state: State, args: Any, tau: Any) -> Float[Array, ""]:
        s, kin, i = state.structure, kinematics(chain, state.q), self.link
        frames = loop_frames(chain, s, kin, state.q)
        p, r = s.parent[i], s.real[i]
        origin = (
            kin.r[p]
            + quat_rotate(kin.quat[p], s.pos[i])
            + (kin.root_position[p] - kin.root_position[r])
        )
        offset = quat_rotate(quat_conjugate(frames.base_quat[i]), frames.real_position[i] - origin)
        offset = offset[np.array(self.axes)]
        if len(self.axes) == 1:
            return offset[0] - self.distance
        squared = jnp.sum(offset * offset)
        # the derivative of sqrt at zero is not finite
        norm = where(squared == 0, 0, jnp.sqrt(where(squared == 0, 1, squared)))
        return norm - self.distance


class Leaves(LinkGuard):
    """The guard that `leaves` returns."""

    needs_torques: ClassVar[bool] = True
    initial_value: ClassVar[float] = 1.0
    axis: Float[Array, "3"]

    def value(self, chain: Chain, t: Scalar, state: State, args: Any, tau: Any) -> Float[Array, ""]:
        s, i = state.structure, self.link
        kin = kinematics(chain, state.q)
        normal = quat_rotate(loop_frames(chain, s, kin, state.q).base_quat[i], self.axis)
        normal_force = jnp.sum(loop_forces(chain, state, tau).force[i] * normal)
        # positive while the link is cut, so that a link that would have to pull as soon as it
        # connects crosses zero
        return where(s.connected[i], normal_force, self.initial_value)


class Overload(LinkGuard):
    """The guard that `overload` returns."""

    needs_torques: ClassVar[bool] = True
    initial_value: ClassVar[float] = -1.0
    force: Float[Array, ""]
    torque: Float[Array, ""]

    def value(self, chain: Chain, t: Scalar, state: State, args: Any, tau: Any) -> Float[Array, ""]:
        load = loop_forces(chain, state, tau)
        norm = lambda x: jnp.sqrt(jnp.maximum(jnp.sum(x[self.link] ** 2), jnp.finfo(x.dtype).tiny))
        return jnp.maximum(norm(load.force) / self.force, norm(load.torque) / self.torque) - 1


def touch(chain: Chain, link: str, distance: Scalar = 0.01, axes: str | None = None) -> Touch:
    """Return a guard that falls through zero when the two ends of a virtual link come close.

    The guard's value (m) is the distance between the link's point on the real link and its point on
    the parent, less `distance`. Use the guard with direction=False. Points that enter and leave
    this distance within one step are noticed; `svkc.when` states what can be missed.

    link: name of a virtual link.
    distance: distance between the points at the event (m).
    axes: axes of the joint's frame in the parent along which the distance is measured, such as "xy"
        for a bar along z; None: the axes along which the joint cannot slide. Along a single axis
        the distance has a sign: "z" measures the height above the plane z = 0.

    Raises ValueError for an unknown link, a distance that is not one finite number, or axes that
    are not distinct letters of "xyz".
    """
    check_chain(chain)
    slot = link_index(chain.topology, link)
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
        raise ValueError(f"touch: axes: expected distinct letters of 'xyz', got {axes!r}")
    distance = jnp.asarray(
        scalar("touch: distance", finite_array("touch: distance", distance)), chain.q_load.dtype
    )
    indices = tuple("xyz".index(a) for a in axes)
    return Touch(chain=chain, link=slot, distance=distance, axes=indices)


def leaves(chain: Chain, link: str, axis: Numbers = (0.0, 0.0, 1.0)) -> Leaves:
    """Return a lift-off guard: falls through zero when a virtual link would have to pull.

    The guard's value (N) is the force of the link's parent on its real link along `axis`. With
    direction=False and cut=link the link is a support that can push but not pull.

    link: name of a virtual link.
    axis: direction in which the support pushes, in the joint's frame in the parent; its length does
        not matter.

    Raises ValueError for an unknown link, or an axis that is not three finite numbers, not all
    zero.
    """
    check_chain(chain)
    axis = np.asarray(finite_array("leaves: axis", axis), float)
    norm = float(np.linalg.norm(axis))
    if axis.shape != (3,) or not 0 < norm < np.inf:
        raise ValueError(f"leaves: axis: expected three numbers that are not all zero, got {axis}")
    return Leaves(
        chain, link_index(chain.topology, link), jnp.asarray(axis / norm, chain.q_load.dtype)
    )


def overload(
    chain: Chain, link: str, force: Scalar | None = None, torque: Scalar | None = None
) -> Overload:
    """Return a guard that rises through zero when a virtual link is overloaded.

    The guard's value is the larger one of |force| / `force` and |torque| / `torque`, less one. With
    direction=True and cut=link the joint breaks under the load. In redundant loops the load is the
    least-norm one (see `loop_forces`).

    link: name of a virtual link.
    force: largest force (N); None: unlimited.
    torque: largest torque (N m); None: unlimited.

    Raises ValueError for an unknown link, a limit that is not a positive number, or no limit.
    """
    if force is None and torque is None:
        raise ValueError("overload: give the largest force (N), the largest torque (N m), or both")
    check_chain(chain)
    limits = [
        jnp.asarray(np.inf if x is None else positive_scalar(name, x), chain.q_load.dtype)
        for name, x in (("overload: force", force), ("overload: torque", torque))
    ]
    return Overload(chain, link_index(chain.topology, link), *limits)
