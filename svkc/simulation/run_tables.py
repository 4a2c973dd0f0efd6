"""What `print(traj)` shows: tables of the phases, the events and the joints of a run, and of the
events of a batch."""

import collections
from typing import Any

import numpy as np

from svkc.model.chain_names import ChainNames
from svkc.model.tables import Table, count, join_names, number
from svkc.simulation.records import Phases

# a table of events or joints has at most this many rows
MOST_ROWS = 12


def extent(traj: Any) -> str:
    """Return one line: the times of a run, and the numbers of its save times, phases and events.

    For a batch, the line has its shape, the overall range of times, and the largest numbers of any
    lane.
    """
    lanes = "x".join(map(str, np.shape(traj.t_final)))
    runs = f"Trajectories of {lanes} lanes" if lanes else "Trajectory"
    most = lambda counts: int(np.max(np.asarray(counts), initial=0))
    end = float(np.max(traj.t_final))
    numbers = [
        # a run of no length has no phases
        f"t = {np.min(traj.phases.start, initial=end):.6g} to {end:.6g} s",
        count(np.shape(traj.ts)[-1], "save time"),
        count(most(traj.phases.count), "phase"),
        count(most(traj.events.count), "event"),
    ]
    stopped = not lanes and str(traj.result) == "stopped"
    return f"{runs}: {', '.join(numbers)}" + "; stopped by an event" * stopped


def link_labels(names: ChainNames | None, size: int) -> tuple[str, ...]:
    """Return the names of the virtual links, or "link 0" and so on if the names are not known."""
    return names.links if names else tuple(f"link {i}" for i in range(size))


def phase_table(phases: Phases, names: ChainNames | None) -> Table:
    """Return a row for each phase of one run. Phases of zero duration after the first one are left
    out."""
    p = phases
    labels = link_labels(names, np.shape(p.connected)[-1])
    rows = []
    for i in range(int(p.count)):
        if float(p.start[i]) == float(p.stop[i]) and i:
            continue
        numbers = (int(x[i]) for x in (p.joint_freedoms, p.rank, p.freedoms, p.accepted))
        rows.append(
            (
                f"{float(p.start[i]):.6f}",
                f"{float(p.stop[i]):.6f}",
                join_names(_of_mask(labels, p.connected[i]), "nothing"),
                *map(str, numbers),
                f"{float(p.energy_drift[i]):.2e}",
            )
        )
    titles = "from\ns", "to\ns", "held by", "joint\nfreedoms", "rank", "mobility", "steps"
    return Table((*titles, "energy drift\nJ"), rows, MOST_ROWS)


def event_table(traj: Any) -> Table:
    """Return a row for each instant of one run with events."""
    events, labels = traj.events, link_labels(traj.names, np.shape(traj.connected)[-1])
    which, lost = np.asarray(events.which), np.asarray(events.energy_lost)
    rows = []
    for time, connected, cut in changes_of_run(traj):
        now = np.asarray(events.time) == time
        numbers = ", ".join(map(str, which[now].tolist()))
        changed = [join_names(_of_mask(labels, mask)) for mask in (connected, cut)]
        rows.append((f"{time:.6f}", numbers, *changed, number(lost[now].sum())))
    titles = "time\ns", "event\nindex", "connected", "cut", "energy lost\nJ"
    return Table(titles, rows, MOST_ROWS)


def joint_table(traj: Any) -> Table:
    """Return the range of each joint coordinate of one run over its save times.

    Quaternions, and coordinates of virtual links that are not cuttable joints, are left out.
    """
    names, q, v = traj.names, np.asarray(traj.states.q), np.asarray(traj.states.v)
    of_joints = {
        i
        for name, start, stop in names.q_ranges
        if name in names.joints or name in names.cuttable
        for i in range(start, stop)
    }
    rows = []
    for i, name in enumerate(names.q):
        if i not in of_joints or name not in names.v:
            continue
        k = names.v.index(name)
        ends = q[0, i], q[-1, i], q[:, i].min(), q[:, i].max(), np.abs(v[:, k]).max()
        # without the round-off of coordinates that are zero
        numbers = (number(np.round(x, 9) + 0.0) for x in ends)
        rows.append((name, "rad" if names.angular[k] else "m", *numbers))
    titles = "joint", "unit", "at the first\nsave time", "at the last", "min", "max"
    return Table((*titles, "largest speed\nunit/s"), rows, MOST_ROWS)


def batch_event_table(traj: Any) -> Table:
    """Return a row for each event of a batch: its lanes, its times, and the most frequent change.

    The change is that of all events at the instant.
    """
    lanes = np.size(traj.t_final)
    labels = link_labels(traj.names, np.shape(traj.connected)[-1])
    flat = lambda x: np.reshape(np.asarray(x), (lanes, *np.shape(x)[np.ndim(traj.t_final) :]))
    p, e = traj.phases, traj.events
    starts, connected, counts = map(flat, (p.start, p.connected, p.count))
    times, which, final = map(flat, (e.time, e.which, traj.final.structure.connected))
    occurrences = collections.defaultdict(list)
    for lane in range(lanes):
        own = starts[lane, : counts[lane]], connected[lane, : counts[lane]]
        for time, *masks in _changes(*own, times[lane], final[lane]):
            change = tuple(join_names(_of_mask(labels, mask)) for mask in masks)
            for event in which[lane, times[lane] == time].tolist():
                occurrences[event].append((time, lane, change))
    rows = []
    for event, own in sorted(occurrences.items()):
        t, in_lanes, changes = zip(*own, strict=True)
        change, _ = collections.Counter(changes).most_common(1)[0]
        shown = (f"{x:.6f}" for x in (min(t), np.median(t), max(t)))
        rows.append((str(event), *change, str(len(set(in_lanes))), *shown))
    titles = "event\nindex", "connected", "cut", "lanes", "first\ns", "median\ns", "last\ns"
    return Table(titles, rows, MOST_ROWS // 3)


def _changes(starts, connected, times, final) -> list[tuple[float, np.ndarray, np.ndarray]]:
    """Return (time, links that were connected, links that were cut) of each instant with events.

    starts, connected: of the phases of one run. times: of its events.
    final: which links are connected at the end of the run.
    """
    changes, instants = [], np.unique(times[np.isfinite(times)])
    for time in instants:
        old = connected[max(np.searchsorted(starts, time) - 1, 0)]
        # a phase starts at each instant, but not always after the last one
        last = time == instants[-1]
        new = final if last else connected[np.searchsorted(starts, time, "right") - 1]
        changes.append((float(time), new & ~old, old & ~new))
    return changes


def changes_of_run(traj: Any) -> list[tuple[float, np.ndarray, np.ndarray]]:
    """Return `_changes` of one run."""
    p, written = traj.phases, slice(int(traj.phases.count))
    final = traj.final.structure.connected
    records = p.start[written], p.connected[written], traj.events.time, final
    return _changes(*map(np.asarray, records))


def _of_mask(labels: tuple[str, ...], mask: Any) -> list[str]:
    """Return the labels that a mask selects."""
    return [label for label, on in zip(labels, np.asarray(mask), strict=True) if on]
