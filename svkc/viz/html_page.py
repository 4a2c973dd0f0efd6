"""A run as one self-contained HTML page: bodies in three dimensions, a time line, numbers.

The page loads nothing from a network. Its JavaScript is in `web/`.
"""

import base64
import dataclasses
import html
import json
import pathlib

import jax
import jax.numpy as jnp
import numpy as np

from svkc.loops.constraint import largest_gaps
from svkc.model.annotations import Integer
from svkc.model.chain import Chain, State, Structure, active_dofs
from svkc.model.validation import integer
from svkc.simulation.trajectory import Trajectory
from svkc.tree.bodies import poses
from svkc.tree.energy import energy
from svkc.viz.meshes import MIN_FACES, Mesh, decimate, load_mesh, mesh_key
from svkc.viz.outlines import geom_color, geom_kind, visible_geoms
from svkc.viz.run_data import (
    check_single_run,
    event_descriptions,
    saved_states,
    warn_of_another_chain,
)

FOLDER = pathlib.Path(__file__).parent / "web"


@dataclasses.dataclass(frozen=True)
class Page:
    """The HTML page of a run. Jupyter displays the page in a frame.

    text: the HTML file.
    height: height of the frame (pixels).
    """

    text: str
    height: int = 480

    def _repr_html_(self) -> str:
        style = f"width:100%;height:{self.height}px;border:0"
        return (
            f'<iframe srcdoc="{html.escape(self.text)}" style="{style}"'
            ' allow="fullscreen"></iframe>'
        )


def show(
    chain: Chain, traj: Trajectory, *, title: str = "svkc", height: int = 480,
    max_faces: Integer = 20_000,
) -> Page:  # fmt: skip
    """Return the HTML page of a run.

    A notebook displays the page below a cell whose last line is this call. `svkc.render(chain,
    traj, "run.html")` writes the page to a file. Between save times the page interpolates positions
    linearly and orientations at constant angular velocity: save about 40 states a second.

    traj: one run, not a batch.
    title: title of the page.
    height: height of the notebook's frame (pixels).
    max_faces: meshes with more faces are drawn with at most this number, by vertex clustering;
        at least 100. The page holds each mesh once, whatever the length of the run.

    Raises ValueError if `traj` is a batch of runs or `max_faces` is not such a number.
    """
    max_faces = integer("max_faces", max_faces, MIN_FACES)
    text = _read_web_file("page.html")
    # the run is inserted last, so that no placeholder is replaced inside its strings
    placeholders = {
        "three": _read_web_file("three.min.js"),
        "page": _read_web_file("page.js"),
        "title": html.escape(title),
        "run": _script_json(_run_data(chain, traj, max_faces)),
    }
    for name, value in placeholders.items():
        text = text.replace("{{" + name + "}}", value)
    return Page(text, height)


def write_page(chain: Chain, traj: Trajectory, path: pathlib.Path, max_faces: int) -> pathlib.Path:
    """Write the page of a run to a file, with the file's stem as title, and return the path."""
    text = show(chain, traj, title=path.stem, max_faces=max_faces).text
    path.write_text(text, encoding="utf-8")
    return path


def _read_web_file(name: str) -> str:
    """Return the text of a file in `web/`."""
    return (FOLDER / name).read_text(encoding="utf-8")


def _script_json(data) -> str:
    """Return JSON for a <script> element. `<` is escaped, so no string can end the element."""
    return json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


def _json_numbers(x):
    """Return nested lists of numbers, with None for non-finite ones, which JSON lacks."""
    x = np.asarray(x, float)
    values = x.astype(object)
    values[~np.isfinite(x)] = None
    return values.tolist()


def _base64(x, dtype) -> str:
    """Return the array's little-endian bytes in base64."""
    return base64.b64encode(
        np.ascontiguousarray(x, np.dtype(dtype).newbyteorder("<")).tobytes()
    ).decode()


def _run_data(chain: Chain, traj: Trajectory, max_faces: int) -> dict:
    """Return what the page's script reads of a run, as JSON data."""
    check_single_run(traj)
    ts, numbers, states = saved_states(traj)
    gaps = np.asarray(traj.gaps)[numbers]
    if len(gaps) < len(ts):
        gaps = np.concatenate([gaps, jax.jit(largest_gaps)(chain, traj.final)[0][None]])
    positions, quats, energies = jax.jit(jax.vmap(lambda s: (*poses(chain, s), energy(chain, s))))(
        states
    )
    warn_of_another_chain(traj, ts, energies)
    phases = _phase_rows(chain, traj, ts, states)
    geoms, meshes = _geoms(chain.model.model, max_faces)
    return {
        "bodies": chain.body_names,
        "times": _json_numbers(ts),
        "poses": _base64(np.concatenate([positions, quats], -1), np.float32),
        "energy": _json_numbers(energies),
        "gaps": _json_numbers(gaps),
        "phases": phases,
        "events": _event_rows(chain, traj, ts[0]),
        "geoms": geoms,
        "meshes": meshes,
        "size": float(chain.length),
    }


