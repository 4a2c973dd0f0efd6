"""Plots of a run by matplotlib: a strobe, and curves over time."""

import functools
import pathlib
from typing import Any

import jax
import numpy as np

from svkc.model.chain import Chain
from svkc.simulation.trajectory import Trajectory
from svkc.tree.energy import kinetic_energy, potential_energy
from svkc.viz.shapes import (
    color,
    connected_link_positions,
    event_descriptions,
    positions_and_rotations,
    segments,
)


def strobe(chain: Chain, traj: Trajectory, path: pathlib.Path, frames: int) -> pathlib.Path:
    """Draw several poses of a run in the x-z plane, save the picture, and return its path.

    Each structure has a color. Connected virtual links are rings. Later poses are more opaque.
    """
    from matplotlib.figure import Figure

    ts = np.asarray(traj.ts)
    frame_indices = np.unique(
        np.searchsorted(ts, np.linspace(ts[0], ts[-1], frames)).clip(0, len(ts) - 1)
    )
    states = jax.tree.map(lambda x: x[frame_indices], traj.states)
    positions, R = positions_and_rotations(chain, states)
    link_positions = connected_link_positions(chain, states, positions, R)
    starts, structures = _structures(traj)
    colors = {s: color(n) for n, s in enumerate(dict.fromkeys(structures))}
    figure = Figure(figsize=(10, 7.5))
    axes = figure.add_subplot(aspect="equal", xlabel="x (m)", ylabel="z (m)")
    shapes = segments(chain)
    ground_shapes, body_shapes = [s for s in shapes if s[0] == 0], [s for s in shapes if s[0] != 0]
    low, high = _axis_limits(ground_shapes, positions)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    # points per metre
    scale = 72 * min(9 / (high[0] - low[0]), 6.7 / (high[1] - low[1]))
    draw = functools.partial(_draw_shapes, axes, scale=scale)
    draw(ground_shapes, positions[0], R[0], color="#9a9aa2", alpha=0.8)
    for frame, i in enumerate(frame_indices):
        structure = structures[max(int(np.sum(starts <= ts[i])) - 1, 0)]
        shade = 0.2 + 0.7 * (frame + 1) / len(frame_indices)
        draw(body_shapes, positions[frame], R[frame], color=colors[structure], alpha=shade)
        rings = np.array([place[[0, 2]] for place in link_positions[frame].values()]).reshape(-1, 2)
        axes.plot(*rings.T, "o", color="#202020", alpha=shade, markersize=7, fillstyle="none")
    _add_legend(axes, chain, starts, structures, colors)
    axes.grid(alpha=0.2)
    axes.set_title(
        f"{len(frame_indices)} poses, {ts[frame_indices[0]]:.2f} s to {ts[frame_indices[-1]]:.2f} s"
    )
    figure.savefig(path, dpi=110, bbox_inches="tight")
    return path


def _structures(traj: Trajectory) -> tuple[np.ndarray, list[tuple[int, ...]]]:
    """Return the start (s) and the connected links of each phase.

    Phases of zero duration, which lie between events at one instant, are left out.
    """
    p = traj.phases
    phases = [i for i in range(int(p.count)) if p.stop[i] > p.start[i]] or [0]
    links = [tuple(np.flatnonzero(p.connected[i]).tolist()) for i in phases]
    return np.asarray(p.start)[phases], links


