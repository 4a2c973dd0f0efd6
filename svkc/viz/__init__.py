"""Pictures of runs: strobe, animation, plots, HTML page."""
