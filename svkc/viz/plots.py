"""Curves of a run over time, by matplotlib."""

from typing import Any

import jax
import numpy as np

from svkc.model.chain import Chain
from svkc.simulation.trajectory import Trajectory
from svkc.tree.energy import kinetic_energy, potential_energy
from svkc.viz.shapes import event_descriptions


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
