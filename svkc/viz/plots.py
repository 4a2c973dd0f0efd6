"""Flat pictures of a run by matplotlib: a strobe, curves over time."""

import pathlib

import jax
import numpy as np

from svkc.model.chain import Chain
from svkc.simulation.trajectory import Trajectory
from svkc.tree.energy import kinetic_energy, potential_energy
from svkc.viz.shapes import color, happened, held, segments, world_poses


def strobe(chain: Chain, traj: Trajectory, path: pathlib.Path, frames: int) -> pathlib.Path:
    """Poses over one another in the plane of x and z, a colour for each structure, links that hold
    as rings."""
    from matplotlib.figure import Figure
    from matplotlib.transforms import ScaledTranslation

    ts = np.asarray(traj.ts)
    pick = np.unique(np.searchsorted(ts, np.linspace(ts[0], ts[-1], frames)).clip(0, len(ts) - 1))
    states = jax.tree.map(lambda x: x[pick], traj.states)
    positions, R = world_poses(chain, states)
    holding = held(chain, states, positions, R)
    p = traj.phases
    # phases of no length, between events of one instant, are not seen
    phases = [i for i in range(int(p.count)) if p.stop[i] > p.start[i]] or [0]
    starts, structures = (
        np.asarray(p.start)[phases],
        [tuple(np.flatnonzero(p.connected[i])) for i in phases],
    )
    colors = {s: color(n) for n, s in enumerate(dict.fromkeys(structures))}
    figure = Figure(figsize=(10, 7.5))
    axes = figure.add_subplot(aspect="equal", xlabel="x (m)", ylabel="z (m)")
    shapes = segments(chain)
    # what is fixed is shown no further than a metre beyond what moves: a long floor would make the
    # figure small
    moving = positions[:, 1:, [0, 2]].reshape(-1, 2)
    fixed = np.array([end for body, *ends, _ in shapes if body == 0 for end in ends]).reshape(
        -1, 3
    )[:, [0, 2]]
    shown = np.concatenate([moving, fixed.clip(moving.min(0) - 1, moving.max(0) + 1)])
    low, high = shown.min(0) - 0.3, shown.max(0) + 0.3
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    # points a metre, limbs at two thirds of their thickness, so that poses can be told apart
    scale = 72 * min(9 / (high[0] - low[0]), 6.7 / (high[1] - low[1]))
    for frame, i in enumerate(pick):
        phase = max(int(np.sum(starts <= ts[i])) - 1, 0)
        shade = 0.2 + 0.7 * (frame + 1) / len(pick)
        for body, a, b, radius in shapes:
            if body == 0 and frame:
                continue
            ends = np.array([positions[frame, body] + R[frame, body] @ x for x in (a, b)])
            paint = "#9a9aa2" if body == 0 else colors[structures[phase]]
            if np.hypot(*(ends[1] - ends[0])[[0, 2]]) * scale < 1:
                # seen end-on: a line of no length would not be drawn
                ends[1, 0] = ends[0, 0] + 1 / scale
            width = max(1.0, 1.3 * radius * scale)
            axes.plot(
                ends[:, 0],
                ends[:, 2],
                color=paint,
                alpha=0.8 if body == 0 else shade,
                solid_capstyle="round",
                linewidth=width,
            )
        rings = np.array([place[[0, 2]] for place in holding[frame].values()]).reshape(-1, 2)
        axes.plot(*rings.T, "o", color="#202020", alpha=shade, markersize=7, fillstyle="none")
    for structure, paint in colors.items():
        since = [
            f"{start:.2f}" for start, s in zip(starts, structures, strict=True) if s == structure
        ]
        since = ", ".join(since[:6]) + ", ..." * (len(since) > 6)
        axes.plot(
            [],
            [],
            color=paint,
            linewidth=5,
            label=(
                f"{', '.join(chain.link_names[k] for k in structure) or 'nothing'} from {since} s"
            ),
        )
    # below the picture: inside it would hide limbs
    below = axes.transAxes + ScaledTranslation(0, -0.6, figure.dpi_scale_trans)
    axes.legend(
        loc="upper center",
        bbox_to_anchor=(0.5, 0),
        bbox_transform=below,
        ncols=2,
        fontsize=9,
        title="held (rings) by",
    )
    axes.grid(alpha=0.2)
    axes.set_title(f"{len(pick)} poses, {ts[pick[0]]:.2f} s to {ts[pick[-1]]:.2f} s")
    figure.savefig(path, dpi=110, bbox_inches="tight")
    return path


def curves(traj: Trajectory, chain: Chain | None = None):
    """A matplotlib figure over time: coordinates, energy, loop gaps, mobility, events as lines with
    their names; with the chain, kinetic and potential energy at every saved time and the joints'
    names, without it energy at the phases' ends alone."""
    from matplotlib.figure import Figure

    ts, p = np.asarray(traj.ts), traj.phases
    figure = Figure(figsize=(9, 10), layout="constrained")
    joints, energies, gaps, mobility = panels = figure.subplots(
        4, 1, sharex=True, height_ratios=(2, 1.4, 1.2, 0.8)
    )
    count = int(p.count)
    starts, stops = np.asarray(p.start)[:count], np.asarray(p.stop)[:count]
    _coordinates(joints, ts, traj, chain)
    if chain is not None:
        for name, of in (("kinetic", kinetic_energy), ("potential", potential_energy)):
            energies.plot(
                ts,
                np.asarray(jax.jit(jax.vmap(lambda s, of=of: of(chain, s)))(traj.states)),
                linewidth=1,
                label=name,
            )
    ends = np.stack([starts, stops, np.full(count, np.nan)], 1).ravel()
    energies.plot(
        ends,
        np.pad(np.asarray(p.energy)[:count], ((0, 0), (0, 1)), constant_values=np.nan).ravel(),
        "k.-",
        linewidth=1,
        label="sum, by phases",
    )
    energies.set_ylabel("energy (J)")
    energies.legend(fontsize=8)
    gaps.semilogy(ts, np.maximum(np.asarray(traj.gaps), 1e-17), linewidth=1, label=["rad", "m"])
    gaps.set_ylabel("largest loop gap")
    gaps.legend(fontsize=8)
    mobility.stairs(
        np.asarray(p.freedoms)[:count], np.append(starts, stops[-1]), baseline=None, linewidth=1.5
    )
    mobility.set(ylabel="mobility", xlabel="t (s)")
    events = happened(traj, chain)
    for number, (t, _) in enumerate(events, 1):
        for panel in panels:
            panel.axvline(t, color="0.6", linewidth=0.8, linestyle="--")
        joints.annotate(
            str(number),
            (t, 1),
            xycoords=("data", "axes fraction"),
            ha="center",
            va="bottom",
            fontsize=8,
        )
    if events:
        figure.supxlabel(
            "\n".join(f"{number}: {t:.4f} s, {what}" for number, (t, what) in enumerate(events, 1)),
            fontsize=8,
        )
    return figure


def _coordinates(axes, ts, traj: Trajectory, chain: Chain | None):
    """Joints' coordinates by name where they are few; quaternions' and positions' too."""
    axes.plot(ts, np.asarray(traj.states.q), linewidth=0.8)
    axes.set_ylabel("q (m, rad)")
    if chain is not None and chain.nq == len(chain.joint_names) <= 8:
        # the tree's come first; virtual joints' go without a name
        axes.legend(axes.lines[: chain.nq], chain.joint_names, fontsize=7)
