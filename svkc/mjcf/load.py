"""Loading of a `Chain` from MJCF, URDF or MuJoCo objects, on the host with NumPy."""

import dataclasses
import hashlib
import os
import pathlib
import warnings
from collections.abc import Iterable
from typing import Any

import jax
import numpy as np

from svkc.mjcf.bodies import (
    actuator_arrays,
    body_arrays,
    characteristic_length,
    joint_armature,
    name_of,
    scatter_to_dofs,
    springs_and_limits,
    tree_rows,
)
from svkc.mjcf.convert import mjcf_text
from svkc.mjcf.cuttable_joints import (
    CuttableJoint,
    check_armature,
    cuttable_joints,
    with_cuttable_joints,
)
from svkc.mjcf.flags import is_disabled
from svkc.mjcf.unsupported import left_out_elements
from svkc.mjcf.virtual_links import declared_links, float_array, load_structure
from svkc.model.annotations import Checked, Integer, MuJoCo, Names, Path
from svkc.model.chain import Chain
from svkc.model.topology import Topology
from svkc.model.validation import integer, names
from svkc.model.virtual_link import VirtualLink, joint_freedoms


@dataclasses.dataclass(frozen=True)
class Source:
    """The source of a chain, for rendering, `Chain.to_mjcf` and saved files.

    A source is static data of the chain: JAX compares two sources by their digests.

    model: the mujoco.MjModel.
    text: its MJCF text; None if the chain was loaded from a MjModel.
    arguments: the other arguments of `load`.
    digest: SHA-256 of the model, the text and the arguments.
    """

    model: Any = dataclasses.field(compare=False, repr=False)
    text: str | None = dataclasses.field(compare=False, repr=False)
    arguments: dict[str, Any] = dataclasses.field(compare=False, repr=False)
    digest: str


def load(
    source: MuJoCo | Path, *, virtual_links: Checked[VirtualLink | Iterable[VirtualLink]] = (),
    cuttable: Names = (), spare: Integer = 0, ignore: Names = (), ignore_armature: Names = (),
) -> Chain:  # fmt: skip
    """Load a `Chain` from a model.

    Functions are compiled once for all loads of one model with equal arguments. They are compiled
    again for another model, even if only numbers differ: to change numbers without compiling,
    replace floats of one chain (`eqx.tree_at`). Collisions between geoms are not simulated.

    source: MJCF or URDF as a path or text, a mujoco.MjSpec, or a mujoco.MjModel.
    virtual_links: `VirtualLink`s in addition to those from the model's <equality> elements: a
        connect becomes a ball, a weld a weld, under the element's name.
    cuttable: names of joints of the tree that can be cut. Each becomes a virtual link of that name,
        connected in the load pose (paper, Fig. 15).
    spare: number of spare slots, virtual links that `bind` makes at run time.
    ignore: kinds to leave out, as in the error message, "all" of these, or "limit" (joint ranges),
        "spring", "damping", "armature". Connects, welds and motors on joints stay.
    ignore_armature: names of joints whose armature (rotor inertia) is left out. A cuttable joint
        cannot have armature.

    Raises ValueError if the source cannot be read, has elements that are neither simulated nor
    ignored, has numbers that are not finite, or if a name is unknown or not unique.
    """
    declared = tuple(virtual_links) if np.iterable(virtual_links) else (virtual_links,)
    model, text = _compile(source)
    cuttable = names("cuttable", cuttable)
    cuts = cuttable_joints(model, cuttable)
    ignore, spare = names("ignore", ignore), integer("spare", spare, 0, 1000)
    left_out = left_out_elements(model, ignore)
    ignore_armature = names("ignore_armature", ignore_armature)
    armature = joint_armature(model, ignore, ignore_armature)
    check_armature(model, cuts, armature)
    rows, topology = _tree_without(model, cuts)
    links = declared_links(model, declared, [cut.link for cut in cuts], spare)
    topology = _with_virtual_links(topology, links, spare)
    topology = with_cuttable_joints(model, topology, cuts, first=len(links) - spare - len(cuts))
    structure = load_structure(model, topology, links)
    arguments = {
        "virtual_links": declared,
        "cuttable": cuttable,
        "spare": spare,
        "ignore": ignore,
        "ignore_armature": ignore_armature,
    }
    # computed now, as the user can modify a MjModel after loading
    digest = _digest(model, text, arguments)
    loaded = Source(model=model, text=text, arguments=arguments, digest=digest)
    return _check_finite(_build_chain(loaded, topology, rows, structure, armature, left_out))


