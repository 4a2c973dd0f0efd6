"""Row blocks with derivatives in closed form: equations of motion, connections, projections."""

import functools
from collections.abc import Callable
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from svkc._jax.lanes_last import with_lanes_last
from svkc.optimize.blocks import (
    MANY_LANES,
    Multipliers,
    PlainBlock,
    StageBlock,
    Unknowns,
    lower_half,
)
from svkc.optimize.closed_forms import (
    ConnectionDerivatives,
    ProjectionDerivatives,
    StageDerivatives,
)
from svkc.optimize.equations import Model, connection, projection, stage_equations
from svkc.optimize.lift import Lift, StagePolynomials, motion_hessian_pattern

DerivativesOfNode: TypeAlias = ConnectionDerivatives | ProjectionDerivatives


class MotionBlock(StageBlock):
    """A row block of `stage_equations`, for chains with closed forms.

    model: static part of the equations. options: keyword arguments of `StageBlock`.
    """

    def __init__(self, model: Model, poly: StagePolynomials, **options: Any):
        call = functools.partial(stage_equations, model)
        super().__init__(call, model.layout, poly, **options)
        self.model = model

    def _derivatives(self, params: Any, own: Any, lift: Lift) -> StageDerivatives:
        """Return the derivatives at one stage. own: data of the lane."""
        return StageDerivatives(self.model, params, own, lift.variables())

    def jacobian(self, params: Any, data: Any, z: Unknowns) -> jax.Array:
        def at_stage(params, own, lift):
            return lift.pull_back(self._derivatives(params, own, lift).jacobian())

        return self._join_stages(jnp.ravel, at_stage, params, data, z)

    def hessian(self, params: Any, data: Any, z: Unknowns, multipliers: Multipliers) -> jax.Array:
        def at_stage(params, own, lift, m):
            return lift.motion_hessian(*self._derivatives(params, own, lift).hessian(m))

        multipliers = multipliers.reshape(len(z), len(self.poly.c), -1)
        total = lambda x: jnp.sum(x, 0)
        return self._join_stages(total, at_stage, params, data, z, multipliers)

    @property
    def hessian_pattern(self) -> tuple[np.ndarray, np.ndarray]:
        return motion_hessian_pattern(self.layout)


class NodeBlock(PlainBlock):
    """A row block of a function of nodes, for chains with closed forms.

    function: (model, params, data, unknowns) -> rows.
    derivatives: class of the function's derivatives.
    """

    def __init__(
        self,
        model: Model,
        function: Callable[..., jax.Array],
        derivatives: type[DerivativesOfNode],
        *args: Any,
    ):
        super().__init__(functools.partial(function, model), *args)
        self.model = model
        self.derivatives = derivatives

    def jacobian(self, params: Any, data: Any, z: Unknowns) -> jax.Array:
        def at_lane(params, data, z):
            return self.derivatives(self.model, params, data, z).jacobian().ravel()

        return self._over(at_lane, params, data, z)

    def hessian(self, params: Any, data: Any, z: Unknowns, multipliers: Multipliers) -> jax.Array:
        def at_lane(params, data, z, m):
            return lower_half(self.derivatives(self.model, params, data, z).hessian(m))

        return self._over(at_lane, params, data, z, multipliers)

    @staticmethod
    def _over(at_lane: Callable, params: Any, data: Any, z: Unknowns, *arrays) -> jax.Array:
        """Return at_lane(params, data, z, ...) over lanes."""
        if len(z) >= MANY_LANES:
            at_lane = with_lanes_last(at_lane)
        return jax.vmap(at_lane, (None, 0, 0, *(0 for _ in arrays)))(params, data, z, *arrays)


# class of the derivatives of each function of nodes that has closed forms
CLOSED_FORMS: dict[Callable[..., jax.Array], type[DerivativesOfNode]] = {
    connection: ConnectionDerivatives,
    projection: ProjectionDerivatives,
}
