"""Row blocks: rows of the problem that one function gives at many intervals or nodes.

The function is vmapped. Each of its evaluations is a lane: one interval, or one node. A lane has
local unknowns and local rows. Index tables say which unknown of the problem each local unknown is,
and to which row of the problem each local row is added. The last row of the problem is the cost.

Row blocks have nothing to do with control blocks (see `AbstractControls`).
"""

from collections.abc import Callable
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc._jax.lanes_last import with_lanes_last
from svkc._jax.static_gather import static_take
from svkc.optimize.lift import Layout, Lift, StagePolynomials, dependencies

# blocks with at least this many lanes are compiled for speed; others for a short compile time
MANY_LANES = 8
# local unknowns z of all lanes, and multipliers of their local rows
Unknowns: TypeAlias = Float[Array, "lanes n"]
Multipliers: TypeAlias = Float[Array, "lanes m"]


class Block:
    """Base class of row blocks.

    unknowns: [lanes n] index of each local unknown in the problem; -1: it is zero.
    rows: [lanes m] index of the row to which each local row is added; -1: it is left out.
    masks: which entries of `jacobian_pattern` and of `hessian_pattern` may be nonzero although they
        are zero at a few random points; None: not known.
    by_args: mask [rows of a stage, free args] of the same for derivatives by free args. Only blocks
        with masks have it.
    data: constants of each lane, with a leading axis over lanes. Methods take the data as an
        argument, so that new data need no compilation.
    """

    unknowns: np.ndarray
    rows: np.ndarray
    data: Any
    masks: tuple[np.ndarray, np.ndarray] | None = None
    by_args: np.ndarray

    def set_lanes(self, lanes: Any) -> None:
        """Replace the data of the lanes."""
        self.data = lanes

    def values(self, params: Any, data: Any, z: Unknowns) -> jax.Array:
        """Return the local rows [lanes m] at local unknowns [lanes n]."""
        raise NotImplementedError

    def jacobian(self, params: Any, data: Any, z: Unknowns) -> jax.Array:
        """Return the entries [lanes entries] of the Jacobian in `jacobian_pattern`."""
        raise NotImplementedError

    def hessian(self, params: Any, data: Any, z: Unknowns, multipliers: Multipliers) -> jax.Array:
        """Return the entries [lanes entries] of the Hessians in `hessian_pattern`.

        They are those of the functions multipliers . rows, one for each lane.
        """
        raise NotImplementedError

    @property
    def jacobian_pattern(self) -> tuple[np.ndarray, np.ndarray]:
        """Local row and local unknown of each entry of the Jacobian."""
        return _full_pattern(self.rows.shape[1], self.unknowns.shape[1])

    @property
    def hessian_pattern(self) -> tuple[np.ndarray, np.ndarray]:
        """The two local unknowns of each entry of the Hessian, which has one of (i, k), (k, i)."""
        return np.tril_indices(self.unknowns.shape[1])


def lower_half(H: Float[Array, "n n"]) -> Float[Array, " entries"]:
    """Return the entries of the lower half of a matrix, in the order of `np.tril_indices`."""
    return static_take(H.ravel(), np.ravel_multi_index(np.tril_indices(len(H)), H.shape))


