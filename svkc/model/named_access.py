"""Access to bodies, joints and coordinates by name: the base class of `Chain`."""

import abc
from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from svkc.model.chain_names import ChainNames, chain_names
from svkc.model.names import body_index, link_index, q_slice, v_slice
from svkc.model.state import State
from svkc.model.topology import Topology
from svkc.model.validation import real_array


class JointState(NamedTuple):
    """Coordinates and velocities of one joint, without a last axis for hinges and slides.

    q: m, rad; a quaternion wxyz for a ball joint; position, then quaternion, for a free joint.
    v: m/s, rad/s.
    """

    q: Float[Array, "..."]
    v: Float[Array, "..."]


class NamedAccess(eqx.Module):
    """Names and numbers of bodies, joints and coordinates.

    Wherever a joint is named, a virtual link may be named too: it has the coordinates of its joint.

    topology: everything static: names, parents, joint kinds, index tables.
    """

    topology: Topology = eqx.field(static=True)

    @property
    @abc.abstractmethod
    def _dtype(self) -> np.dtype:
        """The floating-point type of the chain's arrays."""

    @property
    def names(self) -> ChainNames:
        """Names of the bodies, joints, virtual links and coordinates, as results keep them."""
        return chain_names(self.topology)

    @property
    def body_names(self) -> tuple[str, ...]:
        """Names of the bodies in the model's order; the first is the world."""
        return self.topology.body_names

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the tree's joints in the model's order."""
        return self.topology.joint_names

    @property
    def link_names(self) -> tuple[str, ...]:
        """Names of the virtual links, in the order of `Structure`'s entries."""
        return self.topology.link_names

    @property
    def dof_names(self) -> tuple[str, ...]:
        """Names of the joint coordinates, in the order of `State.v`.

        A joint with several coordinates appends .x, .y, .z (translations) and .rx, .ry, .rz.
        """
        return self.names.v

    @property
    def nq(self) -> int:
        """Number of the tree's coordinates q: MuJoCo's nq if no joint is cuttable."""
        return self.topology.nq

    @property
    def nv(self) -> int:
        """Number of the tree's velocities v: MuJoCo's nv if no joint is cuttable."""
        return self.topology.nv

    @property
    def dofs(self) -> int:
        """Number of all joint coordinates: the tree's, then the virtual links'; the length of v."""
        return self.topology.dofs

    def q_index(self, joint: str) -> slice:
        """Return the slice of a joint in `State.q`. It is static: usable under jit.

        Raises ValueError, with the nearest names, if there is no such joint.
        """
        return q_slice(self.topology, joint, links=True)

    def v_index(self, joint: str) -> slice:
        """Return the slice of a joint in `State.v` and in torques. It is static: usable under jit.

        Raises ValueError, with the nearest names, if there is no such joint.
        """
        return v_slice(self.topology, joint, links=True)

    def body_index(self, name: str) -> int:
        """Return the row of a body, by its name, in the results of `svkc.poses` and others.

        Raises ValueError, with the nearest names, if there is no such body.
        """
        return body_index(self.topology, name)

    def joint(self, state: State, name: str) -> JointState:
        """Return q and v of a joint: scalars for a hinge or slide, arrays for other joints.

        state: a state, or several with leading axes, which the result has too.
        name: of a joint or a virtual link.
        Raises ValueError, with the nearest names, if there is no such joint.
        """
        q, v = state.q[..., self.q_index(name)], state.v[..., self.v_index(name)]
        return JointState(*(x[..., 0] if x.shape[-1] == 1 else x for x in (q, v)))

    def connected(self, state: State, link: str) -> Bool[Array, "..."]:
        """Return whether a virtual link is connected.

        state: a state, or several with leading axes, which the result has too.
        link: name of the virtual link.
        Raises ValueError, with the nearest names, if there is no such link.
        """
        return state.structure.connected[..., link_index(self.topology, link)]

    def torques(self, torques: Mapping[str, Any]) -> Float[Array, " dofs"]:
        """Return joint torques (N m, N) over every coordinate from torques by joint name.

        Joints that are not named have zero torque. `control` may return such a dict, and `tau` may
        be one.

        torques: {joint: torque}, with one number for a hinge or slide, three for a ball joint, and
            six for a free joint.

        Raises ValueError if a name is unknown or a joint has another number of coordinates.
        """
        named, end, dtype = [], 0, self._dtype
        for name, value in torques.items():
            at, value = self.v_index(name), real_array(f"tau[{name!r}]", value, dtype)
            if value.size != (count := at.stop - at.start):
                raise ValueError(f"tau[{name!r}]: got {value.size} numbers, the joint has {count}")
            named.append((at, value.reshape(-1)))
        # joined without scatter, which is slow in compiled steps
        parts = []
        for at, value in sorted(named, key=lambda entry: entry[0].start):
            parts += [jnp.zeros(at.start - end, dtype), value]
            end = at.stop
        return jnp.concatenate([*parts, jnp.zeros(self.dofs - end, dtype)])
