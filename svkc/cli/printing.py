"""What several commands print: the report of a run, and why a command failed."""

from svkc.simulation.trajectory import Trajectory


def print_report(traj: Trajectory) -> None:
    """Print tables of the phases and of the events of a run, and the run's report."""
    from svkc.model.tables import as_text
    from svkc.simulation.run_tables import event_table, phase_table

    tables = [phase_table(traj.phases, traj.names)]
    if traj.events.count:
        tables.append(event_table(traj))
    energy = f"energy at the start {float(traj.phases.energy[0, 0]):.3f} J"
    print(as_text([*tables, energy, str(traj.report())]))


def print_error(error: Exception, command: str, ignored: tuple[str, ...]) -> None:
    """Print why a command failed; if elements of the model are not simulated, with the option that
    leaves them out.

    ignored: kinds that the command was told to ignore.
    """
    print(error)
    kinds = getattr(error, "kinds", ())
    if kinds:
        kept = [kind for kind in ignored if kind not in kinds]
        print(f"On the command line: {command} --ignore {','.join([*kept, *kinds])}")
