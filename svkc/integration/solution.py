"""The problem, the options, the state and the solution of the integration of one phase."""

from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from svkc.integration.event_location import Found, Search, Watched
from svkc.integration.integrators import Motion, Scene
from svkc.integration.vector_field import Field, Seen
from svkc.loops.constraint import largest_gaps
from svkc.model.chain import State

NON_FINITE, OPEN = -1, -2
# by articulated bodies a step may be moved, as it is put back onto the loops, by 1 / MOVED of what
# it may err by
MOVED = 1e-3
SUCCESSFUL, EVENT, MAX_STEPS = (
    diffrax.RESULTS.successful._value,
    diffrax.RESULTS.event_occurred._value,
    diffrax.RESULTS.max_steps_reached._value,
)


class World(eqx.Module):
    """What the motion depends on besides its start: the scene, and the vector field with all that
    it closes over."""

    scene: Scene
    field: Field


class How(eqx.Module):
    """What finds the steps: nothing of it is differentiated."""

    solver: diffrax.AbstractSolver
    watched: Watched | None
    controller: Any
    first_step: Any
    progress_meter: diffrax.AbstractProgressMeter
    gap: float = eqx.field(static=True)
    max_steps: int = eqx.field(static=True)
    every: int = eqx.field(static=True)


class Tally(eqx.Module):
    """What a run has cost and shown: tries, and of the steps that were kept the sum of their
    estimated errors (root mean square over q and v; inf: the solver gives none), the least |R_mm| /
    |R_11| of the loops, how often the dependent coordinates changed (-1: not looked at), the loop
    that could not be closed (-1: none), and the largest of the loops' gaps (rad, m)."""

    tries: Int[Array, ""]
    error: Float[Array, ""]
    margin: Float[Array, ""]
    swaps: Int[Array, ""]
    loop: Int[Array, ""]
    gap: Float[Array, "2"]

    @classmethod
    def none(cls, dtype, looked: bool) -> "Tally":
        """Before the first step."""
        zero = jnp.zeros((), jnp.int32)
        return cls(
            tries=zero,
            error=jnp.zeros((), dtype),
            margin=jnp.ones((), dtype),
            swaps=zero if looked else zero - 1,
            loop=zero - 1,
            gap=jnp.zeros(2, dtype),
        )

    @classmethod
    def unknown(cls, dtype, tries: Int[Array, ""]) -> "Tally":
        """Return the tally of a loop that counts tries alone."""
        no, one = jnp.asarray(-1, jnp.int32), jnp.ones((), dtype)
        gap = jnp.zeros(2, dtype)
        return cls(tries=tries, error=jnp.inf * one, margin=one, swaps=no, loop=no, gap=gap)


class Path(eqx.Module):
    """Where a solve ended, the states at the times asked for, the times of its steps (inf: not
    taken), one state in `every`, diffrax's result code."""

    t: Float[Array, ""]
    end: Motion
    saved: Motion
    times: Float[Array, " steps"]
    kept: Motion
    accepted: Int[Array, ""]
    rejected: Int[Array, ""]
    result: Int[Array, ""]
    tally: Tally
    found: Found | None = None


class Step(eqx.Module):
    """What goes from step to step. length: what the controller asks for, before a time to be met
    shortens it; times, kept, saved: as in `Path`, but buffers within the loop."""

    t: Float[Array, ""]
    y: Motion
    next: Float[Array, ""]
    length: Float[Array, ""]
    jumped: Bool[Array, ""]
    solver: Any
    controller: Any
    meter: Any
    guards: Float[Array, " guards"] | None
    search: Search | None
    times: Any
    kept: Any
    saved: Any
    accepted: Int[Array, ""]
    rejected: Int[Array, ""]
    result: Int[Array, ""]
    tally: Tally
    seen: Seen | None


class Tried(eqx.Module):
    """What a try has led to."""

    t: Float[Array, ""]
    y: Motion
    keep: Bool[Array, ""]
    length: Float[Array, ""]
    jumped: Bool[Array, ""]
    solver: Any
    controller: Any
    result: Int[Array, ""]
    error: Float[Array, ""]
    seen: Seen | None


def _counted(s: Step, tried: Tried, result: Int[Array, ""], scene: Scene) -> Tally:
    """With one more try. result: how the run stands after it."""
    old, kept = s.tally, tried.keep
    margin, swaps, gap = old.margin, old.swaps, old.gap
    if tried.seen is not None and tried.seen.pivots is not None:
        margin = jnp.where(kept, jnp.minimum(margin, tried.seen.margin), margin)
        # the first choice of a phase is no change
        swapped = jnp.any(s.seen.dependent) & jnp.any(s.seen.dependent != tried.seen.dependent)
        swaps = swaps + (kept & swapped).astype(jnp.int32)
    loop = old.loop
    if tried.seen is not None:
        widest = jnp.argmax(jnp.max(tried.seen.gap, 1)).astype(jnp.int32)
        loop = jnp.where(result == OPEN, widest, loop)
    if len(scene.chain.link_names):
        gap = jnp.where(kept, jnp.maximum(gap, _open(tried, scene)), gap)
    error = old.error + jnp.where(kept, tried.error, 0)
    return Tally(tries=old.tries + 1, error=error, margin=margin, swaps=swaps, loop=loop, gap=gap)


def _open(tried: Tried, scene: Scene) -> Float[Array, "2"]:
    """The largest of the loops' gaps (rad, m) at the end of a try."""
    if tried.seen is None:
        return largest_gaps(scene.chain, State(tried.y.q, tried.y.v, scene.structure))[0]
    return jnp.max(tried.seen.gap, 0) * jnp.stack(
        [jnp.ones_like(scene.chain.length), scene.chain.length]
    )
