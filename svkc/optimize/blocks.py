"""Blocks of rows: one function over many lanes, with its derivatives and its place in the whole.

A block is a vmapped function of local unknowns. Tables say which unknown of the problem each local
one is, and to which row of the problem each local row is added (-1: none). The last row of the
problem is the cost.
"""

from collections.abc import Callable
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc._jax.eager import eager_jit
from svkc._jax.lanes_last import with_lanes_last
from svkc._jax.static_gather import static_take
from svkc.optimize.lift import Layout, Lift, StagePolynomials, dependencies

# fewest lanes for which a block's execution time outweighs its compile time
MANY_LANES = 8
# local unknowns, and multipliers of local rows
Unknowns: TypeAlias = Float[Array, "lanes n"]
Multipliers: TypeAlias = Float[Array, "lanes m"]


class Block:
    """A function over lanes.

    unknowns: [lanes n] index of each local unknown in the problem; -1: the unknown is zero.
    rows: [lanes m] index of the row to which each local row is added; -1: left out.
    data: what distinguishes the lanes, with a leading axis. It is an argument of the methods, as it
        changes without compiling again.
    """

    unknowns: np.ndarray
    rows: np.ndarray
    data: Any

    def set_lanes(self, lanes: Any) -> None:
        """Set the data of the lanes."""
        self.data = lanes

    def values(self, params: Any, data: Any, z: Unknowns) -> jax.Array:
        """Return the local rows [lanes m] at local unknowns [lanes n]."""
        raise NotImplementedError

    def jacobian(self, params: Any, data: Any, z: Unknowns) -> jax.Array:
        """Return the derivatives [lanes entries] of the rows, at `jacobian_places`."""
        raise NotImplementedError

    def hessian(self, params: Any, data: Any, z: Unknowns, multipliers: Multipliers) -> jax.Array:
        """Return the Hessians [lanes entries] of the rows' sum with multipliers [lanes m], at
        `hessian_places`."""
        raise NotImplementedError

    @property
    def jacobian_places(self) -> tuple[np.ndarray, np.ndarray]:
        """Local row and local unknown of each entry."""
        return _every_place(self.rows.shape[1], self.unknowns.shape[1])

    @property
    def hessian_places(self) -> tuple[np.ndarray, np.ndarray]:
        """Local unknowns of each entry; of two that are symmetric there is one."""
        return np.tril_indices(self.unknowns.shape[1])


def lower_half(H: Float[Array, "n n"]) -> Float[Array, " entries"]:
    """Return the entries of the lower half of a matrix."""
    return static_take(H.ravel(), np.ravel_multi_index(np.tril_indices(len(H)), H.shape))


