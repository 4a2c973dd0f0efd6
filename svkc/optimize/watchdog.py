"""The watchdog: full steps on trial after many shortened ones.

Chamberlain, Powell, Lemarechal and Pedersen (1982), "The watchdog technique for forcing convergence
in algorithms for constrained optimization".
"""

import dataclasses
from typing import Any

import numpy as np

from svkc.optimize.filter_line_search import Accepted, LineSearch, Reference, Step

# shortened steps after which full steps are tried, and number of full steps
_SHORTENED, _TRIALS = 10, 3
# part of the largest step length below which a step counts as shortened
_FULL = 0.99


@dataclasses.dataclass
class _Attempt:
    """An attempt: where it began, the step from there, the barrier parameter, trials left."""

    state: Any
    step: Step
    origin: Reference
    parameter: float
    left: int


class Watchdog:
    """Line search that tries full steps after ten shortened ones.

    If none of four full steps gives a point that is accepted in comparison with the first, the
    method goes back to the first.

    search: the line search.
    """

    def __init__(self, search: LineSearch):
        self._search = search
        self._shortened = 0
        self._attempt: _Attempt | None = None

    @property
    def active(self) -> bool:
        """Whether full steps are on trial."""
        return self._attempt is not None

    def stop(self) -> None:
        """End an attempt."""
        self._attempt, self._shortened = None, 0

    def take(self, state: Any, step: Step) -> tuple[Any, Step, Accepted | None]:
        """Return (state, step, accepted step): of this iterate, or of the one that it returns to.

        state: what the method restores if it goes back.
        """
        search = self._search
        search.by_filter = search.tiny = False
        if self._attempt is not None and self._attempt.parameter != search.barrier.parameter:
            self.stop()
        accepted = None
        if self._attempt is not None:
            accepted = self._continued(step, self._attempt.origin)
            if accepted is None and self._attempt is not None:
                state, step = self._attempt.state, self._attempt.step
                search.system.factor(step.terms, *step.shifts)
                self.stop()
        elif self._shortened >= _SHORTENED:
            self._attempt = _Attempt(
                state=state,
                step=step,
                origin=search.reference(step),
                parameter=search.barrier.parameter,
                left=_TRIALS,
            )
            accepted = self._first(step, self._attempt.origin)
        if accepted is None:
            accepted = search.search(step)
        if accepted is not None and self._attempt is None:
            is_short = accepted.length < _FULL * step.length
            self._shortened = self._shortened + 1 if is_short else 0
        return state, step, accepted

    def _first(self, step: Step, origin: Reference) -> Accepted | None:
        """Return the full step that begins an attempt; None: the line search accepts it itself."""
        w = step.at.w + step.length * step.d
        trial = self._search.trial(w, origin)
        if trial.accepted or not self._possible(w, trial.theta):
            self.stop()
            return None
        return self._full(step, w)

    def _continued(self, step: Step, origin: Reference) -> Accepted | None:
        """Return the full step, or None if the attempt has failed."""
        assert self._attempt is not None
        w = step.at.w + step.length * step.d
        trial = self._search.trial(w, origin)
        if trial.accepted:
            if trial.augments:
                self._search.filter.add(origin.theta, origin.cost)
            self.stop()
            return Accepted(w, step.dy, step.length)
        return (
            self._full(step, w) if self._attempt.left and self._possible(w, trial.theta) else None
        )

    def _full(self, step: Step, w: np.ndarray) -> Accepted:
        """Return a full step on trial."""
        assert self._attempt is not None
        self._attempt.left -= 1
        return Accepted(w, step.dy, step.length)

    def _possible(self, w: np.ndarray, theta: float) -> bool:
        """Return whether the functions are finite at a trial point."""
        return bool(np.isfinite(theta) and np.isfinite(self._search.barrier.cost(w)))
