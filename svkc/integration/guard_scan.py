"""Guards within a step: crossings of zero that the values at the two ends of the step do not show.

A guard that crosses zero twice within a step has one sign at both ends. `locate_event` scans the
guards along the dense output of a kept step, by smaller intervals where a guard may turn back to
zero between two points. If a guard crosses zero more than once, the step is rejected, and the next
one ends at the first scanned point past the first of these crossings. That step has one crossing,
which `EventSearch` locates between states that the solver stepped to, so that the time of an event
does not depend on the dense output.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from svkc._jax.pytrees import tree_where
from svkc._jax.select import where
from svkc.integration.dense_output import ProjectedInterpolation
from svkc.integration.event_location import (
    EventSearch,
    GuardValues,
    event_tolerance,
    update_search,
)
from svkc.integration.ode import Guards, ODEState, Time
from svkc.integration.solution import (
    NON_FINITE,
    PhaseProblem,
    StepAttempt,
    StepperOptions,
    StepperState,
)
from svkc.transitions.plan import guard_round_off
from svkc.tree.configuration import normalize

# Intervals of a kept step before any is halved; guards are evaluated at their ends and midpoints.
INTERVALS = 4
# Their number if a guard needs torques, as such a guard costs an evaluation of the dynamics.
INTERVALS_WITH_TORQUES = 1
# Largest fraction of the step within which a change of sign may count as one crossing.
CROSSING_INTERVAL = 2.0**-6
# Intervals of this fraction of the step, or less, are not halved.
SMALLEST_INTERVAL = 2.0**-17
# Evaluations in a step after which no interval is halved. A parabola that touches zero takes 80.
MAX_EVALUATIONS = 100


class GuardScan(eqx.Module):
    """The scan of the guards along a step, by intervals from its start to its end.

    Times are fractions of the step.

    left, right: ends of the interval.
    at_left, at_right: guards there. `at_right` is valid if `has_right`.
    middle, at_middle: midpoint of the interval before this one, and guards there. `middle` is
        `left` at the start of the step and while an earlier interval is scanned again.
    at_end: guards at the end of the step.
    sides: sign of each guard at the last point at which it was not zero.
    changes: how often the sign of each guard has changed.
    first_change: first point at which the sign had changed, inf before.
    count: number of evaluations.
    done: whether the scan has reached the end of the step.
    """

    left: Float[Array, ""]
    right: Float[Array, ""]
    at_left: Float[Array, " guards"]
    at_right: Float[Array, " guards"]
    middle: Float[Array, ""]
    at_middle: Float[Array, " guards"]
    at_end: Float[Array, " guards"]
    has_right: Bool[Array, ""]
    sides: Int[Array, " guards"]
    changes: Int[Array, " guards"]
    first_change: Float[Array, " guards"]
    count: Int[Array, ""]
    done: Bool[Array, ""]

    @staticmethod
    def from_end(before: Guards, at_end: Guards, intervals: int) -> "GuardScan":
        """Return the scan before its first interval.

        before, at_end: guards at the two ends of the step.
        intervals: number of intervals before any is halved.
        """
        zero = jnp.zeros((), at_end.dtype)
        return GuardScan(
            left=zero,
            right=zero + 1 / intervals,
            at_left=before,
            at_right=at_end,
            middle=zero,
            at_middle=before,
            at_end=at_end,
            has_right=jnp.asarray(intervals == 1),
            sides=_signs(before),
            changes=jnp.zeros(before.shape, jnp.int32),
            first_change=jnp.full_like(before, jnp.inf),
            count=jnp.ones((), jnp.int32),
            done=jnp.zeros((), bool),
        )

    def next_point(self) -> Float[Array, ""]:
        """Return the point of the next evaluation: the interval's right end, then its midpoint."""
        return where(self.has_right, (self.left + self.right) / 2, self.right)

    def update(self, values: Guards, armed: Bool[Array, " guards"], intervals: int) -> "GuardScan":
        """Return the scan after an evaluation at `next_point`.

        values: guards at this point.
        armed: mask of the guards that may end the phase.
        """
        point, at_right = self.next_point(), where(self.has_right, self.at_right, values)
        width = self.right - self.left
        hides = armed & _may_hide_crossings(
            (self.at_left, values, at_right), width, self.round_off()
        )
        may_halve = self.has_right & (width > SMALLEST_INTERVAL) & (self.count < MAX_EVALUATIONS)
        # Scan the second half of the interval before this one again.
        back = may_halve & jnp.any(self._bends_behind(values, point) & armed)
        halve = may_halve & jnp.any(hides) & ~back
        advance = self.has_right & ~halve & ~back
        scan = self._count_changes(values, point, advance)
        scan = scan._count_changes(at_right, self.right, advance)
        # After an interval without hidden crossings the next one is twice as wide.
        next_width = jnp.minimum(2 * width, 1 / intervals)
        next_right = self.right + next_width
        is_last = next_right + next_width / 2 > 1
        next_right = where(is_last, 1, next_right)
        choose = lambda advanced, halved, backed, same: where(
            advance, advanced, where(halve, halved, where(back, backed, same))
        )
        left, right, at_left = self.left, self.right, self.at_left
        return dataclasses.replace(
            scan,
            left=choose(right, left, self.middle, left),
            right=choose(next_right, point, left, right),
            at_left=choose(at_right, at_left, self.at_middle, at_left),
            at_right=choose(self.at_end, values, at_left, at_right),
            middle=choose(point, self.middle, self.middle, self.middle),
            at_middle=choose(values, self.at_middle, self.at_middle, self.at_middle),
            has_right=where(advance, is_last, True),
            count=self.count + 1,
            done=advance & (right >= 1),
        )

    def _bends_behind(self, values, point) -> Bool[Array, " guards"]:
        """Return which guards may cross zero between `middle` and `left` unseen.

        Where a kink and a curvature cancel in the second difference about `middle`, the one about
        `left` shows the kink. values: of the guards at `point`, the midpoint of this interval.
        """
        width = self.left - self.middle
        slope = (self.at_left - self.at_middle) / where(width == 0, 1, width)
        bend = jnp.abs((values - self.at_left) / (point - self.left) - slope) * width
        near = jnp.minimum(jnp.abs(self.at_middle), jnp.abs(self.at_left))
        one_sign = (self.at_middle * self.at_left > 0) & (self.at_left * values > 0)
        wide = width > SMALLEST_INTERVAL
        return wide & one_sign & (near < 2 * bend) & (bend > self.round_off())

    def round_off(self) -> Float[Array, " guards"]:
        """Return the magnitudes below which guards count as zero between the ends of the step."""
        magnitudes = jnp.maximum(jnp.abs(self.at_end), jnp.abs(self.at_left))
        return jnp.finfo(magnitudes.dtype).eps ** 0.75 * magnitudes

    def _count_changes(self, values, point, active) -> "GuardScan":
        """Return the scan with changes of sign at a point counted where `active` holds."""
        beyond = (point >= 1) | (jnp.abs(values) > self.round_off())
        signs = where(beyond & active, _signs(values), 0)
        changed = (signs != 0) & (signs != self.sides)
        return dataclasses.replace(
            self,
            sides=where(changed, signs, self.sides),
            changes=self.changes + changed.astype(jnp.int32),
            first_change=where(changed, jnp.minimum(self.first_change, point), self.first_change),
        )


