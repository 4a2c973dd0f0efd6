"""Saved states, poses, link positions and descriptions of events, which all pictures use."""

import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from svkc.model.chain import Chain, State
from svkc.simulation.run_tables import changes_of_run, link_labels
from svkc.simulation.trajectory import Trajectory
from svkc.tree.bodies import poses

# of structures in a strobe, and of trails in an animation
COLORS = ("#1f5fa8", "#d9822b", "#2f8f4e", "#8e3b8e", "#b03030")


def check_single_run(traj: Any) -> None:
    """Raise ValueError if the argument is no trajectory or is a batch of trajectories."""
    if not isinstance(traj, Trajectory):
        raise ValueError(f"traj: expected one run of svkc.simulate, got {type(traj).__name__}")
    if np.ndim(traj.ts) != 1:
        raise ValueError(
            f"render: a picture shows one run, got a batch of {traj.ts.shape[:-1]};"
            " give one lane: traj[0]"
        )


def plain_text(text: str) -> str:
    """Return text that matplotlib shows as it is.

    matplotlib reads TeX between dollar signs, and leaves labels that start with an underscore out
    of legends.
    """
    return " " * text.startswith("_") + text.replace("$", r"\$")


def color(i: int) -> str:
    """Return color i of a cyclic palette, as #rrggbb."""
    return COLORS[i % len(COLORS)]


def saved_states(traj: Trajectory) -> tuple[np.ndarray, np.ndarray, State]:
    """Return the save times up to the end of the run, their numbers, and states.

    A run may end before its last save time. Times (s) and states, but not numbers, have one more
    entry, the end of the run, if no save time is the end.
    """
    ts, end = np.asarray(traj.ts, float), float(traj.t_final)
    numbers = np.flatnonzero(ts <= end)
    ts, states = ts[numbers], jax.tree.map(lambda x: x[numbers], traj.states)
    if len(ts) and ts[-1] == end:
        return ts, numbers, states
    append = lambda x, last: jnp.concatenate([x, last[None]])
    return np.append(ts, end), numbers, jax.tree.map(append, states, traj.final)


def warn_of_another_chain(traj: Trajectory, ts: Any, energies: Any) -> None:
    """Warn if the energy at the start of a phase is not the one that the run recorded.

    ts, energies: save times (s), and the mechanical energy (J) of the chain that is drawn.
    """
    p, count = traj.phases, int(traj.phases.count)
    recorded = np.asarray(p.energy, float)[:count, 0]
    size = max(np.max(np.abs(recorded), initial=0), np.max(np.abs(energies), initial=0))
    tolerance = np.sqrt(np.finfo(traj.ts.dtype).eps) * size
    for start, of_run in zip(np.asarray(p.start)[:count], recorded, strict=True):
        for of_chain in np.asarray(energies)[: len(ts)][np.asarray(ts) == start]:
            if abs(of_chain - of_run) > tolerance:
                warnings.warn(
                    f"the chain is not that of the run: at {start:.6g} s its energy is"
                    f" {of_chain:.6g} J, the run's {of_run:.6g} J. Give the chain of this lane,"
                    " with its own masses.",
                    stacklevel=2,
                )
                return


def positions_and_rotations(chain: Chain, states: State) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (m) and rotation matrices of the body frames in the ground frame.

    Shapes are [times bodies 3] and [times bodies 3 3].
    """
    positions, quats = jax.jit(jax.vmap(lambda s: poses(chain, s)))(states)
    w, x, y, z = np.moveaxis(np.asarray(quats, float), -1, 0)
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    return np.asarray(positions, float), np.moveaxis(R, (0, 1), (-2, -1))


def connected_link_positions(
    chain: Chain, states: State, positions: Any, R: Any
) -> list[dict[int, np.ndarray]]:
    """Return {link: position (m)} of the connected virtual links, for each state.

    A link's position is its point on the real link, in the ground frame.

    positions, R: result of `positions_and_rotations`.
    """
    body_of_row, structure = (
        {row: body for body, row in enumerate(chain.topology.body_row)},
        states.structure,
    )
    connected, real, real_pos = (
        np.asarray(structure.connected),
        np.asarray(structure.real),
        np.asarray(structure.real_pos, float),
    )
    position_of = lambda i, link, body: positions[i, body] + R[i, body] @ real_pos[i, link]
    return [
        {
            int(k): position_of(i, k, body_of_row[int(real[i, k])])
            for k in np.flatnonzero(connected[i])
        }
        for i in range(len(positions))
    ]


def event_descriptions(traj: Trajectory, chain: Chain | None = None) -> list[tuple[float, str]]:
    """Return (time (s), description) for each instant with events.

    A description lists the virtual links that were connected and cut. If none was, the description
    is the numbers of the events.

    chain: the chain of the run, for link names. None: the names that the run keeps.
    """
    e, descriptions = traj.events, []
    names = traj.names if chain is None else chain.names
    labels = link_labels(names, np.shape(traj.connected)[-1])
    for time, connected, cut in changes_of_run(traj):
        changes = [f"connect {labels[k]}" for k in np.flatnonzero(connected)]
        changes += [f"cut {labels[k]}" for k in np.flatnonzero(cut)]
        which = np.asarray(e.which)[np.asarray(e.time) == time]
        descriptions.append((time, ", ".join(changes) or f"event {', '.join(map(str, which))}"))
    return descriptions
