"""Event location: guards, the bracket about a root, and the search for the root.

The search is a state machine that is advanced by one evaluation of the guards; the stepping loop
makes the evaluations.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from svkc._jax.pytrees import tree_where
from svkc.integration.integrators import Motion, Scene
from svkc.integration.vector_field import Field
from svkc.model.chain import State
from svkc.model.validation import scalar
from svkc.transitions.plan import Plan

# how often a bracket may be narrowed
NARROWINGS = 200


class Bracket(eqx.Module):
    """Two times, at the first a function is below zero, at the second not: narrowed to round-off by
    false position with the Illinois weight, every third time by bisection. `fine`: how narrow;
    `last`: which end has moved (1: b, -1: a)."""

    a: Float[Array, ""]
    b: Float[Array, ""]
    fa: Float[Array, ""]
    fb: Float[Array, ""]
    fine: Float[Array, ""]
    last: Int[Array, ""]
    count: Int[Array, ""]

    @staticmethod
    def around(a, b, fa, fb) -> "Bracket":
        """From the two times and the function there."""
        eps = jnp.finfo(fb.dtype).eps
        fine = 2 * eps * jnp.maximum(jnp.abs(a), jnp.abs(b)) + eps * (b - a)
        zero = jnp.zeros((), jnp.int32)
        return Bracket(a=a, b=b, fa=fa, fb=fb, fine=fine, last=zero, count=zero)

    def wide(self) -> Bool[Array, ""]:
        """Whether to go on."""
        return (self.b - self.a > self.fine) & (self.count < NARROWINGS)

    def inside(self) -> Float[Array, ""]:
        """The time to look at next."""
        weight = self.fb - self.fa
        secant = self.b - self.fb * (self.b - self.a) / jnp.where(weight == 0, 1, weight)
        c = jnp.where((self.count % 3 == 2) | (weight == 0), self.a + (self.b - self.a) / 2, secant)
        return jnp.clip(c, self.a + self.fine / 4, self.b - self.fine / 4)

    def narrowed(self, c, fc) -> "Bracket":
        """With what the function is at c."""
        right = fc >= 0
        fa = jnp.where(right & (self.last == 1), self.fa / 2, self.fa)
        fb = jnp.where(~right & (self.last == -1), self.fb / 2, self.fb)
        return Bracket(
            a=jnp.where(right, self.a, c),
            b=jnp.where(right, c, self.b),
            fa=jnp.where(right, fa, fc),
            fb=jnp.where(right, fc, fb),
            fine=self.fine,
            last=jnp.where(right, 1, -1).astype(jnp.int32),
            count=self.count + 1,
        )


# a guard that at the rate it crosses zero with would change this little over a step, measured by
# its size, touches zero rather than crosses it
FLAT = 1e-5


class Reading(eqx.Module):
    """The values of all guards. Torques are evaluated where one of the guards needs them."""

    made: Plan
    field: Field

    def __call__(self, t, y: Motion, scene: Scene) -> Float[Array, " guards"]:
        state = State(y.q, y.v, scene.structure)
        guards = self.made.guards
        tau = (
            self.field.torques(t, y, scene)[0]
            if any(g.needs_torques for g in guards)
            else jnp.zeros_like(y.v)
        )
        values = [g.value(scene.chain, t, state, scene.args, tau) for g in guards]
        return jnp.stack([jnp.asarray(scalar("guard", x), y.q.dtype) for x in values])


class Found(eqx.Module):
    """The guards that fired, which guard values go on, the first guard, whether there was one, it
    jumped over zero, or it only touched it."""

    fired: Bool[Array, " guards"]
    values: Float[Array, " guards"]
    first: Int[Array, ""]
    hit: Bool[Array, ""]
    jumps: Bool[Array, ""]
    flat: Bool[Array, ""]


def event_tolerance(t: Float[Array, ""]) -> Float[Array, ""]:
    """Events this close (s) to the earliest happen together with it: sqrt(eps), 1.5e-8 in float64,
    relative from t = 1 s on."""
    return jnp.finfo(t.dtype).eps ** 0.5 * jnp.maximum(1, jnp.abs(t))


def field_of(guards: Reading | Field) -> Field:
    """Return the field of the guards, or the field itself where there are no guards."""
    return guards if isinstance(guards, Field) else guards.field


class Watched(eqx.Module):
    """Guards, their values at the start of a phase, and which of them may end it."""

    guards: Reading
    values: Float[Array, " guards"]
    which: Bool[Array, " guards"]


class Search(eqx.Module):
    """For the first zero in the step from the loop's t, over a span of time: guards that crossed
    it, by the side they are on then, and their sizes; the bracket and, at its right end, the motion
    and the guards; the guards just after that. on: begun; narrow: the bracket is to be made smaller
    yet."""

    span: Float[Array, ""]
    side: Float[Array, " guards"]
    size: Float[Array, " guards"]
    bracket: Bracket
    motion: Motion
    values: Float[Array, " guards"]
    ahead: Float[Array, " guards"]
    on: Bool[Array, ""]
    narrow: Bool[Array, ""]
    done: Bool[Array, ""]

    def asked(self) -> Float[Array, ""]:
        """The time to be looked at next."""
        b = self.bracket.b
        return jnp.where(self.narrow, self.bracket.inside(), b + event_tolerance(b))


def watch(
    old: Search,
    before: Float[Array, " guards"],
    *,
    t0,
    t1,
    y: Motion,
    keep,
    scene: Scene,
    watched: Watched,
) -> tuple[Float[Array, " guards"], Search]:
    """The guards after a try of a step from t0 to t1, and the search for their first zero: begun,
    narrowed, or done once they are known just after it.

    before: the guards at t0; y: where the try has led to; keep: whether the step holds.
    """
    values = watched.guards(t1, y, scene)
    # a guard at zero is not armed before it has left it by more than round-off
    values = jnp.where(
        (before == 0) & (jnp.abs(values) < jnp.finfo(values.dtype).eps ** 0.75), 0, values
    )
    crossed = watched.guards.made.crossed(before, values) & watched.which & keep & ~old.on
    begun = jnp.any(crossed)
    side = jnp.where(
        begun,
        jnp.where(crossed, jnp.where(values >= before, 1, -1), 0).astype(values.dtype),
        old.side,
    )
    # the largest of the guards that crossed: positive where one has
    passed = lambda values: jnp.max(jnp.where(side != 0, side * values, -jnp.inf))
    bracket = tree_where(old.narrow, old.bracket.narrowed(t1, passed(values)), old.bracket)
    bracket = tree_where(begun, Bracket.around(t0, t1, passed(before), passed(values)), bracket)
    at_right = begun | (old.narrow & (passed(values) >= 0))
    done = old.on & ~old.narrow
    on = begun | (old.on & ~done)
    search = Search(
        span=jnp.where(begun, t1 - t0, old.span),
        side=side,
        size=jnp.where(begun, jnp.maximum(jnp.abs(before), jnp.abs(values)), old.size),
        bracket=bracket,
        motion=tree_where(at_right, y, old.motion),
        values=jnp.where(at_right, values, old.values),
        ahead=jnp.where(done, values, old.ahead),
        on=on,
        narrow=on & bracket.wide(),
        done=done,
    )
    return jnp.where(done, search.values, values), search


def found(search: Search, guards: Float[Array, " guards"], t) -> Found:
    """Which guards fired, where a search that ended at t has looked for that. guards: their values
    there."""
    crossed, passed = search.side != 0, search.side * search.values
    first = jnp.argmax(jnp.where(crossed, passed, -jnp.inf)).astype(jnp.int32)
    fired = (crossed & (search.side * search.ahead >= 0)) | (
        jnp.arange(crossed.shape[0], dtype=jnp.int32) == first
    )
    value, grown, large = (
        jnp.abs(passed[first]),
        jnp.abs(search.ahead - search.values)[first],
        FLAT * search.size[first],
    )
    jumps = search.done & (value > grown) & (value > large)
    flat = search.done & ~jumps & (grown / event_tolerance(t) * search.span < large)
    fired = fired & search.done
    # zero: not armed, until it has left zero
    values = jnp.where(fired, 0, guards)
    return Found(fired=fired, values=values, first=first, hit=search.done, jumps=jumps, flat=flat)
