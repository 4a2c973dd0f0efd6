"""Event location: guards, the bracket about a root, and the search for the root.

The search is a state machine that is advanced by one evaluation of the guards; the stepping loop
makes the evaluations.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from svkc._jax.pytrees import tree_where
from svkc.integration.ode import FieldArgs, ODEState
from svkc.integration.vector_field import VectorField
from svkc.model.chain import State
from svkc.model.validation import scalar
from svkc.transitions.plan import Plan

# how often a bracket may be narrowed
MAX_ITERATIONS = 200


class Bracket(eqx.Module):
    """Two times, at the first a function is below zero, at the second not: narrowed to round-off by
    false position with the Illinois weight, every third time by bisection. `fine`: how narrow;
    `last`: which end has moved (1: b, -1: a)."""

    a: Float[Array, ""]
    b: Float[Array, ""]
    fa: Float[Array, ""]
    fb: Float[Array, ""]
    tol: Float[Array, ""]
    last_side: Int[Array, ""]
    count: Int[Array, ""]

    @staticmethod
    def around(a, b, fa, fb) -> "Bracket":
        """From the two times and the function there."""
        eps = jnp.finfo(fb.dtype).eps
        fine = 2 * eps * jnp.maximum(jnp.abs(a), jnp.abs(b)) + eps * (b - a)
        zero = jnp.zeros((), jnp.int32)
        return Bracket(a=a, b=b, fa=fa, fb=fb, tol=fine, last_side=zero, count=zero)

    def not_converged(self) -> Bool[Array, ""]:
        """Whether to go on."""
        return (self.b - self.a > self.tol) & (self.count < MAX_ITERATIONS)

    def next_point(self) -> Float[Array, ""]:
        """The time to look at next."""
        weight = self.fb - self.fa
        secant = self.b - self.fb * (self.b - self.a) / jnp.where(weight == 0, 1, weight)
        c = jnp.where((self.count % 3 == 2) | (weight == 0), self.a + (self.b - self.a) / 2, secant)
        return jnp.clip(c, self.a + self.tol / 4, self.b - self.tol / 4)

    def update(self, c, fc) -> "Bracket":
        """With what the function is at c."""
        right = fc >= 0
        fa = jnp.where(right & (self.last_side == 1), self.fa / 2, self.fa)
        fb = jnp.where(~right & (self.last_side == -1), self.fb / 2, self.fb)
        return Bracket(
            a=jnp.where(right, self.a, c),
            b=jnp.where(right, c, self.b),
            fa=jnp.where(right, fa, fc),
            fb=jnp.where(right, fc, fb),
            tol=self.tol,
            last_side=jnp.where(right, 1, -1).astype(jnp.int32),
            count=self.count + 1,
        )


# a guard that at the rate it crosses zero with would change this little over a step, measured by
# its size, touches zero rather than crosses it
GRAZING_THRESHOLD = 1e-5


class GuardValues(eqx.Module):
    """The values of all guards. Torques are evaluated where one of the guards needs them."""

    plan: Plan
    field: VectorField

    def __call__(self, t, y: ODEState, scene: FieldArgs) -> Float[Array, " guards"]:
        state = State(y.q, y.v, scene.structure)
        guards = self.plan.guards
        tau = (
            self.field.torques(t, y, scene)[0]
            if any(g.needs_torques for g in guards)
            else jnp.zeros_like(y.v)
        )
        values = [g.value(scene.chain, t, state, scene.args, tau) for g in guards]
        return jnp.stack([jnp.asarray(scalar("guard", x), y.q.dtype) for x in values])


class EventInfo(eqx.Module):
    """The guards that fired, which guard values go on, the first guard, whether there was one, it
    jumped over zero, or it only touched it."""

    fired: Bool[Array, " guards"]
    values: Float[Array, " guards"]
    first: Int[Array, ""]
    occurred: Bool[Array, ""]
    jumps: Bool[Array, ""]
    grazing: Bool[Array, ""]


def event_tolerance(t: Float[Array, ""]) -> Float[Array, ""]:
    """Events this close (s) to the earliest happen together with it: sqrt(eps), 1.5e-8 in float64,
    relative from t = 1 s on."""
    return jnp.finfo(t.dtype).eps ** 0.5 * jnp.maximum(1, jnp.abs(t))


def vector_field_of(guards: GuardValues | VectorField) -> VectorField:
    """Return the field of the guards, or the field itself where there are no guards."""
    return guards if isinstance(guards, VectorField) else guards.field


class ArmedGuards(eqx.Module):
    """Guards, their values at the start of a phase, and which of them may end it."""

    evaluate: GuardValues
    initial_values: Float[Array, " guards"]
    armed: Bool[Array, " guards"]


class EventSearch(eqx.Module):
    """For the first zero in the step from the loop's t, over a span of time: guards that crossed
    it, by the side they are on then, and their sizes; the bracket and, at its right end, the motion
    and the guards; the guards just after that. on: begun; narrow: the bracket is to be made smaller
    yet."""

    step_size: Float[Array, ""]
    sides: Float[Array, " guards"]
    magnitudes: Float[Array, " guards"]
    bracket: Bracket
    y: ODEState
    values: Float[Array, " guards"]
    values_after: Float[Array, " guards"]
    active: Bool[Array, ""]
    narrowing: Bool[Array, ""]
    done: Bool[Array, ""]

    def next_time(self) -> Float[Array, ""]:
        """The time to be looked at next."""
        b = self.bracket.b
        return jnp.where(self.narrowing, self.bracket.next_point(), b + event_tolerance(b))


def update_search(
    old: EventSearch,
    before: Float[Array, " guards"],
    *,
    t0,
    t1,
    y: ODEState,
    keep,
    scene: FieldArgs,
    watched: ArmedGuards,
) -> tuple[Float[Array, " guards"], EventSearch]:
    """The guards after a try of a step from t0 to t1, and the search for their first zero: begun,
    narrowed, or done once they are known just after it.

    before: the guards at t0; y: where the try has led to; keep: whether the step holds.
    """
    values = watched.evaluate(t1, y, scene)
    # a guard at zero is not armed before it has left it by more than round-off
    values = jnp.where(
        (before == 0) & (jnp.abs(values) < jnp.finfo(values.dtype).eps ** 0.75), 0, values
    )
    crossed = watched.evaluate.plan.crossed(before, values) & watched.armed & keep & ~old.active
    begun = jnp.any(crossed)
    side = jnp.where(
        begun,
        jnp.where(crossed, jnp.where(values >= before, 1, -1), 0).astype(values.dtype),
        old.sides,
    )
    # the largest of the guards that crossed: positive where one has
    passed = lambda values: jnp.max(jnp.where(side != 0, side * values, -jnp.inf))
    bracket = tree_where(old.narrowing, old.bracket.update(t1, passed(values)), old.bracket)
    bracket = tree_where(begun, Bracket.around(t0, t1, passed(before), passed(values)), bracket)
    at_right = begun | (old.narrowing & (passed(values) >= 0))
    done = old.active & ~old.narrowing
    on = begun | (old.active & ~done)
    search = EventSearch(
        step_size=jnp.where(begun, t1 - t0, old.step_size),
        sides=side,
        magnitudes=jnp.where(begun, jnp.maximum(jnp.abs(before), jnp.abs(values)), old.magnitudes),
        bracket=bracket,
        y=tree_where(at_right, y, old.y),
        values=jnp.where(at_right, values, old.values),
        values_after=jnp.where(done, values, old.values_after),
        active=on,
        narrowing=on & bracket.not_converged(),
        done=done,
    )
    return jnp.where(done, search.values, values), search


def event_info(search: EventSearch, guards: Float[Array, " guards"], t) -> EventInfo:
    """Which guards fired, where a search that ended at t has looked for that. guards: their values
    there."""
    crossed, passed = search.sides != 0, search.sides * search.values
    first = jnp.argmax(jnp.where(crossed, passed, -jnp.inf)).astype(jnp.int32)
    fired = (crossed & (search.sides * search.values_after >= 0)) | (
        jnp.arange(crossed.shape[0], dtype=jnp.int32) == first
    )
    value, grown, large = (
        jnp.abs(passed[first]),
        jnp.abs(search.values_after - search.values)[first],
        GRAZING_THRESHOLD * search.magnitudes[first],
    )
    jumps = search.done & (value > grown) & (value > large)
    flat = search.done & ~jumps & (grown / event_tolerance(t) * search.step_size < large)
    fired = fired & search.done
    # zero: not armed, until it has left zero
    values = jnp.where(fired, 0, guards)
    return EventInfo(
        fired=fired, values=values, first=first, occurred=search.done, jumps=jumps, grazing=flat
    )
