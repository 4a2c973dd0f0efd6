"""The nouns: chain (what the bodies are), structure (how they are joined now), state (how they move
now)."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from svkc.model.topology import FREE, Topology
from svkc.model.validation import real_array


class Structure(eqx.Module):
    """How the bodies are joined for the length of a phase. Placements are the joint's frame in its
    two bodies (m, wxyz), its axis along z.

    `connected` [links]; `parent`, `real`: rows of the two bodies; `freedoms`: of each virtual
    joint; `locked`: joint coordinates held still, None where nothing can be locked; `independent`:
    coordinates asked to be independent where they can be; `rank`: m, decided once for the phase,
    with `margin`: |R_mm| / |R_11| where that was, in a generic configuration.
    """

    connected: Bool[Array, "... links"]
    parent: Int[Array, "... links"]
    real: Int[Array, "... links"]
    pos: Float[Array, "... links 3"]
    quat: Float[Array, "... links 4"]
    real_pos: Float[Array, "... links 3"]
    real_quat: Float[Array, "... links 4"]
    freedoms: Bool[Array, "... links 6"]
    rank: Int[Array, "..."]
    margin: Float[Array, "..."]
    locked: Bool[Array, "... dofs"] | None = None
    independent: Bool[Array, "... dofs"] | None = None


class State(eqx.Module):
    """How the bodies move: `q` (m, rad, wxyz; MuJoCo's qpos, then the virtual joints'), `v` (m/s,
    rad/s), and the structure they move under."""

    q: Float[Array, "... q"]
    v: Float[Array, "... dofs"]
    structure: Structure


class Chain(eqx.Module):
    """The bodies of a scene and the joints between them; its floats are leaves to differentiate.
    Made by `svkc.load`.

    Rows are those of `Topology`. `pos`, `quat`: joint frame in the parent's; `anchor`, `axis`: of
    the joint in the row's own frame; `inertia`: about the centre of mass, row axes. What a scene
    does not have (anchors, armature, damping, springs, limits) is None and is not compiled.
    """

    topology: Topology = eqx.field(static=True)
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

    @property
    def body_names(self) -> tuple[str, ...]:
        """Bodies in the model's order; the first is the world."""
        return self.topology.body_names

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Joints of the tree in the model's order."""
        return self.topology.joint_names

    @property
    def link_names(self) -> tuple[str, ...]:
        """The virtual links."""
        return self.topology.link_names

    @property
    def dof_names(self) -> tuple[str, ...]:
        """Of every joint coordinate: the joint's name, with .x .y .z for slides and .rx .ry .rz for
        turns where it has several."""
        return self.topology.dof_names

    @property
    def nq(self) -> int:
        """Coordinates q of the tree (m, rad; wxyz of a ball), MuJoCo's."""
        return self.topology.nq

    @property
    def nv(self) -> int:
        """Freedoms v of the tree (m/s, rad/s), MuJoCo's."""
        return self.topology.nv

    @property
    def dofs(self) -> int:
        """All joint coordinates: the tree's, then the virtual links'."""
        return self.topology.dofs

    @property
    def rotational(self) -> Float[Array, "rows 3 3"]:
        """`inertia` made symmetric, so that its entries may be moved one by one."""
        return (self.inertia + jnp.swapaxes(self.inertia, -1, -2)) / 2

    @property
    def parent(self) -> np.ndarray:
        """Pointer of the paper's section IV, for each body, then each virtual link, as an index
        into both; -1: none."""
        return _pointers(self)[0]

    @property
    def child(self) -> np.ndarray:
        """The first child of each body and virtual link; -1: none."""
        return _pointers(self)[1]

    @property
    def brother(self) -> np.ndarray:
        """The next child of the same parent; -1: none."""
        return _pointers(self)[2]

    @property
    def real(self) -> np.ndarray:
        """The real link of each virtual link; -1 for bodies, and for spare slots not bound yet."""
        return _pointers(self)[3]

    @property
    def actuated(self) -> Bool[Array, " dofs"]:
        """What the model's actuators drive (without actuators every joint that is not free), and
        virtual joints declared as actuated."""
        top = self.topology
        if self.gear.shape[0]:
            driven = jnp.any(self.gear != 0, 0)
        else:
            driven = jnp.asarray(
                np.append(
                    np.array(top.kind)[top.dof_row] != FREE, np.zeros(top.dofs - top.nv, bool)
                )
            )
            driven = driven | self._link_dof_mask(np.array(top.link_child, int) >= 0)
        return driven | self._link_dof_mask(np.array(top.link_actuated, bool))

    def _link_dof_mask(self, links: np.ndarray) -> np.ndarray:
        """[dofs] the own coordinates of some virtual links."""
        table, mask = self.topology.links.dof[links], np.zeros(self.dofs, bool)
        mask[table[table < self.dofs]] = True
        return mask

    def motors(self, u: Any) -> Float[Array, " dofs"]:
        """Joint torques (N m, N) of the model's actuators for the controls u: gear times u, each
        clipped to its range."""
        u = real_array("u", u, self.gear.dtype)
        if u.shape != self.gear.shape[:1]:
            raise ValueError(
                f"u: got shape {u.shape}, the model has {self.gear.shape[0]} actuators"
            )
        force = jnp.clip(u, self.control_range[:, 0], self.control_range[:, 1])
        force = jnp.clip(force, self.force_range[:, 0], self.force_range[:, 1])
        return force @ self.gear

    def state(self, q: Any = None, v: Any = None, connected: Any = None) -> State:
        """A consistent state: loops closed by Newton's method, velocities made to agree with them.

        q, v: arrays over the tree (or over every coordinate), or dicts by joint name, whose entries
        are kept where the loops allow it.
        connected: names of the virtual links, or a mask; None: as the model says. ValueError:
        unknown names, wrong sizes, quaternions that are not unit, loops that cannot be closed (says
        which, and by how much).
        """
        # the one import that goes up the house: a state needs the loops closed, and the contract
        # puts the verb on the noun
        from svkc.transitions.initial_state import assemble

        return assemble(self, q, v, connected)

    def to_mjcf(self) -> str:
        """MJCF text of the scene: the model as it was loaded, every number to its last digit, with
        the virtual links as <equality>.

        ball and weld are connect and weld, a hinge two connects (the second, NAME_axis, at
        `chain.length` along its axis), each between two new sites, active where the link is
        connected; MuJoCo holds them softly. What has no such form (other joints, motors on virtual
        joints, spare slots, which joints may be cut) is said in a comment at the top. Files of
        meshes are named by absolute paths, except those in memory (`MjSpec.assets`) and of attached
        specs. Changes to the chain's own arrays are not written, but for the links' placements.
        ValueError: loaded from a MjModel.
        """
        # as above: the text needs what stands higher up
        from svkc.mjcf.convert import to_mjcf

        return to_mjcf(self)


