"""Curves of a run over time, by matplotlib."""

import dataclasses
from typing import Any, NamedTuple

import jax
import numpy as np

from svkc.model.chain import Chain, State
from svkc.model.chain_names import ChainNames, chain_names
from svkc.model.names import unknown_name
from svkc.simulation.trajectory import Trajectory
from svkc.tree.energy import kinetic_energy, potential_energy
from svkc.viz.run_data import (
    event_descriptions,
    plain_text,
    saved_states,
    warn_of_another_chain,
)

# curves in a panel, and curves of coordinates if no joints are named
MOST_CURVES, MOST_SHOWN = 8, 48
UNITS = ("q (m, rad)", "length (m)", "angle (rad)")


class Curve(NamedTuple):
    """A coordinate over time: its joint, its label, the label of its axis, values [times]."""

    joint: str
    label: str
    unit: str
    values: np.ndarray


def curves(
    traj: Trajectory, chain: Chain | None = None, joints: tuple[str, ...] | None = None
) -> Any:
    """Return a matplotlib figure of coordinates, energy, loop gaps and mobility over time.

    Events are numbered vertical lines. The figure ends where the run ends.

    chain: the chain of the run, which adds the parts of the energy. Without a chain, the energy is
        shown at the ends of phases alone.
    joints: names of joints and virtual links whose coordinates are shown, as in `svkc.plot`.

    Raises ValueError for an unknown joint.
    """
    from matplotlib.figure import Figure

    ts, numbers, states = saved_states(traj)
    p, count = traj.phases, int(traj.phases.count)
    names = traj.names or (chain_names(chain.topology) if chain is not None else None)
    groups, note = panels_of_coordinates(coordinates(names, np.asarray(states.q)), names, joints)
    figure = Figure(figsize=(10, 1.9 * len(groups) + 5.4), layout="constrained")
    panels = figure.subplots(
        len(groups) + 3, 1, sharex=True, height_ratios=[1.9] * len(groups) + [2.4, 1.3, 0.9]
    )
    for axes, group in zip(panels, groups, strict=False):
        axes.set_ylabel(group[0].unit)
        for curve in group:
            axes.plot(ts, curve.values, linewidth=1, label=plain_text(curve.label))
    *_, energies, gaps, mobility = panels
    _plot_energies(energies, traj, ts[: len(numbers)], numbers, chain)
    values = np.maximum(np.asarray(traj.gaps)[numbers], 1e-17)
    gaps.semilogy(ts[: len(numbers)], values, linewidth=1, label=["rad", "m"])
    gaps.set_ylabel("largest loop gap")
    if count:
        bounds = np.append(np.asarray(p.start)[:count], p.stop[count - 1])
        mobility.stairs(np.asarray(p.freedoms)[:count], bounds, baseline=None, linewidth=1.5)
    mobility.set(ylabel="mobility", xlabel="t (s)")
    mobility.yaxis.get_major_locator().set_params(integer=True)
    for axes in panels[:-1]:
        axes.legend(loc="upper left", bbox_to_anchor=(1, 1), fontsize=8, frameon=False)
    panels[0].set_title(plain_text(note), fontsize=9, loc="left", pad=16)
    _mark_events(figure, panels, event_descriptions(traj, chain))
    return figure


def coordinates(names: ChainNames | None, q: np.ndarray) -> list[Curve]:
    """Return the curves of all coordinates; rotation vectors stand for quaternions.

    q: [times q].
    """
    if names is None:
        labels = [f"q[{i}]" for i in range(q.shape[1])]
        return [Curve(x, label=x, unit=UNITS[0], values=q[:, i]) for i, x in enumerate(labels)]
    result = []
    for joint, start, stop in names.q_ranges:
        for i, label in enumerate(names.q[start:stop], start):
            if label in names.v:
                unit = UNITS[1 + names.angular[names.v.index(label)]]
                result.append(Curve(joint, label=label, unit=unit, values=q[:, i]))
            elif label.endswith(".qw"):
                stem, vectors = label.removesuffix("qw"), rotation_vectors(q[:, i : i + 4])
                result += [
                    Curve(joint, label=stem + axis, unit=UNITS[2], values=values)
                    for axis, values in zip(("rx", "ry", "rz"), vectors.T, strict=True)
                ]
    return result


def rotation_vectors(quats: np.ndarray) -> np.ndarray:
    """Return rotation vectors (rad) of quaternions [times 4], continuous up to whole turns."""
    flips = np.sign(np.sum(quats[1:] * quats[:-1], -1))
    first = np.where(quats[:1, 0] < 0, -1, 1)
    quats = quats * np.cumprod(np.append(first, np.where(flips < 0, -1, 1)))[:, None]
    length = np.linalg.norm(quats[:, 1:], axis=-1, keepdims=True)
    # the limit of angle / sin(angle / 2) at no rotation is 2
    angle = 2 * np.arctan2(length, quats[:, :1])
    return quats[:, 1:] * np.where(length > 0, angle / np.where(length > 0, length, 1), 2)


