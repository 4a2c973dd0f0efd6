"""How free a structure is (paper (13)): freedoms, rank, redundant rows."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from svkc.loops.constraint import loop_kinematics
from svkc.loops.coordinates import coordinates
from svkc.loops.pivoting import count_rank, pivot_ratio, pivoted_qr
from svkc.model.chain import Chain, State, active_dofs
from svkc.model.checked_jit import checked_jit


class Mobility(eqx.Module):
    """`freedoms` N_F = N_J - m (13), `joint_freedoms` N_J, `rank` m of the phase, `redundant`: rows
    of each loop that those before it already imply, `independent`: the coordinates chosen as
    theta_G, `margin`: |R_mm| / |R_11|, how far the weakest row that counts is from being redundant.
    Printed, it is a table with the names."""

    freedoms: Int[Array, ""]
    joint_freedoms: Int[Array, ""]
    rank: Int[Array, ""]
    redundant: Int[Array, " links"]
    independent: Bool[Array, " dofs"]
    margin: Float[Array, ""]
    connected: Bool[Array, " links"]
    link_names: tuple[str, ...] = eqx.field(static=True)
    dof_names: tuple[str, ...] = eqx.field(static=True)

    def __str__(self) -> str:
        if isinstance(self.rank, jax.core.Tracer) or self.rank.ndim:
            return repr(self)
        chosen = ", ".join(n for n, on in zip(self.dof_names, self.independent, strict=True) if on)
        lines = [
            f"joint freedoms (N_J)      {int(self.joint_freedoms):4d}",
            f"rank of the loops (m)     {int(self.rank):4d}   margin {float(self.margin):.2e}",
            f"mobility (N_F = N_J - m)  {int(self.freedoms):4d}",
            f"independent coordinates: {chosen or 'none'}",
        ]
        for name, on, rows in zip(self.link_names, self.connected, self.redundant, strict=True):
            lines.append(
                f"  {name}: "
                + (f"6 rows, {int(rows)} of them redundant" if on else "not connected")
            )
        return "\n".join(lines)


@checked_jit(eager=True)
def mobility(chain: Chain, state: State) -> Mobility:
    """Freedoms of the structure that the state is under, with the rank its phase decided on."""
    active = active_dofs(chain, state.structure)
    joint_freedoms = jnp.sum(active, dtype=jnp.int32)
    links = len(chain.link_names)
    if not links:
        zero = jnp.zeros((), jnp.int32)
        one, none = jnp.ones((), state.q.dtype), jnp.zeros(0, jnp.int32)
        return Mobility(
            freedoms=joint_freedoms,
            joint_freedoms=joint_freedoms,
            rank=zero,
            redundant=none,
            independent=active,
            margin=one,
            connected=none > 0,
            link_names=(),
            dof_names=chain.dof_names,
        )
    J = loop_kinematics(chain, state.structure, state.q).J
    # of the first loop's rows, the first two loops', and so on
    upto = np.arange(6 * links)[None] < 6 * np.arange(1, links + 1)[:, None]
    ranks = jax.lax.map(
        lambda rows: count_rank(
            pivoted_qr(jnp.where(rows[:, None], jax.lax.stop_gradient(J), 0)).diag_R
        ),
        jnp.asarray(upto),
    )
    rows = jnp.where(state.structure.connected, 6, 0).astype(jnp.int32)
    redundant = rows - jnp.diff(ranks, prepend=jnp.zeros(1, jnp.int32))
    rank = state.structure.rank
    return Mobility(
        freedoms=joint_freedoms - rank,
        joint_freedoms=joint_freedoms,
        rank=rank,
        redundant=redundant,
        independent=coordinates(chain, state).independent,
        margin=pivot_ratio(pivoted_qr(J, rank)),
        connected=state.structure.connected,
        link_names=chain.link_names,
        dof_names=chain.dof_names,
    )
