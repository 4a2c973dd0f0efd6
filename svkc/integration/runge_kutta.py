"""Single steps of a solver, in the form that is differentiated."""

from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc.integration.ode import FieldArgs, ODEState
from svkc.integration.vector_field import VectorField, project_state


def _without_last_stage(tableau: diffrax.ButcherTableau) -> diffrax.ButcherTableau:
    """Return an explicit tableau without its last stage, whose weights are zero."""
    assert tableau.b_sol[-1] == tableau.b_error[-1] == 0
    return diffrax.ButcherTableau(
        c=tableau.c[:-1],
        b_sol=tableau.b_sol[:-1],
        b_error=tableau.b_error[:-1],
        a_lower=tableau.a_lower[:-1],
    )


def with_scan_kind(
    solver: diffrax.AbstractSolver[Any], kind: str | None
) -> diffrax.AbstractSolver[Any]:
    """Return a Runge-Kutta solver whose loop over stages is of this kind; others as they are.

    kind: "lax" for forward mode, "bounded" for both modes, None for diffrax's own choice.
    """
    if not isinstance(solver, diffrax.AbstractRungeKutta):
        return solver
    return eqx.tree_at(lambda s: s.scan_kind, solver, kind, is_leaf=lambda x: x is None)


class _Dopri8WithoutDenseOutput(diffrax.Dopri8):
    """Dopri8 without its fourteenth stage, which serves the dense output alone."""

    tableau: ClassVar[diffrax.ButcherTableau] = _without_last_stage(diffrax.Dopri8.tableau)
    interpolation_cls: ClassVar[Any] = diffrax.LocalLinearInterpolation


def without_dense_output(solver: diffrax.AbstractSolver[Any]) -> diffrax.AbstractSolver[Any]:
    """Return a solver with these steps and error estimates that evaluates no stage for its dense
    output alone.

    Only Dopri8 has such a stage, its last. It is also the first of the next step, but not after a
    projection, which changes the state.
    """
    if type(solver) is not diffrax.Dopri8:
        return solver
    return _Dopri8WithoutDenseOutput(scan_kind=solver.scan_kind)


def replay_step(
    solver: diffrax.AbstractSolver[Any],
    field: VectorField,
    t0: Float[Array, ""],
    t1: Float[Array, ""],
    y: ODEState,
    field_args: FieldArgs,
) -> ODEState:
    """Take one projected step that depends on no earlier step, to be differentiated.

    Reverse mode stores the arguments of each evaluation of the field and of each iteration of the
    projection, and recomputes everything else.
    """
    rate = eqx.filter_checkpoint(field)
    if isinstance(solver, diffrax.AbstractERK) and isinstance(
        solver.tableau, diffrax.ButcherTableau
    ):
        y1 = _explicit_step(solver.tableau, rate, t0, t1, y, field_args)
    else:
        solver = with_scan_kind(solver, "bounded")
        term = diffrax.ODETerm(rate)
        solver_state = solver.init(term, t0, t1, y, field_args)
        y1 = solver.step(term, t0, t1, y, field_args, solver_state, made_jump=False)[0]
    return project_state(field, field_args, y1)[0]


def _explicit_step(
    tableau: diffrax.ButcherTableau, rate, t0, t1, y: ODEState, field_args: FieldArgs
) -> ODEState:
    """Take an explicit Runge-Kutta step as a scan over its stages.

    Stages that serve the error estimate alone are skipped.

    rate: vector field.
    """
    count = int(np.max(np.flatnonzero(tableau.b_sol))) + 1
    A = np.zeros((count, count))
    for i, row in enumerate(tableau.a_lower[: count - 1]):
        A[i + 1, : i + 1] = row
    c, dtype = np.append(0.0, tableau.c)[:count], t1.dtype
    add = lambda weights, rates: jax.tree.map(
        lambda y, k: y + (t1 - t0) * jnp.tensordot(weights, k, 1), y, rates
    )

    def stage(rates, x):
        weights, fraction, is_row = x
        k = rate(t0 + fraction * (t1 - t0), add(weights, rates), field_args)
        write = lambda ks, k: jnp.where(is_row.reshape(-1, *(1,) * k.ndim), k[None], ks)
        return jax.tree.map(write, rates, k), None

    zeros = jax.tree.map(lambda y: jnp.zeros((count, *y.shape), y.dtype), y)
    stages = (jnp.asarray(A, dtype), jnp.asarray(c, dtype), np.eye(count, dtype=bool))
    rates, _ = jax.lax.scan(stage, zeros, stages)
    return add(jnp.asarray(tableau.b_sol[:count], dtype), rates)