def _pointers(chain: Chain) -> np.ndarray:
    """[4, bodies + links] parent, child, brother, real."""
    top = chain.topology
    bodies, count = len(top.body_names), len(top.body_names) + len(top.link_names)
    body_of_row = np.full(len(top.parent), -1)
    for body, row in enumerate(top.body_row):
        body_of_row[row] = body
    table = np.full((4, count), -1)
    for body in range(1, bodies):
        row = top.parent[top.body_row[body]]
        while body_of_row[row] < 0:
            row = top.parent[row]
        table[0, body] = body_of_row[row]
    for link, spare in enumerate(top.link_spare):
        if not spare:
            table[0, bodies + link] = body_of_row[int(chain.structure.parent[link])]
            table[3, bodies + link] = body_of_row[int(chain.structure.real[link])]
    for parent in range(bodies):
        children = np.flatnonzero(table[0] == parent)
        if len(children):
            table[1, parent] = children[0]
            table[2, children[:-1]] = children[1:]
    return table


def active_dofs(chain: Chain, structure: Structure) -> Bool[Array, " dofs"]:
    """Joint coordinates that can move: the tree's and the connected virtual links', less the locked
    ones."""
    top = chain.topology
    used = jnp.concatenate(
        [(structure.connected[:, None] & structure.freedoms).ravel(), jnp.zeros(1, bool)]
    )
    slot = np.full(top.dofs - top.nv, used.shape[0] - 1)
    for i, d in enumerate(top.links.dof.ravel()):
        if d < top.dofs:
            slot[d - top.nv] = i
    active = jnp.concatenate([jnp.ones(top.nv, bool), used[slot]])
    return active if structure.locked is None else active & ~structure.locked