def _full_pattern(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the row and column of each entry of a full matrix."""
    row, column = np.indices((rows, columns))
    return row.ravel(), column.ravel()


class PlainBlock(Block):
    """A row block of any function (params, data of the lane, unknowns) -> rows.

    Derivatives are those of automatic differentiation.
    """

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
        """Return function(rows of z, ...) over lanes. arrays: further arguments [lanes ...]."""
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
    """A row block of a function of stages. Its lanes are intervals.

    The function is differentiated by the variables y of a stage. `Lift` gives the derivatives by
    the unknowns of the interval.

    function: (params, data of the lane, weight, y) -> rows of a stage. The weight is the stage's
        share of the phase's duration in the quadrature of a running cost.
    poly: coefficients of each stage at which the function is evaluated.
    start_ratio, duration_ratio: [lanes] as of `Lift`.
    nonlinear: indices of stage variables. The second derivative by two variables is zero where
        neither is among these.
    variables: indices of the stage variables that have a second derivative with any other; all of
        them unless set.
    options: keyword arguments for the functions of `UserRows`.
    """

    def __init__(
        self,
        function: Callable[..., jax.Array],
        layout: Layout,
        poly: StagePolynomials,
        *,
        data: Any,
        start_ratio: np.ndarray,
        duration_ratio: np.ndarray,
        unknowns: np.ndarray,
        rows: np.ndarray,
        nonlinear: np.ndarray,
    ):
        self.function = function
        self.layout = layout
        self.poly = poly
        self.data: Any = (data, np.asarray(start_ratio, float), np.asarray(duration_ratio, float))
        self.unknowns: np.ndarray = unknowns
        self.rows: np.ndarray = rows
        self.nonlinear = nonlinear
        self.variables: np.ndarray = np.arange(layout.stage_size)
        self.options: dict[str, Any] = {}

    def set_lanes(self, lanes: Any) -> None:
        self.data = (lanes, *self.data[1:])

    def over_stages(self, function: Callable, params: Any, data: Any, z, *arrays) -> Any:
        """Return function(rows of y, lift, ...) for all lanes and stages [lanes stages ...].

        arrays: further arguments [lanes stages ...].
        """
        return self._join_stages(lambda x: x, self._at_stage(function), params, data, z, *arrays)

    def _at_stage(self, function: Callable) -> Callable:
        """Return `function` with the arguments (params, data, lift, ...) of `_join_stages`."""

        def at_stage(params, own, lift, *x):
            weight = lift.poly.b / lift.duration_ratio
            return function(lambda y: self.function(params, own, weight, y), lift, *x)

        return at_stage

    def _join_stages(self, join: Callable, at_stage: Callable, params: Any, data: Any, z, *arrays):
        """Return join(values of at_stage at all stages) for all lanes.

        at_stage: function (params, data, lift, ...) of one stage.
        join: function of the values [stages ...] of one lane.
        """

        def at_lane(params, lane, z, *x):
            own, start_ratio, duration_ratio = lane
            lift = lambda poly: Lift(self.layout, poly, z, start_ratio, duration_ratio)
            over_stages = jax.vmap(lambda poly, *x: at_stage(params, own, lift(poly), *x))
            return join(over_stages(self.poly, *x))

        if len(z) >= MANY_LANES:
            at_lane = with_lanes_last(at_lane)
        return jax.vmap(at_lane, (None, 0, 0, *(0 for _ in arrays)))(params, data, z, *arrays)

    def values(self, params: Any, data: Any, z: Unknowns) -> jax.Array:
        rows = self.over_stages(lambda f, lift: f(lift.variables()), params, data, z)
        return rows.reshape(len(z), -1)

    def jacobian(self, params: Any, data: Any, z: Unknowns) -> jax.Array:
        def of_stage(f, lift):
            return lift.pull_back(jax.jacrev(f)(lift.variables()))

        matrix = self.over_stages(of_stage, params, data, z)
        return matrix.reshape(len(z), -1)

    def hessian(self, params: Any, data: Any, z: Unknowns, multipliers: Multipliers) -> jax.Array:
        def of_stage(f, lift, m):
            y = lift.variables()
            gradient = jax.grad(lambda y: f(y) @ m)
            if not len(self.nonlinear):
                return lift.curvature(gradient(y))
            g, product = jax.linearize(gradient, y)
            directions = jnp.eye(len(y), dtype=y.dtype)[self.nonlinear]
            H = self._symmetric(jax.vmap(product)(directions))
            of_variables = lower_half(lift.hessian(H, self.variables))
            return jnp.concatenate([lift.curvature(g), of_variables])

        multipliers = multipliers.reshape(len(z), len(self.poly.c), -1)
        at_stage, total = self._at_stage(of_stage), lambda x: jnp.sum(x, 0)
        return self._join_stages(total, at_stage, params, data, z, multipliers)

    @property
    def hessian_pattern(self) -> tuple[np.ndarray, np.ndarray]:
        row = np.arange(self.layout.interval_size)
        first = row, np.ones_like(row)
        if not len(self.nonlinear):
            return first
        columns = dependencies(self.layout, self.variables)
        second = (columns[x] for x in np.tril_indices(len(columns)))
        row, column = (np.concatenate(x) for x in zip(first, second))
        return row, column

    def _symmetric(self, rows):
        """Return the Hessian over `variables` from the rows [nonlinear y] of the full Hessian.

        Of an entry whose row is missing, the symmetric one is taken.
        """
        place = np.full(self.layout.stage_size, len(self.nonlinear))
        place[self.nonlinear] = np.arange(len(self.nonlinear))
        place, some = place[self.variables], static_take(rows.T, self.variables).T
        some = static_take(some, place)
        return jnp.where((place < len(self.nonlinear))[:, None], some, some.T)