def _signs(values: Float[Array, " guards"]) -> Int[Array, " guards"]:
    """Return 1, -1 or 0 for each value; 0 where a value is NaN."""
    return (values > 0).astype(jnp.int32) - (values < 0).astype(jnp.int32)


def _may_hide_crossings(values, width, round_off) -> Bool[Array, " guards"]:
    """Return which guards may cross zero unseen within an interval.

    The second difference, `bend`, bounds how far a guard departs from its chords: a parabola by an
    eighth of `bend`, two straight lines with a kink by at most `bend`. A guard of one sign hides no
    crossing if its least absolute value exceeds 2 `bend`; the factor 2 allows for a bend that
    varies. A guard that changes sign hides none if the interval is short, and if a parabola with
    twice this bend would still be monotonic.

    values: of the guards at the ends and at the midpoint of the interval.
    width: of the interval.
    """
    left, middle, right = values
    rise, rise_after = middle - left, right - middle
    bend = jnp.abs(rise_after - rise)
    values = jnp.stack(values)
    changes_sign = (jnp.min(values, 0) < 0) & (jnp.max(values, 0) > 0)
    # Three points alone do not tell one crossing from three that lie symmetrically.
    monotonic = (
        (rise * rise_after > 0)
        & (bend < jnp.minimum(jnp.abs(rise), jnp.abs(rise_after)))
        & (width <= CROSSING_INTERVAL)
    )
    least = jnp.min(where(values == 0, jnp.inf, jnp.abs(values)), 0)
    return where(changes_sign, ~monotonic, (least < 2 * bend) & (bend > round_off))


