"""One phase of a run: vector field, steps, projection, event location, derivatives."""