def _axis_limits(ground_shapes, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and the upper limits of x and z (m).

    Shapes on the ground count up to a metre beyond the bodies: a long floor would make the bodies
    small.
    """
    points = positions[:, 1:, [0, 2]].reshape(-1, 2)
    ends = np.array([end for _, *ends, _ in ground_shapes for end in ends]).reshape(-1, 3)[
        :, [0, 2]
    ]
    visible = np.concatenate([points, ends.clip(points.min(0) - 1, points.max(0) + 1)])
    return visible.min(0) - 0.3, visible.max(0) + 0.3


def _draw_shapes(axes, shapes, positions, R, *, scale: float, color: str, alpha: float):
    """Draw shapes as thick lines at the poses of their bodies.

    scale: printer's points per metre.
    """
    for body, a, b, radius in shapes:
        ends = np.array([positions[body] + R[body] @ x for x in (a, b)])
        if np.hypot(*(ends[1] - ends[0])[[0, 2]]) * scale < 1:
            # seen end-on: matplotlib does not draw a line of zero length
            ends[1, 0] = ends[0, 0] + 1 / scale
        axes.plot(
            ends[:, 0],
            ends[:, 2],
            color=color,
            alpha=alpha,
            solid_capstyle="round",
            # two thirds of the true thickness, so that poses can be told apart
            linewidth=max(1.0, 1.3 * radius * scale),
        )


def _add_legend(axes, chain: Chain, starts, structures, colors: dict):
    """Name each structure by its connected links and the times at which it starts."""
    from matplotlib.transforms import ScaledTranslation

    for structure, structure_color in colors.items():
        start_times = [
            f"{t:.2f}" for t, s in zip(starts, structures, strict=True) if s == structure
        ]
        times = ", ".join(start_times[:6]) + ", ..." * (len(start_times) > 6)
        links = ", ".join(chain.link_names[k] for k in structure) or "nothing"
        axes.plot([], [], color=structure_color, linewidth=5, label=f"{links} from {times} s")
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


def curves(traj: Trajectory, chain: Chain | None = None) -> Any:
    """Return a matplotlib figure of coordinates, energy, loop gaps and mobility over time.

    Events are numbered vertical lines.

    chain: the chain of the run, which adds joint names, and kinetic and potential energy at the
        save times. Without a chain, the energy is shown at the ends of phases alone.
    """
    from matplotlib.figure import Figure

    ts, p, count = np.asarray(traj.ts), traj.phases, int(traj.phases.count)
    figure = Figure(figsize=(9, 10), layout="constrained")
    joints, energies, gaps, mobility = panels = figure.subplots(
        4, 1, sharex=True, height_ratios=(2, 1.4, 1.2, 0.8)
    )
    _plot_coordinates(joints, ts, traj, chain)
    _plot_energies(energies, ts, traj, chain)
    gaps.semilogy(ts, np.maximum(np.asarray(traj.gaps), 1e-17), linewidth=1, label=["rad", "m"])
    gaps.set_ylabel("largest loop gap")
    gaps.legend(fontsize=8)
    bounds = np.append(np.asarray(p.start)[:count], p.stop[count - 1])
    mobility.stairs(np.asarray(p.freedoms)[:count], bounds, baseline=None, linewidth=1.5)
    mobility.set(ylabel="mobility", xlabel="t (s)")
    _mark_events(figure, panels, event_descriptions(traj, chain))
    return figure


def _plot_coordinates(axes, ts, traj: Trajectory, chain: Chain | None):
    """Plot all coordinates over time.

    A legend names the tree's coordinates if there are at most eight, one for each joint.
    """
    axes.plot(ts, np.asarray(traj.states.q), linewidth=0.8)
    axes.set_ylabel("q (m, rad)")
    if chain is not None and chain.nq == len(chain.joint_names) <= 8:
        # coordinates of the tree come first; those of virtual joints have no label
        axes.legend(axes.lines[: chain.nq], chain.joint_names, fontsize=7)


def _plot_energies(axes, ts, traj: Trajectory, chain: Chain | None):
    """Plot the energy at the ends of phases; with a chain, kinetic and potential energy too."""
    if chain is not None:
        for name, energy_of in (("kinetic", kinetic_energy), ("potential", potential_energy)):
            values = jax.jit(jax.vmap(lambda s, of=energy_of: of(chain, s)))(traj.states)
            axes.plot(ts, np.asarray(values), linewidth=1, label=name)
    p, count = traj.phases, int(traj.phases.count)
    # NaN breaks the line after each phase
    gap = np.full((count, 1), np.nan)
    ends = np.stack([p.start, p.stop], 1)[:count]
    times, values = (np.hstack([x, gap]).ravel() for x in (ends, np.asarray(p.energy)[:count]))
    axes.plot(times, values, "k.-", linewidth=1, label="sum, by phases")
    axes.set_ylabel("energy (J)")
    axes.legend(fontsize=8)


def _mark_events(figure, panels, events: list[tuple[float, str]]):
    """Draw a numbered vertical line at each event in every panel, and list the events below."""
    for number, (t, _) in enumerate(events, 1):
        for panel in panels:
            panel.axvline(t, color="0.6", linewidth=0.8, linestyle="--")
        panels[0].annotate(
            str(number),
            (t, 1),
            xycoords=("data", "axes fraction"),
            ha="center",
            va="bottom",
            fontsize=8,
        )
    if events:
        names = (f"{number}: {t:.4f} s, {what}" for number, (t, what) in enumerate(events, 1))
        figure.supxlabel("\n".join(names), fontsize=8)
