"""F6: the records of a run, row by row: what its phases and events leave behind."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from svkc.chain import Chain, State, Structure
from svkc.closure import largest_gaps
from svkc.energy import energy_and_momentum
from svkc.loops import active_dofs
from svkc.marching import Path
from svkc.topology import FREE
from svkc.trajectory import Events, Phases


def no_events(rows: int, links: int, dtype) -> Events:
    """Rows that nothing has been written to: they show, by inf and -1."""
    impulse = jnp.zeros((rows, links, 3), dtype)
    return Events(jnp.full(rows, jnp.inf, dtype), jnp.full(rows, -1, jnp.int32), impulse, impulse, jnp.zeros(rows, dtype), jnp.asarray(0, jnp.int32))


def no_phases(rows: int, links: int, dtype) -> Phases:
    """The same for phases."""
    number, count = jnp.zeros(rows, dtype), jnp.zeros(rows, jnp.int32)
    return Phases(
        start=jnp.full(rows, jnp.inf, dtype),
        stop=jnp.full(rows, jnp.inf, dtype),
        connected=jnp.zeros((rows, links), bool),
        rank=count - 1,
        joint_freedoms=count - 1,
        energy=jnp.zeros((rows, 2), dtype),
        work=number,
        margin=number + 1,
        accepted=count,
        rejected=count,
        evaluations=count,
        swaps=count,
        loop=count - 1,
        error=number,
        gap=jnp.zeros((rows, 2), dtype),
        gap_rate=jnp.zeros((rows, 2), dtype),
        free=jnp.zeros(rows, bool),
        momentum_drift=jnp.zeros((rows, 2), dtype),
        count=jnp.asarray(0, jnp.int32),
    )


def recorded(chain: Chain, p: Phases, row: Bool[Array, " phases"], began: tuple, ended: tuple, work, path: Path, margin, stages: int) -> Phases:
    """With the row of one phase written, where there is one. began, ended: time and state; stages: evaluations of the field in one try of a step."""
    (start, first), (stop, last) = began, ended
    s = first.structure
    both = jax.tree.map(lambda *x: jnp.stack(x), (first.q, first.v), (last.q, last.v))
    energies, linear, angular = jax.checkpoint(jax.vmap(lambda q, v: energy_and_momentum(chain, State(q, v, s))))(*both)
    gaps = jax.vmap(lambda q, v: largest_gaps(*jax.lax.stop_gradient((chain, State(q, v, s)))))(*both)
    gap, gap_rate = (jnp.max(x, 0) for x in gaps)
    linear, angular = jax.lax.stop_gradient((linear, angular))
    free = _free(chain, s)
    written = {
        "start": start, "stop": stop, "connected": s.connected, "rank": s.rank, "joint_freedoms": jnp.sum(active_dofs(chain, s), dtype=jnp.int32),
        "energy": energies, "work": work, "margin": jnp.minimum(margin, path.tally.margin), "accepted": path.accepted, "rejected": path.rejected,
        "evaluations": stages * path.tally.tries, "swaps": path.tally.swaps, "loop": path.tally.loop, "error": path.tally.error,
        "gap": jnp.maximum(gap, path.tally.gap), "gap_rate": gap_rate, "free": free,
        "momentum_drift": jnp.where(free, _momentum_drift(chain, linear, angular, stop - start), 0),
    }  # fmt: skip
    new = {name: jnp.where(row.reshape(-1, *(1,) * jnp.ndim(x)), jnp.asarray(x)[None], getattr(p, name)) for name, x in written.items()}
    return Phases(**new, count=p.count + jnp.any(row).astype(jnp.int32))


def _free(chain: Chain, s: Structure) -> Bool[Array, ""]:
    """Whether nothing holds the bodies to the ground: every tree hangs on it by a free joint, and no loop does."""
    top = chain.topology
    roots = [i for i in range(1, len(top.parent)) if top.parent[i] == 0]
    if not roots or any(top.kind[i] != FREE for i in roots):
        return jnp.zeros((), bool)
    return ~jnp.any(s.connected & ((s.parent == 0) | (s.real == 0)))


def _momentum_drift(chain: Chain, linear: Float[Array, "2 3"], angular: Float[Array, "2 3"], span) -> Float[Array, "2"]:
    """Change of linear momentum (N s) that gravity does not explain, and of the angular momentum about the centre of mass (N m s)."""
    fallen = jnp.sum(chain.mass) * chain.gravity * span
    return jnp.stack([jnp.linalg.norm(linear[1] - linear[0] - fallen), jnp.linalg.norm(angular[1] - angular[0])])


def stages(solver: diffrax.AbstractSolver) -> int:
    """Evaluations of the vector field in one try of a step; Newton iterations of implicit stages are not counted."""
    tableau = getattr(solver, "tableau", None)
    return len(np.asarray(tableau.b_sol)) if isinstance(tableau, diffrax.ButcherTableau) else 1
