"""What several commands print: the report of a run, and why a command failed."""


def print_report(chain, traj):
    """Print a table of the phases, the times of the events (s), and the run's report.

    Phases of zero duration after the first one are left out.
    """
    p, report = traj.phases, traj.report()
    names = {
        i: (
            ", ".join(n for n, on in zip(chain.link_names, p.connected[i], strict=True) if on)
            or "nothing"
        )
        for i in range(int(p.count))
    }
    width = max(34, *map(len, names.values()))
    print(
        f"      from        to  {'held by':<{width}} joint   rank  mobility   steps  energy drift"
    )
    print(f"         s         s  {'':<{width}} freedoms                           J")
    for i in range(int(p.count)):
        if float(p.start[i]) == float(p.stop[i]) and i:
            continue
        print(
            f"{float(p.start[i]):10.6f}{float(p.stop[i]):10.6f} "
            f" {names[i]:<{width}}{int(p.joint_freedoms[i]):6d}{int(p.rank[i]):7d}"
            f"{int(p.freedoms[i]):10d}{int(p.accepted[i]):8d}{float(p.energy_drift[i]):14.2e}"
        )
    times = ", ".join(f"{float(t):.6f} s" for t in traj.events.time[: int(traj.events.count)])
    print(f"events at {times or 'no time'}; energy at the start {float(p.energy[0, 0]):.3f} J")
    print(report)


def print_error(error: Exception, command: str, ignored: tuple[str, ...]):
    """Print why a command failed; if elements of the model are not simulated, with the option that
    leaves them out.

    ignored: kinds that the command was told to ignore.
    """
    print(error)
    kinds = getattr(error, "kinds", ())
    if kinds:
        kept = [kind for kind in ignored if kind not in kinds]
        print(f"On the command line: {command} --ignore {','.join([*kept, *kinds])}")
