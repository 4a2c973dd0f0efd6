"""Conversion of states to and from `mujoco.MjData`, and of chains to MJCF text."""

import os

import numpy as np

from svkc.mjcf.bodies import name_of, rotation_matrix
from svkc.model.annotations import MuJoCo
from svkc.model.chain import Chain, State
from svkc.model.checked_jit import check_chain, check_state
from svkc.model.virtual_link import JOINTS


def _links_with_equality(chain: Chain) -> list[tuple[int, int]]:
    """Return (virtual link, index of the <equality>) of each link that is one in the model."""
    model, names = chain.model.model, {name: i for i, name in enumerate(chain.link_names)}
    equalities = [(name_of(model, "equality", i), i) for i in range(model.neq)]
    return [(names[name], i) for name, i in equalities if name in names]


def mjcf_text(spec: MuJoCo) -> str:
    """Return the MJCF of a mujoco.MjSpec with all digits, and the folders of its files absolute."""
    spec.compiler.savecompiled = spec.compiler.savecanonical = False
    here = os.path.abspath(spec.modelfiledir or ".")
    if not spec.assets:
        if any(item.file for item in [*spec.meshes, *spec.hfields, *spec.skins]):
            spec.compiler.meshdir = os.path.join(here, spec.compiler.meshdir)
        if any(item.file for item in spec.textures):
            spec.compiler.texturedir = os.path.join(here, spec.compiler.texturedir)
    return spec.to_xml()


def to_mjcf(chain: Chain) -> str:
    """Return MJCF text of the chain; see `Chain.to_mjcf`."""
    import mujoco

    if chain.model.text is None:
        raise ValueError(
            "to_mjcf: the chain was loaded from a MjModel, which does not hold its MJCF; load a"
            " path, text or MjSpec"
        )
    try:
        spec = mujoco.MjSpec.from_string(chain.model.text)
    except ValueError as error:
        raise ValueError(
            f"to_mjcf: MuJoCo cannot read the MJCF that it writes for this MjSpec: {error}"
        ) from error
    own, top, notes = dict(_links_with_equality(chain)), chain.topology, []
    for link, name in enumerate(chain.link_names):
        if link in own:
            spec.equalities[own[link]].active = bool(chain.structure.connected[link])
        elif not top.link_spare[link] and not (top.link_child and top.link_child[link] >= 0):
            notes += _add_equality(chain, spec, link, name)
    if np.any(np.asarray(chain.structure.connected)):
        # else MuJoCo would ignore the connected links
        spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_EQUALITY)
    slots = [name for name, spare in zip(chain.link_names, top.link_spare, strict=True) if spare]
    cuttable = [name for name, _, _ in top.cuttable_joints]
    notes += (
        [f"not in this text: {len(slots)} spare slots, svkc.load(..., spare={len(slots)})"]
        if slots
        else []
    )
    notes += (
        [f"not in this text: what may be cut, svkc.load(..., cuttable={cuttable})"]
        if cuttable
        else []
    )
    # two hyphens would end the comment
    spec.comment = "\n".join(
        filter(None, [spec.comment, *(note.replace("--", "- -") for note in notes)])
    )
    return mjcf_text(spec)


