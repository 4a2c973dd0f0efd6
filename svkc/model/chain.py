"""The bodies of a scene and the joints between them (`Chain`, for the life of the scene)."""

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from svkc.model.chain_tables import chain_blocks, chain_summary
from svkc.model.link_pointers import link_pointers
from svkc.model.named_access import NamedAccess
from svkc.model.parameters import BodyParameters, body_parameters, with_parameters
from svkc.model.state import State, Structure
from svkc.model.tables import Block, Printed, is_readable
from svkc.model.topology import FREE
from svkc.model.validation import real_array


class Chain(Printed, NamedAccess):
    """The bodies of a scene and the joints between them, made by `svkc.load`.

    Floats are differentiable leaves. There is one row for each joint or fixed body of the tree
    (`Topology`); row 0 is the world. Anchors, armature, damping, springs and limits are None if the
    scene has none, so that no code is compiled for them.

    topology: everything static: names, parents, joint kinds, index tables.
    pos: origin of the row's frame in the parent's frame, before the joint moves it (m).
    quat: orientation of the row's frame in the parent's frame, before the joint moves it (wxyz).
    axis: joint axis in the row's frame, of unit length.
    mass: mass (kg); zero for rows that are not the last of a body.
    com: centre of mass in the row's frame (m).
    inertia: rotational inertia about the centre of mass, in the axes of the row's frame (kg m^2).
    gravity: gravitational acceleration in the world frame (m/s^2).
    q_load: coordinates of the load pose (MuJoCo's qpos0).
    length: characteristic length (m) by which translations and rotations are compared.
    gear: joint torques (N m, N) for a unit control of each actuator: MuJoCo's gear times gain.
    control_range: lower and upper bound of each control; infinite if there is none.
    force_range: bounds of each control that MuJoCo's forcerange implies: forcerange / gain.
    structure: the structure of the load pose.
    anchor: the joint's anchor in the row's frame (m); None: at the origin of every row.
    armature: rotor inertia, added to the diagonal of the mass matrix (kg m^2, kg).
    damping: joint damping (N m s, N s/m).
    stiffness: stiffness of joint springs (N m, N/m).
    q_spring: coordinates at which the joint springs are at rest.
    limit: lower and upper end of the joint range (rad, m); infinite if there is none.
    limit_spring: stiffness and damping outside of the joint range.
    model: the `svkc.mjcf.load.Source` of the chain; the mujoco.MjModel is `model.model`.
    left_out: one line for each kind of element of the model that svkc cannot simulate.
    """

    pos: Float[Array, "rows 3"]
    quat: Float[Array, "rows 4"]
    axis: Float[Array, "rows 3"]
    mass: Float[Array, " rows"]
    com: Float[Array, "rows 3"]
    inertia: Float[Array, "rows 3 3"]
    gravity: Float[Array, "3"]
    q_load: Float[Array, " q"]
    length: Float[Array, ""]
    gear: Float[Array, "motors dofs"]
    control_range: Float[Array, "motors 2"]
    force_range: Float[Array, "motors 2"]
    structure: Structure
    anchor: Float[Array, "rows 3"] | None = None
    armature: Float[Array, " nv"] | None = None
    damping: Float[Array, " dofs"] | None = None
    stiffness: Float[Array, " dofs"] | None = None
    q_spring: Float[Array, " q"] | None = None
    limit: Float[Array, "2 dofs"] | None = None
    limit_spring: Float[Array, "2 dofs"] | None = None
    model: Any = eqx.field(static=True, default=None)
    left_out: tuple[str, ...] = eqx.field(static=True, default=())

    def _blocks(self) -> list[Block]:
        return chain_blocks(self)

    def __repr__(self) -> str:
        return f"<{chain_summary(self)}>" if is_readable(self) else super().__repr__()

    @property
    def _dtype(self) -> np.dtype:
        return self.q_load.dtype

    @property
    def symmetric_inertia(self) -> Float[Array, "rows 3 3"]:
        """Symmetric part of `inertia`, so that each entry of `inertia` can be perturbed alone."""
        return (self.inertia + jnp.swapaxes(self.inertia, -1, -2)) / 2

    @property
    def _pointers(self) -> np.ndarray:
        return link_pointers(self.topology, self.structure.parent, self.structure.real)

    @property
    def parent(self) -> np.ndarray:
        """Parent of each body, then of each virtual link, as an index into both; -1: none."""
        return self._pointers[0]

    @property
    def child(self) -> np.ndarray:
        """First child of each body and virtual link, indexed as `parent`; -1: none."""
        return self._pointers[1]

    @property
    def brother(self) -> np.ndarray:
        """Next sibling of each body and virtual link, indexed as `parent`; -1: none."""
        return self._pointers[2]

    @property
    def real(self) -> np.ndarray:
        """Real link of each virtual link, indexed as `parent`; -1 for bodies and spare slots."""
        return self._pointers[3]

    @property
    def actuated(self) -> Bool[Array, " dofs"]:
        """Mask of joint coordinates that an actuator drives, or a virtual joint declared actuated.

        In a model without actuators these are the coordinates of every joint that is not free.
        """
        top = self.topology
        if self.gear.shape[0]:
            driven = jnp.any(self.gear != 0, 0)
        else:
            not_free = np.array(top.kind)[top.dof_row] != FREE
            driven = jnp.asarray(np.append(not_free, np.zeros(top.dofs - top.nv, bool)))
            driven = driven | top.link_dof_mask(np.array(top.link_child, int) >= 0)
        return driven | top.link_dof_mask(np.array(top.link_actuated, bool))

    def body(self, name: str) -> BodyParameters:
        """Return the mass, centre of mass, inertia and placement of a body, by its name.

        Raises ValueError, with the nearest names, if there is no such body.
        """
        return body_parameters(self, name)

    def replace(self, *, scale_inertia: bool = False, **parameters: Any) -> "Chain":
        """Return the chain with other parameters, each given by name or as the whole array.

        parameters: `mass={"ball": 2.0}` sets the entries of the bodies or joints named, and
            `gravity=[0, 0, -1.6]` a whole array. By body name: `mass` (kg), `com` (m), `inertia`
            (kg m^2, [3 3], or [3] on the diagonal), `pos` (m), `quat` (wxyz, normalized). By joint
            name: `axis` (normalized), `armature`, `damping`, `stiffness`, `q_spring`, `limit`
            (lower and upper end). Any other array as a whole. All values may be traced.
        scale_inertia: scale the inertia of each body named in `mass` by the ratio of its masses.

        Raises ValueError if a name is unknown, a shape is wrong, or a number is not finite.
        """
        return with_parameters(self, parameters, scale_inertia)

    def motors(self, u: Any) -> Float[Array, " dofs"]:
        """Return the joint torques (N m, N) of the model's actuators: gear times clipped controls.

        u: one control for each motor on a joint, in the model's order, clipped to its control range
            and force range. Actuators left out by `load(ignore=...)` have no entry.
        Raises ValueError if u has another length.
        """
        u = real_array("u", u, self.gear.dtype)
        if u.shape != (count := len(self.gear),):
            raise ValueError(
                f"u: got shape {u.shape}, expected ({count},), a control for each motor on a joint"
            )
        force = jnp.clip(u, self.control_range[:, 0], self.control_range[:, 1])
        force = jnp.clip(force, self.force_range[:, 0], self.force_range[:, 1])
        return force @ self.gear

    def state(
        self,
        q: Any = None,
        v: Any = None,
        connected: Any = None,
        *,
        near: State | None = None,
        hold: bool | None = None,
        tolerance: Any = None,
        throw: bool = True,
    ) -> State:
        """Return a state that satisfies the loop constraints.

        The loops are closed by continuation from the load pose, or from the State `near`: the
        result is on the branch of closed configurations that is connected with this start. If the
        named coordinates leave freedoms, the result is the point of least change from the start on
        that branch. If the start cannot be closed, a second path starts from the named coordinates.
        The velocity is projected onto the closed loops; a velocity that keeps the loops is returned
        to round-off.

        q: coordinates (m, rad, wxyz): a dict by joint name, or an array over the tree or over every
            coordinate. Named coordinates are held: they are returned as given. An array is a guess:
            it is returned to round-off if it closes the loops, else with the least change that
            closes them. None: the load pose.
        v: velocities (m/s, rad/s), in the same forms. None: at rest.
        connected: names of the connected virtual links, or a mask [links]. None: as in `near`, or
            as in the model.
        near: a State from which to start instead of the load pose.
        hold: True: arrays are held too. False: named coordinates are a guess too. None: named
            coordinates are held, arrays are a guess.
        tolerance: largest deviation of a held coordinate from the given one if more coordinates are
            held than there are freedoms (rad, or in `chain.length`s). None: eps^(4/7).
        throw: False: a state that cannot be reached is filled with NaN instead of raising.

        Raises ValueError if a name is unknown, a size is wrong, a number is not finite, a
        quaternion is not of unit length, the loops do not allow the held coordinates, or the loops
        cannot be closed. The message names the joints or loops and the amounts. Under jit, a state
        that cannot be reached raises RuntimeError at run time.
        """
        # an import against the order of packages: a state needs the loop solver
        from svkc.transitions.initial_state import assemble

        return assemble(
            self, q, v, connected, near=near, hold=hold, tolerance=tolerance, throw=throw
        )

    def to_mjcf(self) -> str:
        """Return MJCF text of the loaded model, with the virtual links as <equality> elements.

        Numbers are written to the last digit. A ball becomes a connect, a weld a weld, and a hinge
        two connects, the second named NAME_axis at a distance of `chain.length` along the axis.
        Each is between two new sites, and active if the link is connected. MuJoCo enforces them as
        soft constraints. A comment at the top lists everything without a form in MJCF: other
        virtual joints, motors on virtual joints, spare slots, cuttable joints. Mesh files have
        absolute paths, except files in memory (`MjSpec.assets`) and those of attached specs. Of the
        chain's arrays only `connected` and the placements of virtual links are written.

        Raises ValueError if the chain was loaded from a MjModel, or if MuJoCo cannot read the
        text of the MjSpec.
        """
        # an import against the order of packages: writing the text needs mujoco
        from svkc.mjcf.convert import to_mjcf

        return to_mjcf(self)


def without_locks(structure: Structure) -> Structure:
    """Return the structure with no joint locked."""
    return dataclasses.replace(structure, locked=None)


def active_dofs(chain: Chain, structure: Structure) -> Bool[Array, " dofs"]:
    """Return the mask of joint coordinates that can move.

    These are the coordinates of the tree and of the connected virtual links that are not locked.
    """
    top = chain.topology
    enabled = jnp.concatenate(
        [(structure.connected[:, None] & structure.freedoms).ravel(), jnp.zeros(1, bool)]
    )
    slot = np.full(top.dofs - top.nv, enabled.shape[0] - 1)
    for i, d in enumerate(top.links.dof.ravel()):
        if d < top.dofs:
            slot[d - top.nv] = i
    active = jnp.concatenate([jnp.ones(top.nv, bool), enabled[slot]])
    return active if structure.locked is None else active & ~structure.locked