def panels_of_coordinates(
    every: list[Curve], names: ChainNames | None, joints: tuple[str, ...] | None
) -> tuple[list[list[Curve]], str]:
    """Return the curves of each panel of coordinates, and a note on the choice.

    If no joints are named, these are the joints of the tree; of more than `MOST_SHOWN` curves,
    those that change most.
    """
    known = tuple(dict.fromkeys(curve.joint for curve in every))
    for name in joints or ():
        if name not in known:
            raise unknown_name("joint", name, known)
    shown = joints if joints is not None else known if names is None else names.joints
    of_joints = [[curve for curve in every if curve.joint == name] for name in shown]
    number, note = sum(map(len, of_joints)), ""
    if joints is None and number > MOST_SHOWN:
        note = f"{MOST_SHOWN} of {number} coordinates, those that change most; joints=[...] chooses"
        changes = [np.ptp(c.values) for block in of_joints for c in block]
        rank = iter(np.argsort(np.argsort(-np.array(changes), kind="stable")))
        of_joints = [[c for c in block if next(rank) < MOST_SHOWN] for block in of_joints]
    panels = []
    for unit in UNITS:
        blocks = [[curve for curve in block if curve.unit == unit] for block in of_joints]
        panels += _parts([block for block in blocks if block])
    return panels, note


def _parts(blocks: list[list[Curve]]) -> list[list[Curve]]:
    """Return the curves in parts of about one size, at most `MOST_CURVES`, with blocks kept."""
    total, parts = sum(map(len, blocks)), []
    for block in blocks:
        if not parts or len(parts[-1]) + len(block) > -(-total // -(-total // MOST_CURVES)):
            parts.append([])
        parts[-1] += block
    return parts


def _plot_energies(axes, traj: Trajectory, ts, numbers, chain: Chain | None):
    """Plot the parts of the energy and their sum, which is constant, with its drift.

    Work and losses are shown with the signs with which the sum is constant. Parts that are zero
    throughout are left out. Without a chain, or without the work in a file of an older version,
    the energy at the ends of phases is shown.
    """
    axes.set_ylabel("energy (J)")
    if chain is None or traj.work is None:
        p, count = traj.phases, int(traj.phases.count)
        # NaN breaks the line after each phase
        gap = np.full((count, 1), np.nan)
        ends = np.stack([p.start, p.stop], 1)[:count]
        times, values = (np.hstack([x, gap]).ravel() for x in (ends, np.asarray(p.energy)[:count]))
        axes.plot(times, values, "k.-", linewidth=1, label="kinetic + potential")
        return
    parts = energy_parts(traj, ts, numbers, chain)
    total = np.sum(list(parts.values()), 0)
    stored = parts["kinetic"] + parts["gravity"] + parts["springs"]
    warn_of_another_chain(traj, ts, stored)
    for name, values in parts.items():
        if np.any(values):
            axes.plot(ts, values, linewidth=1, label=name)
    drift = np.max(np.abs(total - total[:1]), initial=0)
    axes.plot(ts, total, "k", linewidth=1.5, label=f"sum, drifts by {drift:.1e} J")


def energy_parts(
    traj: Trajectory, ts: np.ndarray, numbers: np.ndarray, chain: Chain
) -> dict[str, np.ndarray]:
    """Return the energies (J) at save times whose sum is constant: stored, less what was done.

    ts, numbers: save times (s) and their numbers, from `saved_states`.
    """
    rigid = dataclasses.replace(chain, stiffness=None)

    @jax.jit
    @jax.vmap
    def energies(state: State):
        gravity = potential_energy(rigid, state)
        return kinetic_energy(chain, state), gravity, potential_energy(chain, state) - gravity

    kinetic, gravity, springs = (
        np.asarray(x) for x in energies(jax.tree.map(lambda x: x[numbers], traj.states))
    )
    control, dampers, limits = np.asarray(traj.work)[numbers].T
    return {
        "kinetic": kinetic,
        "gravity": gravity,
        "springs": springs,
        "- work of control": -control,
        "lost in dampers": -dampers,
        "- work of limits": -limits,
        "lost in events": _lost_in_events(traj, ts, kinetic + gravity + springs),
    }


def _lost_in_events(traj: Trajectory, ts, energies) -> np.ndarray:
    """Return the energy (J) that events took before each save time, springs of cut joints included.

    energies: mechanical energy at the save times (J).
    """
    p, count = traj.phases, int(traj.phases.count)
    if not count:
        return np.zeros(np.shape(ts))
    starts, at_ends = np.asarray(p.start)[:count], np.asarray(p.energy)[:count]
    jumps = at_ends[:-1, 1] - at_ends[1:, 0]
    lost = np.sum(np.where(starts[1:] <= ts[:, None], jumps, 0), -1)
    # no phase follows an event at the end of the run
    after = (ts == float(traj.t_final)) & np.any(np.asarray(traj.events.time) == traj.t_final)
    return lost + np.where(after & (starts[-1] < ts), at_ends[-1, 1] - energies, 0)


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
        figure.supxlabel(plain_text("\n".join(names)), fontsize=8)
