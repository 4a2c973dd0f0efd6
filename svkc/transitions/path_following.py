"""The state at the end of a continuation, with its derivatives.

One while loop runs every kind of iteration with one body, so that kinematics, loop Jacobian and
pivots are compiled once. The derivative is that of the stationary point at the end
(`stationarity.py`); it does not depend on the path.
"""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from svkc._jax.primitive import custom_primitive
from svkc._jax.select import where
from svkc.loops.constraint import gap_tolerance, jacobian_scales, loop_kinematics
from svkc.model.chain import Chain, Structure
from svkc.transitions.continuation import DONE, SELECT_HELD, PathState, linearize
from svkc.transitions.newton_state import CLOSE_PERTURBED, DECIDE_RANK, is_any_of
from svkc.transitions.path_steps import next_path_state
from svkc.transitions.placement import joint_coordinates, with_coordinates
from svkc.transitions.stationarity import Targets, projected_velocity, stationary_tangent
from svkc.tree.configuration import difference, integrate

_MAX_ITERATIONS = 20_000


class PathEnd(eqx.Module):
    """The end of a path.

    rank, margin: rank m of the loop Jacobian, and |R_mm| / |R_11|.
    residual_gaps: largest gap of each loop (rad, or in `chain.length`s).
    reached: whether the path has come to its end without failing.
    held: coordinates that the path moved to their requested values.
    from_requested: whether the path started at the requested coordinates.
    """

    q: Float[Array, " q"]
    v: Float[Array, " dofs"]
    rank: Int[Array, ""]
    margin: Float[Array, ""]
    residual_gaps: Float[Array, " links"]
    reached: Bool[Array, ""]
    held: Bool[Array, " dofs"]
    from_requested: Bool[Array, ""]


def _follow(chain: Chain, structure: Structure, targets: Targets) -> PathEnd:
    """Return the end of the path."""

    def body(path: PathState) -> PathState:
        path = dataclasses.replace(path, iterations=path.iterations + 1)
        # q may be singular, so the rank and the held coordinates are decided at the probe
        at_probe = is_any_of(path.kind, CLOSE_PERTURBED, DECIDE_RANK, SELECT_HELD)
        q = where(at_probe, path.newton.probe, path.newton.q)
        linear = linearize(chain, structure, targets, path, q)
        return next_path_state(chain, structure, targets, path, q, linear)

    unfinished = lambda path: (path.kind != DONE) & (path.iterations < _MAX_ITERATIONS)
    path = jax.lax.while_loop(unfinished, body, PathState.init(chain, structure, targets))
    # the requested values themselves, without the round-off of the steps towards them
    round_off = difference(chain, path.newton.q, targets.requested)
    q = integrate(chain, path.newton.q, where(path.held & path.reached, round_off, 0))
    return _path_end(path, q)


def _path_end(path: PathState, q) -> PathEnd:
    """Return the record of a path that ends at q."""
    return PathEnd(
        q=q,
        v=path.newton.v,
        rank=path.newton.rank,
        margin=path.newton.margin,
        residual_gaps=path.newton.residual_gaps,
        reached=path.reached,
        held=path.held,
        from_requested=path.from_requested,
    )


def _follow_nothing(chain: Chain, structure: Structure, targets: Targets) -> PathEnd:
    """Return a `PathEnd` of the right shapes, without following the path."""
    return _path_end(PathState.init(chain, structure, targets), targets.start)


def _with_joint_coordinates(chain: Chain, structure: Structure, links, start):
    """Return the start with the coordinates of virtual joints as the first iteration computes them.

    Only coordinates of cuttable joints have a weight in the change from the start.
    links: links whose coordinates are computed, unless they close their loop already.
    """
    if max(chain.topology.link_child, default=-1) < 0:
        return start
    loops = loop_kinematics(chain, structure, start)
    gaps = jax.lax.stop_gradient(jnp.max(jnp.abs(loops.gap).reshape(-1, 6), 1))
    links = links & structure.connected & ~(gaps < gap_tolerance(start.dtype))
    coordinates = joint_coordinates(chain, structure, loops.kin, start, loops.frames)
    return with_coordinates(chain, links, coordinates, start)


def _follow_jvp(primals, tangents):
    """Return the end of the path and its tangent.

    The tangent of q is that of the stationary point, by the implicit function theorem. The tangent
    of v is that of the projection of the velocity at this point.
    """
    end = follow_path(*primals)
    chain, structure, targets = primals
    rank = (end.rank, jax.lax.stop_gradient(end.margin))
    with_rank = eqx.tree_at(lambda s: (s.rank, s.margin), structure, rank)

    def inputs(chain, structure, targets):
        start = where(end.from_requested, targets.requested, targets.start)
        start = _with_joint_coordinates(chain, structure, targets.read_links, start)
        return chain, structure, start, targets.requested

    y_dot = stationary_tangent(
        *eqx.filter_jvp(inputs, primals, tangents), end.q, end.held, with_rank
    )
    moved = lambda y: integrate(chain, end.q, jacobian_scales(chain)[1] * y)
    q_dot = jax.jvp(moved, (jnp.zeros_like(y_dot),), (y_dot,))[1]
    v_dot = eqx.filter_jvp(
        lambda chain, structure, q, v: projected_velocity(chain, structure, q, v, targets.held_v),
        (chain, with_rank, end.q, targets.v),
        (*tangents[:2], q_dot, None if tangents[2] is None else tangents[2].v),
    )[1]
    none = jax.tree.map(lambda x: None, end)
    tangent = eqx.tree_at(lambda t: (t.q, t.v), none, (q_dot, v_dot), is_leaf=lambda x: x is None)
    return end, tangent


# follow_path(chain, structure, targets) -> PathEnd
follow_path: Callable[[Chain, Structure, Targets], PathEnd] = custom_primitive(
    "follow_path", _follow, _follow_jvp, like=_follow_nothing
)
