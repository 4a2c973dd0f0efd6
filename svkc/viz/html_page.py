"""A run as one HTML page of its own: bodies in three dimensions, a timeline with its events,
numbers beside it. Nothing is read from a network."""

import base64
import dataclasses
import html
import json
import pathlib

import jax
import jax.numpy as jnp
import numpy as np

from svkc.loops.constraint import largest_gaps
from svkc.model.chain import Chain, State, Structure, active_dofs
from svkc.simulation.trajectory import Trajectory
from svkc.tree.energy import energy
from svkc.tree.kinematics import poses
from svkc.viz.shapes import check_single_run, event_descriptions

FOLDER = pathlib.Path(__file__).parent / "web"


@dataclasses.dataclass(frozen=True)
class Page:
    """A run's page: `text` is the HTML file. A notebook shows it in a frame `height` pixels
    high."""

    text: str
    height: int = 480

    def _repr_html_(self) -> str:
        style = f"width:100%;height:{self.height}px;border:0"
        return (
            f'<iframe srcdoc="{html.escape(self.text)}" style="{style}"'
            ' allow="fullscreen"></iframe>'
        )


def show(chain: Chain, traj: Trajectory, *, title: str = "svkc", height: int = 480) -> Page:
    """The page of a run; as the last line of a notebook's cell it is shown below it:
    `svkc.show(chain, traj)`. `svkc.render(chain, traj, "run.html")` writes the same page to a
    file.

    Bodies move in straight lines and turn at constant rates between the saved times: save 40 a
    second or so. ValueError: a batch of runs.
    """
    text = _read_web_file("page.html")
    # the run comes last: nothing in it is taken for a place to put something in
    parts = {
        "three": _read_web_file("three.min.js"),
        "page": _read_web_file("page.js"),
        "title": html.escape(title),
        "run": _script_json(_run_data(chain, traj)),
    }
    for place, value in parts.items():
        text = text.replace("{{" + place + "}}", value)
    return Page(text, height)


def write_page(chain: Chain, traj: Trajectory, path: pathlib.Path) -> pathlib.Path:
    """Writes the page to a file, of whose name its title is made."""
    path.write_text(show(chain, traj, title=path.stem).text, encoding="utf-8")
    return path


def _read_web_file(name: str) -> str:
    return (FOLDER / name).read_text(encoding="utf-8")


def _script_json(data) -> str:
    """JSON that can stand inside a <script>: no name in it ends the script."""
    return json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


def _json_numbers(x):
    """Lists of numbers; null for what is not finite."""
    x = np.asarray(x, float)
    values = x.astype(object)
    values[~np.isfinite(x)] = None
    return values.tolist()


def _base64(x, dtype) -> str:
    return base64.b64encode(
        np.ascontiguousarray(x, np.dtype(dtype).newbyteorder("<")).tobytes()
    ).decode()


def _run_data(chain: Chain, traj: Trajectory) -> dict:
    """All that the page knows of a run."""
    check_single_run(traj)
    ts, states, gaps = _saved_frames(chain, traj)
    positions, quats, energies = jax.jit(jax.vmap(lambda s: (*poses(chain, s), energy(chain, s))))(
        states
    )
    phases = _phase_rows(chain, traj, ts, states)
    geoms, meshes = _geoms(chain.model.model)
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


def _saved_frames(chain: Chain, traj: Trajectory) -> tuple[np.ndarray, State, np.ndarray]:
    """The saved times up to the end of the run, which may have come early, with states and gaps
    there; the end is one of them."""
    ts, end = np.asarray(traj.ts, float), float(traj.t_final)
    keep = np.flatnonzero(ts <= end)
    ts, states, gaps = (
        ts[keep],
        jax.tree.map(lambda x: x[keep], traj.states),
        np.asarray(traj.gaps)[keep],
    )
    if len(ts) and ts[-1] == end:
        return ts, states, gaps
    last, _ = jax.jit(largest_gaps)(chain, traj.final)
    return (
        np.append(ts, end),
        jax.tree.map(lambda x, y: jnp.concatenate([x, y[None]]), states, traj.final),
        np.concatenate([gaps, last[None]]),
    )


