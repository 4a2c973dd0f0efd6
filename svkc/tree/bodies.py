"""Poses and velocities of bodies in the world."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float

from svkc._jax.static_gather import static_take
from svkc.model.chain import Chain, State
from svkc.model.checked_jit import checked_jit
from svkc.tree.kinematics import kinematics, twists
from svkc.tree.spatial import cross


class Poses(NamedTuple):
    """Poses of body frames in the world.

    position: origins (m).
    quaternion: unit quaternions wxyz, body to world.
    """

    position: Float[Array, "bodies 3"]
    quaternion: Float[Array, "bodies 4"]


class Velocities(NamedTuple):
    """Velocities of bodies in world axes.

    linear: of the body's origin (m/s).
    angular: rad/s.
    """

    linear: Float[Array, "bodies 3"]
    angular: Float[Array, "bodies 3"]


class Jacobian(NamedTuple):
    """Velocities for a unit rate of each joint coordinate, in world axes.

    linear: m/s; angular: rad/s; each per rad/s or m/s of the coordinate.
    """

    linear: Float[Array, "*n 3 dofs"]
    angular: Float[Array, "*n 3 dofs"]


@checked_jit
def poses(chain: Chain, state: State) -> Poses:
    """Return the position (m) and the quaternion (wxyz, body to world) of every body frame.

    Body 0 is the world (Featherstone section 4.4).
    """
    rows = np.array(chain.topology.body_row)
    kin = kinematics(chain, state.q)
    return Poses(static_take(kin.root_position + kin.r, rows), static_take(kin.quat, rows))


@checked_jit
def velocities(chain: Chain, state: State) -> Velocities:
    """Return the linear velocity (m/s) of every body's origin and its angular velocity (rad/s).

    Both are in world axes. Body 0 is the world (Featherstone section 5.3).
    """
    rows = np.array(chain.topology.body_row)
    kin = kinematics(chain, state.q)
    V = twists(chain, kin, state.v)
    linear = V[:, 3:] + cross(V[:, :3], kin.r)
    return Velocities(static_take(linear, rows), static_take(V[:, :3], rows))
