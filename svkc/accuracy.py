"""How accurate a run is, and which options are fastest at a given accuracy."""

from svkc.tools.accuracy import (
    Candidate as Candidate,
    Tuning as Tuning,
    configuration_error as configuration_error,
    estimate_error as estimate_error,
    tune as tune,
)
