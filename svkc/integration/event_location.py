"""F6: the search for where a guard was zero, a look at a time; the loop that takes the steps makes the looks."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from svkc.integration.event_adjoint import FLAT, Found, Reading, event_tolerance
from svkc.integration.vector_field import Motion, Scene, chosen
from svkc.transitions.events import Bracket


class Watched(eqx.Module):
    """Guards, their values at the start of a phase, and which of them may end it."""

    guards: Reading
    values: Float[Array, " guards"]
    which: Bool[Array, " guards"]


class Search(eqx.Module):
    """For the first zero in the step from the loop's t, over a span of time: guards that crossed it, by the side they are on then, and their sizes; the
    bracket and, at its right end, the motion and the guards; the guards just after that. on: begun; narrow: the bracket is to be made smaller yet."""

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


def watch(old: Search, before: Float[Array, " guards"], t0, t1, y: Motion, keep, scene: Scene, watched: Watched) -> tuple[Float[Array, " guards"], Search]:
    """The guards after a try of a step from t0 to t1, and the search for their first zero: begun, narrowed, or done once they are known just after it.

    before: the guards at t0; y: where the try has led to; keep: whether the step holds.
    """
    values = watched.guards(t1, y, scene)
    # a guard at zero is not armed before it has left it by more than round-off
    values = jnp.where((before == 0) & (jnp.abs(values) < jnp.finfo(values.dtype).eps ** 0.75), 0, values)
    crossed = watched.guards.made.crossed(before, values) & watched.which & keep & ~old.on
    begun = jnp.any(crossed)
    side = jnp.where(begun, jnp.where(crossed, jnp.where(values >= before, 1, -1), 0).astype(values.dtype), old.side)
    # the largest of the guards that crossed: positive where one has
    passed = lambda values: jnp.max(jnp.where(side != 0, side * values, -jnp.inf))
    bracket = chosen(old.narrow, old.bracket.narrowed(t1, passed(values)), old.bracket)
    bracket = chosen(begun, Bracket.around(t0, t1, passed(before), passed(values)), bracket)
    at_right = begun | (old.narrow & (passed(values) >= 0))
    done = old.on & ~old.narrow
    on = begun | (old.on & ~done)
    search = Search(
        span=jnp.where(begun, t1 - t0, old.span),
        side=side,
        size=jnp.where(begun, jnp.maximum(jnp.abs(before), jnp.abs(values)), old.size),
        bracket=bracket,
        motion=chosen(at_right, y, old.motion),
        values=jnp.where(at_right, values, old.values),
        ahead=jnp.where(done, values, old.ahead),
        on=on,
        narrow=on & bracket.wide(),
        done=done,
    )
    return jnp.where(done, search.values, values), search


def found(search: Search, guards: Float[Array, " guards"], t) -> Found:
    """Which guards fired, where a search that ended at t has looked for that. guards: their values there."""
    crossed, passed = search.side != 0, search.side * search.values
    first = jnp.argmax(jnp.where(crossed, passed, -jnp.inf)).astype(jnp.int32)
    fired = (crossed & (search.side * search.ahead >= 0)) | (jnp.arange(crossed.shape[0], dtype=jnp.int32) == first)
    value, grown, large = jnp.abs(passed[first]), jnp.abs(search.ahead - search.values)[first], FLAT * search.size[first]
    jumps = search.done & (value > grown) & (value > large)
    flat = search.done & ~jumps & (grown / event_tolerance(t) * search.span < large)
    fired = fired & search.done
    # zero: not armed, until it has left zero
    return Found(fired, jnp.where(fired, 0, guards), first, search.done, jumps, flat)
