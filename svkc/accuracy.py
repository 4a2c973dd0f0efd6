"""How accurate a run is, and which options are fastest at a given accuracy."""

from svkc.tools.accuracy import (
    Candidate as Candidate,
    Tuning as Tuning,
    error_between as configuration_error,
    halved as estimate_error,
    tune as tune,
)
