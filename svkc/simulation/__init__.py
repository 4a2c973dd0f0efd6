"""A run: options, phases, events applied, records, certificate, trajectory, files."""