def _tree_without(model, cuts: list[CuttableJoint]) -> tuple[list[tuple[int, int]], Topology]:
    """Return `tree_rows` without the cuttable joints; raise ValueError if no joint is left, or if
    names of bodies or joints are not unique."""
    rows, topology = tree_rows(model, {cut.body: cut.link.name for cut in cuts})
    if not topology.joint_names:
        raise ValueError("source: the model has no joints")
    _check_unique("bodies", topology.body_names)
    names_of_cut = [name_of(model, "joint", j) for cut in cuts for j in cut.joints]
    _check_unique("joints", [*topology.joint_names, *names_of_cut])
    return rows, topology


def _with_virtual_links(topology: Topology, links: list[VirtualLink], spare: int) -> Topology:
    """Return the topology with these virtual links, of which the last `spare` are spare slots."""
    return dataclasses.replace(
        topology,
        link_names=tuple(link.name for link in links),
        link_freedoms=tuple(joint_freedoms(link.joint) for link in links),
        link_spare=tuple(i >= len(links) - spare for i in range(len(links))),
        link_actuated=tuple(bool(link.actuated) for link in links),
        link_as_loaded=tuple(x.real_pos is None and x.real in topology.body_names for x in links),
    )


def _digest(model, text: str | None, arguments: dict[str, Any]) -> str:
    """Return the SHA-256 of the compiled model, its text, and the canonical arguments of `load`."""
    import mujoco

    image = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, image)
    links = tuple(map(_canonical_link, arguments["virtual_links"]))
    sets = (sorted(set(arguments[name])) for name in ("ignore", "ignore_armature"))
    rest = arguments["cuttable"], arguments["spare"], *sets
    digest = hashlib.sha256(image.data)
    digest.update(repr((text, links, rest)).encode())
    return digest.hexdigest()


def _canonical_link(link: VirtualLink) -> tuple:
    """Return the fields of a virtual link as lists of floats, with the joint by its freedoms."""
    vectors = (link.pos, link.quat, link.real_pos, link.real_quat, link.axis)
    numbers = (None if x is None else np.asarray(x, float).tolist() for x in vectors)
    flags = bool(link.connected), bool(link.actuated)
    return link.name, link.parent, link.real, joint_freedoms(link.joint), *numbers, *flags


def _check_unique(elements: str, names) -> None:
    """Raise ValueError if names are not unique, such as `joint_1` of a joint without a name."""
    if len(set(names)) < len(names):
        raise ValueError(
            f"source: names of {elements} must be unique, with KIND_INDEX for {elements} without a"
            f" name; got {names}"
        )