def _phase_rows(chain: Chain, traj: Trajectory, ts: np.ndarray, states: State) -> list[dict]:
    """From when, with what mobility, held by which links. What an event at the very end leaves is a
    phase too."""
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
    # a row of the topology as a body
    body_of_row = {row: i for i, row in enumerate(chain.topology.body_row)}
    bounds = [row["start"] for row in rows] + [np.inf]
    for row, connected, start, stop in zip(
        rows, connected_rows, bounds[:-1], bounds[1:], strict=True
    ):
        # where links hold is known where a state was saved
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


def _link_ends(s: Structure, link: int, body: dict) -> list:
    """Body and place in it, of the parent's end and the real link's."""
    return [
        [body[int(row[link])], _json_numbers(pos[link])]
        for row, pos in ((s.parent, s.pos), (s.real, s.real_pos))
    ]


def _event_rows(chain: Chain, traj: Trajectory, begin: float) -> list[dict]:
    """What happened, one line an instant, and the energy (J) that it cost."""
    e = traj.events
    times, lost = (np.asarray(x[: int(e.count)], float) for x in (e.time, e.energy_lost))
    # what rounding leaves of a cut is no loss
    rounding = 100 * float(jnp.finfo(traj.ts.dtype).eps * jnp.max(jnp.abs(traj.phases.energy)))
    instants = [
        (time, text, float(lost[times == time].sum()))
        for time, text in event_descriptions(traj, chain)
        if time >= begin
    ]
    return [
        {"time": time, "text": text, "lost": loss if abs(loss) > rounding else 0.0}
        for time, text, loss in instants
    ]


def _geoms(model) -> tuple[list[dict], list[dict]]:
    """What MuJoCo's own viewer shows at first: geoms of the groups 0 to 2; meshes, and heightfields
    as such, once each."""
    import mujoco

    kinds = mujoco.mjtGeom
    geoms, meshes, known = [], [], {}
    for g in range(model.ngeom):
        kind, data, material = (
            kinds(int(model.geom_type[g])),
            int(model.geom_dataid[g]),
            int(model.geom_matid[g]),
        )
        rgba = model.geom_rgba[g]
        if material >= 0 and np.array_equal(rgba, np.array([0.5, 0.5, 0.5, 1], np.float32)):
            # MuJoCo's rule: the material's colour, unless the geom has one of its own
            rgba = model.mat_rgba[material]
        if model.geom_group[g] > 2 or rgba[3] == 0:
            continue
        shape = {
            "body": int(model.geom_bodyid[g]),
            "kind": kind.name.removeprefix("mjGEOM_").lower(),
            "rgba": _json_numbers(rgba.round(4)),
        }
        shape |= {
            "size": _json_numbers(model.geom_size[g]),
            "pos": _json_numbers(model.geom_pos[g]),
            "quat": _json_numbers(model.geom_quat[g]),
        }
        if data >= 0:
            source = (kind == kinds.mjGEOM_HFIELD, data)
            if source not in known:
                known[source] = len(meshes)
                vertices, faces = _heightfield(model, data) if source[0] else _mesh(model, data)
                meshes.append(
                    {"vertices": _base64(vertices, np.float32), "faces": _base64(faces, np.uint32)}
                )
            shape |= {"kind": "mesh", "mesh": known[source]}
        geoms.append(shape)
    return geoms, meshes


def _mesh(model, i: int) -> tuple[np.ndarray, np.ndarray]:
    first, count, face, faces = (
        int(x[i])
        for x in (model.mesh_vertadr, model.mesh_vertnum, model.mesh_faceadr, model.mesh_facenum)
    )
    return model.mesh_vert[first : first + count], model.mesh_face[face : face + faces]


def _heightfield(model, i: int) -> tuple[np.ndarray, np.ndarray]:
    """Its upper surface."""
    rows, columns, first = (
        int(x[i]) for x in (model.hfield_nrow, model.hfield_ncol, model.hfield_adr)
    )
    wide, deep, high, _ = model.hfield_size[i]
    x, y = np.meshgrid(np.linspace(-wide, wide, columns), np.linspace(-deep, deep, rows))
    corner = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (
        part.ravel()
        for part in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1])
    )
    z = high * model.hfield_data[first : first + rows * columns]
    return np.stack([x.ravel(), y.ravel(), z], -1), np.concatenate(
        [np.stack([a, b, c], -1), np.stack([a, c, d], -1)]
    )
