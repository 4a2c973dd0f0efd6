"""Blocks of rows: one function over many lanes, with its derivatives and its place in the whole.

A block is a vmapped function of local unknowns. Tables say which unknown of the problem each local
one is, and to which row of the problem each local row is added (-1: none). The last row of the
problem is the cost.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from svkc._jax.eager import eager_jit
from svkc._jax.lanes_last import with_lanes_last
from svkc._jax.static_gather import static_take
from svkc.optimize.lift import Layout, Lift, StagePolynomials

# fewest lanes for which a block's execution time outweighs its compile time
MANY_LANES = 8


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

    def values(self, params: Any, data: Any, z) -> jax.Array:
        """Return the local rows [lanes m] at local unknowns [lanes n]."""
        raise NotImplementedError

    def jacobian(self, params: Any, data: Any, z) -> jax.Array:
        """Return the derivatives [lanes m n] of the rows by the unknowns."""
        raise NotImplementedError

    def hessian(self, params: Any, data: Any, z, multipliers) -> jax.Array:
        """Return the Hessians [lanes n n] of the rows' sum with multipliers [lanes m]."""
        raise NotImplementedError


class PlainBlock(Block):
    """A block of any function (params, data of the lane, unknowns) -> rows."""

    def __init__(self, function: Callable, data: Any, unknowns: np.ndarray, rows: np.ndarray):
        self.function, self.data, self.unknowns, self.rows = function, data, unknowns, rows

    def _over_lanes(self, function: Callable, params: Any, data: Any, *arrays) -> jax.Array:
        call = lambda data, *x: function(lambda z: self.function(params, data, z), *x)
        return jax.vmap(call)(data, *arrays)

    def values(self, params: Any, data: Any, z) -> jax.Array:
        return self._over_lanes(lambda f, z: f(z), params, data, z)

    def jacobian(self, params: Any, data: Any, z) -> jax.Array:
        return self._over_lanes(lambda f, z: jax.jacrev(f)(z), params, data, z)

    def hessian(self, params: Any, data: Any, z, multipliers) -> jax.Array:
        product = lambda f, z, m: jax.jacfwd(jax.grad(lambda z: f(z) @ m))(z)
        return self._over_lanes(product, params, data, z, multipliers)


class StageBlock(Block):
    """A block of a function of stages, carried to the unknowns of intervals by their polynomials.

    function: (params, data, weight, y) -> rows of a stage; weight is b / count of the quadrature.
    poly: of each stage at which the function is evaluated.
    index, count: [lanes] start of a lane's interval and the phase's duration, both by the
        interval's length; of equal intervals which one the lane is, and how many there are.
    tangents: stage's variables in which the function is not linear; others have no second
        derivatives among themselves.
    """

    def __init__(
        self,
        function: Callable,
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
        self.function, self.layout, self.poly = function, layout, poly
        self.data = (data, np.asarray(index, float), np.asarray(count, float))
        self.unknowns, self.rows, self.tangents = unknowns, rows, tangents
        self.options: dict[str, Any] = {}

    def set_lanes(self, lanes: Any) -> None:
        self.data = (lanes, *self.data[1:])

    def _over_stages(self, function: Callable, params: Any, data: Any, z, *arrays) -> jax.Array:
        """Return function(rows of y, lift, ...) over lanes and stages."""

        def at_stage(params, lane, poly, z, *x):
            own, index, count = lane
            lift = Lift(self.layout, poly, z, index, count)
            weight = poly.b / count
            return function(lambda y: self.function(params, own, weight, y), lift, *x)

        lanes, stages = len(z), len(self.poly.c)
        if lanes >= MANY_LANES:
            at_stage = with_lanes_last(at_stage)
        # one axis of lanes and stages
        of_lane = lambda x: jnp.repeat(x, stages, axis=0)
        poly = jax.tree.map(lambda x: jnp.tile(x, (lanes, *(1,) * (x.ndim - 1))), self.poly)
        lane, z = jax.tree.map(of_lane, (data, z))
        arrays = [x.reshape(lanes * stages, *x.shape[2:]) for x in arrays]
        over_all = jax.vmap(at_stage, (None, 0, 0, 0, *(0 for _ in arrays)))
        results = over_all(params, lane, poly, z, *arrays)
        return results.reshape(lanes, stages, *results.shape[1:])

    def values(self, params: Any, data: Any, z) -> jax.Array:
        rows = self._over_stages(lambda f, lift: f(lift.variables()), params, data, z)
        return rows.reshape(len(z), -1)

    def jacobian(self, params: Any, data: Any, z) -> jax.Array:
        def of_stage(f, lift):
            return lift.pull_back(jax.jacrev(f)(lift.variables()))

        matrix = self._over_stages(of_stage, params, data, z)
        return matrix.reshape(len(z), -1, self.layout.of_interval)

    def hessian(self, params: Any, data: Any, z, multipliers) -> jax.Array:
        def of_stage(f, lift, m):
            y = lift.variables()
            gradient = jax.grad(lambda y: f(y) @ m)
            if not len(self.tangents):
                return lift.curvature(gradient(y))
            g, product = jax.linearize(gradient, y)
            directions = jnp.eye(len(y), dtype=y.dtype)[self.tangents]
            return lift.hessian(self._symmetric(jax.vmap(product)(directions)), g)

        multipliers = multipliers.reshape(len(z), len(self.poly.c), -1)
        return jnp.sum(self._over_stages(of_stage, params, data, z, multipliers), 1)

    def _symmetric(self, rows):
        """Return the Hessian from its rows of `tangents`, which hold all its nonzero entries."""
        place = np.full(self.layout.of_stage, len(self.tangents))
        place[self.tangents] = np.arange(len(self.tangents))
        some = static_take(rows, place)
        return jnp.where((place < len(self.tangents))[:, None], some, some.T)


def find_tangents(block: StageBlock, params: Any, draws) -> np.ndarray:
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