def _add_equality(chain: Chain, spec, link: int, name: str) -> list[str]:
    """Add a virtual link to the spec as <equality> elements between new sites.

    Return notes on everything about the link that MJCF cannot express.
    """
    import mujoco

    s, top = chain.structure, chain.topology
    freedoms, active = top.link_freedoms[link], bool(s.connected[link])
    bodies = [top.body_row.index(int(row)) for row in (s.parent[link], s.real[link])]
    frames = [
        tuple(float(x) for x in frame[link]) for frame in (s.pos, s.quat, s.real_pos, s.real_quat)
    ]
    placement = ", ".join(
        f"{key}={frame}"
        for key, frame in zip(("pos", "quat", "real_pos", "real_quat"), frames, strict=True)
    )
    ends = ", ".join(repr(top.body_names[body]) for body in bodies)
    call = (
        f"svkc.VirtualLink({name!r}, {ends}, {_joint_argument(freedoms)!r}, {placement},"
        f" connected={active}, actuated={top.link_actuated[link]})"
    )
    rotations = sum(freedoms[:3])
    if rotations == 2 or any(freedoms[3:]):
        return [f"no <equality> is like {call}"]
    kind = mujoco.mjtEq.mjEQ_CONNECT if rotations else mujoco.mjtEq.mjEQ_WELD
    points = {name: np.zeros(3)}
    if rotations == 1:
        points[_unique_name(f"{name}_axis", chain.link_names)] = float(chain.length) * np.array(
            freedoms[:3], float
        )
    for label, point in points.items():
        sites = _add_sites(spec, bodies, frames, label=label, point=point)
        spec.add_equality(
            name=label,
            type=kind,
            objtype=mujoco.mjtObj.mjOBJ_SITE,
            name1=sites[0],
            name2=sites[1],
            active=active,
        )
    return (
        [f"not in this text: motors on the virtual joint of {call}"]
        if top.link_actuated[link]
        else []
    )


def _add_sites(spec, bodies, frames, *, label: str, point) -> list[str]:
    """Add a site at `point` of the frame in the parent, and one in the real link; return their
    names."""
    sites = []
    for body, side, pos, quat in zip(
        bodies, ("parent", "real"), frames[::2], frames[1::2], strict=True
    ):
        sites.append(_unique_name(f"{label}_{side}", [site.name for site in spec.sites]))
        spec.bodies[body].add_site(
            name=sites[-1],
            pos=np.array(pos) + rotation_matrix(quat) @ point,
            quat=quat,
            group=3,
        )
    return sites


def _unique_name(name: str, existing) -> str:
    """Return the name, with underscores appended until it is not in `existing`."""
    while name in existing:
        name += "_"
    return name


def _joint_argument(freedoms: tuple[bool, ...]):
    """Return the `joint` argument of a `VirtualLink` with these freedoms."""
    return next((joint for joint, others in JOINTS.items() if others == freedoms), freedoms)


def _check_data(chain: Chain, data) -> None:
    """Raise ValueError if the data's qpos and qvel are not of the chain's model."""
    nq, nv = len(chain.topology.model_q), len(chain.topology.model_v)
    shapes = [np.asarray(getattr(data, name, None)).shape for name in ("qpos", "qvel")]
    if shapes != [(nq,), (nv,)]:
        got = [shape[0] if shape else "no" for shape in shapes]
        raise ValueError(
            f"data: got {got[0]} qpos and {got[1]} qvel, the chain's model has {nq} and {nv};"
            " give a MjData of that model"
        )


def to_mujoco(chain: Chain, state: State, data: MuJoCo) -> None:
    """Copy a state into a `mujoco.MjData` of the chain's model; call `mj_forward` next.

    Writes qpos, qvel, and which <equality> elements are active. A joint that is cut has the
    coordinates of its virtual joint.

    data: a `mujoco.MjData` of `chain.model.model`, changed in place.

    Raises ValueError if the data is of another model.
    """
    check_state(chain, state)
    _check_data(chain, data)
    data.qpos[:] = np.asarray(state.q)[np.array(chain.topology.model_q, int)]
    data.qvel[:] = np.asarray(state.v)[np.array(chain.topology.model_v, int)]
    for link, equality in _links_with_equality(chain):
        data.eq_active[equality] = bool(state.structure.connected[link])


def from_mujoco(chain: Chain, data: MuJoCo) -> State:
    """Return the state in a `mujoco.MjData` of the chain's model, by copy.

    `chain.state` closes the loops and projects the velocity. Virtual links from an <equality> are
    connected if the equality is active in the data, others as in the chain.

    data: a `mujoco.MjData` of `chain.model.model`.

    Raises ValueError if the data is of another model, or if a loop cannot be closed.
    """
    check_chain(chain)
    _check_data(chain, data)
    connected = np.array(chain.structure.connected)
    for link, equality in _links_with_equality(chain):
        connected[link] = bool(data.eq_active[equality])
    return chain.state(np.array(data.qpos), np.array(data.qvel), connected)
