"""Virtual links as a model and its user declare them: <equality>, ends by bodies or sites,
placements."""

import dataclasses

import jax.numpy as jnp
import numpy as np

from svkc.mjcf.bodies import name_of
from svkc.model.chain import Structure
from svkc.model.topology import Topology
from svkc.model.virtual_link import VirtualLink, joint_freedoms


def equalities(model) -> list[VirtualLink]:
    """<equality> connect and weld as virtual links: ball and weld, child of the first body, under
    their own names."""
    import mujoco

    links = []
    for i in range(model.neq):
        kind, data = int(model.eq_type[i]), model.eq_data[i]
        if kind not in (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD)):
            continue
        weld = kind == int(mujoco.mjtEq.mjEQ_WELD)
        ends = [int(model.eq_obj1id[i]), int(model.eq_obj2id[i])]
        if int(model.eq_objtype[i]) == int(mujoco.mjtObj.mjOBJ_SITE):
            places = [(model.site_pos[s], model.site_quat[s]) for s in ends]
            ends = [int(model.site_bodyid[s]) for s in ends]
        elif weld:
            places = [(data[3:6], data[6:10]), (data[:3], (1, 0, 0, 0))]
        else:
            # a ball's coordinates start at the identity in the load pose
            places = [(data[:3], (1, 0, 0, 0)), (data[3:6], None)]
        links.append(
            VirtualLink(
                name=name_of(model, "equality", i),
                parent=name_of(model, "body", ends[0]),
                real=name_of(model, "body", ends[1]),
                joint="weld" if weld else "ball",
                pos=tuple(places[0][0]),
                quat=_unit(places[0][1]),
                real_pos=tuple(places[1][0]),
                real_quat=None if places[1][1] is None or not weld else _unit(places[1][1]),
                connected=bool(model.eq_active0[i]),
            )
        )
    return links


def _unit(quat):
    return tuple(np.asarray(quat, float) / np.linalg.norm(quat))


def _on_bodies(model, link: VirtualLink, ids: dict[str, int]) -> VirtualLink:
    """The link from body to body: an end that names a site is the site's body, its placement is in
    the site's frame, at the site where none is given."""
    import mujoco

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
        place, turn = np.zeros(3), np.zeros(4)
        mujoco.mju_rotVecQuat(
            place,
            np.asarray((0, 0, 0) if getattr(link, pos) is None else getattr(link, pos), float),
            frame,
        )
        changed = {side: body, pos: tuple(model.site_pos[site] + place)}
        if getattr(link, quat) is not None:
            mujoco.mju_mulQuat(turn, frame, np.asarray(getattr(link, quat), float))
            changed[quat] = _unit(turn)
        link = dataclasses.replace(link, **changed)
    return link


def structure_of(model, topology: Topology, links: list[VirtualLink]) -> Structure:
    """The links' declared placements, their axis turned to z of the joint's frame; what is not
    given is taken from the load pose."""
    import mujoco

    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    ids = {name: i for i, name in enumerate(topology.body_names)}
    links = [_on_bodies(model, link, ids) for link in links]

    def multiply(a, b):
        out = np.zeros(4)
        mujoco.mju_mulQuat(out, np.asarray(a, float), np.asarray(b, float))
        return out

    def turn(quat, x):
        out = np.zeros(3)
        mujoco.mju_rotVecQuat(out, np.asarray(x, float), np.asarray(quat, float))
        return out

    frames = {"pos": [], "quat": [], "real_pos": [], "real_quat": []}
    ends = []
    for link in links:
        p, r = ids[link.parent], ids[link.real]
        to_z = np.zeros(4)
        mujoco.mju_quatZ2Vec(to_z, np.asarray(link.axis, float) / np.linalg.norm(link.axis))
        quat = _unit(multiply(_unit(link.quat), to_z))
        world = data.xpos[p] + turn(data.xquat[p], link.pos)
        back = data.xquat[r] * np.array([1, -1, -1, -1])
        real_pos = turn(back, world - data.xpos[r]) if link.real_pos is None else link.real_pos
        real_quat = (
            multiply(back, multiply(data.xquat[p], quat))
            if link.real_quat is None
            else multiply(_unit(link.real_quat), to_z)
        )
        ends.append((topology.body_row[p], topology.body_row[r]))
        for name, value in (
            ("pos", link.pos),
            ("quat", quat),
            ("real_pos", real_pos),
            ("real_quat", _unit(real_quat)),
        ):
            frames[name].append(np.asarray(value, float))
    count = len(links)
    return Structure(
        connected=jnp.asarray(np.array([link.connected for link in links], bool)),
        parent=jnp.asarray(np.array([e[0] for e in ends], np.int32)),
        real=jnp.asarray(np.array([e[1] for e in ends], np.int32)),
        **{
            name: floats(np.array(value).reshape(count, 4 if "quat" in name else 3))
            for name, value in frames.items()
        },
        freedoms=jnp.asarray(
            np.array([joint_freedoms(link.joint) for link in links], bool).reshape(count, 6)
        ),
        rank=jnp.asarray(np.int32(0)),
        margin=jnp.zeros((), jnp.result_type(float)),
    )


def floats(x):
    """The default float type's array: float64 where jax has it enabled, else float32."""
    return jnp.asarray(np.asarray(x, np.float64), dtype=jnp.result_type(float))
