"""Event location: guards and the search for their roots.

The search is a state machine that consumes one evaluation of the guards per call. The stepping
loop evaluates the guards, so that the compiled loop contains one step of the solver only.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from svkc._jax.pytrees import tree_where
from svkc._jax.select import where
from svkc.integration.bracket import Bracket
from svkc.integration.ode import FieldArgs, ODEState
from svkc.integration.vector_field import VectorField
from svkc.model.annotations import Scalar
from svkc.model.chain import State
from svkc.model.validation import as_array, description
from svkc.transitions.plan import Plan

# A guard only touches zero (grazes) if, at its rate there, it would change over a step by less than
# this fraction of its magnitude. A guard jumps only if it exceeds this fraction after the root.
GRAZING_THRESHOLD = 1e-5


class GuardValues(eqx.Module):
    """The values of all guards of a plan, as a function of time, state and field arguments.

    Torques are evaluated only if a guard needs them.
    """

    plan: Plan
    field: VectorField

    def __call__(self, t: Scalar, y: ODEState, field_args: FieldArgs) -> Float[Array, " guards"]:
        chain, state = field_args.chain, State(y.q, y.v, field_args.structure)
        guards = self.plan.guards
        tau = (
            self.field.torques(t, y, field_args)[0]
            if any(g.needs_torques for g in guards)
            else jnp.zeros_like(y.v)
        )
        values = [g.value(chain, t, state, field_args.args, tau) for g in guards]
        numbers = zip(self.plan.guarded, values, strict=True)
        return jnp.stack([_guard_value(event, x, y.q.dtype) for event, x in numbers])


def _guard_value(event: int, value, dtype) -> Float[Array, ""]:
    """Return a guard's value as an array. Integers are refused: they jump over zero.

    event: index of the guard's event in the list that `simulate` was given.
    """
    number = as_array(value)
    if number.shape != () or not jnp.issubdtype(number.dtype, jnp.floating):
        raise ValueError(
            f"events[{event}]: expected guard(t, state, args) to return one floating-point number,"
            f" got {description(value)}"
        )
    return jnp.asarray(number, dtype)


class EventInfo(eqx.Module):
    """The outcome of an event search.

    fired: guards that crossed zero at the event.
    values: values of the guards for the next phase, 0 for those that fired.
    first: index of the guard whose root was located.
    occurred: whether an event ended the phase. `first` is valid only then.
    jumps: whether guard `first` is discontinuous there.
    grazing: whether guard `first` touches zero without crossing it.
    """

    fired: Bool[Array, " guards"]
    values: Float[Array, " guards"]
    first: Int[Array, ""]
    occurred: Bool[Array, ""]
    jumps: Bool[Array, ""]
    grazing: Bool[Array, ""]


def event_tolerance(t: Float[Array, ""]) -> Float[Array, ""]:
    """Return the time (s) within which events are simultaneous with the earliest one.

    sqrt(eps), 1.5e-8 in float64, absolute up to t = 1 s and relative beyond.
    """
    return jnp.finfo(t.dtype).eps ** 0.5 * jnp.maximum(1, jnp.abs(t))


def vector_field_of(guards: GuardValues | VectorField) -> VectorField:
    """Return the vector field of the guards, or the argument if there are no guards."""
    return guards if isinstance(guards, VectorField) else guards.field


class ArmedGuards(eqx.Module):
    """The guards of a phase.

    initial_values: values at the start of the phase.
    armed: mask of the guards that may end the phase.
    """

    evaluate: GuardValues
    initial_values: Float[Array, " guards"]
    armed: Bool[Array, " guards"]


class EventSearch(eqx.Module):
    """The search for the first root of the guards in the step that starts at the loop's t.

    step_size: size of that step.
    sides: for each guard that crossed zero, its sign after the crossing; 0 for all others.
    magnitudes: larger of the absolute values of each guard at the two ends of the step.
    bracket: interval that holds the first root of the guards that crossed.
    y, values: state and guards at `bracket.b`.
    is_new: whether `y` and `values` come from the last attempted step.
    values_after: guards just after `bracket.b`, valid once the search is done.
    active: whether a search is under way.
    narrowing: whether the bracket has yet to converge.
    done: whether the search has just ended.
    retry_time: end of the next step if a guard crossed zero several times in the last; else inf.
    """

    step_size: Float[Array, ""]
    sides: Float[Array, " guards"]
    magnitudes: Float[Array, " guards"]
    bracket: Bracket
    y: ODEState
    values: Float[Array, " guards"]
    is_new: Bool[Array, ""]
    values_after: Float[Array, " guards"]
    active: Bool[Array, ""]
    narrowing: Bool[Array, ""]
    done: Bool[Array, ""]
    retry_time: Float[Array, ""]

    @staticmethod
    def inactive(
        t0: Float[Array, ""], y: ODEState, values: Float[Array, " guards"]
    ) -> "EventSearch":
        """Return the search before any guard has crossed zero."""
        no = jnp.zeros((), bool)
        return EventSearch(
            step_size=t0,
            sides=jnp.zeros_like(values),
            magnitudes=values,
            bracket=Bracket.around(t0, t0, t0, t0),
            y=y,
            values=values,
            is_new=no,
            values_after=values,
            active=no,
            narrowing=no,
            done=no,
            retry_time=jnp.full_like(t0, jnp.inf),
        )

    def end_of_attempt(self, tnext: Float[Array, ""]) -> Float[Array, ""]:
        """Return the end of the next attempted step.

        A search evaluates guards in the bracket and, once converged, just after its right end.

        tnext: end of the next step if there is neither a search nor a shorter step to take.
        """
        b = self.bracket.b
        locate = where(self.narrowing, self.bracket.next_point(), b + event_tolerance(b))
        return where(self.active, locate, jnp.minimum(tnext, self.retry_time))


def update_search(
    old: EventSearch,
    before: Float[Array, " guards"],
    values: Float[Array, " guards"],
    *,
    t0: Float[Array, ""],
    t1: Float[Array, ""],
    y: ODEState,
    keep_step: Bool[Array, ""],
    retry_time: Float[Array, ""],
    armed_guards: ArmedGuards,
) -> tuple[Float[Array, " guards"], EventSearch]:
    """Advance the event search after an attempted step from t0 to t1.

    A search starts if a guard crosses zero in a step that is kept, narrows its bracket, and ends
    with one evaluation after the root. Return the guards and the search. The guards are those at t1
    or, once the search is done, at the root.

    before, values: of the guards at t0 and t1.
    y: state at t1.
    keep_step: whether the step is kept.
    retry_time: as in `EventSearch`.
    """
    crossed = armed_guards.evaluate.plan.crossed(before, values)
    crossed = crossed & armed_guards.armed & keep_step & ~old.active
    starts = jnp.any(crossed)
    new_sides = where(crossed, where(values >= before, 1, -1), 0).astype(values.dtype)
    sides = where(starts, new_sides, old.sides)
    # The largest of `sides * x` is negative until the first of these guards crosses zero.
    f0, f1 = (jnp.max(where(sides != 0, sides * x, -jnp.inf)) for x in (before, values))
    bracket = tree_where(old.narrowing, old.bracket.update(t1, f1), old.bracket)
    bracket = tree_where(starts, Bracket.around(t0, t1, f0, f1), bracket)
    at_right_end = starts | (old.narrowing & (f1 >= 0))
    done = old.active & ~old.narrowing
    active = starts | (old.active & ~done)
    search = EventSearch(
        step_size=where(starts, t1 - t0, old.step_size),
        sides=sides,
        magnitudes=where(starts, jnp.maximum(abs(before), abs(values)), old.magnitudes),
        bracket=bracket,
        y=tree_where(at_right_end, y, old.y),
        values=where(at_right_end, values, old.values),
        is_new=at_right_end,
        values_after=where(done, values, old.values_after),
        active=active,
        narrowing=active & bracket.not_converged(),
        done=done,
        retry_time=retry_time,
    )
    return where(done, search.values, values), search


def event_info(
    search: EventSearch, guard_values: Float[Array, " guards"], t: Float[Array, ""]
) -> EventInfo:
    """Return which guards fired in a search that ended at t.

    guard_values: values of the guards at t.
    """
    crossed, beyond = search.sides != 0, search.sides * search.values
    first = jnp.argmax(where(crossed, beyond, -jnp.inf)).astype(jnp.int32)
    crossed_after = crossed & (search.sides * search.values_after >= 0)
    fired = crossed_after | (jnp.arange(crossed.shape[0], dtype=jnp.int32) == first)
    fired = fired & search.done
    value, threshold = jnp.abs(beyond[first]), GRAZING_THRESHOLD * search.magnitudes[first]
    change = jnp.abs(search.values_after - search.values)[first]
    jumps = search.done & (value > change) & (value > threshold)
    change_in_step = change / event_tolerance(t) * search.step_size
    return EventInfo(
        fired=fired,
        # A guard at zero is not armed until it has left zero.
        values=where(fired, 0, guard_values),
        first=first,
        occurred=search.done,
        jumps=jumps,
        grazing=search.done & ~jumps & (change_in_step < threshold),
    )
