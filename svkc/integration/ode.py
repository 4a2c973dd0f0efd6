"""The state and the arguments of the ordinary differential equation of one phase."""

from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from svkc.loops.constraint_rows import RowChoice
from svkc.model.chain import Chain, Structure

# a time (s)
Time: TypeAlias = Float[Array, ""]
# the guards of a phase: one number for each
Guards: TypeAlias = Float[Array, " guards"]
# start, end and save times of a phase (s)
Times: TypeAlias = tuple[Float[Array, ""], Float[Array, ""], Float[Array, " times"]]


class ODEState(eqx.Module):
    """The integrated state: q, v and the work (J) done by control, by dampers and by joint limits.

    work: None where the scene has neither control nor dampers nor joint limits.
    """

    q: Float[Array, " q"]
    v: Float[Array, " dofs"]
    work: Float[Array, "3"] | None = None


class FieldArgs(eqx.Module):
    """The `args` of the vector field: everything it depends on besides time and state.

    args: the user's `args`, passed on to control and guards.
    pivots: pivots of the loops' rows that are reused instead of selected anew
        (`AbstractDynamics.hold`). None: select pivots at every evaluation.
    row_choice: rows of the loops that articulated bodies use. None: all.
    """

    chain: Chain
    structure: Structure
    args: Any
    pivots: Float[Array, "steps dofs"] | None = None
    row_choice: RowChoice | None = None


def is_finite(y: ODEState) -> Bool[Array, ""]:
    """Return whether every number of a state is finite."""
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(y)]))


def rms_norm(y: ODEState) -> Float[Array, ""]:
    """Return the root mean square over q and v. Work does not influence the step size."""
    both = jnp.concatenate([y.q, y.v])
    return jnp.sqrt(jnp.mean(both * both))