def _every_place(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the row and column of each entry of a full matrix."""
    row, column = np.indices((rows, columns))
    return row.ravel(), column.ravel()


class PlainBlock(Block):
    """A block of any function (params, data of the lane, unknowns) -> rows."""

    def __init__(
        self,
        function: Callable[..., jax.Array],
        data: Any,
        unknowns: np.ndarray,
        rows: np.ndarray,
    ):
        self.function = function
        self.data: Any = data
        self.unknowns: np.ndarray = unknowns
        self.rows: np.ndarray = rows

    def _over_lanes(self, function: Callable, params: Any, data: Any, *arrays) -> jax.Array:
        call = lambda data, *x: function(lambda z: self.function(params, data, z), *x)
        return jax.vmap(call)(data, *arrays)

    def values(self, params: Any, data: Any, z: Unknowns) -> jax.Array:
        return self._over_lanes(lambda f, z: f(z), params, data, z)

    def jacobian(self, params: Any, data: Any, z: Unknowns) -> jax.Array:
        return self._over_lanes(lambda f, z: jax.jacrev(f)(z).ravel(), params, data, z)

    def hessian(self, params: Any, data: Any, z: Unknowns, multipliers: Multipliers) -> jax.Array:
        product = lambda f, z, m: lower_half(jax.jacfwd(jax.grad(lambda z: f(z) @ m))(z))
        return self._over_lanes(product, params, data, z, multipliers)


class StageBlock(Block):
    """A block of a function of stages, carried to the unknowns of intervals by their polynomials.

    function: (params, data, weight, y) -> rows of a stage; weight is b / count of the quadrature.
    poly: of each stage at which the function is evaluated.
    index, count: [lanes] start of a lane's interval and the phase's duration, both by the
        interval's length; of equal intervals which one the lane is, and how many there are.
    tangents: stage's variables in which the function is not linear; others have no second
        derivatives among themselves.
    variables: those that have second derivatives.
    """

    def __init__(
        self,
        function: Callable[..., jax.Array],
        layout: Layout,
        poly: StagePolynomials,
        *,
        data: Any,
        index: np.ndarray,
        count: np.ndarray,
        unknowns: np.ndarray,
        rows: np.ndarray,
        tangents: np.ndarray,
    ):
        self.function = function
        self.layout = layout
        self.poly = poly
        self.data: Any = (data, np.asarray(index, float), np.asarray(count, float))
        self.unknowns: np.ndarray = unknowns
        self.rows: np.ndarray = rows
        self.tangents = tangents
        self.variables: np.ndarray = np.arange(layout.of_stage)
        self.options: dict[str, Any] = {}

    def set_lanes(self, lanes: Any) -> None:
        self.data = (lanes, *self.data[1:])

    def _over_stages(self, function: Callable, params: Any, data: Any, z, *arrays) -> jax.Array:
        """Return function(rows of y, lift, ...) over lanes and stages.

        arrays: further arguments [lanes stages ...].
        """
        return self._join_stages(lambda x: x, self._at_stage(function), params, data, z, *arrays)

    def _at_stage(self, function: Callable) -> Callable:
        """Return a function of stages from function(rows of y, lift, ...)."""

        def at_stage(params, own, lift, *x):
            weight = lift.poly.b / lift.count
            return function(lambda y: self.function(params, own, weight, y), lift, *x)

        return at_stage

    def _join_stages(self, join: Callable, at_stage: Callable, params: Any, data: Any, z, *arrays):
        """Return join(values of all stages) of at_stage(params, data, lift, ...) over lanes."""

        def at_lane(params, lane, z, *x):
            own, index, count = lane
            lift = lambda poly: Lift(self.layout, poly, z, index, count)
            over_stages = jax.vmap(lambda poly, *x: at_stage(params, own, lift(poly), *x))
            return join(over_stages(self.poly, *x))

        if len(z) >= MANY_LANES:
            at_lane = with_lanes_last(at_lane)
        return jax.vmap(at_lane, (None, 0, 0, *(0 for _ in arrays)))(params, data, z, *arrays)

    def values(self, params: Any, data: Any, z: Unknowns) -> jax.Array:
        rows = self._over_stages(lambda f, lift: f(lift.variables()), params, data, z)
        return rows.reshape(len(z), -1)

    def jacobian(self, params: Any, data: Any, z: Unknowns) -> jax.Array:
        def of_stage(f, lift):
            return lift.pull_back(jax.jacrev(f)(lift.variables()))

        matrix = self._over_stages(of_stage, params, data, z)
        return matrix.reshape(len(z), -1)

    def hessian(self, params: Any, data: Any, z: Unknowns, multipliers: Multipliers) -> jax.Array:
        def of_stage(f, lift, m):
            y = lift.variables()
            gradient = jax.grad(lambda y: f(y) @ m)
            if not len(self.tangents):
                return lift.curvature(gradient(y))
            g, product = jax.linearize(gradient, y)
            directions = jnp.eye(len(y), dtype=y.dtype)[self.tangents]
            H = self._symmetric(jax.vmap(product)(directions))
            of_variables = lower_half(lift.hessian(H, self.variables))
            return jnp.concatenate([lift.curvature(g), of_variables])

        multipliers = multipliers.reshape(len(z), len(self.poly.c), -1)
        at_stage, total = self._at_stage(of_stage), lambda x: jnp.sum(x, 0)
        return self._join_stages(total, at_stage, params, data, z, multipliers)

    @property
    def hessian_places(self) -> tuple[np.ndarray, np.ndarray]:
        row = np.arange(self.layout.of_interval)
        first = row, np.ones_like(row)
        if not len(self.tangents):
            return first
        columns = dependencies(self.layout, self.variables)
        second = (columns[x] for x in np.tril_indices(len(columns)))
        row, column = (np.concatenate(x) for x in zip(first, second))
        return row, column

    def _symmetric(self, rows):
        """Return the Hessian by `variables` from its rows of `tangents`."""
        place = np.full(self.layout.of_stage, len(self.tangents))
        place[self.tangents] = np.arange(len(self.tangents))
        place, some = place[self.variables], static_take(rows.T, self.variables).T
        some = static_take(some, place)
        return jnp.where((place < len(self.tangents))[:, None], some, some.T)


def find_tangents(block: StageBlock, params: Any, draws: np.ndarray) -> np.ndarray:
    """Return the stage's variables in which a block's function is not linear.

    draws: values [draws lanes n] of local unknowns. The Hessian is evaluated there, with random
    multipliers, and a variable is kept where a second derivative is not zero.
    """

    @eager_jit
    def second(params, data, z, multipliers):
        def of_stage(f, lift, m):
            return jax.jacfwd(jax.grad(lambda y: f(y) @ m))(lift.variables())

        multipliers = multipliers.reshape(len(z), len(block.poly.c), -1)
        return block._over_stages(of_stage, params, data, z, multipliers)

    # a few lanes are like the others
    lanes = lambda x: jax.tree.map(lambda x: jnp.asarray(x[:2]), x)
    rows = block.rows[:2]
    random, used = np.random.default_rng(0), np.zeros(block.layout.of_stage, bool)
    for z in draws:
        H = second(params, lanes(block.data), lanes(z), random.normal(size=rows.shape))
        used |= (np.asarray(H) != 0).any((0, 1, 2))
    return np.flatnonzero(used)