def _check_finite(chain: Chain) -> Chain:
    """Return the chain; raise ValueError if a number is not finite in the chain's precision."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(chain):
        name, leaf = jax.tree_util.keystr(path), np.asarray(leaf)
        if np.isnan(leaf).any() or (
            np.isinf(leaf).any() and name not in (".control_range", ".force_range", ".limit")
        ):
            raise ValueError(
                f"source: the model has numbers that are not finite, or too large for {leaf.dtype}:"
                f" {name[1:]}"
            )
    return chain


def _compile(source) -> tuple[Any, str | None]:
    """Return the mujoco.MjModel of a source and its MJCF text, which is None for a MjModel."""
    import mujoco

    if isinstance(source, mujoco.MjModel):
        return source, None
    if not isinstance(source, (mujoco.MjSpec, str, os.PathLike)):
        raise ValueError(
            "source: expected MJCF or URDF text, a path, MjSpec or MjModel, got"
            f" {type(source).__name__}"
        )
    text = "<" if isinstance(source, mujoco.MjSpec) else os.fsdecode(source)
    if "<" not in text and not os.path.isfile(text):
        raise ValueError(f"source: no such file: {text!r}")
    try:
        spec = source.copy() if isinstance(source, mujoco.MjSpec) else _read_spec(text)
        model = spec.compile()
        with warnings.catch_warnings(action="ignore"):
            return model, mjcf_text(spec)
    except (ValueError, OSError, mujoco.FatalError) as error:
        raise ValueError(f"source: the model cannot be read: {error}") from error


def _read_spec(text: str):
    """Return the mujoco.MjSpec of MJCF or URDF, by text or path."""
    import mujoco

    inline = "<" in text
    spec = mujoco.MjSpec.from_string(text) if inline else mujoco.MjSpec.from_file(text)
    if "<robot" in (text if inline else pathlib.Path(text).read_text(errors="replace")):
        # keep links behind fixed joints as bodies, so that virtual links can name them
        spec.compiler.fusestatic = False
        for mesh in spec.meshes:
            mesh.file = _resolve_package_uri(
                mesh.file, pathlib.Path("." if inline else text).resolve().parent
            )
    return spec


def _resolve_package_uri(file: str, folder: pathlib.Path) -> str:
    """Return the path of a file given as ROS's package://NAME/PATH; return other names unchanged.

    Search for NAME/PATH, then PATH, in `folder` and its parents; then for the file in `folder`.
    """
    if not file.startswith("package://"):
        return file
    name = pathlib.PurePosixPath(file.removeprefix("package://"))
    inside = name.relative_to(name.parts[0])
    places = [place / path for path in (name, inside) for place in (folder, *folder.parents)] + [
        folder / name.name
    ]
    return next((str(place) for place in places if place.is_file()), file)


def _load_pose(model, topology: Topology) -> np.ndarray:
    """Return the coordinates of the load pose: the model's qpos0, other virtual joints at zero."""
    import mujoco

    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    tables = topology.links
    q = np.zeros(topology.nq_all)
    q[tables.quat[tables.quat[:, 0] < topology.nq_all, 0]] = 1
    q[np.array(topology.model_q, int)] = model.qpos0
    for row in topology.link_child:
        if row >= 0:
            body, start = topology.body_row.index(row), topology.q_start[row]
            q[start : start + 7] = *data.xpos[body], *data.xquat[body]
    return q


def _gravity(model) -> np.ndarray:
    """Return gravity (m/s^2), zero if the model disables it."""
    return np.zeros(3) if is_disabled(model, "gravity") else model.opt.gravity


def _passive_forces(model, ignored: set[str], topology: Topology, q_load) -> dict[str, Any]:
    """Return the chain's fields on damping, springs and limits; None if the model has none."""
    stiffness, limit, spring = springs_and_limits(model, ignored, topology)
    undamped = "damping" in ignored or is_disabled(model, "damper")
    damping = scatter_to_dofs(topology, 0 * model.dof_damping if undamped else model.dof_damping)
    q_spring = np.array(q_load)
    q_spring[np.array(topology.model_q, int)] = model.qpos_spring
    sprung, limited = stiffness.any(), np.isfinite(limit).any()
    return {
        "damping": float_array(damping) if damping.any() else None,
        "stiffness": float_array(stiffness) if sprung else None,
        "q_spring": float_array(q_spring) if sprung else None,
        "limit": float_array(limit) if limited else None,
        "limit_spring": float_array(spring) if limited else None,
    }


def _build_chain(source: Source, topology, rows, structure, armature, left_out) -> Chain:
    """Return the chain with all arrays of the model."""
    model, ignored = source.model, set(source.arguments["ignore"])
    bodies = body_arrays(model, topology, rows)
    gear, control, force = actuator_arrays(model, topology)
    q_load = _load_pose(model, topology)
    own = ("pos", "quat", "axis", "mass", "com", "inertia")
    return Chain(
        topology=topology,
        **{name: float_array(bodies[name]) for name in own},
        gravity=float_array(_gravity(model)),
        q_load=float_array(q_load),
        length=float_array(characteristic_length(bodies, topology)),
        gear=float_array(gear),
        control_range=float_array(control),
        force_range=float_array(force),
        structure=structure,
        anchor=float_array(bodies["anchor"]) if bodies["anchor"].any() else None,
        armature=float_array(scatter_to_dofs(topology, armature)[: topology.nv])
        if armature.any()
        else None,
        **_passive_forces(model, ignored, topology, q_load),
        model=source,
        left_out=left_out,
    )
