"""Strobe: several poses of a run in one picture, by matplotlib."""

from typing import Any

import jax
import numpy as np

from svkc.model.chain import Chain
from svkc.simulation.trajectory import Trajectory
from svkc.viz.outlines import Shape, ground_and_bodies, motion_box, outlines
from svkc.viz.run_data import (
    color,
    connected_link_positions,
    plain_text,
    positions_and_rotations,
    saved_states,
)

GROUND_COLOR = "#b4b4ba"


def strobe(chain: Chain, traj: Trajectory, frames: int) -> Any:
    """Return a matplotlib figure of several poses of a run in the x-z plane.

    Bodies are drawn in their true outlines, as seen along y; nearer bodies and later poses hide
    others. Each structure has a color, paler in earlier poses. Connected virtual links are rings.
    Bodies fixed to the ground are grey. The picture ends where the run ends.
    """
    from matplotlib.figure import Figure

    ts, _, states = saved_states(traj)
    frame_indices = np.unique(
        np.searchsorted(ts, np.linspace(ts[0], ts[-1], frames)).clip(0, len(ts) - 1)
    )
    ts, states = ts[frame_indices], jax.tree.map(lambda x: x[frame_indices], states)
    positions, R = positions_and_rotations(chain, states)
    link_positions = connected_link_positions(chain, states, positions, R)
    starts, structures = _structures(traj)
    colors = {s: color(n) for n, s in enumerate(dict.fromkeys(structures))}
    figure = Figure(figsize=(10, 7.5))
    axes = figure.add_subplot(aspect="equal", xlabel="x (m)", ylabel="z (m)")
    # meshes are clustered to about a pixel
    ground, bodies = ground_and_bodies(chain, float(chain.length) / 100)
    box = motion_box(ground, bodies, positions, R)[:, [0, 2]]
    margin = 0.06 * np.ptp(box, axis=0).max() * np.array([[-1], [1]])
    axes.set(xlim=(box + margin)[:, 0], ylim=(box + margin)[:, 1])
    for shape in ground:
        # the edge shows planes, which are seen edge-on
        _draw(axes, [shape], positions[0][shape.body], R[0][shape.body], GROUND_COLOR, edge=1.5)
    for frame in range(len(ts)):
        structure = structures[max(int(np.sum(starts <= ts[frame])) - 1, 0)]
        opacity = 0.35 + 0.65 * (frame + 1) / len(ts)
        _draw_pose(axes, bodies, positions[frame], R[frame], _pale(colors[structure], opacity))
        rings = np.array([place[[0, 2]] for place in link_positions[frame].values()]).reshape(-1, 2)
        axes.plot(*rings.T, "o", color="#202020", alpha=opacity, markersize=7, fillstyle="none")
    _add_legend(axes, chain, starts, structures, colors)
    axes.grid(alpha=0.2)
    axes.set_title(f"{len(ts)} poses, {ts[0]:.4g} s to {ts[-1]:.4g} s")
    return figure


def _structures(traj: Trajectory) -> tuple[np.ndarray, list[tuple[int, ...]]]:
    """Return the start (s) and the connected links of each phase, and of the end if they differ.

    Phases of zero duration, which lie between events at one instant, are left out.
    """
    p = traj.phases
    phases = [i for i in range(int(p.count)) if p.stop[i] > p.start[i]] or [0]
    starts = np.asarray(p.start)[phases]
    connected = [*np.asarray(p.connected)[phases], np.asarray(traj.final.structure.connected)]
    links = [tuple(np.flatnonzero(row).tolist()) for row in connected]
    if links[-1] == links[-2]:
        return starts, links[:-1]
    return np.append(starts, float(traj.t_final)), links


def _pale(hexadecimal: str, opacity: float) -> np.ndarray:
    """Return red, green and blue of a color on white."""
    from matplotlib.colors import to_rgb

    return 1 - opacity * (1 - np.array(to_rgb(hexadecimal)))


def _draw_pose(axes, bodies: list[Shape], positions, R, color):
    """Draw the bodies of a pose, the farthest first."""
    by_body = {}
    for shape in bodies:
        by_body.setdefault(shape.body, []).append(shape)
    depth = lambda body: np.mean(
        [np.mean(shape.points, 0) @ R[body][1] + positions[body][1] for shape in by_body[body]]
    )
    for body in sorted(by_body, key=depth, reverse=True):
        _draw(axes, by_body[body], positions[body], R[body], color, edge=0.3)


def _draw(axes, body: list[Shape], position, R, color, edge: float):
    """Draw the union of shapes of one body, with a white line around it.

    edge: width of a line of the shapes' color on their outlines (points).
    """
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path
    from matplotlib.patheffects import Normal, Stroke

    polygons = [polygon for shape in body for polygon in outlines(shape, position, R)]
    # agg fills where the winding number is not zero
    path = Path.make_compound_path(*(Path(x[[*range(len(x)), 0]], closed=True) for x in polygons))
    halo = Stroke(linewidth=edge + 1, foreground="white")
    # `add_patch` would compute the limits of the axes anew, which takes seconds for meshes
    axes.add_artist(
        PathPatch(
            path,
            facecolor=color,
            edgecolor=color,
            linewidth=edge,
            joinstyle="round",
            path_effects=[halo, Normal()],
        )
    )


def _add_legend(axes, chain: Chain, starts, structures, colors: dict):
    """Name each structure by its connected links and the times at which it starts."""
    from matplotlib.transforms import ScaledTranslation

    for structure, structure_color in colors.items():
        start_times = [
            f"{t:.3g}" for t, s in zip(starts, structures, strict=True) if s == structure
        ]
        times = ", ".join(start_times[:6]) + ", ..." * (len(start_times) > 6)
        links = ", ".join(chain.link_names[k] for k in structure) or "nothing"
        axes.plot(
            [], [], color=structure_color, linewidth=5, label=plain_text(f"{links} from {times} s")
        )
    # below the picture: inside, the legend would hide limbs
    below = axes.transAxes + ScaledTranslation(0, -0.6, axes.figure.dpi_scale_trans)
    axes.legend(
        loc="upper center",
        bbox_to_anchor=(0.5, 0),
        bbox_transform=below,
        ncols=2,
        fontsize=9,
        title="held (rings) by",
    )
