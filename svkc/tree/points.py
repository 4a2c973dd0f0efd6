"""Points of bodies: centre of mass, body Jacobian, velocity of a point, and forces at a point.

Bodies and sites are named. Names are resolved outside of jit: compiled programs depend on the
frame, not on its name.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc._jax.pytrees import is_concrete
from svkc._jax.select import where
from svkc._jax.static_gather import static_take
from svkc.model.annotations import Names, Numbers
from svkc.model.chain import Chain, State
from svkc.model.checked_jit import check_state, checked_jit
from svkc.model.names import body_or_site, body_rows
from svkc.model.topology import FixedFrame
from svkc.model.validation import names
from svkc.tree.bodies import Jacobian
from svkc.tree.energy import body_motions
from svkc.tree.inverse_dynamics import pad_to_dofs
from svkc.tree.kinematics import Kinematics, kinematics, twists
from svkc.tree.spatial import angular_linear, cross, matvec, quat_rotate, shift_motion


class CenterOfMass(NamedTuple):
    """The centre of mass of some bodies.

    position: in the world (m).
    velocity: in world axes (m/s).
    mass: of these bodies (kg).
    """

    position: Float[Array, "3"]
    velocity: Float[Array, "3"]
    mass: Float[Array, ""]


def center_of_mass(chain: Chain, state: State, bodies: Names | None = None) -> CenterOfMass:
    """Return the centre of mass of some bodies, its velocity, and their mass.

    bodies: name of a body, or names of several. None: all bodies.
    Raises ValueError if a name is unknown, or if the bodies have no mass.
    """
    check_state(chain, state)
    of = chain.body_names if bodies is None else names("bodies", bodies)
    rows = tuple(sorted(set(body_rows(chain.topology, *of))))
    if is_concrete(chain.mass) and not np.any(np.asarray(chain.mass)[list(rows)]):
        raise ValueError(f"center_of_mass: the bodies have no mass: {', '.join(of) or 'none'}")
    return _center_of_mass(chain, state, rows=rows)


@checked_jit(static=("rows",))
def _center_of_mass(chain: Chain, state: State, *, rows: tuple[int, ...]) -> CenterOfMass:
    """Return the centre of mass of rows."""
    at, kin = np.array(rows), kinematics(chain, state.q)
    c, u, _, _ = body_motions(chain, kin, state.v)
    mass = static_take(chain.mass, at)
    total = jnp.sum(mass)
    mean = lambda x: jnp.sum(mass[:, None] * static_take(x, at), 0) / total
    return CenterOfMass(position=mean(kin.root_position + c), velocity=mean(u), mass=total)


def jacobian(chain: Chain, state: State, body: str, point: Numbers = (0.0, 0.0, 0.0)) -> Jacobian:
    """Return the Jacobian of a point of a body (Featherstone section 4.5).

    A velocity v moves the point by `linear @ v` (m/s) and turns the body by `angular @ v` (rad/s).
    Virtual links carry no body: the columns of their joints' coordinates are zero, and the body of
    a cuttable joint moves by its own free joint. Columns of locked coordinates are those without
    the lock.

    body: name of a body, or of a site of the model. A name that both have is the body's.
    point: [3] the point in the frame of the body, or of the site (m).
    Raises ValueError if the name is unknown, or if point has another shape.
    """
    check_state(chain, state)
    return _jacobian(chain, state, point=point, frame=body_or_site(chain.topology, body))


@checked_jit(static=("frame",))
def _jacobian(chain: Chain, state: State, point, *, frame: FixedFrame) -> Jacobian:
    """Return the Jacobian of a point of a frame."""
    kin = kinematics(chain, state.q)
    S = shift_motion(_motion_subspaces_of(chain, kin, frame), _from_root(kin, frame, point)[None])
    padding = jnp.zeros((chain.dofs - chain.nv, 6), S.dtype)
    angular, linear = angular_linear(jnp.concatenate([S, padding]))
    return Jacobian(linear=linear.T, angular=angular.T)


def point_position(
    chain: Chain, state: State, body: str, point: Numbers = (0.0, 0.0, 0.0)
) -> Float[Array, "3"]:
    """Return the position (m) of a point of a body in the world.

    body: name of a body, or of a site of the model. A name that both have is the body's.
    point: [3] the point in the frame of the body, or of the site (m).
    Raises ValueError if the name is unknown, or if point has another shape.
    """
    check_state(chain, state)
    return _point_position(chain, state, point=point, frame=body_or_site(chain.topology, body))


@checked_jit(static=("frame",))
def _point_position(chain: Chain, state: State, point, *, frame: FixedFrame) -> Float[Array, "3"]:
    """Return the position of a point of a frame."""
    kin = kinematics(chain, state.q)
    return kin.root_position[frame.row] + _from_root(kin, frame, point)


def point_velocity(
    chain: Chain, state: State, body: str, point: Numbers = (0.0, 0.0, 0.0)
) -> Float[Array, "3"]:
    """Return the velocity (m/s) of a point of a body, in world axes.

    body: name of a body, or of a site of the model. A name that both have is the body's.
    point: [3] the point in the frame of the body, or of the site (m).
    Raises ValueError if the name is unknown, or if point has another shape.
    """
    check_state(chain, state)
    return _point_velocity(chain, state, point=point, frame=body_or_site(chain.topology, body))


@checked_jit(static=("frame",))
def _point_velocity(chain: Chain, state: State, point, *, frame: FixedFrame) -> Float[Array, "3"]:
    """Return the velocity of a point of a frame."""
    kin = kinematics(chain, state.q)
    w, v = angular_linear(twists(chain, kin, state.v)[frame.row])
    return v + cross(w, _from_root(kin, frame, point))


def apply_force(
    chain: Chain, state: State, body: str, force: Numbers,
    point: Numbers = (0.0, 0.0, 0.0), torque: Numbers = (0.0, 0.0, 0.0),
) -> Float[Array, " dofs"]:  # fmt: skip
    """Return the generalized force (N m, N) of a force and a torque on a body, over every
    coordinate.

    Add the result to the torques of a control. A force at the point has the same power in both
    forms: tau . v = force . velocity of the point + torque . angular velocity of the body.

    body: name of a body, or of a site of the model. A name that both have is the body's.
    force: [3] force on the point (N), in world axes.
    point: [3] where the force acts, in the frame of the body, or of the site (m).
    torque: [3] torque on the body (N m), in world axes.
    Raises ValueError if the name is unknown, or if a vector has another shape.
    """
    check_state(chain, state)
    frame = body_or_site(chain.topology, body)
    return _apply_force(chain, state, force=force, point=point, torque=torque, frame=frame)


@checked_jit(static=("frame",))
def _apply_force(
    chain: Chain, state: State, force, point, torque, *, frame: FixedFrame
) -> Float[Array, " dofs"]:
    """Return the generalized force of a wrench at a point of a frame."""
    kin = kinematics(chain, state.q)
    force, torque = (x.astype(kin.r.dtype) for x in (force, torque))
    about_root = torque + cross(_from_root(kin, frame, point), force)
    S = _motion_subspaces_of(chain, kin, frame)
    return pad_to_dofs(chain, S @ jnp.concatenate([about_root, force]))


def _from_root(kin: Kinematics, frame: FixedFrame, point: Any) -> Float[Array, "3"]:
    """Return a point of a frame from the origin of the row's root, in world axes (m)."""
    point = point.astype(kin.r.dtype)
    if any(frame.pos) or frame.quat != (1.0, 0.0, 0.0, 0.0):
        pos, quat = (jnp.asarray(x, kin.r.dtype) for x in (frame.pos, frame.quat))
        point = pos + quat_rotate(quat, point)
    return kin.r[frame.row] + matvec(kin.R[frame.row], point)


def _motion_subspaces_of(chain: Chain, kin: Kinematics, frame: FixedFrame) -> Float[Array, "nv 6"]:
    """Return the motion subspaces of the joints that move a row; those of other joints are zero."""
    top = chain.topology
    return where(top.ancestor_mask[frame.row, top.dof_row][:, None], kin.S, 0)
