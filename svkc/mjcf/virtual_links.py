"""Virtual links from a model's <equality> elements and from the user, with placements from bodies,
sites and the load pose."""

import dataclasses
from collections.abc import Iterable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from svkc.mjcf.bodies import name_of
from svkc.mjcf.flags import is_disabled
from svkc.model.annotations import MuJoCo, Numbers
from svkc.model.chain import Structure
from svkc.model.topology import Topology
from svkc.model.virtual_link import VirtualLink, joint_freedoms


def links_from_equalities(model: MuJoCo) -> list[VirtualLink]:
    """Return the model's <equality> elements as virtual links, children of the first body.

    A connect becomes a ball. A weld becomes a weld, or a ball if its torquescale is zero. Other
    elements are skipped.
    """
    import mujoco

    links, disabled = [], is_disabled(model, "equality", "constraint")
    for i in range(model.neq):
        kind, data = int(model.eq_type[i]), model.eq_data[i]
        if kind not in (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD)):
            continue
        is_weld = kind == int(mujoco.mjtEq.mjEQ_WELD)
        weld = is_weld and data[10] != 0  # the element's torquescale
        ends = [int(model.eq_obj1id[i]), int(model.eq_obj2id[i])]
        if int(model.eq_objtype[i]) == int(mujoco.mjtObj.mjOBJ_SITE):
            places = [(model.site_pos[s], model.site_quat[s]) for s in ends]
            ends = [int(model.site_bodyid[s]) for s in ends]
        elif is_weld and not weld:
            places = [(data[3:6], (1, 0, 0, 0)), (data[:3], None)]
        elif weld:
            places = [(data[3:6], data[6:10]), (data[:3], (1, 0, 0, 0))]
        else:
            # without an orientation, the ball's quaternion is the identity in the load pose
            places = [(data[:3], (1, 0, 0, 0)), (data[3:6], None)]
        links.append(
            VirtualLink(
                name=name_of(model, "equality", i),
                parent=name_of(model, "body", ends[0]),
                real=name_of(model, "body", ends[1]),
                joint="weld" if weld else "ball",
                pos=tuple(places[0][0]),
                quat=_normalize(places[0][1]),
                real_pos=tuple(places[1][0]),
                real_quat=None if places[1][1] is None or not weld else _normalize(places[1][1]),
                connected=bool(model.eq_active0[i]) and not disabled,
            )
        )
    return links


def declared_links(
    model: MuJoCo, declared: Iterable[VirtualLink], cuttable: list[VirtualLink], spare: int
) -> list[VirtualLink]:
    """Return all virtual links in order: <equality>, declared, cuttable joints, spare slots.

    Raises ValueError if a declared link is no `VirtualLink`, or if names are not unique.
    """
    links = [*links_from_equalities(model), *declared]
    for link in links:
        if not isinstance(link, VirtualLink):
            raise ValueError(f"virtual_links: expected svkc.VirtualLink objects, got {link!r}")
    links += cuttable
    links += [VirtualLink(f"spare_{i}", "world", "world", "free") for i in range(spare)]
    names = [link.name for link in links]
    if len(set(names)) < len(names):
        raise ValueError(f"virtual_links: names must be unique, got {names}")
    return links


def _normalize(quat) -> tuple[float, ...]:
    """Return a quaternion of unit length."""
    return tuple(np.asarray(quat, float) / np.linalg.norm(quat))


def _multiply(a, b) -> np.ndarray:
    """Return the product of two quaternions."""
    import mujoco

    out = np.zeros(4)
    mujoco.mju_mulQuat(out, np.asarray(a, float), np.asarray(b, float))
    return out


def _rotate(quat, x) -> np.ndarray:
    """Return the vector x rotated by a quaternion."""
    import mujoco

    out = np.zeros(3)
    mujoco.mju_rotVecQuat(out, np.asarray(x, float), np.asarray(quat, float))
    return out