def _scan_step(
    s: StepperState, attempt: StepAttempt, t1, problem: PhaseProblem, options: StepperOptions
) -> GuardScan:
    """Return the scan of the guards along an attempted step to t1.

    Guards are evaluated at t1 if the step is kept or a root is being located. They are evaluated
    along the step if it is kept, no root is being located, and a guard is armed.
    """
    assert s.search is not None
    assert options.armed_guards is not None
    assert s.guard_values is not None
    assert attempt.interpolation is not None
    before, guards, search = s.guard_values, options.armed_guards, s.search
    interpolation, field_args = attempt.interpolation, problem.field_args
    intervals = _intervals(guards.evaluate)
    along = attempt.keep_step & ~search.active & jnp.any(guards.armed)
    # A guard at zero stays zero, and cannot cross, until it has left zero by more than round-off.
    round_off = guard_round_off(before.dtype)

    def cond_fun(scan: GuardScan):
        at_end = (scan.count == 0) & (attempt.keep_step | search.active)
        return at_end | ((scan.count > 0) & along & ~scan.done)

    def body_fun(scan: GuardScan):
        at_end, point = scan.count == 0, scan.next_point()
        t = where(at_end, t1, s.t + point * (t1 - s.t))
        y = tree_where(at_end, attempt.y, _state_within(interpolation, t, field_args.chain))
        values = guards.evaluate(t, y, field_args)
        values = where((before == 0) & (jnp.abs(values) < round_off), 0, values)
        start = GuardScan.from_end(before, values, intervals)
        return tree_where(at_end, start, scan.update(values, guards.armed, intervals))

    start = GuardScan.from_end(before, before, intervals)
    start = dataclasses.replace(start, count=jnp.zeros((), jnp.int32))
    return jax.lax.while_loop(cond_fun, body_fun, start)


def _intervals(guards: GuardValues) -> int:
    """Return the number of intervals of a kept step before any is halved."""
    needs_torques = any(g.needs_torques for g in guards.plan.guards)
    return INTERVALS_WITH_TORQUES if needs_torques else INTERVALS


def _state_within(interpolation: ProjectedInterpolation, t, chain) -> ODEState:
    """Return the state within a step, with quaternions normalized."""
    y = interpolation.evaluate(t)
    return eqx.tree_at(lambda y: y.q, y, normalize(chain, y.q))


def locate_event(
    s: StepperState, attempt: StepAttempt, t1: Time, problem: PhaseProblem, options: StepperOptions
) -> tuple[StepAttempt, Array, EventSearch, Array]:
    """Evaluate the guards after an attempt to t1 and advance the event search.

    Return the attempt with the decision of the search, the values of the guards, the search, and
    whether the loop keeps the step size and the controller's state: while a root is being located,
    and while a step is divided because a guard crosses zero several times.
    """
    assert s.search is not None
    assert s.guard_values is not None
    assert options.armed_guards is not None
    scan = _scan_step(s, attempt, t1, problem, options)
    armed = options.armed_guards.armed
    is_nan = attempt.keep_step & jnp.any(jnp.isnan(scan.at_end) & armed)
    several = armed & (scan.changes > 1)
    first = jnp.min(where(several, scan.first_change, jnp.inf))
    shorter = s.t + first * (t1 - s.t)
    # Crossings closer than simultaneous events are not separated.
    divide = (first < 1) & (shorter - s.t > event_tolerance(s.t)) & ~is_nan
    guard_values, search = update_search(
        s.search,
        s.guard_values,
        scan.at_end,
        t0=s.t,
        t1=t1,
        y=attempt.y,
        keep_step=attempt.keep_step & ~divide,
        retry_time=where(divide, shorter, jnp.inf),
        armed_guards=options.armed_guards,
    )
    locating = s.search.active | search.active
    land = search.done & ~is_nan
    advance = (attempt.keep_step & ~is_nan & ~locating & ~divide) | land
    hold = (locating | divide | (jnp.isfinite(s.search.retry_time) & advance)) & ~is_nan
    t, y = tree_where(land, (search.bracket.b, search.y), (attempt.t, attempt.y))
    result = where(is_nan, NON_FINITE, attempt.result)
    attempt = dataclasses.replace(attempt, t=t, y=y, keep_step=advance, result=result)
    return attempt, guard_values, search, hold
