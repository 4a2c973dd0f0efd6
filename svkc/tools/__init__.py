"""Tools built on runs: batches, accuracy and tuning, gradient checks."""