def _resolve_sites(model, link: VirtualLink, ids: dict[str, int]) -> VirtualLink:
    """Return the link between two bodies: replace each site by its body and move the placement.

    A placement at a site is in the site's frame; None is the site's origin.

    ids: name -> index of the bodies.
    Raises ValueError if a name is neither a body nor a site.
    """
    sites = {name_of(model, "site", i): i for i in range(model.nsite)}
    for side, pos, quat in (("parent", "pos", "quat"), ("real", "real_pos", "real_quat")):
        name = getattr(link, side)
        if name in ids:
            continue
        site = sites.get(name)
        if site is None:
            raise ValueError(
                f"virtual link {link.name!r}: {side} is {name!r}, neither a body nor a site;"
                f" bodies: {', '.join(ids)}"
            )
        frame, body = model.site_quat[site], name_of(model, "body", int(model.site_bodyid[site]))
        offset = _rotate(frame, (0, 0, 0) if getattr(link, pos) is None else getattr(link, pos))
        changed = {side: body, pos: tuple(model.site_pos[site] + offset)}
        if getattr(link, quat) is not None:
            changed[quat] = _normalize(_multiply(frame, getattr(link, quat)))
        link = dataclasses.replace(link, **changed)
    return link


def _joint_frames(data, link: VirtualLink, parent: int, real: int) -> dict[str, np.ndarray]:
    """Return pos, quat, real_pos and real_quat of the joint's frame, with the joint's axis on z.

    Placements that the link leaves None are those of the load pose.

    data: MjData in the load pose.
    parent, real: indices of the two bodies.
    """
    import mujoco

    to_z = np.zeros(4)
    mujoco.mju_quatZ2Vec(to_z, np.asarray(link.axis, float) / np.linalg.norm(link.axis))
    quat = _normalize(_multiply(_normalize(link.quat), to_z))
    real_inverse = data.xquat[real] * np.array([1, -1, -1, -1])
    pos_w = data.xpos[parent] + _rotate(data.xquat[parent], link.pos)
    frames = {
        "pos": link.pos,
        "quat": quat,
        "real_pos": _rotate(real_inverse, pos_w - data.xpos[real])
        if link.real_pos is None
        else link.real_pos,
        "real_quat": _normalize(
            _multiply(real_inverse, _multiply(data.xquat[parent], quat))
            if link.real_quat is None
            else _multiply(_normalize(link.real_quat), to_z)
        ),
    }
    return {name: np.asarray(value, float) for name, value in frames.items()}


def load_structure(model: MuJoCo, topology: Topology, links: list[VirtualLink]) -> Structure:
    """Return the structure of the load pose, with the links at their declared placements."""
    import mujoco

    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    ids = {name: i for i, name in enumerate(topology.body_names)}
    links = [_resolve_sites(model, link, ids) for link in links]
    ends = [(ids[link.parent], ids[link.real]) for link in links]
    frames = [_joint_frames(data, link, *both) for link, both in zip(links, ends, strict=True)]
    stacked = lambda name, size: float_array(
        np.array([frame[name] for frame in frames]).reshape(len(links), size)
    )
    rows = lambda end: jnp.asarray(np.array([topology.body_row[e[end]] for e in ends], np.int32))
    freedoms = np.array([joint_freedoms(link.joint) for link in links], bool)
    return Structure(
        connected=jnp.asarray(np.array([link.connected for link in links], bool)),
        parent=rows(0),
        real=rows(1),
        pos=stacked("pos", 3),
        quat=stacked("quat", 4),
        real_pos=stacked("real_pos", 3),
        real_quat=stacked("real_quat", 4),
        freedoms=jnp.asarray(freedoms.reshape(len(links), 6)),
        rank=jnp.asarray(np.int32(0)),
        margin=jnp.zeros((), jnp.result_type(float)),
    )


def float_array(x: float | Numbers) -> Array:
    """Return an array of JAX's default float type: float64 if x64 is enabled, else float32."""
    return jnp.asarray(np.asarray(x, np.float64), dtype=jnp.result_type(float))
