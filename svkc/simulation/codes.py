"""How a run ended (`RESULTS`), and whether the run has derivatives (`DERIVATIVE`).

Saved runs hold the names of the codes, so that codes may be added in any order.
"""

from typing import TYPE_CHECKING, Any

import equinox as eqx

from svkc import _deprecated
from svkc._jax.enumerations import connect_enumerations

if TYPE_CHECKING:  # as equinox annotates the metaclass of its enumerations
    from enum import EnumMeta

    class FormerMeta(EnumMeta):
        """The metaclass, with messages by member."""

        def __getitem__(cls, item: Any) -> str: ...  # pyright: ignore

    MovedMeta = FormerMeta
else:
    from svkc._jax.enumerations import FormerMeta, MovedMeta


class RESULTS(eqx.Enumeration, metaclass=FormerMeta):  # pyright: ignore
    """How a run ended, for each element of a batch."""

    successful = ""
    stopped = "An event stopped the run."
    max_events = (
        "More events than max_events: the run ended at the first event that has no row in the"
        " records, in the state before this event. Raise max_events, or look for chattering."
    )
    max_steps = "More steps than max_steps in one phase. Raise max_steps, or loosen rtol and atol."
    step_too_small = (
        "The step size fell to its lower bound: the problem is too stiff, or singular, for this"
        " solver and tolerance. Or a traced dt, rtol, atol or dtmax is not above zero."
    )
    not_in_place = (
        "An event connects a link at its declared placement, but the bodies were elsewhere. Use"
        " here=True, or a guard that waits until they are there."
    )
    loop_open = (
        "A loop is open by more than the tolerance. Use smaller steps, or projection; check the"
        " mobility and its margin there."
    )
    non_finite = "A non-finite number appeared."
    not_a_time = (
        "A time is not a number or infinite: the start or end of the run, a save time, or the time"
        " of an event. Nothing was run."
    )
    reversed = (
        "Times are out of order: t1, an event or a save time is before t0, or save times decrease."
        " Nothing was run."
    )
    not_positive_definite = (
        "A mass, inertia or armature of the chain is negative or not finite, so that the mass"
        " matrix is not positive definite. Nothing was run."
    )
    no_slot = (
        "An event makes a grip, but every spare slot was bound, or the slot that the grip names was"
        " connected: the grip was skipped, all other changes were made. Load with more spare slots,"
        " or unbind."
    )
    not_bound = (
        "An event connects a spare slot that is bound to no bodies. Bind the slot before, with"
        " svkc.bind, or in the event, with bind=svkc.Grip(..., slot=...)."
    )


class DERIVATIVE(eqx.Enumeration, metaclass=MovedMeta):  # pyright: ignore
    """Whether a run has derivatives, for each element of a batch, and why not."""

    successful = ""
    grazing = (
        "A guard touched zero without crossing it: the time of its event has no derivative;"
        " derivatives are NaN."
    )
    jump = "A guard jumped over zero: derivatives treat the time of its event as constant."
    together = (
        "Events happened at one instant: derivatives hold for this order of events, and do not"
        " exist if their times can separate."
    )
    rank_lost = (
        "The loops lose rank at an end of a phase: derivatives across that end are unreliable."
    )


connect_enumerations(RESULTS, DERIVATIVE, _deprecated.warn_of_results)

# Enumeration of each field of `Trajectory` and `Report` that holds a code.
CODES: dict[str, Any] = {"result": RESULTS, "derivative": DERIVATIVE}