def _phase_rows(chain: Chain, traj: Trajectory, ts: np.ndarray, states: State) -> list[dict]:
    """Return times (s), mobility, energy (J), gaps (rad, m) and connected links of each phase.

    If an event ends the run, the structure after this event is one more phase, of zero duration.
    """
    p, final = traj.phases, traj.final.structure
    rows = [
        {
            "start": float(p.start[i]),
            "stop": float(p.stop[i]),
            "mobility": int(p.freedoms[i]),
            "energy": _json_numbers(p.energy[i]),
            "gap": _json_numbers(p.gap[i]),
        }
        for i in range(int(p.count))
    ]
    connected_rows = [*np.asarray(p.connected)[: len(rows)]]
    if not rows or np.any(np.asarray(traj.events.time) == rows[-1]["stop"]):
        end, mobility = (
            float(traj.t_final),
            int(jnp.sum(active_dofs(chain, final))) - int(final.rank),
        )
        rows.append(
            {
                "start": end,
                "stop": end,
                "mobility": mobility,
                "energy": [None, None],
                "gap": [None, None],
            }
        )
        connected_rows.append(np.asarray(final.connected))
    # the body number of each row of the topology
    body_of_row = {row: i for i, row in enumerate(chain.topology.body_row)}
    bounds = [row["start"] for row in rows] + [np.inf]
    for row, connected, start, stop in zip(
        rows, connected_rows, bounds[:-1], bounds[1:], strict=True
    ):
        # link placements are recorded at save times alone
        saved = np.flatnonzero((ts >= start) & (ts < stop))
        s = (
            jax.tree.map(lambda x, k=saved: np.asarray(x[k[0]]), states.structure)
            if len(saved)
            else None
        )
        row["links"] = [
            {"name": chain.link_names[i], "link": i, "ends": s and _link_ends(s, i, body_of_row)}
            for i in np.flatnonzero(connected).tolist()
        ]
    return rows


def _link_ends(structure: Structure, link: int, body_of_row: dict) -> list:
    """Return [body, position in the body's frame (m)] for a link's parent and its real link."""
    return [
        [body_of_row[int(row[link])], _json_numbers(pos[link])]
        for row, pos in ((structure.parent, structure.pos), (structure.real, structure.real_pos))
    ]


def _event_rows(chain: Chain, traj: Trajectory, start: float) -> list[dict]:
    """Return time (s), description and lost energy (J) of each instant with events.

    start: first save time (s). Earlier events are left out.
    """
    e = traj.events
    times, lost = (np.asarray(x[: int(e.count)], float) for x in (e.time, e.energy_lost))
    # a cut loses no energy: a loss within round-off is shown as zero
    rounding = 100 * float(jnp.finfo(traj.ts.dtype).eps * jnp.max(jnp.abs(traj.phases.energy)))
    instants = [
        (time, text, float(lost[times == time].sum()))
        for time, text in event_descriptions(traj, chain)
        if time >= start
    ]
    return [
        {"time": time, "text": text, "lost": loss if abs(loss) > rounding else 0.0}
        for time, text, loss in instants
    ]


def _geoms(model, max_faces: int) -> tuple[list[dict], list[dict]]:
    """Return the visible geoms, and each mesh or height field among them once."""
    geoms, meshes, numbers = [], [], {}
    for g in visible_geoms(model):
        geom = {
            "body": int(model.geom_bodyid[g]),
            "kind": geom_kind(model, g),
            "rgba": _json_numbers(geom_color(model, g).round(4)),
            "size": _json_numbers(model.geom_size[g]),
            "pos": _json_numbers(model.geom_pos[g]),
            "quat": _json_numbers(model.geom_quat[g]),
        }
        if (key := mesh_key(model, g)) is not None:
            if key not in numbers:
                numbers[key] = len(meshes)
                meshes.append(_packed(decimate(load_mesh(model, key), max_faces)))
            geom |= {"kind": "mesh", "mesh": numbers[key]}
        geoms.append(geom)
    return geoms, meshes


def _packed(mesh: Mesh) -> dict:
    """Return a mesh for the page's script.

    Coordinates are 16-bit fractions of the bounding box; vertex numbers have 16 bits if 65,536
    vertices are enough, otherwise 32.
    """
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    fractions = (mesh.vertices - low) / np.where(high > low, high - low, 1)
    return {
        "low": _json_numbers(low),
        "high": _json_numbers(high),
        "vertices": _base64(np.rint(fractions * 65535), np.uint16),
        "faces": _base64(mesh.faces, np.uint16 if len(mesh.vertices) <= 65536 else np.uint32),
    }
